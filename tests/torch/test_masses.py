"""Masses, rotary inertia and drag as parameters of steps and equilibria: against scenes built with them, and against differences."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from tests.adjoint import differences
from tests.adjoint.differences import TIGHT, built
from tests.adjoint.test_adjoint import CURVE, DT, SCENES, SOFT, T, a_scene

torch = pytest.importorskip("torch")
from ddg_warp.torch import RodParameters, ShellParameters, Simulator, gradient_check_scenes  # noqa: E402
from tests.pairwise import covering  # noqa: E402
from tests.torch.test_torch import check, normal  # noqa: E402

SECTIONS = {
    "circle": lambda c: ddg.Circle(0.004 * c),
    "ellipse": lambda c: ddg.Ellipse(0.004 * c, 0.003 * c),
    "rectangle": lambda c: ddg.Rectangle(0.004 * c, 0.006 * c),
    "ribbon": lambda c: ddg.Ribbon(0.01 * c, 0.002 * c),
}
OBJECTS = (
    *SECTIONS,
    "circle in a fluid",
    "planar circle",
    "joined circle",
    "joined circle in a fluid",
    "planar joined circle",
)
DENSITY, RADIUS = 1.7, 1.2


def scene_of(name: str, radius: float = 1.0, density: float = 1.0) -> ddg.Scene:
    """Rods with such a section, times a radius and a density; joined, in the plane, in a fluid."""
    flat, fluid = "planar" in name, "fluid" in name
    scene = ddg.Scene(gravity=(0.3, 0.0, -9.81), mass_damping=0.7, dimension=2 if flat else 3)
    material = ddg.Material(1e6, density=1000.0 * density, viscosity=0.01)
    section = next(make for sim, make in SECTIONS.items() if sim in name)(radius)

    def rod(points):
        return scene.add_rod(points * ([1.0, 0.0, 1.0] if flat else 1.0), section=section, material=material)

    rods = [rod(CURVE)]
    scene.clamp(rods[0])
    scene.add_mass(rods[0], 2, 0.003)
    if "joined" in name:
        rods += [rod(CURVE[-1] + np.stack([0.1 * T, y * T, z * T], axis=1)) for y, z in ((0.2, 0.1), (-0.2, 0.05))]
        scene.join([(rods[0], 5), (rods[1], 0), (rods[2], 0)])
        scene.fix(rods[1], [5], components="xz")
        scene.add_mass(rods[2], 0, 0.002)  # on the joint
    if fluid:
        scene.drag(rods[:1], ddg.Viscous(3.0))
        for reference in rods[1:]:
            scene.drag(reference, tangential=0.1, normal=0.2)
    return scene


def end(sim: Simulator, parameters=None, statics: bool = False, worlds: int = 1) -> torch.Tensor:
    """Positions and velocities after five steps, or positions at rest."""
    if statics:
        return sim.equilibrium(parameters, batch=worlds, **TIGHT).positions
    *_, state = sim.rollout(sim.initial_state(worlds), parameters, steps=5)
    return torch.cat([state.positions, state.velocities], -1)


def simulator(scene: ddg.Scene, scheme: str = "implicit_midpoint") -> Simulator:
    return Simulator(built(scene), DT, scheme=scheme, **TIGHT)


@covering(1, name=OBJECTS, statics=(False, True))
def test_density_and_radius_are_those_that_rods_are_built_with(name, statics):
    sim = simulator(scene_of(name))
    factors = RodParameters(sim, names=("density", "radius"))
    with torch.no_grad():
        factors.logarithms["density"].fill_(np.log(DENSITY))
        factors.logarithms["radius"].fill_(np.log(RADIUS))
        result, reference = end(sim, factors(), statics), simulator(scene_of(name, RADIUS, DENSITY))
        torch.testing.assert_close(result, end(reference, None, statics), rtol=1e-9, atol=1e-11)
        assert float((result - end(sim, None, statics)).abs().max()) > 1e-3
    for parameter, values in factors().items():
        torch.testing.assert_close(values.detach(), reference.parameter(parameter), rtol=1e-12, atol=1e-18)


def test_masses_of_every_world():
    """Twice all masses, inertia, stiffnesses and drag move alike; half the mass alone does not."""
    for name in ("circle in a fluid", "joined circle in a fluid"):
        sim = simulator(scene_of(name))
        parameters = [n for n in sim.engine(3).tables.names() if n.startswith(("rod.", "drag.")) or "stiffness" in n]
        factor = torch.tensor([[1.0], [2.0], [1.0]], dtype=torch.float64)
        inputs = {n: sim.parameter(n, 3) * factor for n in parameters}
        inputs["rod.mass"][2] *= 0.5
        for statics in (False, True):
            result = end(sim, inputs, statics, 3)
            torch.testing.assert_close(result[1], result[0], rtol=1e-8, atol=1e-11)
            torch.testing.assert_close(result[0], end(sim, None, statics, 3)[0], rtol=1e-8, atol=1e-11)
            assert float((result[2] - result[0]).abs().max()) > 1e-4


@covering(
    1,
    name=("twisted", "closed", "joined", "sheet", "planar", "stiffened"),
    analysis=("implicit_euler", "implicit_midpoint", "statics"),
)
def test_masses_under_gravity_of_every_world(name, analysis):
    """Gradients by every kind of mass use the gravity of their world."""
    statics = analysis == "statics"
    sim = Simulator(built(SCENES[name]()), DT, scheme="implicit_euler" if statics else analysis, **TIGHT)
    masses = [n for n in sim.engine(2).tables.names() if n.endswith((".mass", ".inertia"))]
    assert masses
    torch.manual_seed(2)
    weight = normal(2, sim.model.points_count, 3)
    gravity = torch.tensor([[2.0, 0.0, -12.0], [-1.0, 0.0, -3.0]], dtype=torch.float64)

    def loss(gravity, **inputs):
        inputs = {key.replace("__", "."): values for key, values in inputs.items()}
        if statics:
            return (weight * sim.equilibrium(inputs, {"gravity": gravity}, batch=2, **TIGHT).positions).sum()
        state = sim.initial_state(2)
        *_, state = sim.rollout(state, inputs, {"gravity": gravity}, steps=3)
        moved = (weight * state.positions).sum() + 0.1 * (weight * state.velocities).sum()
        return moved + state.angles.square().sum()

    values = {n.replace(".", "__"): sim.parameter(n, 2) for n in masses if not (statics and n == "rod.inertia")}
    inertia_step = 0.05 if name == "stiffened" else 0.01  # small derivatives are limited by rounding
    sizes = {key: (inertia_step if "inertia" in key else 1e-3) * float(result.max()) for key, result in values.items()}
    check(loss, {"gravity": gravity} | values, {"gravity": 2e-3} | sizes)


def test_gradients_repeat_without_side_effects():
    for name in ("circle in a fluid", "joined circle"):
        sim = simulator(scene_of(name))
        plain = end(sim)
        mass = 2.0 * sim.parameter("rod.mass")

        def once(sim=sim, mass=mass):
            inputs = mass.clone().requires_grad_()
            result = end(sim, {"rod.mass": inputs})
            return result.detach(), *torch.autograd.grad((result**2).sum(), inputs)

        for one, reference in zip(once(), once(), strict=True):
            torch.testing.assert_close(one, reference, rtol=0.0, atol=0.0)
        torch.testing.assert_close(end(sim), plain, rtol=0.0, atol=0.0)
        rest = end(sim, None, statics=True)
        assert (end(sim, {"rod.mass": mass}, statics=True) != rest).any()
        torch.testing.assert_close(end(sim, None, statics=True), rest, rtol=0.0, atol=0.0)


def test_worlds_of_a_map_are_those_of_a_batch():
    sim = simulator(scene_of("circle"))
    masses = sim.parameter("rod.mass") * torch.tensor([[1.0], [1.5]], dtype=torch.float64)

    def loss(mass):
        return (end(sim, {"rod.mass": mass}) ** 2).sum()

    result = torch.func.vmap(torch.func.grad(loss))(masses[:, None])
    for one, mass in zip(result, masses, strict=True):
        torch.testing.assert_close(one, torch.func.grad(loss)(mass[None]), rtol=1e-9, atol=1e-12)


def test_masses_of_a_rod_and_its_shell_add_up():
    """Masses of a rod and its shell add up at common nodes."""

    def stiffened(density: float = 1.0) -> ddg.Scene:
        scene = a_scene()
        gradient_check_scenes.OBJECTS["rod on a shell"][1](scene, gradient_check_scenes.soft(density))
        return scene

    sim = simulator(stiffened())
    assert sim.parameter("rod.mass").shape[1] + sim.parameter("shell.mass").shape[1] == sim.model.points_count
    rod, shell = RodParameters(sim, names=("density",)), ShellParameters(sim, ("density",))
    with torch.no_grad():
        rod.logarithms["density"].fill_(np.log(2.0))
        shell.changes["density"].fill_(np.log(2.0))
        both = end(sim, rod() | shell())
        torch.testing.assert_close(both, end(simulator(stiffened(2.0))), rtol=1e-8, atol=1e-10)
        assert float((both - end(sim, shell())).abs().max()) > 1e-6
        assert float((both - end(sim, rod())).abs().max()) > 1e-6


def _magnetise(scene: ddg.Scene) -> None:
    scene.magnetize(0, 1e3)
    scene.magnetic_field((0.0, 0.0, 1e-3))


@pytest.mark.parametrize(
    ("change", "names", "match"),
    [
        (lambda s: s.add_rod(CURVE + 1.0, section=ddg.Stiffness(1.0, 1e-4, GJ=1e-4)), ("radius",), "of a Stiffness"),
        (_magnetise, ("radius",), "'rod' are magnetised"),
        (lambda s: None, ("mass",), "no rod has 'mass'; there is stretching, bending, twisting, density, radius"),
    ],
)
def test_missing_parameters_are_refused(change, names, match):
    scene = ddg.Scene()
    scene.add_rod(CURVE, section=ddg.Circle(0.004), material=SOFT)
    change(scene)
    with pytest.raises(SceneError, match=match):
        RodParameters(Simulator(built(scene), DT), names=names)


def test_densities_that_are_none_are_refused():
    scene = ddg.Scene()
    scene.add_rod(CURVE, section=ddg.Circle(0.004), material=ddg.Material(1e6, density=0.0))
    with pytest.raises(SceneError, match="no rod has 'density'"):
        RodParameters(Simulator(built(scene), DT), names=("density",))


@pytest.mark.parametrize(
    ("parameters", "match"),
    [
        ({"rod.mass": 0.0}, "rod.mass: value 0 is 0; it is finite and positive"),
        ({"rod.mass": [[np.nan]]}, "rod.mass: value 0 is nan; it is finite and positive"),
        ({"rod.inertia": -1.0}, "rod.inertia: value 0 is -1; it is finite and not negative"),
        ({"rod.mass": torch.ones(4)}, r"rod.mass has shape \(4,\); give \(\), \(1, 1\) for each world, \(1, 6\)"),
        ({"shell.mass": 1.0}, "no object has 'shell.mass'; this model has .*rod.mass, rod.inertia, drag.tangential"),
        ({"drag.speed": 1.0}, "no object has 'drag.speed'"),
        ({"drag.normal": "thick"}, "drag.normal is 'thick', no array of numbers; give numbers"),
    ],
)
def test_invalid_values_are_refused(parameters, match):
    sim = simulator(scene_of("circle in a fluid"))
    with pytest.raises(SceneError, match=match):
        sim.step(sim.initial_state(), parameters)


@covering(1, factor=(1.0, 1e3, 1e6), scheme=("implicit_euler", "implicit_midpoint"))
def test_mixed_precision_follows_the_given_stiffness(scheme, factor):
    """A tensor makes rods far stiffer than the model's, for which float32 suffices; a factor 1e6 selects float64."""
    names = [f"rod_bend_twist.stiffness_{k}" for k in (1, 2, 3)] + ["rod_stretch.stiffness"]

    def gradient(precision):
        along = np.linspace(0.0, 1.0, 24)
        curve = np.stack([0.3 * along, 0.05 * np.sin(3.0 * along), 0.04 * np.cos(5.0 * along)], axis=1)
        scene = ddg.Scene(gravity=(0.3, 0.2, -9.81))
        scene.clamp(scene.add_rod(curve, section=ddg.Circle(0.004), material=ddg.Material(1e4, density=1000.0)))
        sim = Simulator(scene.build(differences.DEVICE, precision), DT, scheme=scheme, **TIGHT)
        inputs = {name: (factor * sim.parameter(name)).requires_grad_() for name in names}
        *_, state = sim.rollout(sim.initial_state(), inputs, steps=5)
        return torch.cat(torch.autograd.grad(state.positions[0, -1, 2], list(inputs.values())), 1)

    exact, mixed = gradient("float64"), gradient("mixed")
    assert float((mixed - exact).norm()) < 1e-6 * float(exact.norm())
