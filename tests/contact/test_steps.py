"""Steps in which rods touch: nothing passes, momentum, balance, repeatability, and what refuses."""

from importlib import import_module

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.solve.net import chains as net_chains

RADIUS = 2e-3
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)


def heap(law: str = "barrier", rods: int = 27, order=None, **contact) -> tuple[ddg.Scene, np.ndarray]:
    """Rods in all directions that fly at each other, and their velocities."""
    rng = np.random.default_rng(1)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    side = round(rods ** (1 / 3))
    places = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3) - 0.5 * (side - 1)
    direction = rng.normal(size=(len(places), 1, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    points = 0.08 * places[:, None] + np.linspace(-0.03, 0.03, 9)[:, None] * direction
    velocities = np.broadcast_to(-2.0 * 0.08 * places[:, None], points.shape)
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
    """Linear and angular momentum of nodes, without that of spins."""
    mass = model.net.host.mass[: model.net.host.nodes, :1]
    x, v = (array.numpy()[: len(mass)] for array in (state.net.q, state.net.v))
    return (mass * v).sum(0), (mass * np.cross(x, v)).sum(0)


@pytest.mark.parametrize("law", ["barrier", "penalty"])
def test_rods_that_fly_at_each_other_bounce(device, law):
    """Sum of impulses is zero (Newton's third law); speeds along the line of the centres fall to a fraction."""
    scene, velocities = heap(law)
    model, integrator, states = run(device, scene, velocities, 30, rtol=1e-11)
    size = model.net.host.mass[: model.net.host.nodes, 0].sum() * np.abs(velocities).max()
    for state in states:
        linear, _ = momentum(model, state)
        assert np.abs(linear).max() < 1e-9 * size
    touched = [model.contacts(state) for state in states]
    assert max(map(len, touched)) > 4
    least = 0.0 if law == "barrier" else -0.5 * RADIUS
    assert min(found.gap.min() for found in touched if len(found)) > least
    kinetic = [model.energies(state)["kinetic"] for state in states]
    assert kinetic[-1] < 0.995 * kinetic[0]
    assert integrator.statistics()["contact"]["refused_crossings"] == 0


def test_what_lies_on_a_beam_weighs_on_it(device):
    """Forces of contact carry the weight of what is on top: sum of forces = m g at rest."""
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
    found = model.contacts(states[-1])
    weight = 2 * model.scene.batches[1].section.mass_per_length * 0.1 * 9.81
    on_lower = np.where(found.objects[:, :1] == 0, found.force, -found.force)[(found.objects == 0).any(1)]
    np.testing.assert_allclose(-on_lower.sum(0)[2], weight, rtol=1e-3)


def test_two_runs_are_equal(device):
    states = [run(device, *heap())[2][-1].points() for _ in range(2)]
    np.testing.assert_array_equal(*states)


def test_the_order_of_rods_does_not_matter(device):
    order = np.random.default_rng(2).permutation(27)
    first, second = (
        run(device, *heap(order=o), 25, rtol=1e-10)[2][-1].points().reshape(-1, 9, 3) for o in (None, order)
    )
    np.testing.assert_allclose(second, first[order], atol=1e-6 * RADIUS)


def test_worlds_do_not_touch_each_other(device):
    scene, velocities = heap()
    one = run(device, scene, velocities)[2][-1].points()
    model = scene.build(device=device, worlds=2)
    integrator = ddg.Integrator(model)
    state = model.state(velocities=np.stack([velocities, 0.0 * velocities]))
    for _ in range(25):
        state = integrator.step(state, 0.01)
    np.testing.assert_allclose(state.points()[0], one, atol=1e-6 * RADIUS)
    np.testing.assert_allclose(state.points()[1], model.state().points()[1], atol=1e-12)


def test_more_pairs_than_there_is_room_for(device):
    """The step is done again with more room, and is the same; it was not tried in shorter ones before."""
    scene, velocities = heap()
    _, usual, states = run(device, scene, velocities)
    expected = states[-1].points()
    model = scene.build(device=device)
    integrator = ddg.Integrator(model)
    for pairs in integrator._net.newton.contact.search.lists:
        pairs.reserve(1)
    integrator._net.newton.contact.search.version += 1
    integrator._net.newton.contact.terms.fit()
    state = model.state(velocities=velocities)
    for _ in range(25):
        state = integrator.step(state, 0.01)
    np.testing.assert_allclose(state.points(), expected, atol=1e-9)
    assert integrator.statistics()["retries"] == 0
    searches = [own.statistics()["contact"]["searches"] for own in (usual, integrator)]
    assert searches[1] <= searches[0] + 8


def crossing(apart: float, law: str = "barrier") -> ddg.Scene:
    scene = ddg.Scene()
    s = np.linspace(-0.05, 0.05, 11)
    for name, points in (("lower", np.stack([s, 0 * s, 0 * s], 1)), ("upper", np.stack([0 * s, s, 0 * s + apart], 1))):
        scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, name=name)
    scene.contact(law=law)
    return scene


def test_overlaps_at_the_start_are_refused(device):
    model = crossing(1.9 * RADIUS).build(device=device)
    with pytest.raises(ddg.SceneError, match=r"edge \d+ of rod 0 .* and edge \d+ of rod 1 .* overlap by 0.0002 m"):
        ddg.Integrator(model).step(model.state(), 0.01)


@pytest.mark.parametrize("law", ["barrier", "penalty"])
def test_derivatives_of_the_energy(device, law):
    """Forces of contact as the host's tangent has them are those of its energy, by central differences."""
    model = crossing((2.0 if law == "barrier" else 1.9) * RADIUS + 2e-4, law).build(device=device)
    state = model.state()
    q = state.net.q.numpy().copy()
    rng = np.random.default_rng(0)
    way = rng.normal(size=q.shape) * (np.arange(len(q)) < model.net.host.nodes)[:, None]

    def energy(h):
        other = state.copy()
        other.net.q.assign(q + h * way)
        return model.energies(other)["contact"]

    model.touch.at(state.net.q)
    slope = -(model.touch.terms.forces.numpy() * way).sum()
    h = 1e-8
    assert slope != 0.0
    np.testing.assert_allclose((energy(h) - energy(-h)) / (2 * h), slope, rtol=1e-5)


def test_refusals(device):
    scene = crossing(3 * RADIUS)
    scene.clamp([0, 1], edges=[0])
    with pytest.raises(ddg.SceneError, match="has contact already"):
        scene.contact()
    model = scene.build(device=device)
    for options in ({"scheme": "implicit_midpoint"}, {"solver": "projective"}):
        with pytest.raises(ddg.SceneError, match="contact: "):
            ddg.Integrator(model, **options)


@pytest.mark.parametrize("name", [pytest.param("noodles", marks=pytest.mark.slow), "crossed_beams"])
def test_chains_are_eliminated_by_one_thread_or_by_many(device, monkeypatch, name):
    """Contact's part of the bands is in both: the same iterations and the same motion but for rounding, by which one of hundreds of
    iterations may be more or less."""
    found = []
    for reduces in (False, True):
        monkeypatch.setattr(net_chains, "long_and_few", lambda *_, reduces=reduces: reduces)
        scene = import_module(f"ddg_warp.scenes.{name}").build()
        model = scene.build(device, precision="float64")
        integrator = ddg.Integrator(model, rtol=1e-5)  # above rounding, of which iterations are another number
        state = model.state()
        for _ in range(40):
            state = integrator.step(state, scene.analysis.dt)
        found.append((state.points(), integrator.statistics()))
    (one, by_one), (many, by_many) = found
    assert by_one["contact"]["contacts"]["mean"] > 0.0
    newton = [by["newton_iterations"]["mean"] * sum(by["outcomes"].values()) for by in (by_one, by_many)]
    assert abs(newton[1] - newton[0]) <= 1.0 + 1e-9
    assert abs(by_many["pcg_iterations"] - by_one["pcg_iterations"]) < 0.1 * by_one["pcg_iterations"]
    np.testing.assert_allclose(many, one, rtol=0.0, atol=1e-7)
