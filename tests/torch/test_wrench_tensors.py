"""Wrenches of steps as tensors: values of the integrator, and gradients against differences."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import ddg_warp as ddg  # noqa: E402
from ddg_warp.torch.simulator import Simulator  # noqa: E402
from tests.test_wrenches import DT, SCENES, SECTION, line, pendulum, shake, sheet  # noqa: E402

RUBBER = ddg.Material(young=2e6, poisson=0.35, density=1000.0, viscosity=1e-3)
TIGHT = {"rtol": 1e-12, "max_iterations": 200}
SCENES = SCENES | {"midedge": lambda scene: sheet(scene, "midedge")}


def dragged(scene):
    scene.flow = (0.3, 0.1, 0.2)
    scene.drag(pendulum(scene), tangential=0.3, normal=0.8, rotational=1e-3)


def in_sand(scene):
    scene.flow = (0.3, 0.1, 0.2)
    scene.drag(pendulum(scene), ddg.Granular(lateral=3.0, friction=0.5, leading=0.5, speed=0.1))


def joined_and_dragged(scene):
    scene.flow = (0.3, 0.1, 0.2)
    SCENES["joined"](scene)
    scene.drag([0], tangential=0.3, normal=0.8, rotational=1e-3)


def magnetised(scene):
    """Add two magnetised rods, which attract each other, in a field with a gradient."""
    for shift in (0.0, 0.15):
        rod = scene.add_rod(line((0, shift, 0), (0.5, shift, 0.1)), section=SECTION, material=RUBBER)
        scene.clamp_end(rod)
        scene.magnetize(rod, (2e4, 1e4, 0.0))
    scene.magnetic_field(lambda t: (0.0, 0.01 + t, 0.02), gradient=np.diag([1e-2, 1e-2, -2e-2]))
    scene.add_dipoles()


def pressed(scene):
    """Add two clamped rods, one lying on the other and both on a plane, without friction."""
    for i, height in enumerate((0.0105, 0.0315)):
        points = line((0, 0.1 * i, height), (0.5, 0.05 - 0.05 * i, height))
        scene.clamp_end(scene.add_rod(points, section=SECTION, material=RUBBER))
    scene.contact()
    scene.add_obstacle(ddg.Plane())


def rubbed(scene):
    """Add a clamped rod that slides on a plane, across another one, with friction."""
    for i, height in enumerate((0.0105, 0.0315)):
        points = line((0, 0.1 * i, height), (0.5, 0.05 - 0.05 * i, height))
        scene.clamp_end(scene.add_rod(points, section=SECTION, material=RUBBER), motion=shake() if i else None)
    scene.contact(friction=0.3, velocity=0.05, rolling=True)
    scene.add_obstacle(ddg.Plane())


def sheet_in_wind(scene):
    scene.flow = ddg.Turbulence((3.0, 1.0, 2.0), 0.4, 0.2, seed=2, modes=16)
    sheet(scene, "hinge")
    scene.drag(law=ddg.QuadraticDrag(20.0))


SCENES |= {"sheet_in_wind": sheet_in_wind}
SCENES |= {"dragged": dragged, "in_sand": in_sand, "joined_and_dragged": joined_and_dragged, "pressed": pressed}
SCENES |= {"magnetised": magnetised, "rubbed": rubbed}


def gripped(scene):
    scene.clamp_end(scene.add_rod(line((0, 0, 0), (0.5, 0, 0.1)), section=SECTION, material=RUBBER), motion=ddg.Grip())


def simulated(name, device, worlds=2):
    scene = ddg.Scene(gravity=(0.3, 0.2, -9.81), mass_damping=0.8)
    (gripped if name == "gripped" else SCENES[name])(scene)
    return Simulator(scene.build(device, "float64", worlds=worlds), DT, **TIGHT)


def started(simulator, seed=0):
    """Return a state with motion after some steps."""
    state = simulator.initial_state()
    for _ in range(3):
        state = simulator.step(state)
    return state.detach()


@pytest.mark.parametrize("name", [*SCENES, "gripped"])
def test_tensors_are_the_wrenches_of_the_integrator(device, name):
    simulator = simulated(name, device)
    before = started(simulator)
    watched = before.engine.integrator.watch_wrenches()
    after = simulator.step(before)
    result = simulator.wrenches(before, after)
    if name == "pressed":
        assert result.force[0, -1, 2] > 1.0
    for one, values in ((result.force, watched.force), (result.moment, watched.moment), (result.point, watched.point)):
        expected = values.numpy()
        np.testing.assert_allclose(one.detach().cpu().numpy(), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("name", [*SCENES, "gripped"])
def test_gradients_against_differences(device, name):
    """Gradients by the start state, a stiffness, masses, coefficients of drag, gravity, forces and poses, through the step."""
    simulator = simulated(name, device)
    before = started(simulator)
    random = np.random.default_rng(0)
    model = before.engine.model
    term = (
        "shell_stretch.stiffness"
        if "shell_stretch.stiffness" in before.engine.tables.names()
        else "rod_stretch.stiffness"
    )
    stiffness = simulator.parameter(term)
    inputs = {
        "positions": torch.zeros_like(before.positions),
        "velocities": torch.zeros_like(before.velocities),
        "stiffness": torch.zeros((model.worlds, 1), dtype=torch.float64, device=stiffness.device),
        "gravity": torch.zeros((model.worlds, 3), dtype=torch.float64, device=stiffness.device),
        "forces": torch.zeros_like(before.positions),
    }
    if model.magnetic:
        inputs["field"] = torch.zeros((model.worlds, 3), dtype=torch.float64, device=stiffness.device)
    if name == "gripped":
        inputs["poses"] = torch.zeros((model.worlds, 1, 6), dtype=torch.float64, device=stiffness.device)
    masses = [mass for mass in ("rod.mass", "shell.mass") if mass in before.engine.tables.names()]
    if name == "oblique":  # velocities off a skew support would leave its plane
        del inputs["velocities"]
    coefficients = [each for each in before.engine.tables.names() if each.startswith("drag.")]
    for each in ("mass", *coefficients):
        inputs[each] = torch.zeros_like(inputs["stiffness"])
    weights = {}

    def loss(**moved):
        values = list(before.values)
        layout = before.layout
        values = layout.put_points(values, "x", "q", before.positions + moved["positions"])
        values = layout.put_points(values, "v", "v", before.velocities + moved.get("velocities", 0.0))
        state = type(before)(tuple(values), before.time, before.engine, before.codes, before.differentiable)
        parameters = {term: stiffness * (1.0 + moved["stiffness"])}
        for mass in masses:
            parameters[mass] = simulator.parameter(mass) * (1.0 + moved["mass"])
        for each in coefficients:
            parameters[each] = simulator.parameter(each) + 0.05 + 0.1 * moved[each]
        controls = {
            "gravity": moved["gravity"] + torch.tensor(model.scene.gravity, dtype=torch.float64),
            "forces": moved["forces"],
        }
        if "field" in moved:
            controls["field"] = moved["field"] + 0.01
        if "poses" in moved:
            controls["poses"] = moved["poses"]
        after = simulator.step(state, parameters, controls)
        result = simulator.wrenches(state, after, parameters, controls)
        total = 0.0
        for key in ("force", "moment"):
            values = getattr(result, key)
            if key not in weights:
                weights[key] = torch.as_tensor(random.normal(size=values.shape), device=values.device)
            total = total + (weights[key] * values).sum()
        return total

    moved = {key: value.clone().requires_grad_() for key, value in inputs.items()}
    loss(**moved).backward()
    sizes = {
        "positions": 1e-6,
        "velocities": 1e-4,
        "stiffness": 1e-4,
        "mass": 1e-3,
        "gravity": 1e-3,
        "forces": 1e-4,
        "poses": 1e-6,
    }
    for key, value in inputs.items():
        direction = torch.as_tensor(random.normal(size=value.shape), device=value.device)
        step = sizes.get(key, 1e-3)
        with torch.no_grad():
            ends = [loss(**(inputs | {key: value + sign * step * direction})) for sign in (1.0, -1.0, 2.0, -2.0)]
        difference = float((8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * step))
        gradient = float((moved[key].grad * direction).sum())
        assert gradient == pytest.approx(difference, rel=1e-6), key


def test_models_without_gradients_are_refused(device):
    scene = ddg.Scene()
    pendulum(scene)
    model = scene.build(device)
    simulator = Simulator(model, DT, scheme="implicit_midpoint")
    state = simulator.initial_state()
    with pytest.raises(ddg.SceneError, match="midpoint"):
        simulator.wrenches(state, simulator.step(state))
