"""Pinched cylinder: two forces crush a thin cylinder between rigid diaphragms.

Case 3.6 of Sze, Liu and Lo (2004). At small loads the wall dips by 164.24 P / (E h) (Lindberg, Olson and Cowper 1969). The dimple
is a tenth of the radius wide, and the mesh is graded for it; at larger loads it snaps from fold to fold.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _sze

RADIUS, LENGTH, THICKNESS = 100.0, 200.0, 1.0  # m
YOUNG, POISSON = 30.0e3, 0.3  # Pa, 1
FORCE = 12.0e3  # N
LINEAR = 164.24  # w E h / P at small loads
SOURCE = "Lindberg, Olson and Cowper 1969"


def build(
    n: int = 12,
    load: float = 1.0,
    grading: float = 4.0,
    pattern: str = "crossed",
    membrane: str = "flat",
    steps: int = 40,
) -> ddg.Scene:
    """Build an eighth of the cylinder about z, pressed along x.

    Args:
        n: cells around a quarter and along half of the cylinder
        load: fraction of the load
        grading: ratio of even to graded cell width under the force; 1 for an even mesh
        pattern: how cells become triangles: right, alternating, crossed or jittered
        membrane: flat or curved, see Scene.add_shell; here, where a dimple bends the wall, flat ones are twice as exact
        steps: load steps
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=steps))
    flat, triangles = _sze.sheet(n, n, (1.5 * RADIUS, 0.5 * LENGTH), pattern)
    flat = flat * (1.0 + (grading - 1.0) * flat) / grading
    shell = {"thickness": THICKNESS, "material": ddg.Material(density=1.0, young=YOUNG, poisson=POISSON)}
    cylinder = _sze.add_octant(scene, flat, triangles, RADIUS, 0.5 * LENGTH, membrane=membrane, **shell)
    scene.hold(cylinder, _sze.side(flat, 1, 1.0), "xy")
    scene.add_vertex_force(cylinder, [0], (-0.25 * load * FORCE, 0.0, 0.0))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the inward displacement under the force [m]."""
    return {"inwards": -_sze.displacement(model, state, 0, 0)}


def compliance(model) -> float:
    """Return w E h / P of the cylinder at rest, from the tangent there."""
    from ddg_warp.solve.equilibrium.tangent import Tangent
    from ddg_warp.solve.linear.sparse_direct import Factorisation

    tangent, state = Tangent(model), model.state()
    free = np.flatnonzero(tangent.free)
    loads = tangent.loads(1.0, tangent.dofs(state))
    step = Factorisation(tangent.hessian(state)[free][:, free]).solve(loads[free])
    return float(loads[free] @ step) / np.abs(loads).sum() ** 2 * 0.25 * YOUNG * THICKNESS


def check(result) -> list[ddg.Check]:
    """Check the compliance at rest, to 4 % at 12 cells: a point force has an error of the size of its cells."""
    name = "w E h / P at rest"
    return [ddg.Check(name, compliance(result.model), LINEAR, 0.04, SOURCE, relative=True)]


def picture(result, frames) -> dict:
    """Draw the whole cylinder before and under the load, and the displacement under the force."""
    load = -4.0 * float(result.scene.shell_loads[0].force[0, 0])
    lines = [("", result.series["inwards"], 1e-3 * load * np.array(result.times), "-")]
    return _sze.octants(result, frames, {"lines": lines, "x": "displacement inwards [m]", "y": "force [kN]"})


def benchmark() -> ddg.bench.Study:
    """Study the compliance under a small force over meshes and membranes."""
    return ddg.bench.Study(
        {"n": (6, 12, 24), "membrane": ("flat", "curved")},
        "w E h / P at rest",
        fixed={"load": 1e-3, "steps": 1},
        series=("membrane",),
    )
