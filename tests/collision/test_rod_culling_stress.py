"""Invariants of whole runs with friction: momentum, energy, rest, no self-crossing, and the order of objects."""

import numpy as np
import pytest
from hard_cases import (
    MU,
    RADIUS,
    RANGE,
    SOFT,
    WEIGHT,
    assert_no_energy_is_made,
    forces_on,
    heap_at_rest,
    least_gap,
    line,
    rod,
    run,
)
from test_steps import heap

import ddg_warp as ddg
from ddg_warp.geometry import meshes

LAWS = pytest.mark.parametrize("law", ["barrier", "penalty"])


def colliding_objects(friction: float, law: str) -> tuple[ddg.Scene, np.ndarray]:
    """Return two rods without twist and a sheet that collide, and velocities."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod(scene, line(0.1, 10, middle=(0.0, 0.01, 0.03)), "first", twist=False)
    rod(scene, line(0.1, 10, (0.0, 1.0, 0.0), (0.0, 0.0, 0.04)), "second", twist=False)
    points, triangles = meshes.rectangle(4, 4, (0.08, 0.08), "alternating")
    points = points - [0.04, 0.04, 0.0]
    scene.add_shell(points, triangles, thickness=2e-3, material=SOFT, bending="hinge")
    scene.contact(law=law, range=RANGE, friction=friction)
    counts = (11, 11, len(points))
    return scene, np.repeat([[1.0, 0.5, -3.0], [0.0, 0.2, -6.0], [0.0, 0.0, 2.0]], counts, axis=0)


@LAWS
@pytest.mark.parametrize("friction", [0.0, MU])
def test_internal_contact_conserves_momentum(device, friction, law):
    """Contact and friction forces sum to zero to rounding, as do moments of contact; momentum is conserved to the solver's tolerance.

    Implicit Euler has sum x1 x m (v1 - v0) = 0 where the moments of all forces vanish. Friction acts between centrelines, whose
    distance is the arm of a couple, so that this holds without friction only.
    """
    scene, speed = colliding_objects(friction, law)
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model, rtol=1e-11), model.state(velocities=speed)
    contact, mass = integrator._coupled.newton.contact, model.coupled.host.mass[: len(speed), :1]
    start, size, total = (mass * speed).sum(0), (mass * np.abs(speed)).sum(), [sum(model.energies(state).values())]
    largest = 0.0
    for _ in range(40):
        before, state = state.velocities(), integrator.step(state, 2e-3)
        after, points = state.velocities(), state.points()
        forces = contact.terms.forces.numpy()[: len(speed)]  # with friction
        assert np.abs(forces.sum(0)).max() <= 1e-13 * max(np.abs(forces).sum(), 1e-300)
        model.touch.evaluate(state.coupled.q)
        forces = model.touch.terms.forces.numpy()[: len(speed)]  # without
        largest = max(largest, np.abs(forces).sum())
        moments = np.cross(points, forces)
        assert np.abs(moments.sum(0)).max() <= 1e-13 * max(np.abs(forces).sum() * np.abs(points).max(), 1e-300)
        assert np.abs((mass * after).sum(0) - start).max() < 1e-10 * size
        if not friction:
            change = (mass * np.cross(points, after - before)).sum(0)
            assert np.abs(change).max() < 1e-10 * size * np.abs(points).max()
        total.append(sum(model.energies(state).values()))
    assert largest > 1.0
    assert_no_energy_is_made(np.array(total))
    assert integrator.statistics()["contact"]["refused_crossings"] == 0


@LAWS
def test_friction_never_adds_energy(device, law):
    """The energy of 27 colliding rods falls in every step, more so with friction. Friction work never decreases."""
    total, works = {}, []
    for friction in (0.0, 0.5):
        scene, speed = heap(law, **({"friction": friction, "velocity": 1e-2} if friction else {}))
        model = scene.build(device=device)
        integrator, state = ddg.Integrator(model), model.state(velocities=speed)
        total[friction] = [sum(model.energies(state).values())]
        for _ in range(60):
            state = integrator.step(state, 0.01)
            total[friction].append(sum(model.energies(state).values()))
            works.append(integrator.statistics()["contact"].get("friction_work", 0.0))
        assert_no_energy_is_made(np.array(total[friction]))
    works = np.array(works[60:])
    assert (np.diff(works) >= 0.0).all()
    assert 0.0 < works[-1] < total[0.5][0] - total[0.5][-1]


def test_rod_on_a_slope_creeps_by_the_friction_law_for_a_minute(device):
    """The rod creeps at nu atanh(tan(slope) / mu) / 7.5, by the logistic law below nu, and does not sink."""
    slope, friction, velocity = 0.3, 0.5, 1e-4
    normal, down = np.array([np.sin(slope), 0.0, np.cos(slope)]), np.array([np.cos(slope), 0.0, -np.sin(slope)])
    scene = ddg.Scene()
    rod(scene, line(0.1, 10, (0.0, 1.0, 0.0), 1.3 * RADIUS * normal))
    scene.contact(friction=friction, velocity=velocity)
    scene.add_obstacle(ddg.Plane(normal=tuple(normal)))
    _, _, states = run(scene, device, 1200, 0.05)
    settled, last = (state.points() for state in (states[200], states[-1]))
    creep = ((last - settled) @ down).mean() / 50.0
    assert creep == pytest.approx(velocity * np.arctanh(np.tan(slope) / friction) / 7.5, rel=0.01)
    assert creep < velocity
    assert np.abs((last - settled) @ normal).max() < 1e-8 * RADIUS


def test_heap_stays_at_rest_for_a_minute(device):
    """Friction stops bent rods but for a creep of a hundredth of the threshold, 1e-5 m/s."""
    model, integrator, states = run(heap_at_rest(None, 0.05), device, 1200, 0.05)
    moved = np.abs(states[-1].points() - states[200].points()).max()
    assert moved < 0.01 * 1e-5 * 50.0
    assert np.abs(states[-1].velocities()).max() < 1e-7
    contacts = model.contacts(states[-1])
    assert -forces_on(contacts, 4).sum(0)[2] == pytest.approx(4 * 0.1 * WEIGHT, rel=1e-4)
    assert integrator.statistics()["contact"]["smallest_gap"] > 0.0


@pytest.mark.parametrize("cells", [8, pytest.param(16, marks=pytest.mark.slow)])
def test_crumpled_sheet_never_crosses_itself(device, cells):
    """Six planes close in to a fifth of the side; the sheet has self-contact all over and crosses itself nowhere."""
    side, thickness, dt, steps, least = 0.1, 1e-3, 0.02, 60, 0.2
    points, triangles = meshes.rectangle(cells, cells, (side, side), "alternating")
    points = points - [0.5 * side, 0.5 * side, 0.0]
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), mass_damping=5.0)
    material = ddg.Material(young=1e5, density=500.0, poisson=0.3)
    scene.add_shell(points, triangles, thickness=thickness, material=material, bending="hinge", name="sheet")
    half = 0.55 * side
    for axis in np.eye(3):
        for direction in (axis, -axis):
            inwards = -(1.0 - least) * half * direction
            motion = ddg.Motion(translation=lambda t, inwards=inwards: inwards * min(1.0, t / (0.8 * dt * steps)))
            scene.add_obstacle(ddg.Plane(half * direction, -direction), motion=motion, name="wall")
    scene.contact(range=0.5 * thickness, friction=MU)
    start = points + np.random.default_rng(1).normal(size=points.shape) * [0.0, 0.0, 0.5 * thickness]

    def crumple():
        return run(scene, device, steps, dt, points=start, retries=30)

    model, integrator, states = crumple()
    last = states[-1]
    assert np.abs(last.points()).max() < least * half - 0.5 * thickness
    contacts = model.contacts(last)
    itself = (contacts.objects == 0).all(1)
    assert itself.sum() > 10 * cells
    assert min(least_gap(model, state) for state in states[1::10]) > 0.0
    assert least_gap(model, last) == pytest.approx(contacts.gap[itself].min(), rel=1e-9)
    assert integrator.statistics()["contact"]["smallest_gap"] > 0.0
    if cells == 8:
        np.testing.assert_array_equal(crumple()[2][-1].points(), last.points())


NAMES = ["sheet", "ball", "floor", "rod0", "rod1", "rod2"]
ON_THE_CPU = [
    [-0.045911025167, -0.046871163442, -0.028095957669],
    [0.048575888615, -0.049497165012, -0.009383987732],
    [-0.039333623282, 0.052767499484, -0.026302795892],
    [0.049588789456, 0.048814762426, 0.007498368537],
    [-0.001502613809, -0.000281193273, 0.004322417321],
    [0.007388486209, -0.006061345501, 0.007286669772],
    [0.013543066882, -0.014587707002, 0.008631682046],
]


def drop_objects(device, order) -> dict[str, np.ndarray]:
    """Return positions after 0.3 s by object, added in some order: a sheet falls on a ball and a floor, and rods on the sheet."""
    points, triangles = meshes.rectangle(4, 4, (0.1, 0.1), "alternating")
    scene = ddg.Scene(mass_damping=1.0)
    for name in order:
        if name == "sheet":
            sheet = points - [0.05, 0.05, -0.01]
            scene.add_shell(sheet, triangles, thickness=2e-3, material=SOFT, bending="hinge", name=name)
        elif name == "ball":
            scene.add_obstacle(ddg.Sphere((0.01, 0.005, -0.03), 0.03), name=name)
        elif name == "floor":
            scene.add_obstacle(ddg.Plane((0.0, 0.0, -0.03)), name=name)
        else:
            k = int(name[-1])
            along = (np.cos(0.4 + 1.1 * k), np.sin(0.4 + 1.1 * k), 0.0)
            rod(scene, line(0.1, 10, along, (0.01 * k, 0.0, 0.02 + 0.012 * k)), name)
    scene.contact(range=RANGE, friction=MU)
    model, _, states = run(scene, device, 60, 0.005, rtol=1e-10)
    assert len(model.contacts(states[-1])) > 20
    x = states[-1].points()
    rods = [name for name in order if name.startswith("rod")]
    return {"sheet": x[33:]} | {name: x[11 * k : 11 * k + 11] for k, name in enumerate(rods)}


@pytest.mark.parametrize("order", [NAMES[::-1], ["rod1", "floor", "sheet", "rod2", "rod0", "ball"]])
def test_the_order_of_objects_does_not_matter(device, order):
    first = drop_objects(device, NAMES)
    for name, points in drop_objects(device, order).items():
        np.testing.assert_allclose(points, first[name], atol=1e-6 * RADIUS)


def test_devices_agree(device):
    """Corners of the sheet and middles of the rods equal a float64 run on one core to a millionth of a radius [m]."""
    positions = drop_objects(device, NAMES)
    points = np.concatenate([positions["sheet"][[0, 4, 20, 24]], [positions[f"rod{k}"][5] for k in range(3)]])
    np.testing.assert_allclose(points, ON_THE_CPU, atol=1e-6 * RADIUS)
