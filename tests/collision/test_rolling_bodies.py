"""Rolling of rigid balls, hollow balls and capsules by friction on their surfaces: closed forms."""

import numpy as np
import pytest

import ddg_warp as ddg
from tests.pairwise import covering

RADIUS, RANGE, STIFFNESS, G = 0.02, 2e-4, 1e5, 9.81
DT = 1e-3  # s


def body(scene, shape: str, center, **options) -> float:
    """Add a ball, a hollow ball or a capsule along y; return I / (m R^2) about y."""
    center = np.asarray(center, float)
    if shape == "hollow":
        inertia = np.full(3, 2.0 / 3.0 * 0.03 * RADIUS**2)
        scene.add_body(ddg.Sphere(tuple(center), RADIUS), mass=0.03, inertia=inertia, center=center, **options)
    elif shape == "capsule":
        ends = (tuple(center + [0.0, y, 0.0]) for y in (-0.03, 0.03))
        scene.add_body(ddg.Capsule(*ends, RADIUS), density=1000.0, **options)
    else:
        scene.add_body(ddg.Sphere(tuple(center), RADIUS), density=1000.0, **options)
    added = scene.bodies[-1]
    return (added.axes * added.moments @ added.axes.T)[1, 1] / (added.mass * RADIUS**2)


def run(model, steps: int, dt: float = DT, state=None):
    integrator, state = ddg.Integrator(model), state or model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    return state


def on_incline(shape: str, slope: float, mu: float, speed: float = 0.0):
    """Return a scene with a body on an incline, in contact, the downhill direction, and I / (m R^2)."""
    normal, down = np.array([np.sin(slope), 0.0, np.cos(slope)]), np.array([np.cos(slope), 0.0, -np.sin(slope)])
    scene = ddg.Scene()
    ratio = body(scene, shape, (RADIUS + 0.93 * RANGE) * normal, velocity=tuple(speed * down))
    scene.add_obstacle(ddg.Plane(normal=tuple(normal)))
    scene.contact(range=RANGE, stiffness=STIFFNESS, friction=mu)
    return scene, down, ratio


@covering(1, shape=("ball", "hollow", "capsule"), slides=(False, True))
def test_body_rolls_or_slides_down_an_incline(device, shape, slides):
    """A body with k = I / (m R^2) rolls down an incline while tan(slope) <= mu (1 + k) / k.

    Friction takes k / (1 + k) of the weight's component. The body then rolls with g sin / (1 + k): 5/7 and 3/5 of g sin for full and
    hollow balls. Else it slides with g (sin - mu cos), and friction spins it up by mu g cos / (k R).
    """
    slope = 0.5
    scene, down, k = on_incline(shape, slope, 0.1 if slides else 0.5)
    model, mu = scene.build(device), scene.contact_settings.friction
    settled = run(model, 60)
    later = run(model, 60, state=settled)
    before, after = (state.body(0) for state in (settled, later))
    time = later.time - settled.time
    assert (np.tan(slope) > mu * (1.0 + k) / k) == slides
    rate = G * (np.sin(slope) - mu * np.cos(slope)) if slides else G * np.sin(slope) / (1.0 + k)
    assert (after.velocity - before.velocity) @ down / time == pytest.approx(rate, rel=1e-4)
    spin = RADIUS * (after.angular_velocity - before.angular_velocity)[1] / time
    assert spin == pytest.approx(mu * G * np.cos(slope) / k if slides else rate, rel=2e-4)
    assert np.abs(after.angular_velocity[[0, 2]]).max() < 1e-9
    contacts = model.contacts(later)
    normal, friction = (np.linalg.norm(values.sum(0)) for values in (contacts.force, contacts.friction))
    weight = scene.bodies[0].mass * G
    assert normal == pytest.approx(weight * np.cos(slope), rel=1e-3)
    assert friction == pytest.approx(mu * normal if slides else weight * np.sin(slope) * k / (1.0 + k), rel=2e-3)


def test_rolling_distance_is_of_first_order(device):
    """A step h too far of implicit Euler, a t h / 2, is all the error of the distance a t^2 / 2."""
    scene, down, k = on_incline("ball", 0.3, 0.5)
    model, a, time, errors = scene.build(device), G * np.sin(0.3) / (1.0 + k), 0.16, []
    for dt in (4e-3, 2e-3):
        settled = run(model, 20, dt)
        state = run(model, round(time / dt), dt, settled)
        far, speed = (
            (getattr(state.body(0), n) - getattr(settled.body(0), n)) @ down for n in ("position", "velocity")
        )
        start = settled.body(0).velocity @ down
        assert speed == pytest.approx(a * time, rel=1e-4)
        errors.append(far - start * time - 0.5 * a * time**2)
        assert errors[-1] == pytest.approx(0.5 * a * time * dt, rel=0.02)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("precision", ["float64", "mixed"])
