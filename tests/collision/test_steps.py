"""Steps of rods in contact: non-penetration, momentum, balance, repeatability, and refusals."""

from importlib import import_module

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.solve.linear import rod_substructuring

RADIUS = 2e-3
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)


def heap(law: str = "barrier", rods: int = 27, order=None, **contact) -> tuple[ddg.Scene, np.ndarray]:
    """Return rods in all directions that fly at each other, and velocities."""
    rng = np.random.default_rng(1)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    side = round(rods ** (1 / 3))
    centres = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3) - 0.5 * (side - 1)
    direction = rng.normal(size=(len(centres), 1, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    points = 0.08 * centres[:, None] + np.linspace(-0.03, 0.03, 9)[:, None] * direction
    velocities = np.broadcast_to(-2.0 * 0.08 * centres[:, None], points.shape)
    order = np.arange(len(points)) if order is None else order
    scene.add_rods(points[order], section=ddg.Circle(RADIUS), material=SOFT)
    scene.contact(law=law, **contact)
    return scene, velocities[order].reshape(-1, 3)


def run(device, scene, velocities=None, steps: int = 25, dt: float = 0.01, **options):
    model = scene.build(device=device)
    integrator = ddg.Integrator(model, **options)
    state = model.state(velocities=velocities)
    states = [state]
    for _ in range(steps):
        state = integrator.step(state, dt)
        states.append(state)
    return model, integrator, states


def momentum(model, state) -> tuple[np.ndarray, np.ndarray]:
    """Return linear and angular momentum of nodes, without that of spins."""
    mass = model.coupled.host.mass[: model.coupled.host.nodes, :1]
    x, v = (array.numpy()[: len(mass)] for array in (state.coupled.q, state.coupled.v))
    return (mass * v).sum(0), (mass * np.cross(x, v)).sum(0)


@pytest.mark.parametrize("law", ["barrier", "penalty"])
def test_colliding_rods_bounce_and_conserve_momentum(device, law):
    """Impulses sum to zero (Newton's third law), and contact dissipates kinetic energy."""
    scene, velocities = heap(law)
    model, integrator, states = run(device, scene, velocities, 30, rtol=1e-11)
    size = model.coupled.host.mass[: model.coupled.host.nodes, 0].sum() * np.abs(velocities).max()
    for state in states:
        linear, _ = momentum(model, state)
        assert np.abs(linear).max() < 1e-9 * size
    lists = [model.contacts(state) for state in states]
    assert max(map(len, lists)) > 4
    least = 0.0 if law == "barrier" else -0.5 * RADIUS
    assert min(contacts.gap.min() for contacts in lists if len(contacts)) > least
    kinetic = [model.energies(state)["kinetic"] for state in states]
    assert kinetic[-1] < 0.995 * kinetic[0]
    assert integrator.statistics()["contact"]["refused_crossings"] == 0


def test_contact_forces_carry_the_weight(device):
    """The contact forces on a beam at rest are the weight of the rods on top, m g."""
    scene = ddg.Scene(mass_damping=20.0)
    s = np.linspace(-0.05, 0.05, 11)
    for name, points in (
        ("lower", np.stack([s, 0 * s, 0 * s], 1)),
        ("left", np.stack([0 * s - 0.03, s, 0 * s + 2.2 * RADIUS], 1)),
        ("right", np.stack([0 * s + 0.03, s, 0 * s + 2.2 * RADIUS], 1)),
    ):
        scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, name=name)
    scene.clamp(0, edges=[0, -1])
    scene.contact()
    model, _, states = run(device, scene, steps=150)
    contacts = model.contacts(states[-1])
    weight = 2 * model.scene.batches[1].section.mass_per_length * 0.1 * 9.81
    on_lower = np.where(contacts.objects[:, :1] == 0, contacts.force, -contacts.force)[(contacts.objects == 0).any(1)]
    np.testing.assert_allclose(-on_lower.sum(0)[2], weight, rtol=1e-3)


def test_runs_agree_bitwise(device):
    states = [run(device, *heap())[2][-1].points() for _ in range(2)]
    np.testing.assert_array_equal(*states)


def test_the_order_of_rods_does_not_matter(device):
    order = np.random.default_rng(2).permutation(27)
    first, second = (
        run(device, *heap(order=o), 25, rtol=1e-10)[2][-1].points().reshape(-1, 9, 3) for o in (None, order)
    )
    np.testing.assert_allclose(second, first[order], atol=1e-6 * RADIUS)


def test_worlds_are_independent(device):
    scene, velocities = heap()
    one = run(device, scene, velocities)[2][-1].points()
    model = scene.build(device=device, worlds=2)
    integrator = ddg.Integrator(model)
    state = model.state(velocities=np.stack([velocities, 0.0 * velocities]))
    for _ in range(25):
        state = integrator.step(state, 0.01)
    np.testing.assert_allclose(state.points()[0], one, atol=1e-6 * RADIUS)
    np.testing.assert_allclose(state.points()[1], model.state().points()[1], atol=1e-12)


def test_overflowing_lists_repeat_the_step_at_full_length(device):
    """An overflowing step is repeated with more room and is the same, without shorter attempts."""
    scene, velocities = heap()
    _, usual, states = run(device, scene, velocities)
    expected = states[-1].points()
    model = scene.build(device=device)
    integrator = ddg.Integrator(model)
    for pairs in integrator._coupled.newton.contact.search.lists:
        pairs.reserve(1)
    integrator._coupled.newton.contact.search.version += 1
    integrator._coupled.newton.contact.terms.fit()
    state = model.state(velocities=velocities)
    for _ in range(25):
        state = integrator.step(state, 0.01)
    np.testing.assert_allclose(state.points(), expected, atol=1e-9)
    assert integrator.statistics()["retries"] == 0
    searches = [each.statistics()["contact"]["searches"] for each in (usual, integrator)]
    assert searches[1] <= searches[0] + 8


def crossed_rods(distance: float, law: str = "barrier") -> ddg.Scene:
    scene = ddg.Scene()
    s = np.linspace(-0.05, 0.05, 11)
    for name, points in (
        ("lower", np.stack([s, 0 * s, 0 * s], 1)),
        ("upper", np.stack([0 * s, s, 0 * s + distance], 1)),
    ):
        scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, name=name)
    scene.contact(law=law)
    return scene


