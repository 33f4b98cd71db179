"""Gradients of steps by state and parameters against central differences."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.adjoint.implicit import Adjoint
from ddg_warp.compile import precision
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes
from tests.adjoint.differences import (
    TIGHT,
    built,
    check_length,
    check_state,
    close,
    entries,
    moving_state,
    parameter_shifts,
    vjp_of_steps,
)
from tests.pairwise import covering

DT = 0.01
SOFT = ddg.Material(young=1e6, density=1000.0, viscosity=0.01)
T = np.linspace(0.0, 1.0, 6)
CURVE = np.stack([0.3 * T, 0.05 * np.sin(3.0 * T), 0.04 * np.cos(5.0 * T)], axis=1)


def a_scene(dimension=3):
    return ddg.Scene(gravity=(0.0, 0.0, -9.81), mass_damping=0.7, dimension=dimension)


def twisted():
    scene = a_scene()
    first = scene.add_rod(CURVE, section=ddg.Ellipse(0.004, 0.003), material=SOFT)
    second = scene.add_rod(CURVE[:-1] + [0.0, 0.1, 0.2], section=ddg.Ellipse(0.004, 0.003), material=SOFT)
    scene.clamp(first)
    scene.fix(second, [0], components="xz")
    scene.add_force(first, -1, (1e-3, 2e-3, 0.0))
    return scene


def clamped_end():
    scene = a_scene()
    rod = scene.add_rod(CURVE, section=ddg.Circle(0.004), material=SOFT)
    scene.clamp_end(rod)
    return scene


def untwisted():
    scene = a_scene()
    rod = scene.add_rod(CURVE, section=ddg.Circle(0.004), material=SOFT, natural="straight", twist=False)
    scene.fix(rod, [0, -1])
    return scene


def planar():
    scene = a_scene(dimension=2)
    rod = scene.add_rod(CURVE * [1.0, 0.0, 1.0], section=ddg.Circle(0.004), material=SOFT)
    scene.clamp(rod)
    return scene


def closed():
    scene, a = a_scene(), np.linspace(0.0, 2.0 * np.pi, 7, endpoint=False)
    ring = np.stack([0.1 * np.cos(a), 0.1 * np.sin(a), 0.02 * np.sin(2.0 * a)], axis=1)
    rod = scene.add_rod(ring, section=ddg.Ellipse(0.004, 0.003), material=SOFT, closed=True)
    scene.fix(rod, [0])
    return scene


def ribbon():
    scene = a_scene()
    rod = scene.add_rod(CURVE, section=ddg.Ribbon(0.01, 0.002), material=SOFT)
    scene.clamp(rod)
    return scene


def joined(rigid=True):
    scene, last = a_scene(), len(CURVE) - 1
    rods = [scene.add_rod(CURVE, section=ddg.Ellipse(0.004, 0.003), material=SOFT)]
    for y, z in ((0.2, 0.1), (-0.2, 0.05)):
        points = CURVE[-1] + np.stack([0.1 * T, y * T, z * T], axis=1)
        rods.append(scene.add_rod(points, section=ddg.Circle(0.003), material=SOFT))
    scene.clamp(rods[0])
    scene.fix(rods[1], [last], components="xz")
    scene.join([(rods[0], last), (rods[1], 0), (rods[2], 0)], rigid=rigid)
    return scene


def hinged():
    return joined(rigid=False)


def sheet(bending="midedge_dof"):
    scene = a_scene()
    vertices, triangles = meshes.rectangle(3, 2, (0.3, 0.2))
    vertices = np.array(vertices, float)
    vertices[:, 2] = 0.02 * np.sin(9.0 * vertices[:, 0])
    shell = scene.add_shell(vertices, triangles, thickness=0.004, material=SOFT, bending=bending)
    scene.hold(shell, [0, 1, 2])
    return scene


def stiffened():
    scene = a_scene()
    vertices, triangles = meshes.rectangle(3, 2, (0.3, 0.2))
    shell = scene.add_shell(vertices, triangles, thickness=0.004, material=SOFT)
    scene.hold(shell, [0, 4, 8])
    row = np.flatnonzero(np.asarray(vertices)[:, 1] == 0.0)
    rod = scene.add_rod(np.asarray(vertices)[row], section=ddg.Circle(0.003), material=SOFT)
    scene.attach(rod, range(len(row)), shell, row)
    return scene


SCHEMES = ("implicit_euler", "implicit_midpoint")
SCENES = {
    "twisted": twisted,
    "clamped_end": clamped_end,
    "untwisted": untwisted,
    "planar": planar,
    "closed": closed,
    "ribbon": ribbon,
    "joined": joined,
    "hinged": hinged,
    "sheet": sheet,
    "hinges": lambda: sheet("hinge"),
    "midedge": lambda: sheet("midedge"),
    "stiffened": stiffened,
}


def differentiated(name: str, scheme: str, steps: int):
    model = built(SCENES[name]())
    return model, *vjp_of_steps(model, moving_state(model, scheme=scheme), DT, steps, scheme)


@covering(1, name=SCENES, scheme=SCHEMES)
def test_a_step_by_its_state_and_parameters(name, scheme):
    model, gradient, inputs, difference = differentiated(name, scheme, 1)
    check_state(model, gradient, difference, *parameter_shifts(model, inputs))


@covering(1, name=("twisted", "joined", "sheet"), scheme=SCHEMES)
def test_a_step_by_length_and_mass_damping(name, scheme):
    """The length of the step, damping by mass."""
    model, _, (inputs,), difference = differentiated(name, scheme, 1)
    step_inputs = inputs[0]
    check_length(step_inputs, difference, DT, 1e-7, scheme)
    damping = model.scene.mass_damping

    def damped(x):  # which an integrator takes when it is made
        model.scene.mass_damping = damping + x
        difference.advance = lambda start: ddg.Integrator(model, scheme=scheme, **TIGHT).step(start, DT)

    assert close(float(step_inputs.damping.numpy().sum()), difference.by(damped, 1e-3))


@covering(1, name=("twisted", "untwisted", "planar", "closed", "joined", "sheet"), scheme=SCHEMES)
def test_twenty_steps(name, scheme):
    model, gradient, inputs, difference = differentiated(name, scheme, 20)
    check_state(model, gradient, difference, *parameter_shifts(model, inputs))


def test_gradients_repeat_bit_by_bit():
    first, second = (differentiated("joined", "implicit_euler", 2)[1] for _ in range(2))
    for name, array in entries(first).items():
        np.testing.assert_array_equal(array.numpy(), entries(second)[name].numpy())


def test_a_step_with_retries_is_refused():
    model = built(twisted())
    integrator = ddg.Integrator(model, max_iterations=3)
    adjoint, state = Adjoint(integrator), moving_state(model, speed=1.0)
    after, tape = adjoint.step(state, 0.02)
    assert integrator.statistics()["retries"] > 1
    with pytest.raises(SolverError, match=r"rod \d .*took the step in substeps.*take a smaller dt"):
        adjoint.vjp(tape, after)


def moving_clamp(joint=False):
    """A clamp that a motion translates and rotates out of its plane; its edge angle refers to the lagged frame."""
    scene = joined() if joint else twisted()
    scene.supports.clear()
    motion = ddg.Motion(
        translation=lambda t: (0.05 * np.sin(9.0 * t), 0.3 * t, 0.0), angle=lambda t: 4.0 * t, axis=(0.3, 1.0, 0.2)
    )
    scene.clamp(0, motion=motion)
    return scene


SCENES |= {"moving_clamp": moving_clamp, "moving_joined": lambda: moving_clamp(joint=True)}


@covering(1, name=("moving_clamp", "moving_joined"), scheme=SCHEMES)
def test_steps_under_a_motion_that_rotates(name, scheme):
    model, gradient, _, difference = differentiated(name, scheme, 2)
    check_state(model, gradient, difference)


def fixed_between():
    """A rod fixed at inner nodes, by all components and by one, and a free rod."""
    scene = a_scene()
    curve = np.concatenate([CURVE, CURVE[-1] + CURVE[1:]])
    rod = scene.add_rod(curve, section=ddg.Ellipse(0.004, 0.003), material=SOFT)
    scene.fix(rod, [3, 7])
    scene.fix(rod, [5], components="y")
    scene.add_rod(CURVE + [0.0, 1.0, 0.0], section=ddg.Ellipse(0.004, 0.003), material=SOFT)
    return scene


def rings():
    """Closed rods: one with two components of a node fixed, one with two nodes fixed."""
    scene, a = a_scene(), np.linspace(0.0, 2.0 * np.pi, 7, endpoint=False)
    for number, (nodes, components) in enumerate((([3], "xz"), ([2, 4], "xyz"))):
        ring = np.stack([0.1 * np.cos(a), 0.1 * np.sin(a) + number, 0.02 * np.sin(2.0 * a)], axis=1)
        rod = scene.add_rod(ring, section=ddg.Ellipse(0.004, 0.003), material=SOFT, closed=True)
        scene.fix(rod, nodes, components=components)
    return scene


def one_after_another():
    """Rods that are placed one after another, the last one between two anchors, and two free rods."""
    scene, end, section = a_scene(), CURVE[-1], ddg.Circle(0.003)
    side = np.stack([0.1 * T, 0.2 * T, 0.1 * T], axis=1)
    back = np.stack([0.1 * T, -0.2 * T, 0.1 * T + 0.02 * np.sin(5.0 * T)], axis=1)
    loose = CURVE + [0.0, 2.0, 0.0]
    rods = [
        scene.add_rod(points, section=section, material=SOFT)
        for points in (CURVE, end + side, end + side[-1] + back, loose, loose[2] + side)
    ]
    scene.clamp(rods[0])
    scene.fix(rods[2], [-1])
    scene.join([(rods[0], 5), (rods[1], 0)])
    scene.join([(rods[1], 5), (rods[2], 0)], rigid=False)
    scene.join([(rods[3], 2), (rods[4], 0)])
    return scene


TURNING = {"fixed_between": fixed_between, "rings": rings, "one_after_another": one_after_another}
SCENES |= TURNING


@pytest.mark.parametrize("name", ["twisted", "joined", "stiffened", "moving_clamp", "moving_joined", *TURNING])
def test_the_midpoint_rule_with_predictors_that_rotate_edges(name, monkeypatch):
    """Stiff rods: reference frames are transported to the rotated edges of the predictor."""
    monkeypatch.setattr(precision, "STRAIGHT_ROTATION", 1e-3)
    model, gradient, _, difference = differentiated(name, "implicit_midpoint", 1)
    check_state(model, gradient, difference)


FLUID = {"tangential": 0.7, "normal": 1.9, "rotational": 3e-5, "nodes": 0.05}
WIND = ddg.QuadraticDrag(2e4, tangential=0.2)
SAND = ddg.Granular(lateral=0.3, friction=0.2, leading=0.1, speed=0.05)
GRID = np.random.default_rng(5).uniform(-0.2, 0.2, (2, 3, 1, 3, 3)) * [1.0, 0.0, 1.0]
SHEAR = ddg.FlowGrid(GRID, (-0.3, 0.0, -0.3), (0.7, 0.0, 0.6), times=(0.0, 0.1))
EDDIES = ddg.Turbulence((0.1, 0.0, 0.2), 0.8, 0.2, seed=1, modes=32) + ddg.Gust((0.1, 0.2, 0.0), duration=0.1)


def resisted(name: str, density: float = 1000.0, flow=(0.1, 0.0, 0.2), **law):
    """Rods in a fluid that flows, or in sand; without inertia where they have no density."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{__name__}.SOFT", ddg.Material(young=1e6, density=density, viscosity=0.01))
        scene = SCENES[name]()
    scene.drag(**law)
    scene.flow = flow
    return scene


