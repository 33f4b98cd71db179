"""Hard cases of contact: parallel and coincident edges, stacks, whips, stiff and soft contact, many contacts."""

import numpy as np
import pytest
from hard_cases import (
    DENSITY,
    MU,
    RADIUS,
    RANGE,
    WEIGHT,
    assert_no_energy_is_made,
    energy,
    fix_nodes,
    forces_on,
    heap_at_rest,
    least_gap,
    line,
    mass_of_node,
    rod,
    run,
)

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from tests.pairwise import covering


@covering(1, law=("barrier", "penalty"), pull=(0.2, 0.6))
def test_rod_in_the_groove_of_two_parallel_rods(device, pull, law):
    """Three rods are parallel; both normal forces are N / 2 = W / (2 cos a), and friction is at most mu N.

    The rod sticks, creeping below the stick threshold, or slides by T / m - mu N / m.
    """
    length, velocity, dt = 0.1, 1e-4, 2e-3
    scene = ddg.Scene()
    for name, y in (("left", -1.3 * RADIUS), ("right", 1.3 * RADIUS)):
        fix_nodes(scene, rod(scene, line(0.4, 40, middle=(0.1, y, 0.0)), name), 41)
    height = np.sqrt(2.2**2 - 1.3**2) * RADIUS
    upper = rod(scene, line(length, 10, middle=(0.0, 0.0, height)), "upper")
    for node in range(11):
        fraction = (0.5 if node in (0, 10) else 1.0) / 10.0
        scene.add_force(upper, node, (pull * WEIGHT * length * fraction, 0.0, 0.0))
    scene.contact(law=law, friction=MU, velocity=velocity)
    model, integrator, states = run(scene, device, 100, dt, rtol=1e-8)
    speeds = np.array([state.velocities()[82:].mean(0) for state in states])
    if pull < MU:
        assert 0.0 < speeds[-1, 0] < velocity
    else:  # all of the friction is along the groove
        forces = [forces_on(model.contacts(state), 2) / (WEIGHT * length) for state in states[51:]]
        up = np.mean([force.sum(0)[2] for force in forces])
        assert up - 1.0 == pytest.approx((speeds[-1, 2] - speeds[50, 2]) / (50 * dt) / 9.81, abs=1e-3)
        normal = np.mean([np.linalg.norm(force, axis=1).sum() for force in forces])
        acceleration = (speeds[-1, 0] - speeds[50, 0]) / (50 * dt) / 9.81
        assert acceleration == pytest.approx(pull - MU * normal, rel=0.01)
    assert np.abs(speeds[:, 1]).max() < 1e-9
    if law == "barrier":
        assert integrator.statistics()["contact"]["smallest_gap"] > 0.0
        assert least_gap(model, states[-1]) > 0.0


def parallel_rods(gap: float, shift: float = 0.0) -> ddg.Scene:
    """Return two equal parallel rods above each other."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod(scene, line(0.1, 10), "lower")
    rod(scene, line(0.1, 10, middle=(shift, 0.0, 2.0 * RADIUS + gap)), "upper")
    scene.contact(range=RANGE)
    return scene


@pytest.mark.parametrize("shift", [0.0, 0.005, 0.0025])
def test_force_of_parallel_edges_is_the_energy_gradient(device, shift):
    """F = -dE/dgap by central differences, node over node, over the middle of an edge, and between; zero at the range."""
    gap, h = 0.4 * RANGE, 1e-7 * RANGE

    def evaluate(gap):
        model = parallel_rods(gap, shift).build(device=device)
        return model, model.contacts(model.state()), model.energies(model.state())["contact"]

    force = forces_on(evaluate(gap)[1], 1).sum(0)
    slope = (evaluate(gap + h)[2] - evaluate(gap - h)[2]) / (2.0 * h)
    np.testing.assert_allclose(force, [0.0, 0.0, -slope], rtol=1e-6, atol=1e-12 * abs(slope))
    assert slope < 0.0
    assert evaluate(RANGE)[2] == 0.0
    _, contacts, least = evaluate(RANGE * (1.0 - 1e-9))
    assert np.isfinite(contacts.force).all()
    assert 0.0 <= least < 1e-18 * evaluate(gap)[2]
    _, _, states = run(parallel_rods(RANGE), device, 5, 0.01)
    np.testing.assert_array_equal(states[-1].points(), states[0].points())


def test_coincident_edges_are_refused(device):
    model = parallel_rods(-2.0 * RADIUS).build(device=device)
    with pytest.raises(ddg.SceneError, match=r"edge \d+ of rod 0 .* and edge \d+ of rod 1 .* overlap by 0.004 m"):
        ddg.Integrator(model).step(model.state(), 0.01)


def test_collinear_rods_collide_end_to_end(device):
    """The rods bounce along the line and never move sideways; momentum is zero throughout."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod(scene, line(0.1, 10, middle=(-0.05 - 1.5 * RADIUS, 0.0, 0.0)), "left")
    rod(scene, line(0.1, 10, middle=(0.05 + 1.5 * RADIUS, 0.0, 0.0)), "right")
    scene.contact(friction=MU)
    speed = np.repeat([[0.3, 0.0, 0.0], [-0.3, 0.0, 0.0]], 11, axis=0)
    model, _, states = run(scene, device, 60, 1e-3, velocities=speed, rtol=1e-10)
    assert max(len(model.contacts(state)) for state in states) == 1
    assert min(least_gap(model, state) for state in states) > 0.0
    left, right = states[-1].velocities().reshape(2, 11, 3).mean(1)
    assert left[0] < -0.1
    assert left[0] + right[0] == pytest.approx(0.0, abs=1e-9)
    assert not states[-1].points()[:, 1:].any()
    assert_no_energy_is_made(energy(model, states))


