"""Scale invariance: equal relative results from a nanometre to a hundred kilometres.

Covers equilibria, steps, paths and spectra. A scene of size L has the moduli of 1 m, forces scaled by L^2, gravity by 1
/ L, drag coefficients and time by L. It then has the same shape over L, and frequencies scaled by 1 / L.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.continuation import Continuation
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import solve
from tests.pairwise import covering

MATERIAL = ddg.Material(1e6, 0.3, density=1000.0)
LENGTHS = [1e-9, 1e-3, 1e5]
TOLERANCE = {"float64": 1e-7, "mixed": 1e-6}


def line(length: float, edges: int = 12) -> np.ndarray:
    return np.linspace((0, 0, 0), (length, 0, 0), edges + 1)


def scene_of(length: float, dimension: int = 3, weight: float = 1e-3) -> ddg.Scene:
    """Return a scene with gravity `weight` g [1 m] over the length."""
    return ddg.Scene(gravity=(0, 0, -weight * 9.81 / length), dimension=dimension)


def rod(length, **options):
    scene = scene_of(length, options.pop("dimension", 3))
    section = options.pop("section", ddg.Circle(0.02 * length))
    index = scene.add_rod(line(length), section=section, material=MATERIAL, **options)
    scene.clamp_end(index)
    scene.add_force(index, -1, (0, 0, 0.1 * length**2))
    return scene


def ribbon(length):
    return rod(length, section=ddg.Ribbon(0.1 * length, 0.01 * length), director=(0, 1, 0))


def joined(length):
    scene = scene_of(length)
    points = line(length)
    kind = dict(section=ddg.Circle(0.02 * length), material=MATERIAL)
    first, last = scene.add_rod(points[:7], **kind), scene.add_rod(points[6:], **kind)
    brace = scene.add_rod(np.linspace(points[6], points[6] + [0, 0.4 * length, 0], 5), **kind)
    scene.join([(first, -1), (last, 0)])
    scene.join([(first, -1), (brace, 0)], rigid=False)
    scene.clamp_end(first)
    scene.fix(brace, [-1])
    scene.fix_twist(brace, [0])
    scene.add_force(last, -1, (0, 0, 0.1 * length**2))
    return scene


def shell(length, bending, stiffened=False):
    scene = scene_of(length)
    points, triangles = meshes.rectangle(4, 3, (length, 0.6 * length), "alternating")
    sheet = scene.add_shell(points, triangles, thickness=0.02 * length, material=MATERIAL, bending=bending)
    scene.clamp_boundary(sheet, np.flatnonzero(points[:, 0] < 1e-6 * length))
    scene.add_vertex_force(sheet, [int(np.argmax(points @ [1.0, 1e-3, 0.0]))], (0, 0, 0.05 * length**2))
    if stiffened:
        row = np.flatnonzero(np.abs(points[:, 1] - points[:, 1].min()) < 1e-6 * length)
        row = row[np.argsort(points[row, 0])]
        stiffener = scene.add_rod(points[row], section=ddg.Circle(0.01 * length), material=MATERIAL)
        scene.attach(stiffener, range(len(row)), sheet, row)
    return scene


def magnet(length):
    scene = rod(length)
    scene.magnetize(0, (1e4, 0.0, 0.0))
    scene.magnetic_field((0.0, 0.0, 1e-2))
    return scene


def dragged(length):
    scene = rod(length)
    scene.drag(0, tangential=1e-2 * length, normal=2e-2 * length)
    return scene


OBJECTS = {
    "rod": rod,
    "planar": lambda length: rod(length, dimension=2),
    "no_twist": lambda length: rod(length, twist=False),
    "ribbon": ribbon,
    "joined": joined,
    "magnet": magnet,
    "drag": dragged,
    "midedge_dof": lambda length: shell(length, "midedge_dof"),
    "midedge": lambda length: shell(length, "midedge"),
    "hinge": lambda length: shell(length, "hinge"),
    "stiffened": lambda length: shell(length, "midedge_dof", stiffened=True),
    "stiffened_hinge": lambda length: shell(length, "hinge", stiffened=True),
}


@cache
def answers(name: str, length: float, precision: str, device: str) -> dict:
    """Return relative shapes and frequencies times length of one object."""
    model = OBJECTS[name](length).build(device, precision)
    state = solve(model, load_steps=2)
    result = {"equilibrium": state.points() / length}
    if precision == "float64":
        result["frequencies"] = spectrum(model, state, 3).frequencies * length
        path = Continuation(model).trace(stop=ddg.StopCriterion(steps=3))
        result["path"] = path.points[-1].state.points() / length
    integrator, state = ddg.Integrator(model, rtol=1e-9 if precision == "float64" else 1e-7), model.state()
    for _ in range(4):
        state = integrator.step(state, 0.1 * length)
    return result | {"steps": state.points() / length}


@covering(1, name=OBJECTS, length=LENGTHS, precision=("float64", "mixed"))
def test_scale(device, name, length, precision):
    results, expected = (answers(name, each, precision, str(device)) for each in (length, 1.0))
    assert np.abs(expected["equilibrium"] - OBJECTS[name](1.0).build("cpu").state().points()).max() > 1e-3
    for quantity, values in expected.items():
        scale = np.abs(values).max()
        np.testing.assert_allclose(
            results[quantity], values, rtol=0.0, atol=TOLERANCE[precision] * scale, err_msg=quantity
        )
