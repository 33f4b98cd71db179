"""User-defined forces on nodes and between all pairs: closed forms, gradients, worlds, refusals."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.adjoint.implicit import Adjoint
from ddg_warp.geometry import meshes
from ddg_warp.model.masses import point_masses
from ddg_warp.solve.equilibrium.tangent import Tangent

DT = 0.02
SOFT = ddg.Stiffness(EA=10.0, EI1=1e-2, EI2=1e-2, GJ=1e-2, mass_per_length=0.4, rotary_inertia=1e-3)
LINE = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 9)


@cache
def tether(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(x: V, v: V, t: real, p: Any):
        return p.stiffness * (p.target + t * p.speed - x) - p.damping * v

    return force


@cache
def tether_energy(real):
    V = wp.types.vector(3, real)

    @wp.func
    def energy(x: V, v: V, t: real, p: Any):
        return real(0.5) * p.stiffness * wp.length_sq(p.target + t * p.speed - x)

    return energy


@cache
def attraction(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(d: V, p: Any, q: Any):
        r = wp.length(d)
        return d * (p.strength * p.mass * q.mass / (r * r * r))

    return force


@cache
def attraction_energy(real):
    V = wp.types.vector(3, real)

    @wp.func
    def energy(d: V, p: Any, q: Any):
        return -p.strength * p.mass * q.mass / wp.length(d)

    return energy


@cache
def twice_tether_energy(real):
    V, single = wp.types.vector(3, real), tether_energy(real)

    @wp.func
    def energy(x: V, v: V, t: real, p: Any):
        return real(2.0) * single(x, v, t, p)

    return energy


@cache
def twice_attraction_energy(real):
    V, single = wp.types.vector(3, real), attraction_energy(real)

    @wp.func
    def energy(d: V, p: Any, q: Any):
        return real(2.0) * single(d, p, q)

    return energy


@cache
def swirl(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(d: V, p: Any, q: Any):
        return wp.cross(p.axis, d)

    return force


@cache
def push(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(d: V, p: Any, q: Any):
        return p.mass * d

    return force


def rod_scene(gravity=(0.0, 0.0, 0.0)) -> ddg.Scene:
    scene = ddg.Scene(gravity=gravity)
    scene.add_rod(LINE, section=SOFT)
    return scene


def sheet_scene(gravity=(0.0, 0.0, 0.0)) -> ddg.Scene:
    scene = ddg.Scene(gravity=gravity)
    points, triangles = meshes.rectangle(4, 2, (1.0, 0.5))
    scene.add_shell(points, triangles, thickness=0.02, material=ddg.Material(1e6, density=100.0))
    return scene


SCENES = {"rod": rod_scene, "sheet": sheet_scene}


def both_forces(scene: ddg.Scene, strength: float = 0.02, stiffness: float = 0.5) -> ddg.Scene:
    """Add a tether to every node and an attraction between all pairs."""
    points = scene.batches[0].points[0] if scene.batches else scene.shells[0].points
    stiffness = np.linspace(stiffness, 2.0 * stiffness, len(points))
    rest = {"target": points + [0.0, 0.0, 0.1], "speed": (0.0, 0.3, 0.0), "damping": 0.1}
    scene.add_nodal_force("tether", tether, potential=tether_energy, parameters={"stiffness": stiffness, **rest})
    masses = np.linspace(0.1, 0.2, len(points))
    parameters = {"mass": masses, "strength": strength}
    scene.add_pair_force("attraction", attraction, potential=attraction_energy, parameters=parameters)
    return scene


def stepped(model, steps: int = 4, state=None, **options):
    """Return the state after some steps."""
    integrator = ddg.Integrator(model, **({"rtol": 1e-11} | options))
    state = state or model.state()
    for _ in range(steps):
        state = integrator.step(state, DT)
    integrator.check(state)
    return state


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
@pytest.mark.parametrize("kind", SCENES)
def test_spring_to_a_moving_point_steps_by_its_recurrence(device, kind, precision):
    """Springs and dampers by mass move all nodes alike: m (x1 - x0 - h v0) / h^2 = k (p(t1) - x1) - c (x1 - x0) / h."""
    scene = SCENES[kind]()
    masses = np.sum(point_masses(SCENES[kind]().copy().build(device)), axis=0)
    points = SCENES[kind]().build(device).state().points()
    k, c, speed = 30.0, 2.0, np.array([0.1, 0.2, 0.3])
    parameters = {"stiffness": k * masses, "damping": c * masses, "target": points, "speed": speed}
    scene.add_nodal_force("tether", tether, parameters=parameters)
    model = scene.build(device, precision)
    exact = precision != "float32"
    integrator, state = ddg.Integrator(model, rtol=1e-11 if exact else 1e-6), model.state()
    shift, rate = np.zeros(3), np.zeros(3)
    for i in range(1, 6):
        state = integrator.step(state, DT)
        inertia = (shift + DT * rate) / DT**2 + c * shift / DT
        new = (inertia + k * i * DT * speed) / (1.0 / DT**2 + c / DT + k)
        shift, rate = new, (new - shift) / DT
        np.testing.assert_allclose(
            state.points() - points, np.tile(shift, (len(points), 1)), atol=1e-11 if exact else 1e-6
        )
    integrator.check(state)
    assert integrator.statistics()["newton_iterations"]["max"] <= 4


@pytest.mark.parametrize("kind", SCENES)
def test_pair_forces_are_the_sum_over_pairs_and_conserve_momentum(device, kind):
    scene = SCENES[kind]()
    count = len(LINE) if kind == "rod" else len(scene.shells[0].points)
    masses = np.linspace(1.0, 2.0, count)
    scene.add_pair_force("attraction", attraction, parameters={"mass": masses, "strength": 1e-3})
    model = scene.build(device, "float64")
    tangent = Tangent(model)
    x = model.state().points()
    d = x[None] - x[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        pairs = 1e-3 * masses[:, None, None] * masses[None, :, None] * d / np.linalg.norm(d, axis=-1)[..., None] ** 3
    expected = np.nan_to_num(pairs).sum(1)
    computed = tangent.at_points(tangent.loads(0.0, tangent.dofs(model.state())))
    np.testing.assert_allclose(computed, expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(np.cross(x, computed).sum(0), 0.0, atol=1e-12)
    state = stepped(model)
    weights = np.sum(point_masses(model), axis=0)[:, None]
    assert np.abs(weights * state.velocities()).max() > 1e-8
    np.testing.assert_allclose((weights * state.velocities()).sum(0), 0.0, atol=1e-11)


def ring(n: int, strength: float) -> ddg.Scene:
    """Return a closed rod of EA 1 N and radius 1 m, with repelling charges 1 / n at nodes; equal angles bend no node radially."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    angle = 2.0 * np.pi * np.arange(n) / n
    points = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    section = ddg.Stiffness(EA=1.0, EI1=0.01, mass_per_length=1.0)
    scene.add_rod(points, section=section, closed=True, twist=False, natural="straight", curvature="angle")
    scene.fix(0, [0])
    scene.fix(0, [n // 2], "yz")
    scene.fix(0, [n // 4], "z")
    scene.add_pair_force("charge", attraction, parameters={"mass": 1.0 / n, "strength": -strength})
    return scene


def ring_radius(n: int, strength: float) -> float:
    """Return the radius of balance between tension and repulsion: 2 T sin(a) = s / (2 n R)^2 sum of 1 / sin(k a), a = pi / n."""
    a = np.pi / n
    total, rest, low, high = (1.0 / np.sin(a * np.arange(1, n))).sum(), 2.0 * np.sin(a), 1.0, 10.0
    for _ in range(80):
        radius = 0.5 * (low + high)
        tension = radius - 1.0  # EA (2 R sin(a) / rest - 1)
        inward = rest * tension - strength / (2.0 * n * radius) ** 2 * total
        low, high = (low, radius) if inward > 0.0 else (radius, high)
    return radius


@pytest.mark.parametrize("solver", ["direct", "pcg"])
def test_charged_ring_grows_to_its_radius(device, solver):
    model = ring(40, 2.0).build(device, "float64")
    state = ddg.statics.solve(model, solver=solver)
    x = state.points()
    centre = 0.5 * (x[0] + x[20])
    np.testing.assert_allclose(np.linalg.norm(x - centre, axis=1), ring_radius(40, 2.0), rtol=1e-8)
    assert ring_radius(40, 2.0) > 1.1


@pytest.mark.slow
def test_charged_ring_of_2000_nodes_grows_to_its_radius(device):
    model = ring(2000, 2.0).build(device, "float64")
    state = ddg.statics.solve(model)
    assert np.linalg.norm(state.points()[0] - state.points()[1000]) == pytest.approx(
        2.0 * ring_radius(2000, 2.0), rel=1e-7
    )


@pytest.mark.slow
def test_attraction_of_2000_nodes_conserves_momentum(device):
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    generator = np.random.default_rng(1)
    starts = generator.uniform(-1.0, 1.0, (40, 1, 3))
    scene.add_rods(starts + np.linspace((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), 50), section=SOFT)
    scene.add_pair_force("attraction", attraction, parameters={"mass": 1.0 / 2000.0, "strength": 1.0})
    model = scene.build(device, "float64")
    state = stepped(model, 2)
    weights = np.sum(point_masses(model), axis=0)[:, None]
    momentum = weights * state.velocities()
    assert np.abs(momentum.sum(0)).max() < 1e-9 * np.abs(momentum).sum()


@pytest.mark.parametrize("kind", SCENES)
def test_worlds_equal_models_of_their_own(device, kind):
    def model(strength, worlds=1):
        return both_forces(SCENES[kind](), strength).build(device, "float64", worlds=worlds)

    both = model(0.02, 2)
    both.set_parameter("attraction", "strength", [0.02, 0.05])
    moved = stepped(both).points()
    np.testing.assert_array_equal(stepped(both).points(), moved)
    for world, strength in enumerate((0.02, 0.05)):
        np.testing.assert_array_equal(moved[world], stepped(model(strength)).points())
    assert np.abs(moved[0] - moved[1]).max() > 1e-6


def test_changed_parameters_act_from_the_next_step(device):
    changed, fresh = (both_forces(rod_scene(), stiffness=k).build(device, "float64") for k in (0.5, 2.0))
    integrator, start = ddg.Integrator(changed, rtol=1e-11), changed.state()
    for _ in range(2):
        start = integrator.step(start, DT)
    kept = start.copy()
    changed.set_parameter("tether", "stiffness", np.linspace(2.0, 4.0, len(LINE)))
    after = integrator.step(start, DT)
    expected = ddg.Integrator(fresh, rtol=1e-11)
    again = fresh.state(kept.points(), kept.velocities())
    again.time = kept.time
    np.testing.assert_allclose(after.points(), expected.step(again, DT).points(), atol=1e-6)
    assert np.abs(after.points() - stepped(both_forces(rod_scene()).build(device, "float64"), 3).points()).max() > 1e-5
    assert "net/tether/stiffness" in changed.parameters()


def test_substeps_take_their_own_time(device):
    model = both_forces(rod_scene()).build(device, "float64")
    halved, state = ddg.Integrator(model, rtol=1e-11), model.state()
    halved._coupled.islands.substep.fill_(0.5)
    whole = ddg.Integrator(model, rtol=1e-11)
    two = whole.step(whole.step(state, 0.5 * DT), 0.5 * DT)
    np.testing.assert_allclose(halved.step(state, DT).points(), two.points(), atol=1e-12)


def test_attracted_rods_meet_in_contact_and_conserve_momentum(device):
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), mass_damping=5.0)
    scene.add_rod(LINE, section=ddg.Circle(0.02), material=ddg.Material(1e6, density=1e3), name="first")
    turned = (LINE - LINE.mean(axis=0))[:, [1, 0, 2]] + LINE.mean(axis=0) + [0.01, 0.02, 0.1]
    scene.add_rod(turned, section=ddg.Circle(0.02), material=ddg.Material(1e6, density=1e3), name="second")
    scene.contact(friction=0.0)
    scene.add_pair_force("attraction", attraction, parameters={"mass": 0.1, "strength": 0.5})
    model = scene.build(device, "float64")
    state = stepped(model, 40, rtol=1e-8)
    weights = np.sum(point_masses(model), axis=0)[:, None]
    assert 0.02 < state.points()[9:, 2].mean() - state.points()[:9, 2].mean() < 0.06
    momentum = weights * state.velocities()
    assert np.abs(momentum.sum(0)).max() < 1e-7 * max(np.abs(momentum).sum(), 1e-3)


@pytest.mark.parametrize("kind", SCENES)
def test_gradients_agree_with_differences(device, kind):
    torch = pytest.importorskip("torch")
    scene = both_forces(SCENES[kind]())
    scene.clamp(0) if kind == "rod" else scene.hold(0, [0, 1, 2])
    model = scene.build(device, "float64")
    simulator, generator = ddg.torch.Simulator(model, dt=DT, rtol=1e-12), torch.Generator().manual_seed(1)

    def normal(like):
        return torch.randn(like.shape, dtype=torch.float64, generator=generator).to(like.device)

    names = ("tether.stiffness", "tether.target", "tether.damping", "attraction.mass", "attraction.strength")
    values = {name: simulator.parameter(name, 1) for name in names}
    first = simulator.initial_state().positions
    weight = normal(first)

    def end_of_steps(positions, parameters):
        state = simulator.initial_state(positions=positions)
        *_, state = simulator.rollout(state, parameters, {}, steps=3)
        return (weight * (state.positions + 0.1 * state.velocities)).sum()

    def equilibrium(positions, parameters):
        return (weight * simulator.equilibrium(parameters=parameters).positions).sum()

    for loss in (end_of_steps, equilibrium):
        for name, start in ({"positions": first} | values).items():
            if loss is equilibrium and name in ("positions", "tether.damping"):
                continue

            def of(x, name=name, loss=loss):
                return loss(x, values) if name == "positions" else loss(first, values | {name: x})

            x = start.detach().clone().requires_grad_()
            (gradient,) = torch.autograd.grad(of(x), x)
            direction, step = normal(start) * start.abs().max(), 2e-5 if name == "positions" else 1e-3
            with torch.no_grad():
                sides = [float(of(start + step * side * direction)) for side in (-2, -1, 1, 2)]
            difference = (sides[0] - 8.0 * sides[1] + 8.0 * sides[2] - sides[3]) / (12.0 * step)
            assert float((gradient * direction).sum()) == pytest.approx(difference, rel=1e-6), (loss.__name__, name)


def test_unsymmetric_forces_have_gradients(device):
    """A force across the line to a point has no symmetric derivative: sparse factors take over from conjugate gradients."""

    @cache
    def swirl(real):
        V = wp.types.vector(3, real)

        @wp.func
        def force(x: V, v: V, t: real, p: Any):
            return wp.cross(p.axis, x)

        return force

    scene = rod_scene()
    scene.add_nodal_force("swirl", swirl, parameters={"axis": (0.0, 0.3, 0.5)})
    integrator = ddg.Integrator(scene.build(device, "float64"), rtol=1e-12)
    adjoint, model, state = Adjoint(integrator), integrator.model, integrator.model.state()
    end, tape = adjoint.step(state, DT)
    cotangent, weight = end.copy(), np.linspace(-1.0, 1.0, 27).reshape(9, 3)
    for array in cotangent.coupled.arrays().values():
        array.zero_()
    rows, blocks = model.order.coupled_rows
    by_blocks = np.zeros((model.coupled.blocks, 3))
    by_blocks[blocks] = weight[rows]
    cotangent.coupled.q.assign(by_blocks)
    _, inputs = adjoint.vjp(tape, cotangent)
    gradient = inputs[-1].user_forces[0].numpy().reshape(9, 3)
    losses, step = [], 1e-3 * np.cos(np.arange(27.0)).reshape(9, 3)
    for side in (-1.0, 1.0):
        model.set_parameter("swirl", "axis", [0.0, 0.3, 0.5] + side * step)
        losses.append((weight * integrator.step(state, DT).points()).sum())
    assert (gradient * step).sum() == pytest.approx(0.5 * (losses[1] - losses[0]), rel=1e-6)


def test_wrenches_and_reactions_balance_forces_on_supports(device):
    scene = both_forces(rod_scene())
    scene.fix(0, range(len(LINE)))
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    integrator.watch_wrenches()
    integrator.step(state, DT)
    forces = np.linspace(0.5, 1.0, len(LINE))[:, None] * (np.array([0.0, 0.0, 0.1]) + DT * np.array([0.0, 0.3, 0.0]))
    (reaction,) = integrator.wrenches()
    np.testing.assert_allclose(reaction.force, -forces.sum(0), atol=1e-9)


@pytest.mark.parametrize("kind", SCENES)
def test_energies_of_potentials_have_names(device, kind):
    model = both_forces(SCENES[kind]()).build(device, "float64")
    state, energies = model.state(), model.energies(model.state())
    x = state.points()
    springs = 0.5 * np.linspace(0.5, 1.0, len(x)) * 0.1**2
    assert energies["tether"] == pytest.approx(springs.sum(), rel=1e-12)
    m, (i, j) = np.linspace(0.1, 0.2, len(x)), np.triu_indices(len(x), 1)
    pairs = -0.02 * m[i] * m[j] / np.linalg.norm(x[i] - x[j], axis=1)
    assert energies["attraction"] == pytest.approx(pairs.sum(), rel=1e-12)
    assert "attraction: user-defined force on all pairs of" in model.report()


@cache
def two_arguments(real):
    @wp.func
    def force(x: Any, p: Any):
        return x

    return force


GOOD = {"stiffness": 1.0, "target": (0.0, 0.0, 0.0), "speed": (0.0, 0.0, 0.0), "damping": 0.0}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tether", 3), "give a function of the scalar type"),
        (("tether", two_arguments), r"has the arguments \(x, p\); they are \(x, v, t, p\)"),
        (("tether", lambda real: real), "decorated by wp.func"),
        (("a.b", tether), "no new name"),
        (("tether", tether, {"parameters": {}}), "it has no parameters"),
        (("tether", tether, {"parameters": GOOD | {"stiffness": [1.0, 2.0]}}), r"stiffness has shape \(2,\)"),
        (("tether", tether, {"parameters": GOOD | {"stiffness": np.nan}}), "not finite"),
        (("tether", tether, {"parameters": GOOD, "rods": [1]}), "rod 1 does not exist"),
        (("tether", tether, {"parameters": GOOD, "rods": 0, "nodes": [12]}), "node 12"),
        (("tether", tether, {"parameters": [1.0]}), "give a dictionary"),
    ],
)
def test_wrong_forces_are_refused(arguments, message):
    name, function, *options = arguments
    with pytest.raises(ddg.SceneError, match=message):
        rod_scene().add_nodal_force(name, function, **(options[0] if options else {"parameters": GOOD}))


