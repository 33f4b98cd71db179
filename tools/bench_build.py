"""Time the work before the first step: scenes, models, rest shapes, states, controls and kernels.

    python tools/bench_build.py [--quick] [--only WHAT ...] [--json FILE]   seconds of this version
    python tools/bench_build.py --rows FILE --against FILE [--out DIR]      a table of them and those of another version

`pile`: the scene `rod_pile` and its model. `sag_free`: rest strains of strands of 32 nodes. `rods`: scene and model of rods of 64
nodes. `state`, `points`: their rest state, and its points. `controls`: a step with forces, poses and gravity of every world, less a
step without. `cold`: `rod_pile` of six rods up to its first step, in a process with an empty kernel cache. `seconds` is process
time, which other work on the machine does not change, and `wall` is elapsed time. `floor` is the time of one NumPy copy of
the bytes of the result. Only the public interface is used, so that the file also runs with other versions of the package.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.postprocess import sag_free
from ddg_warp.run.summary import machine, table, write_json, write_table
from ddg_warp.scenes import hair, rod_pile

DT = 1.0 / 240.0  # s
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
SIZES = {"pile": 10_000, "sag_free": 10_000, "rods": 100_000, "controls": 2_048, "cold": 6}
QUICK = {"pile": 30, "sag_free": 10, "rods": 10, "controls": 2, "cold": 6}
COLD = """
import time, warnings
warnings.simplefilter("ignore")
import ddg_warp as ddg
from ddg_warp.scenes import rod_pile
scene = rod_pile.build(count={count})
model = scene.build("cpu")
ddg.Integrator(model).step(model.state(), scene.analysis.dt)
print(time.process_time())
"""


def timed(call):
    """Return the result of a call, process time [s] and time that passes [s]."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = call()
    return result, time.process_time() - cpu, time.perf_counter() - wall


def bandwidth() -> float:
    """Return the bytes of a copy per second, read once and written once."""
    values = np.ones(2**22)
    out = values.copy()
    return values.nbytes / min(timed(lambda: np.copyto(out, values))[1] for _ in range(5))


def straight(count: int, nodes: int) -> np.ndarray:
    """Return points of parallel rods (count, nodes, 3) [m]."""
    points = np.zeros((count, nodes, 3))
    points[:, :, 0] = np.linspace(0.0, 1.0, nodes)
    points[:, :, 1] = 0.1 * np.arange(count)[:, None]
    return points


def pile(count: int):
    yield "pile", count * 50 * 13 * 8, *timed(lambda: rod_pile.build(count=count).build("cpu"))[1:]


def rest_strains(count: int):
    model = hair.build(count, 32).build("cpu")
    sag_free.rest_strains(hair.build(2, 32).build("cpu"))  # loads the kernels
    yield "sag_free", count * 32 * 4 * 8, *timed(lambda: sag_free.rest_strains(model))[1:]


def rods(count: int):
    points = straight(count, 64)

    def build():
        scene = ddg.Scene()
        scene.clamp(scene.add_rods(points, section=ddg.Circle(0.01), material=RUBBER))
        return scene.build("cpu", "float64")

    model, *seconds = timed(build)
    yield "rods", count * 64 * 13 * 8, *seconds
    state, *seconds = timed(model.state)
    yield "state", count * 64 * 10 * 8, *seconds
    yield "points", count * 64 * 3 * 8, *timed(state.points)[1:]


def controls(worlds: int):
    device = "cuda:0" if wp.is_cuda_available() else "cpu"
    scene = ddg.Scene()
    scene.clamp(scene.add_rods(straight(1, 64), section=ddg.Circle(0.01), material=RUBBER), motion=ddg.Grip())
    model = scene.build(device, worlds=worlds)
    integrator, state = ddg.Integrator(model), model.state()
    forces, poses = np.zeros((worlds, 64, 3)), np.zeros((worlds, 1, 6))
    gravity = np.tile(scene.gravity, (worlds, 1))

    def step(*controls):
        integrator.step(state, DT, *controls)
        wp.synchronize_device(model.wp_device)

    controls = ddg.Controls(poses, forces, gravity=gravity)
    step(controls)
    step()
    with_controls, without = (
        np.min([timed(lambda f=inputs: step(*f))[1:] for _ in range(5)], axis=0) for inputs in ((controls,), ())
    )
    yield "controls", forces.nbytes, *(with_controls - without).tolist()
    yield "a step without", 0, *without.tolist()


def cold(count: int):
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"WARP_CACHE_PATH": cache}
        command = [sys.executable, "-c", COLD.format(count=count)]
        began = time.perf_counter()
        output = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
        yield "cold", 0, float(output.split()[-1]), time.perf_counter() - began


CASES = {"pile": pile, "sag_free": rest_strains, "rods": rods, "controls": controls, "cold": cold}


def measured(options) -> dict:
    """Return the rows of this version, with their command and machine."""
    sizes, rows, speed = QUICK if options.quick else SIZES, [], bandwidth()
    for name in options.only:
        for label, size, seconds, wall in CASES[name](sizes[name]):
            floor = size / speed if size else ""
            rows.append({"what": label, "size": sizes[name], "seconds": seconds, "wall": wall, "floor": floor})
            print(table(rows[-1:]).splitlines()[1], file=sys.stderr, flush=True)
    command = " ".join(["python", "tools/bench_build.py", *sys.argv[1:]])
    return {"command": command, "machine": machine(), "rows": rows}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smallest sizes")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases (default: all)")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--rows", type=Path, help="rows of this version, which are measured otherwise")
    parser.add_argument("--against", type=Path, help="rows of another version")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="default: tools/results")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    wp.config.quiet = True
    result = json.loads(options.rows.read_text()) if options.rows else measured(options)
    if options.json:
        write_json(options.json, result)
    rows = result["rows"]
    if options.against:
        earlier = json.loads(options.against.read_text())
        before = {row["what"]: row for row in earlier["rows"]}
        rows = [
            {"what": row["what"], "size": row["size"]}
            | {f"{name}_before": before[row["what"]][name] for name in ("seconds", "wall")}
            | {name: row[name] for name in ("seconds", "wall", "floor")}
            for row in rows
        ]
        origin = {name: result[name] for name in ("command", "machine")}
        write_table(options.out / "build_cpu", rows, {**origin, "before": earlier["machine"]["commit"]})
    print(table(rows))


if __name__ == "__main__":
    main()
