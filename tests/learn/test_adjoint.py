"""Gradients of steps against central differences of them, by every entry of the state and every parameter."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.geometry import meshes
from ddg_warp.learn.adjoint import Adjoint
from tests.learn.differences import TIGHT, Difference, along, built, cotangent, directions, entries, lively

DT = 0.01
CLOSE = 1e-6  # relative error of a gradient, as asked
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
MIDPOINT = ("untwisted", "planar", "sheet", "hinges")


def tables(model) -> list:
    """Parameter tables of all parts."""
    return [group.parameters for group in model.groups] + (
        [part.parameters for part in model.net.sets] if model.net else []
    )


def by_parameters(model, inputs: list) -> list[np.ndarray]:
    """Derivatives by the parameters of each table, (rows, ...)."""
    found = [arrays.download(own.parameters) for own in inputs[: len(model.groups)]]
    return found + ([rows.numpy() for rows in inputs[-1].parameters] if model.net else [])


def shared(values: np.ndarray, shape: tuple) -> np.ndarray:
    """Derivatives of every element summed to those of values of this shape, elements along their first axis."""
    for axis in (0, 1):
        if shape[axis] == 1:
            values = values.sum(axis, keepdims=True)
    return values


def close(found: float, wanted: float, scale: float = 0.0) -> bool:
    return abs(found - wanted) <= CLOSE * max(abs(wanted), scale)


def differentiated(name: str, scheme: str, steps: int):
    model = built(SCENES[name]())
    state = lively(model, scheme=scheme)
    weights = directions(model, state, 5)

    def advance(start):
        integrator = ddg.Integrator(model, scheme=scheme, **TIGHT)
        for _ in range(steps):
            start = integrator.step(start, DT)
        return start

    adjoint = Adjoint(ddg.Integrator(model, scheme=scheme, **TIGHT))
    tapes, at = [], state
    for _ in range(steps):
        at, tape = adjoint.step(at, DT)
        tapes.append(tape)
    given, inputs = cotangent(model, weights), []
    for tape in reversed(tapes):
        given, read = adjoint.pull(tape, given)
        inputs.append(read)
    return model, given, inputs, Difference(model, state.copy(), weights, advance)


def check_state(model, gradient, difference) -> None:
    for entry, meant in directions(model, difference.state, 7).items():
        values = arrays.download(entries(gradient)[entry])
        direction = along(values, meant)
        found = float((values * direction).sum())
        assert close(found, difference.by_entry(entry, direction, found)), entry


CASES = [(name, "implicit_euler") for name in SCENES] + [(name, "implicit_midpoint") for name in MIDPOINT]


@pytest.mark.parametrize(("name", "scheme"), CASES)
def test_a_step_by_its_state(name, scheme):
    model, gradient, _, difference = differentiated(name, scheme, 1)
    check_state(model, gradient, difference)


@pytest.mark.parametrize(("name", "scheme"), CASES)
def test_a_step_by_its_parameters(name, scheme):
    model, _, (inputs,), difference = differentiated(name, scheme, 1)
    random = np.random.default_rng(11)
    for number, (table, found) in enumerate(zip(tables(model), by_parameters(model, inputs), strict=True)):
        for row, (parameter, values) in enumerate(table.values.items()):
            size = np.abs(values).max()
            own = found[row] if number < len(model.groups) else found[row].reshape(model.worlds, -1)
            gradient = shared(own, values.shape)
            direction = along(gradient, random.uniform(0.5, 1.0, values.shape) * (size or 1.0))
            reference = difference.by_parameter(table, parameter, direction, 1e-3)
            scale = 1e-4 * abs(
                difference.loss()
            )  # what is less than a change of that much by as much again is not seen
            assert close(float((gradient * direction).sum()), reference, scale), parameter


@pytest.mark.parametrize("name", ["twisted", "joined", "sheet"])
def test_a_step_by_what_all_share(name):
    """The length of the step, damping by mass."""
    model, _, (inputs,), difference = differentiated(name, "implicit_euler", 1)
    own = inputs[0]
    by_rate = float(own.rate.numpy().sum()) + sum(float(v.numpy().sum()) for v in getattr(own, "elements_rate", []))
    before = difference.advance

    def longer(x):
        difference.advance = lambda start: ddg.Integrator(model, **TIGHT).step(start, DT + x)

    assert close(-by_rate / DT**2, difference.by(longer, 1e-7))
    difference.advance, damping = before, model.scene.mass_damping

    def damped(x):
        model.scene.mass_damping = damping + x

    assert close(float(own.damping.numpy().sum()), difference.by(damped, 1e-3))


@pytest.mark.parametrize("name", ["twisted", "untwisted", "closed", "joined", "sheet"])
def test_twenty_steps(name):
    model, gradient, inputs, difference = differentiated(name, "implicit_euler", 20)
    check_state(model, gradient, difference)
    table = tables(model)[0]
    row, (parameter, values) = 1, list(table.values.items())[1]
    found = sum(by_parameters(model, read)[0][row].sum() for read in inputs)
    reference = difference.by_parameter(table, parameter, np.ones_like(values), 1e-4 * values.max())
    assert close(float(found), reference, scale=1e-4 * abs(difference.loss()) / values.max())


def test_gradients_repeat_bit_by_bit():
    first, second = (differentiated("joined", "implicit_euler", 2)[1] for _ in range(2))
    for name, array in entries(first).items():
        np.testing.assert_array_equal(array.numpy(), entries(second)[name].numpy())


def test_a_step_in_parts_is_refused():
    model = built(twisted())
    integrator = ddg.Integrator(model, max_iterations=3)
    adjoint, state = Adjoint(integrator), lively(model, speed=1.0)
    after, tape = adjoint.step(state, 0.02)
    assert integrator.statistics()["retries"] > 1
    with pytest.raises(SolverError, match=r"rod \d .*took the step in parts.*take a smaller dt"):
        adjoint.pull(tape, after)


@pytest.mark.parametrize("scheme", ["implicit_midpoint"])
def test_what_has_no_gradient_says_so(scheme):
    model = built(twisted())
    with pytest.raises(SceneError, match=r"rod \d: no gradient goes through the midpoint rule with twist"):
        Adjoint(ddg.Integrator(model, scheme=scheme))


def turned_clamp(joint=False):
    """A clamp that a motion shifts and turns, out of its plane: its edge's angle is found in the lagged frame."""
    scene = joined() if joint else twisted()
    scene.supports.clear()
    motion = ddg.Motion(
        translation=lambda t: (0.05 * np.sin(9.0 * t), 0.3 * t, 0.0), angle=lambda t: 4.0 * t, axis=(0.3, 1.0, 0.2)
    )
    scene.clamp(0, motion=motion)
    return scene


SCENES |= {"turned_clamp": turned_clamp, "turned_joined": lambda: turned_clamp(joint=True)}


@pytest.mark.parametrize("name", ["turned_clamp", "turned_joined"])
def test_steps_under_a_motion_that_turns(name):
    model, gradient, _, difference = differentiated(name, "implicit_euler", 2)
    check_state(model, gradient, difference)