@pytest.mark.parametrize(
    ("function", "parameters", "message"),
    [
        (swirl, {"axis": (0.0, 0.0, 1.0)}, "derivative of the force by d is not symmetric"),
        (push, {"mass": np.arange(1.0, 10.0)}, "forces on the two nodes of a pair are not opposite"),
        (attraction, {"mass": 1.0, "strength": np.inf}, "finite"),
    ],
)
def test_pair_forces_without_balance_are_refused(device, function, parameters, message):
    scene = ddg.Scene()
    scene.add_rod(
        np.linspace((0.0, 0.0, 0.0), (1.0, 0.5, 0.0), 9), section=ddg.Circle(0.01), material=ddg.Material(1e6)
    )
    with pytest.raises(ddg.SceneError, match=message):
        scene.add_pair_force("odd", function, parameters=parameters)
        scene.build(device)


@pytest.mark.parametrize("potential", [twice_tether_energy, twice_attraction_energy])
def test_potentials_of_another_force_are_refused(device, potential):
    scene = both_forces(rod_scene())
    number = int(potential is twice_attraction_energy)
    scene.user_forces[number] = replace(scene.user_forces[number], potential=potential)
    with pytest.raises(ddg.SceneError, match="not the negative gradient of the potential"):
        scene.build(device)


def test_unsupported_uses_are_refused(device):
    model = both_forces(rod_scene()).build(device, "float64")
    for options in ({"scheme": "implicit_midpoint"}, {"solver": "projective"}):
        with pytest.raises(ddg.SceneError, match="user-defined forces"):
            ddg.Integrator(model, **options)
    with pytest.raises(ValueError, match="no parameter 'width'"):
        model.set_parameter("tether", "width", 1.0)
    with pytest.raises(ValueError, match="has shape"):
        model.set_parameter("tether", "stiffness", [1.0, 2.0])