def pressed():
    scene = sheet()
    scene.add_pressure(0, 30.0)
    return scene


def coupled(name: str):
    """Rods in a fluid under a follower couple."""
    scene = resisted(name, **FLUID)
    scene.add_couple(0, -1, (0.0, 2e-4, 0.0) if scene.dimension == 2 else (1e-4, 2e-4, -1e-4))
    return scene


LAGGED = {
    "fluid, twisted": lambda: resisted("twisted", **FLUID),
    "fluid, planar": lambda: resisted("planar", **FLUID),
    "fluid, closed": lambda: resisted("closed", **FLUID),
    "fluid, joined": lambda: resisted("joined", **FLUID),
    "sand, twisted": lambda: resisted("twisted", law=SAND),
    "sand, joined": lambda: resisted("joined", law=SAND),
    "wind, twisted": lambda: resisted("twisted", law=WIND),
    "wind, joined": lambda: resisted("joined", law=WIND),
    "fluid, sheet": lambda: resisted("sheet", normal=9.0, tangential=3.0),
    "wind, sheet": lambda: resisted("sheet", law=WIND),
    "wind, stiffened": lambda: resisted("stiffened", law=WIND),
    "turbulence, twisted": lambda: resisted("twisted", flow=EDDIES, law=WIND),
    "turbulence, planar": lambda: resisted("planar", flow=SHEAR, **FLUID),
    "turbulence, stiffened": lambda: resisted("stiffened", flow=EDDIES, law=WIND),
    "no inertia, twisted": lambda: resisted("twisted", 0.0, **FLUID),
    "no inertia, joined": lambda: resisted("joined", 0.0, **FLUID),
    "couple, twisted": lambda: coupled("twisted"),
    "couple, planar": lambda: coupled("planar"),
    "couple, joined": lambda: coupled("joined"),
    "pressure": pressed,
}
SCENES |= LAGGED