@pytest.mark.parametrize("layers", [8, pytest.param(50, marks=pytest.mark.slow)])
def test_stacked_sheets_carry_the_weight_above(device, layers):
    """Sheets k and k + 1 exchange (layers - 1 - k) m g, and the floor carries all sheets."""
    thickness, gap, side = 1e-3, 2.5e-4, 0.02
    scene = ddg.Scene(mass_damping=5.0)
    material = ddg.Material(young=1e6, density=DENSITY, poisson=0.3)
    for layer in range(layers):
        points, triangles = meshes.rectangle(2, 2, (side, side), "alternating")
        points = points + [0.0, 0.0, 0.5 * (thickness + gap) + layer * (thickness + 0.8 * gap)]
        scene.add_shell(points, triangles, thickness=thickness, material=material, bending="hinge", name=f"{layer}")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(range=gap, friction=MU)
    model, integrator, states = run(scene, device, 100, 0.02)
    weight, contacts = DENSITY * thickness * side**2 * 9.81, model.contacts(states[-1])
    assert (np.ptp(contacts.objects, axis=1) == 1).sum() + (contacts.objects.max(1) == layers).sum() >= len(contacts)
    between = [contacts.objects.max(1) == layer + 1 for layer in range(layers - 1)]
    carried = np.array([np.abs(contacts.force[rows, 2]).sum() for rows in between]) / weight
    np.testing.assert_allclose(carried, np.arange(layers - 1, 0, -1), atol=1e-5 * layers)
    np.testing.assert_allclose(forces_on(contacts, layers).sum(0) / weight, [0.0, 0.0, -layers], atol=1e-5 * layers)
    heights = states[-1].points()[:, 2].reshape(layers, -1)
    assert (heights[1:].min(1) - heights[:-1].max(1) > thickness).all()  # order and thickness kept
    assert (np.diff(heights.mean(1)) < thickness + gap).all()
    drift = states[-1].points()[:, :2] - states[0].points()[:, :2]
    assert np.abs(drift).max() < 1e-3 * side
    assert 0.0 < integrator.statistics()["contact"]["smallest_gap"]


FAST, FRAME = 100.0, 1.0 / 60.0  # m/s, s
WHIP = ddg.Material(young=1e8, density=DENSITY, poisson=0.5)


