"""Compare the element kernels of two checkouts: registers on a GPU, without one, and time on the CPU.

    python tools/bench_elements.py --base TREE [--out DIR]

Builds the kernels of a Newton iteration and of the adjoint of several kinds of elements for sm_90. From the binaries it reads
registers, stack [B] and code [kB]. On the CPU it times the first of these alone, and whole steps, each the least of many, in
alternating processes of both checkouts. TREE is another checkout with its kernels and scenes next to the package (links
`ddg_warp/kernels` and `ddg_warp/scenes`).
Prints two tables; writes elements_registers.csv, elements_cpu.csv and their .json.
"""

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.adjoint.coupled_step import CoupledStepAdjoint
from ddg_warp.adjoint.rod_step import RodStepAdjoint
from ddg_warp.run.summary import machine, table, write_table

RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
RADIUS, DT, ROUNDS, LAUNCHES, STEPS = 0.02, 0.01, 3, 300, 60
REGISTERS, STACK = 0x2F, 0x12  # attributes of cubins: EIATTR_REGCOUNT, EIATTR_MIN_STACK_SIZE


def scene(kind: str, rods: int, nodes: int) -> ddg.Scene:
    """Return cantilevers side by side, uncoupled or each hinged to a clamped stub."""
    plane = kind.startswith("planar")
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), dimension=2 if plane else 3)
    points = np.zeros((rods, nodes, 3))
    points[:, :, 0] = np.linspace(0.0, 1.0, nodes)
    if "exact" in kind:
        points[:, :, 1] = 0.2 * np.sin(3.0 * points[:, :, 0])
        points[:, :, 2] = 0.2 * np.cos(3.0 * points[:, :, 0])
    points[:, :, 2 if plane else 1] += 10.0 * RADIUS * np.arange(rods)[:, None]
    options = {"section": ddg.Circle(RADIUS), "material": RUBBER} | ({"twist": False} if "twist-free" in kind else {})
    long = scene.add_rods(points, **options)
    scene.clamp(long, edges=[0])
    if kind.startswith("net"):
        stubs = scene.add_rods(points[:, :3] - points[:, 2:3] + points[:, :1], **options)
        scene.clamp(stubs, edges=[0, 1])
        for rod, stub in zip(long, stubs, strict=True):
            scene.join([(int(rod), 0), (int(stub), -1)], rigid=False)
    return scene


KINDS = (
    ("twisted", "float64"),
    ("twisted", "mixed"),
    ("twisted", "float32"),
    ("twisted exact", "mixed"),
    ("twisted exact", "float64"),
    ("twist-free", "float32"),
    ("twist-free", "mixed"),
    ("planar", "mixed"),
    ("planar", "float64"),
    ("net", "mixed"),
    ("net exact", "mixed"),
    ("net exact", "float64"),
)
TIMED = ("twisted", "planar", "twisted exact", "net", "net exact")


def newton_of(integrator):
    """Return the solver of the uncoupled rods, or of the coupled system."""
    return (integrator._coupled or integrator._rod_steps[0]).newton


def cubin(data: bytes) -> dict:
    """Return registers, stack and code of the one kernel in a cubin, which is an ELF file."""
    start, size, count, names = struct.unpack_from("<Q", data, 0x28) + struct.unpack_from("<HHH", data, 0x3A)
    heads = [struct.unpack_from("<IIQQQQ", data, start + i * size) for i in range(count)]

    def name(head) -> str:
        position = heads[names][4] + head[0]
        return data[position : data.index(b"\0", position)].decode()

    attributes = {"registers": 0, "stack": 0, "code_kb": 0.0}
    for head in heads:
        offset, length = head[4], head[5]
        if name(head).startswith(".text."):
            attributes["code_kb"] += length / 1e3
        if name(head) == ".nv.info":
            position = offset
            while position < offset + length:
                form, attribute, more = struct.unpack_from("<BBH", data, position)
                if form == 4 and attribute in (REGISTERS, STACK):
                    key = "registers" if attribute == REGISTERS else "stack"
                    attributes[key] = max(attributes[key], struct.unpack_from("<I", data, position + 8)[0])
                position += 4 + (more if form == 4 else 0)
    return attributes