@covering(1, name=LAGGED, scheme=SCHEMES)
def test_drag_and_follower_loads(name, scheme, monkeypatch):
    """Drag and follower loads are lagged: evaluated at the velocities and nodes of the start, or at the predicted nodes."""
    monkeypatch.setattr(precision, "STRAIGHT_ROTATION", 1e-3)
    model, gradient, inputs, difference = differentiated(name, scheme, 2)
    check_state(model, gradient, difference, *parameter_shifts(model, inputs))


@covering(1, name=("couple, twisted", "sand, joined", "pressure"), scheme=SCHEMES)
def test_drag_and_follower_loads_by_the_length_of_the_step(name, scheme):
    _, _, (inputs,), difference = differentiated(name, scheme, 1)
    check_length(inputs[0], difference, DT, 1e-7, scheme)


def test_drag_over_twenty_steps():
    model, gradient, _, difference = differentiated("sand, twisted", "implicit_euler", 20)
    check_state(model, gradient, difference)


def test_a_step_that_leaves_its_predictor_is_refused():
    """A cold start has other frames than the predictor, to which the midpoint rule transports them."""
    model = built(twisted())
    integrator = ddg.Integrator(model, scheme="implicit_midpoint")
    adjoint = Adjoint(integrator)
    after, tape = adjoint.step(moving_state(model, scheme="implicit_midpoint"), DT)
    tape.parts[0].retries.fill_(1)
    with pytest.raises(SolverError, match=r"rod \d .*restarted the step.*take a smaller dt"):
        adjoint.vjp(tape, after)
