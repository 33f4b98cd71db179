"""Bad inputs as data: actions, and words of their refusals.

`python tests/contracts/bad_inputs.py` counts them.
"""

from __future__ import annotations

import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes

DEVICE = "cpu"  # refusals come from the host
NAN, INF = float("nan"), float("inf")
STIFFNESS = ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0, mass_per_length=1.0, rotary_inertia=0.01, radius=1e-3)
RUBBER = ddg.Material(young=1e7, poisson=0.3, density=1000.0)
RING = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
DOME = np.column_stack([np.sin(np.linspace(0.0, 1.0, 6)), np.cos(np.linspace(0.0, 1.0, 6))])
TUBE = np.column_stack([np.ones(6), np.linspace(0.0, 1.0, 6)])


@dataclass(frozen=True)
class Case:
    """Action that must be refused: `action()` raises an error with the words in its message."""

    group: str
    name: str
    action: Callable[[], object]
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.group}: {self.name}"


CASES: list[Case] = []


def refuse(group: str, table: dict[str, tuple]) -> None:
    """Add cases: name -> (action, *words)."""
    CASES.extend(Case(group, name, action, words) for name, (action, *words) in table.items())


def each(group: str, name: str, values, action, *words: str) -> None:
    """Add a case for each of some values of one argument."""
    refuse(group, {f"{name} {value!r:.40}": (lambda value=value: action(value), *words) for value in values})


def line(nodes: int = 5, **moved) -> np.ndarray:
    """Return a straight rod along x; `n3=(1, 2, 3)` moves node 3."""
    points = np.zeros((nodes, 3))
    points[:, 0] = np.linspace(0.0, 1.0, nodes)
    for name, value in moved.items():
        points[int(name[1:])] = value
    return points


def rods(points=None, scene: ddg.Scene | None = None, **options) -> ddg.Scene:
    """Add a valid rod 0 of 7 nodes, and rod 1, 'odd', by default of 5."""
    scene = scene or ddg.Scene()
    scene.add_rod(line(7), section=STIFFNESS)
    scene.add_rod(line() if points is None else points, **({"section": STIFFNESS, "name": "odd"} | options))
    return scene


def sheet(cells: int = 3, scene: ddg.Scene | None = None, **options) -> ddg.Scene:
    """Add a square sheet, shell 0, of (cells + 1)^2 vertices: (i, j) is i + (cells + 1) j."""
    scene = scene or ddg.Scene()
    settings = {"thickness": 0.01, "material": RUBBER, "name": "sheet"} | options
    scene.add_shell(*meshes.rectangle(cells, cells), **settings)
    return scene


def dome(points=DOME, **options) -> ddg.Scene:
    """Return a scene with a shell of revolution of 6 nodes, the first at the pole."""
    scene = ddg.Scene()
    scene.add_axisymmetric_shell(points, **({"thickness": 0.01, "material": RUBBER, "name": "dome"} | options))
    return scene


def clamped() -> ddg.Scene:
    """Return `rods`, each clamped at the first edge."""
    scene = rods()
    scene.clamp([0, 1])
    return scene


@cache
def model(kind: str = "rods", worlds: int = 1):
    """Return a valid model, built once: rods, rods joined (`net`), or a clamped sheet of a bending model."""
    if kind == "rods":
        scene = clamped()
    elif kind == "net":
        scene = clamped()
        scene.join([(0, 0), (1, 0)])
    else:
        scene = sheet(2, bending=kind)
        scene.clamp_boundary(0, [0, 1, 2])
    return scene.build(DEVICE, "float64", worlds=worlds)


@cache
def integrator(kind: str = "rods"):
    """Return an integrator of a valid model, made once."""
    return ddg.Integrator(model(kind))


def built(scene: ddg.Scene, *changes: Callable[[ddg.Scene], object]):
    """Apply changes to a scene, and build the model."""
    for change in changes:
        change(scene)
    return scene.build(DEVICE, "float64")


def is_bare(error: Exception) -> bool:
    """Return True if an error of Python, NumPy or another library names no object."""
    raised_in = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    packaged = type(error).__module__.startswith("ddg_warp") or Path(ddg.__file__).parent in raised_in.parents
    return not (isinstance(error, ValueError | SolverError) and packaged)


def verdict(case: Case) -> str:
    """Return the outcome of a case: "refused", "silent", "bare", or "unclear" where words are missing."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            case.action()
    except Exception as error:
        if is_bare(error):
            return "bare"
        return "refused" if all(word in str(error) for word in case.words) else "unclear"
    return "silent"


def counts() -> Counter:
    """Return the number of cases by group, of all modules."""
    for path in sorted(Path(__file__).parent.glob("bad_input_*.py")):
        import_module(path.stem)
    return Counter(case.group for case in import_module("bad_inputs").CASES)


if __name__ == "__main__":
    by_group, cases = counts(), import_module("bad_inputs").CASES
    print("\n".join(f"{number:4}  {group}" for group, number in by_group.items()))
    print(f"{sum(by_group.values()):4}  in all")
    verdicts = {str(case): verdict(case) for case in cases}
    for name, said in verdicts.items():
        if said != "refused":
            print(f"{said}: {name}")
    times = Counter(verdicts.values())
    print(", ".join(f"{times[said]} {said}" for said in ("refused", "silent", "bare", "unclear")))