def test_overlaps_at_the_start_are_refused(device):
    model = crossed_rods(1.9 * RADIUS).build(device=device)
    with pytest.raises(ddg.SceneError, match=r"edge \d+ of rod 0 .* and edge \d+ of rod 1 .* overlap by 0.0002 m"):
        ddg.Integrator(model).step(model.state(), 0.01)


@pytest.mark.parametrize("law", ["barrier", "penalty"])
def test_forces_are_derivatives_of_the_contact_energy(device, law):
    """Contact forces of the host's tangent are central differences of the contact energy."""
    model = crossed_rods((2.0 if law == "barrier" else 1.9) * RADIUS + 2e-4, law).build(device=device)
    state = model.state()
    q = state.coupled.q.numpy().copy()
    rng = np.random.default_rng(0)
    direction = rng.normal(size=q.shape) * (np.arange(len(q)) < model.coupled.host.nodes)[:, None]

    def energy(h):
        displaced = state.copy()
        displaced.coupled.q.assign(q + h * direction)
        return model.energies(displaced)["contact"]

    model.touch.evaluate(state.coupled.q)
    slope = -(model.touch.terms.forces.numpy() * direction).sum()
    h = 1e-8
    assert slope != 0.0
    np.testing.assert_allclose((energy(h) - energy(-h)) / (2 * h), slope, rtol=1e-5)


def test_refusals(device):
    scene = crossed_rods(3 * RADIUS)
    scene.clamp([0, 1], edges=[0])
    with pytest.raises(ddg.SceneError, match="has contact already"):
        scene.contact()
    model = scene.build(device=device)
    for options in ({"scheme": "implicit_midpoint"}, {"solver": "projective"}):
        with pytest.raises(ddg.SceneError, match="contact: "):
            ddg.Integrator(model, **options)


@pytest.mark.parametrize("name", [pytest.param("noodles", marks=pytest.mark.slow), "crossed_beams"])
def test_substructuring_does_not_depend_on_the_thread_mapping(device, monkeypatch, name):
    """Two eliminations include the contact terms of the bands: motions agree to rounding, iterations to one of hundreds."""
    results = []
    for reduces in (False, True):
        monkeypatch.setattr(rod_substructuring, "long_and_few", lambda *_, reduces=reduces: reduces)
        scene = import_module(f"ddg_warp.scenes.{name}").build()
        model = scene.build(device, precision="float64")
        integrator = ddg.Integrator(model, rtol=1e-5)  # above the rounding floor, where iterations are another number
        state = model.state()
        for _ in range(40):
            state = integrator.step(state, scene.analysis.dt)
        results.append((state.points(), integrator.statistics()))
    (one, by_one), (many, by_many) = results
    assert by_one["contact"]["contacts"]["mean"] > 0.0
    newton = [
        statistics["newton_iterations"]["mean"] * sum(statistics["outcomes"].values())
        for statistics in (by_one, by_many)
    ]
    assert abs(newton[1] - newton[0]) <= 1.0 + 1e-9
    assert abs(by_many["pcg_iterations"] - by_one["pcg_iterations"]) < 0.1 * by_one["pcg_iterations"]
    np.testing.assert_allclose(many, one, rtol=0.0, atol=1e-7)