def whip(device, target: str, retries: int):
    """Return the run of a whip towards a target, and the position of the target.

    A rod of 0.5 m is clamped at one end; the other end starts at 100 m/s. The target is halfway along the rod.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.clamp_end(rod(scene, line(0.5, 20, middle=(0.25, 0.0, 0.0)), "whip", WHIP), "first")
    position = np.array([0.25, 0.05])
    if target == "post":
        scene.add_obstacle(ddg.Capsule((*position, -1.0), (*position, 1.0), 0.01), name="post")
    elif target == "rod":
        string = rod(scene, line(0.4, 20, (0.0, 0.0, 1.0), (*position, 0.0)), "string", WHIP)
        for end in ("first", "last"):
            scene.clamp_end(string, end)
    else:  # out of the whip's reach, so that it passes by
        scene.add_obstacle(ddg.Capsule((0.5, 0.5, -1.0), (0.5, 0.5, 1.0), 0.01), name="post")
    scene.contact(friction=0.2)
    model = scene.build(device=device)
    speed = np.zeros_like(model.state().points())
    speed[:21, 1] = FAST * np.linspace(0.0, 1.0, 21)
    return run(scene, device, 20, FRAME, velocities=speed, retries=retries), position


def winding(points: np.ndarray, axis: np.ndarray) -> float:
    """Return the winding angle of a curve about an axis along z [rad]."""
    away = points[:, :2] - axis
    step = np.diff(np.arctan2(away[:, 1], away[:, 0]))
    return float(((step + np.pi) % (2.0 * np.pi) - np.pi).sum())


def test_whip_winds_about_a_post(device):
    """The tip moves 1.7 m in a step. The winding angle is positive, and negative had the rod crossed the post."""
    (model, integrator, states), axis = whip(device, "post", retries=4)
    angles = [winding(state.points()[:21], axis) for state in states]
    assert min(angles) > 0.0
    assert max(angles) > 1.5 * np.pi
    assert integrator.statistics()["contact"]["smallest_gap"] > 0.0
    assert_no_energy_is_made(energy(model, states))
    again = whip(device, "post", retries=4)[0][2]
    np.testing.assert_array_equal(again[-1].points(), states[-1].points())


def test_whip_hits_another_rod(device):
    """The rods bend. Steps in which centrelines would cross are counted and repeated in substeps."""
    (model, integrator, states), _ = whip(device, "rod", retries=120)
    assert integrator.statistics()["contact"]["smallest_gap"] > 0.0
    assert min(least_gap(model, state) for state in states) > 0.0
    moved = np.abs(states[1].points()[21:] - states[0].points()[21:]).max()
    assert moved > 10.0 * RADIUS
    assert_no_energy_is_made(energy(model, states))


def test_fast_rod_passes_obstacles_beyond_range_unslowed(device):
    """The gaps to an obstacle and to a rod exceed the range, and the rod moves 1.7 m in a step: nothing decelerates it."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod(scene, line(0.1, 10), "shot")
    fix_nodes(scene, rod(scene, line(0.1, 10, (0.0, 1.0, 0.0), (3.0, 0.0, 3.1 * RADIUS)), "gate"), 11)
    scene.add_obstacle(ddg.Capsule((2.0, -1.0, -0.0131), (2.0, 1.0, -0.0131), 0.01), name="rail")
    scene.contact(range=RANGE, friction=MU)
    speed = np.zeros((22, 3))
    speed[:11, 0] = FAST
    _, integrator, states = run(scene, device, 5, FRAME, velocities=speed)
    displacement = states[-1].points()[:11] - states[0].points()[:11]
    np.testing.assert_allclose(
        displacement, np.broadcast_to([5 * FAST * FRAME, 0.0, 0.0], displacement.shape), atol=1e-9
    )
    assert integrator.statistics()["contact"]["contacts"] == {"mean": 0.0, "last": 0}


@covering(1, ratio=(1e-3, 1.0, 1e4), young=(1e4, 1e9, 1e6))
def test_collisions_at_any_stiffness_ratio_lose_energy(device, ratio, young):
    """Contact stiffness over m / dt^2 and Young's modulus vary: colliding rods bounce and only lose energy."""
    dt = 1e-3
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    material = ddg.Material(young=young, density=DENSITY, poisson=0.5)
    rod(scene, line(0.1, 10), "lower", material)
    rod(scene, line(0.1, 10, (0.0, 1.0, 0.0), (0.0, 0.0, 2.8 * RADIUS)), "upper", material)
    scene.contact(range=RANGE, stiffness=ratio * mass_of_node(10) / dt**2, friction=MU)
    speed = np.repeat([[0.0, 0.0, 0.0], [0.05, 0.0, -0.3]], 11, axis=0)
    model, integrator, states = run(scene, device, 60, dt, velocities=speed, rtol=1e-13)
    mass = model.coupled.host.mass[:22, :1]
    momenta = np.array([(mass * state.velocities()).sum(0) for state in states])
    assert np.abs(momenta - momenta[0]).max() < 1e-9 * np.abs(momenta).max()
    assert 0.0 < integrator.statistics()["contact"]["smallest_gap"] < RANGE
    assert_no_energy_is_made(energy(model, states))
    lower, upper = momenta[-1, 2], (mass * states[-1].velocities())[11:, 2].sum()
    assert lower - upper < 0.0  # the lower rod has taken momentum


@pytest.mark.parametrize("ratio", [1e-3, 1e4])
def test_stiff_and_soft_contact_carry_the_weight(device, ratio):
    # a landing on soft contact closes most of the gap at once, and that step is repeated
    model, integrator, states = run(heap_at_rest(ratio, 2e-3), device, 300, 2e-3, retries=int(ratio < 1.0))
    contacts = model.contacts(states[-1])
    np.testing.assert_allclose(forces_on(contacts, 4).sum(0) / (WEIGHT * 0.1), [0.0, 0.0, -4.0], atol=1e-4)
    assert 0.0 < integrator.statistics()["contact"]["smallest_gap"] <= contacts.gap.min() + 1e-12