def registers() -> list[dict]:
    """Return a row for every kind of element."""
    device_arrays.serial = lambda device: False  # kernels as a GPU runs them: one thread an element
    rows = []
    for kind, precision in KINDS:
        model = scene(kind, 2, 9).build("cpu", precision)
        integrator = ddg.Integrator(model)
        if model.coupled is not None:
            terms = [part.term for part in model.coupled.sets]
            kernels = [kernel for kernel, _ in newton_of(integrator).elements.kernels]
            reverse = CoupledStepAdjoint(model, "implicit_euler")._vjp
        else:
            (group,) = model.groups
            terms, kernels = group.kind.terms, [newton_of(integrator)._evaluate]
            reverse = RodStepAdjoint(model, group, "implicit_euler")._vjp
        of_terms = [f" {term.name}" for term in terms]
        named = list(zip(of_terms if len(kernels) == len(terms) > 1 else [""], kernels, strict=True))
        if precision == "float64":
            reverse = reverse if isinstance(reverse, list) else [reverse]
            each = of_terms if len(reverse) == len(of_terms) else [""]
            named += zip([f"{term}, adjoint" for term in each], reverse, strict=True)
        for name, kernel in named:
            with tempfile.TemporaryDirectory() as folder:
                wp.compile_aot_module(kernel.module, arch=90, module_dir=folder, use_ptx=False)
                (path,) = Path(folder).rglob("*.cubin")
                rows.append({"kernel": f"{kind}{name}", "precision": precision} | cubin(path.read_bytes()))
    return rows


def times() -> list[dict]:
    """Return the least times of the kernel and of a step [us] for every kind of element in float64."""
    rows = []
    for kind in TIMED:
        model = scene(kind, 100, 50).build("cpu", "float64")
        integrator, state = ddg.Integrator(model, check_every=1), model.state()
        state = integrator.step(state, DT)
        newton, steps = newton_of(integrator), []
        for _ in range(STEPS if not kind.startswith("net") else STEPS // 4):
            began = time.perf_counter()
            state = integrator.step(state, DT)
            steps.append(time.perf_counter() - began)
        lasts, launches = state.coupled if model.coupled else state.groups[0].last, []
        newton.islands.status.zero_()
        with wp.ScopedCapture("cpu", force_module_load=False) as capture:
            newton.evaluate(lasts)
        for _ in range(LAUNCHES):
            began = time.perf_counter()
            wp.capture_launch(capture.graph)
            launches.append(time.perf_counter() - began)
        newton_count = integrator.statistics()["newton_iterations"]["mean"]
        rows.append(
            {"kind": kind, "kernel_us": 1e6 * min(launches), "step_us": 1e6 * min(steps), "newton": newton_count}
        )
    return rows


def work(tree: Path | None, task: str) -> list[dict]:
    """Return the rows of a process of a checkout, or of this one."""
    path = {"PYTHONPATH": str(tree)} if tree else {}
    command = [sys.executable, __file__, "--work", task]
    done = subprocess.run(command, env=os.environ | path, stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", type=Path, help="checkout to compare with")
    parser.add_argument("--base-commit", default="", help="its commit")
    parser.add_argument("--only", choices=("registers", "times"), help="one of the tables alone")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--work", choices=("registers", "times"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    wp.config.quiet = True
    if chosen.work:
        print(json.dumps(registers() if chosen.work == "registers" else times()))
        return 0
    about = {
        "command": "python tools/bench_elements.py --base TREE",
        "base": chosen.base_commit,
        "warp": wp.__version__,
        "machine": machine(""),
    }
    if chosen.only != "times":
        each = {"before": work(chosen.base, "registers"), "after": work(None, "registers")}
        by_kernel = {when: {(row["kernel"], row["precision"]): row for row in rows} for when, rows in each.items()}
        rows = [
            {"kernel": kernel, "precision": precision}
            | {
                f"{name}_{when}": rows_of.get((kernel, precision), {}).get(name, "")
                for name in ("registers", "stack", "code_kb")
                for when, rows_of in by_kernel.items()
            }
            for kernel, precision in dict.fromkeys([*by_kernel["before"], *by_kernel["after"]])
        ]
        write_table(chosen.out / "elements_registers", rows, about)
        print(table(rows))
    if chosen.only != "registers":
        runs = [(work(chosen.base, "times"), work(None, "times")) for _ in range(ROUNDS)]
        rows = []
        for i, kind in enumerate(TIMED):
            row = {"kind": kind}
            for name in ("kernel_us", "step_us"):
                old, new = (min(run[tree][i][name] for run in runs) for tree in (0, 1))
                row |= {f"{name}_before": old, f"{name}_after": new, f"{name[:-3]}_ratio": new / old}
            row |= {"newton_before": runs[0][0][i]["newton"], "newton_after": runs[0][1][i]["newton"]}
            rows.append(row)
        write_table(chosen.out / "elements_cpu", rows, about)
        print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
