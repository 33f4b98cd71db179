"""Measure the PPO of the tutorial: mean return of 64 episodes before and after training, for several seeds, on the CPU.

    python tools/bench_ppo.py [--out DIR]       ppo_cpu.csv and ppo_cpu.json in DIR (default: tools/results)

The code is the page's, with another seed. `training_s` includes the evaluations and compilation.
"""

import argparse
import os
import re
import time
from pathlib import Path

from ddg_warp.run.summary import machine, table, write_table

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "tools" / "docs" / "tutorials" / "ppo.md"
SEEDS = (0, 1, 2)


def measure(seed: int) -> dict:
    """Run the first two blocks of the page with a seed and return steps, returns and time [s]."""
    task, training, *_ = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    names, began = {}, time.perf_counter()
    exec(task.replace("seed=0", f"seed={seed}"), names)
    exec(training, names)
    steps = names["policy"].num_timesteps
    took = time.perf_counter() - began
    return {
        "seed": seed,
        "steps": steps,
        "before": float(names["before"]),
        "after": float(names["after"]),
        "training_s": took,
    }


def main() -> None:
    """Measure all seeds and write the table."""
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--out", type=Path, default=ROOT / "tools" / "results")
    chosen = arguments.parse_args()
    rows = [measure(seed) for seed in SEEDS]
    print(table(rows))
    origin = {"command": "python tools/bench_ppo.py", "machine": machine(), "load_average": os.getloadavg()[0]}
    write_table(chosen.out / "ppo_cpu", rows, origin)


if __name__ == "__main__":
    main()