def test_sliding_ball_comes_to_roll(device, precision):
    """A ball of speed v0 without spin rolls with 5/7 v0, whatever mu: m v R + I w about the contact line stays."""
    speed, mu = 0.4, 0.2
    scene, _, k = on_incline("ball", 0.0, mu, speed)
    model = scene.build(device, precision=precision)
    sliding = run(model, 30)
    rolling = run(model, 70, state=sliding)
    for state in (sliding, rolling):
        ball = state.body(0)
        assert ball.velocity[0] + k * RADIUS * ball.angular_velocity[1] == pytest.approx(speed, rel=1e-5)
        assert np.abs(ball.velocity[1]) + np.abs(ball.angular_velocity[[0, 2]]).max() < 1e-6
    assert sliding.body(0).velocity[0] > 0.8 * speed
    assert rolling.body(0).velocity[0] == pytest.approx(5.0 / 7.0 * speed, rel=1e-4)
    assert RADIUS * rolling.body(0).angular_velocity[1] == pytest.approx(5.0 / 7.0 * speed, rel=1e-3)


def test_grazing_balls_spin_each_other(device):
    """Friction between two balls keeps the angular momentum, but for the gap between the surfaces, and spins both alike."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    body(scene, "ball", (-0.5 * RADIUS, 0.0, 0.0), velocity=(0.5, 0.0, 0.0), name="first")
    body(scene, "ball", (0.9 * RADIUS, 1.6 * RADIUS, 0.0), name="second")
    scene.contact(range=1e-3, stiffness=1e3, friction=0.5)
    model = scene.build(device, worlds=2)
    state = model.state()
    mass = scene.bodies[0].mass

    def momenta(state):
        """Return the angular momentum of spins, and of all, about the origin along z."""
        spins = state.coupled.momentum.numpy()[:2, 2].sum()
        poses = [state.body(name) for name in ("first", "second")]
        return spins, spins + sum(mass * np.cross(p.position[0], p.velocity[0])[2] for p in poses)

    before = momenta(state)[1]
    state = run(model, 200, 5e-4)
    spins, total = momenta(state)
    assert np.abs(spins) > 0.05 * np.abs(before)
    assert total == pytest.approx(before, abs=1e-3 * RANGE / RADIUS + 0.03 * np.abs(spins))
    rates = [state.body(name).angular_velocity for name in ("first", "second")]
    np.testing.assert_allclose(*rates, rtol=1e-9)
    np.testing.assert_array_equal(rates[0][0], rates[0][1])


def walking(slope: float, legs: int, gyration2: float) -> tuple[float, float, float]:
    """Return mean rate and rate after an impact of a rimless wheel (leg = g = 1), and the time of a leg's step.

    The wheel falls over a foot as a pendulum. Plastic impacts about the new foot multiply its rate by
    (k^2 + cos 2a) / (k^2 + 1), a = pi / legs, with the radius of gyration k.
    """
    a = np.pi / legs
    kept = ((gyration2 + np.cos(2.0 * a)) / (gyration2 + 1.0)) ** 2
    gained = 2.0 * (np.cos(slope - a) - np.cos(slope + a)) / (1.0 + gyration2)
    square = kept * gained / (1.0 - kept)
    angle = slope - a + 2.0 * a * (np.arange(4000) + 0.5) / 4000
    rates = np.sqrt(square + 2.0 * (np.cos(slope - a) - np.cos(angle)) / (1.0 + gyration2))
    time = 2.0 * a * np.mean(1.0 / rates)
    return 2.0 * a / time, np.sqrt(square), time


def test_rimless_wheel_walks_at_its_rate(device):
    """A wheel of eight legs walks down a slope at the rate of plastic impacts, by steps of a 200th of a leg's step."""
    slope, legs, gyration2, foot = np.radians(15.0), 8, 0.1, 1e-3
    rate, start, time = walking(slope, legs, gyration2)
    assert rate == pytest.approx(0.703393, rel=1e-5)
    scene, half = ddg.Scene(gravity=(0.0, 0.0, -1.0)), np.pi / legs
    normal, lean = np.array([np.sin(slope), 0.0, np.cos(slope)]), slope - half
    up = np.array([np.sin(lean), 0.0, np.cos(lean)])
    center = 1.3 * foot * normal + up
    directions = lean + np.pi + 2.0 * half * np.arange(legs)
    feet = [center + [np.sin(d), y, np.cos(d)] for d in directions for y in (-0.3, 0.3)]
    inertia = gyration2 * np.array([5.0, 1.0, 5.0])
    shapes = [ddg.Sphere(tuple(x), foot) for x in feet]
    spin = np.array([0.0, start, 0.0])
    motion = {"velocity": tuple(np.cross(spin, up)), "angular_velocity": tuple(spin)}
    scene.add_body(shapes, mass=1.0, inertia=inertia, center=tuple(center), **motion)
    scene.add_obstacle(ddg.Plane(normal=tuple(normal)))
    scene.contact(friction=1.0)
    integrator, state, angle, impacts = ddg.Integrator(model := scene.build(device)), model.state(), 0.0, []
    while len(impacts) < 6:
        state = integrator.step(state, time / 200)
        angle += float(state.body(0).angular_velocity[1]) * time / 200
        if angle > 2.0 * half * (len(impacts) + 1):
            impacts.append(state.time)
    assert 8.0 * half / (impacts[5] - impacts[1]) == pytest.approx(rate, rel=0.02)
