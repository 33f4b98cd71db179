"""Draw speed against error of the scene `hair` before and after edge-rotation updates, from the tables of `ddg-warp bench hair`.

python tools/draw_hair.py

Writes tools/results/bench_cpu/hair_before_after.png and tools/results/bench_h200/hair_before_after.png.
"""

import csv
from pathlib import Path

from ddg_warp.run.plots import error_plot

RESULTS = Path(__file__).parent / "results"
TABLES = {"bench_cpu": "hair", "bench_h200": "hair_strands_512"}
TIME, ERROR, RUN = "time of 0.5 s [s]", "largest error of a node [m]", "run"


def main() -> None:
    for folder, name in TABLES.items():
        rows = []
        for when, suffix in (("before", "_before"), ("after", "")):
            with open(RESULTS / folder / f"{name}{suffix}.csv", newline="") as file:
                rows += [
                    {TIME: float(row["seconds"]), ERROR: float(row["error"]), RUN: f"{when}, {row['precision']}"}
                    for row in csv.DictReader(file)
                ]
        error_plot(RESULTS / folder / "hair_before_after.png", rows, TIME, ERROR, RUN, "hair, steps of 1/30 to 1/960 s")


if __name__ == "__main__":
    main()