def test_too_soft_contact_is_reported(device):
    """The force k range^2 / gap stays below the weight down to a thousandth of the range."""
    with pytest.raises(
        ddg.SolverError, match=r"no_room .* point \d+ of rod \d .* give their contact a larger stiffness"
    ) as error:
        run(heap_at_rest(1e-4, 2e-3), device, 300, 2e-3)
    assert error.value.outcome == "no_room"
    assert np.isfinite(error.value.state.points()).all()


def test_grating_of_sixty_bars_carries_a_rod_evenly(device):
    """Each inner bar carries the load of one pitch, and all bars together carry the whole load."""
    bars, pitch = 60, 6.0 * RADIUS
    scene = ddg.Scene(mass_damping=10.0)
    for bar in range(bars):
        fix_nodes(scene, rod(scene, line(0.04, 4, (0.0, 1.0, 0.0), ((bar + 1) * pitch, 0.0, 0.0)), "bar"), 5)
    length, edges = (bars + 1) * pitch, 2 * (bars + 1)
    upper = rod(scene, line(length, edges, middle=(0.5 * length, 0.0, 2.3 * RADIUS)), "upper")
    pressed = 50.0 * WEIGHT * length / edges
    for node in range(edges + 1):
        scene.add_force(upper, node, (0.0, 0.0, -pressed))
    scene.contact(range=RANGE, friction=MU)
    model, integrator, states = run(scene, device, 150, 0.01)
    contacts = model.contacts(states[-1])
    carried = np.array([-forces_on(contacts, bar).sum(0)[2] for bar in range(bars)])
    assert carried.min() > 0.0
    # the ends hang down, so that friction on the last bars carries a little
    assert carried.sum() == pytest.approx(WEIGHT * length + (edges + 1) * pressed, rel=2e-3)
    np.testing.assert_allclose(carried[20:40], WEIGHT * pitch + 2.0 * pressed, rtol=1e-4)
    assert integrator.statistics()["contact"]["smallest_gap"] > 0.0


@pytest.mark.parametrize("speed", [0.0, 1e-3, 1.0])
def test_friction_of_a_state_follows_its_velocities(device, speed):
    """A rod within range of a floor moves at 30 degrees to x: friction is mu N (2 / (1 + exp(-15 v / nu)) - 1) against the motion."""
    velocity, direction = 5e-3, np.array([np.cos(np.pi / 6.0), 0.5, 0.0])
    scene = ddg.Scene()
    points = line(0.1, 10, middle=(0.0, 0.0, RADIUS + 0.5 * RANGE))
    rod(scene, points)
    scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0)), name="floor")
    scene.contact(range=RANGE, friction=MU, velocity=velocity)
    model = scene.build(device=device)
    contacts = model.contacts(model.state(velocities=np.tile(speed * direction, (11, 1))))
    on_rod = forces_on(contacts, 0)
    assert (on_rod[:, 2] > 0.0).all() and len(contacts) == 11
    sign = (contacts.objects == 0).astype(float) @ [1.0, -1.0]
    ratio = 2.0 / (1.0 + np.exp(-15.0 * speed / velocity)) - 1.0
    expected = -MU * ratio * on_rod[:, 2:] * direction
    np.testing.assert_allclose(sign[:, None] * contacts.friction, expected, rtol=1e-6, atol=1e-12)


def test_reported_friction_decelerates_a_rod(device):
    """A settled rod slides on a floor: over a small step friction alone changes the momentum."""
    scene = ddg.Scene()
    rod(scene, line(0.1, 10, middle=(0.0, 0.0, RADIUS + 0.6 * RANGE)))
    scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0)), name="floor")
    scene.contact(range=RANGE, friction=MU)
    model, _, states = run(scene, device, 400, 1e-3, velocities=np.tile([2.0, 0.0, 0.0], (11, 1)), rtol=1e-8)
    mass = WEIGHT * 0.1 / 9.81
    contacts = model.contacts(states[-1])
    sign = (contacts.objects == 0).astype(float) @ [1.0, -1.0]
    slowed = mass * (states[-1].velocities()[:, 0].mean() - states[-2].velocities()[:, 0].mean()) / 1e-3
    assert (sign * contacts.friction[:, 0]).sum() == pytest.approx(slowed, rel=0.02)
    assert slowed == pytest.approx(-MU * mass * 9.81, rel=0.02)
    floor = model.reactions(states[-1])[-1].force  # contact and friction on the floor
    np.testing.assert_allclose(floor, (contacts.force + contacts.friction).T @ sign, rtol=1e-9, atol=1e-12)
    assert floor[0] < 0.0 < floor[2]
