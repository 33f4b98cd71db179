"""Rolling contact: closed forms, and derivatives and blocks of the friction potential."""

import numpy as np
import pytest
from friction_cases import ROLLING, assert_central_differences, each_form, friction_terms
from pair_cases import assembled_hessian, assert_repeatable

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.errors import SceneError
from ddg_warp.scenes import capstan
from tests.pairwise import covering

RADIUS, G = 2e-3, 9.81
STIFF = ddg.Material(young=1e7, density=1000.0, poisson=0.4)
ALONG_Y = np.outer(np.linspace(-0.05, 0.05, 11), [0.0, 1.0, 0.0])


def rod(scene, points, **options) -> int:
    return scene.add_rod(points, section=ddg.Circle(RADIUS), material=STIFF, **options)


def spin(model, state, rod: int = 0) -> np.ndarray:
    """Return the rates of the twist angles of a rod [rad/s]."""
    return state.coupled.v.numpy()[model.coupled.host.rods[rod].edges, 0]


def run(model, steps: int, dt: float = 1e-3, state=None, **options):
    integrator, state = ddg.Integrator(model, **options), state or model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    return state


@covering(1, case=((0.3, 0.5), (0.3, 0.2), (0.5, 0.1), (0.5, 0.15)), mesh=(False, True))
def test_cylinder_rolls_or_slides_down_a_slope(device, case, mesh):
    """A cylinder, I = m r^2 / 2, rolls with 2/3 g sin while tan(slope) <= 3 mu.

    Else it slides with g (sin - mu cos), and friction spins it up by 2 mu g cos / r.
    """
    slope, mu = case
    normal, down = np.array([np.sin(slope), 0.0, np.cos(slope)]), np.array([np.cos(slope), 0.0, -np.sin(slope)])
    scene = ddg.Scene()
    rod(scene, ALONG_Y + 1.48 * RADIUS * normal)
    corners = np.array([-0.3 * down + [0.0, -0.3, 0.0], 0.6 * down + [0.0, -0.3, 0.0], [0.0, 0.6, 0.0]])
    scene.add_obstacle(ddg.Mesh(corners, [[0, 1, 2]]) if mesh else ddg.Plane(normal=tuple(normal)))
    scene.contact(friction=mu, rolling=True)
    model = scene.build(device)
    state = run(model, 150)
    speed, spin_rate = (state.velocities() @ down).mean(), spin(model, state).mean()
    rolls = np.tan(slope) <= 3.0 * mu
    expected = 2.0 / 3.0 * G * np.sin(slope) if rolls else G * (np.sin(slope) - mu * np.cos(slope))
    np.testing.assert_allclose(speed / state.time, expected, rtol=2e-3)
    expected_spin = speed / RADIUS if rolls else 2.0 * mu * G * np.cos(slope) / RADIUS * state.time
    np.testing.assert_allclose(spin_rate, expected_spin, rtol=5e-3)


@pytest.mark.parametrize("law", ["barrier", "penalty"])
def test_sliding_rod_starts_to_roll(device, law):
    """A rod of speed v0 without spin rolls after v0 / (3 mu g) with 2/3 v0, whatever mu; friction has taken a third of the energy."""
    mu, v0 = 0.2, 0.4
    scene = ddg.Scene()
    rod(scene, ALONG_Y + [0.0, 0.0, 1.48 * RADIUS])
    scene.add_obstacle(ddg.Plane())
    scene.contact(law=law, friction=mu, rolling=True)
    model = scene.build(device)
    start = model.state(velocities=np.tile([v0, 0.0, 0.0], (11, 1)))
    dt, needed = 2.5e-4, v0 / (3.0 * mu * G)
    middle = run(model, round(0.5 * needed / dt), dt, start)
    state = run(model, round(needed / dt), dt, middle)
    for each in (middle, state):  # friction conserves m v r + I omega
        speed = np.average(each.velocities()[:, 0], weights=[0.5, *[1.0] * 9, 0.5])
        np.testing.assert_allclose(speed + 0.5 * RADIUS * spin(model, each).mean(), v0, rtol=1e-4)
    assert 0.7 * v0 < middle.velocities()[:, 0].mean() < 0.9 * v0
    np.testing.assert_allclose(spin(model, state) * RADIUS, 2.0 / 3.0 * v0, rtol=5e-3)
    energy = [model.energies(each)["kinetic"] for each in (start, state)]
    np.testing.assert_allclose(energy[1] / energy[0], 2.0 / 3.0, rtol=1e-2)


@pytest.mark.parametrize("quasistatic", [True, False])
def test_roller_moves_half_as_far_as_the_plate(device, quasistatic):
    """Rolling has no resistance, so that nothing pulls the upper plate back."""
    scene, far = ddg.Scene(gravity=(0.0, 0.0, 0.0)), 0.02
    rod(scene, ALONG_Y)
    motion = ddg.Motion(lambda t: (far * t, 0.0, 0.0))
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -1.3 * RADIUS)), name="lower")
    scene.add_obstacle(ddg.Plane((0.0, 0.0, 1.3 * RADIUS), (0.0, 0.0, -1.0)), motion=motion, name="upper")
    scene.contact(friction=0.3, velocity=1e-5, rolling=True)
    model = scene.build(device, precision="float64")
    state = statics.solve(model, load_steps=2) if quasistatic else run(model, 100, 1e-2)
    np.testing.assert_allclose(state.points()[:, 0], 0.5 * far, rtol=1e-3)
    rotation = state.angles()[:10] - model.state().angles()[:10]
    np.testing.assert_allclose(rotation, 0.5 * far / RADIUS, rtol=1e-3)
    contacts = model.contacts(state)
    assert np.linalg.norm(contacts.friction, axis=1).max() < 0.02 * np.linalg.norm(contacts.force, axis=1).max()


@pytest.mark.parametrize("parallel", [False, True])
def test_rotating_shaft_drives_a_rod(device, parallel):
    """A slipping shaft needs the moment mu N r and moves a rod across at omega r.

    A parallel rod that cannot move away counter-rotates as fast.
    """
    omega, mu = 30.0, 0.3
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    shaft = rod(scene, ALONG_Y, name="shaft")
    motion = ddg.Motion(angle=lambda t: omega * t, axis=(0.0, 1.0, 0.0))
    scene.clamp(shaft, edges=list(range(10)), motion=motion)
    lying = ALONG_Y if parallel else ALONG_Y[:, [1, 0, 2]]
    upper = rod(scene, lying + [0.0, 0.0, 2.48 * RADIUS], name="upper")
    if parallel:
        scene.fix(upper, range(11), "x")
    scene.contact(friction=mu, rolling=True)
    model = scene.build(device)
    state = run(model, 5)
    normal_force = np.linalg.norm(model.contacts(state).force.sum(0))
    moment = model.reactions(state, point=(0.0, 0.0, 0.0))[0].moment
    np.testing.assert_allclose(moment[1], mu * normal_force * RADIUS, rtol=1e-2)
    state = run(model, 55, state=state)
    if parallel:
        np.testing.assert_allclose(spin(model, state, upper), -omega, rtol=0.05)
    else:
        np.testing.assert_allclose(state.velocities()[11:, 0].mean(), omega * RADIUS, rtol=0.02)


@pytest.mark.parametrize(("angle", "load_steps"), [(-0.5, 1), (7.0, 1), (7.0, 5)])
def test_rotating_shaft_pulls_a_fixed_rod(device, angle, load_steps):
    """The fixed end of the rod across carries mu N, and the shaft needs mu N r, in equilibria as in steps."""
    mu, scene = 0.3, ddg.Scene(gravity=(0.0, 0.0, -G))
    motion = ddg.Motion(angle=lambda t: angle * t, axis=(0.0, 1.0, 0.0))
    scene.clamp(rod(scene, ALONG_Y, name="shaft"), edges=list(range(10)), motion=motion)
    fixed_rod = rod(scene, ALONG_Y[:, [1, 0, 2]] + [0.0, 0.0, 2.48 * RADIUS], name="held")
    scene.fix(fixed_rod, [0])
    scene.fix(fixed_rod, [-1], "y")
    scene.contact(friction=mu, rolling=True, velocity=1e-4)
    model = scene.build(device, precision="float64")
    state = statics.solve(model, load_steps=load_steps)
    contacts = model.contacts(state)  # forces on the shaft
    friction, normal_force = (array.sum(0) for array in (contacts.friction, contacts.force))
    shaft, end, _ = model.reactions(state, point=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(friction[0], -np.sign(angle) * mu * np.linalg.norm(normal_force), rtol=1e-3)
    np.testing.assert_allclose(end.force[0], (friction + normal_force)[0], rtol=1e-6)
    np.testing.assert_allclose(shaft.moment[1], np.sign(angle) * mu * np.linalg.norm(normal_force) * RADIUS, rtol=1e-3)


def logs(between: float, floor: float) -> ddg.Scene:
    """Return two logs side by side on a floor, without contact between both, and one on top."""
    scene, radius, gap = ddg.Scene(gravity=(0.0, 0.0, -G)), 0.01, 1e-4
    y, offset = np.linspace(-0.02, 0.02, 3), 1.0005 * (radius + 0.5 * gap)
    for x, z in ((-offset, 0.0), (offset, 0.0), (0.0, np.sqrt(3.0) * (radius + 0.5 * gap))):
        points = np.stack([0.0 * y + x, y, 0.0 * y + radius + gap + z], 1)
        name = "top" if z else "left" if x < 0.0 else "right"
        scene.add_rod(points, section=ddg.Circle(radius), material=STIFF, name=name)
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(friction=between, rolling=True, velocity=1e-5, range=gap)
    scene.contact_between("left", "right", ignore=True)
    for name in ("left", "right", "top"):
        scene.contact_between(name, "floor", friction=floor)
    return scene


@covering(1, case=((True, 0.01), (False, 0.02)), floor=(True, False))
def test_log_pile_stands_above_the_critical_friction(device, case, floor):
    """The pile stands for friction of at least 2 - sqrt(3) between logs, and a third of that on the floor; else the upper log
    separates the others.

    A lower log's moments about the axis and about the floor contact need the same friction at both contacts. The normal forces are W
    / 2 / (cos 30 + sin 30 tan 15) from above and 3 W / 2 from below.
    """
    (statically, near), least = case, (2.0 - np.sqrt(3.0)) / (3.0 if floor else 1.0)
    for mu in (least * (1.0 - near), least * (1.0 + near)):
        model = logs(*((0.5, mu) if floor else (mu, 0.5))).build(device, precision="float64")
        state = statics.solve(model) if statically else run(model, 600)
        assert (state.points()[-3:, 2].mean() > 0.027) == (mu > least)


@pytest.mark.parametrize("turns_freely", [True, False])
def test_rope_tension_over_free_and_clamped_pulley(device, turns_freely):
    """A drum free to rotate passes tension on unchanged; a clamped drum follows Euler's and Eytelwein's law."""
    slack, mu = 1000.0 * capstan.B / capstan.AROUND**2, 0.3
    points, ends = capstan.wound(np.pi, np.pi * capstan.AROUND / 30, capstan.AROUND)
    EA = capstan.STIFF * slack * np.exp(np.pi * mu)
    inertia = {"mass_per_length": capstan.MASS_PER_LENGTH, "rotary_inertia": 1e-10, "radius": capstan.RADIUS}
    scene, drum = ddg.Scene(gravity=(0.0, 0.0, 0.0)), np.outer(np.linspace(-1.0, 1.0, 4), [0.0, capstan.DRUM, 0.0])
    section = ddg.Stiffness(EA=EA, EI1=capstan.B, GJ=capstan.B, **inertia)
    rope = scene.add_rod(points, section=section, natural="straight")
    scene.add_force(rope, 0, slack * ends[0])
    scene.fix(rope, [-1], motion=ddg.Motion(translation=lambda t: tuple(capstan.SPEED * t * ends[1])))
    pulley = scene.add_rod(drum, section=ddg.Circle(capstan.DRUM), material=STIFF)
    scene.fix(pulley, range(4))
    if not turns_freely:
        scene.clamp(pulley, edges=range(3))
    scene.contact(range=capstan.RANGE, stiffness=1e4, friction=mu, velocity=capstan.VELOCITY, rolling=True)
    model = scene.build(device, precision="float64")
    for statically, load in ((True, 5.0), (False, 1.0)):
        state = model.state(points=np.concatenate([points, drum]))
        if statically:
            state = statics.solve(model, state, start=1.0, end=5.0, load_steps=4)
        else:
            state = run(model, 30, 1.0, state)
        tension = np.linalg.norm(model.reactions(state, factor=load)[0].force) / (load * slack)
        if turns_freely:
            np.testing.assert_allclose(tension, 1.0, rtol=1e-3)
        else:
            np.testing.assert_allclose(tension, capstan.expected(mu, np.pi, load * slack), rtol=5e-3)


def test_rolling_edges_next_to_clamped_edges_converge(device):
    """Clamped edges of a sagging rod meet the floor where free edges begin, which roll: the tangent includes the rolling."""
    scene = ddg.Scene(gravity=(1.0, 0.7, -40.0))
    x = np.linspace(-0.05, 0.05, 7)
    height = 1.4 * RADIUS + 0.003 * x + 3e-4 * np.cos(55.0 * x)
    soft = ddg.Material(young=1e6, density=1000.0)
    bar = scene.add_rod(np.stack([x, 0.02 * x, height], 1), section=ddg.Circle(RADIUS), material=soft)
    scene.clamp(bar, edges=[0, -1])
    scene.add_obstacle(ddg.Plane())
    scene.contact(range=1e-3, stiffness=50.0, friction=0.3, velocity=1e-4, rolling=True)
    model = scene.build(device, precision="float64")
    search = statics.Equilibrium(model, statics.StaticsOptions(rtol=1e-12))
    state = search.load(model.state(), 1)
    assert np.abs(model.contacts(state).friction).max() > 1e-4
    assert search.iterations <= 25


@each_form
def test_forces_and_products_equal_central_differences(device, form):
    result, positions, _, after = friction_terms(ROLLING, device, form)
    for name in ("angles", "rotations"):
        blocks = (getattr(part.factor, name).numpy()[: int(part.count.numpy()[0])] for part in result.frictions)
        assert sum((each >= 0).sum() for each in blocks) > 20
    assert_central_differences(result, positions, after)


@each_form
def test_blocks_equal_the_matrix(device, form):
    """Blocks are of nodes, angles and rotations with themselves, of neighbouring angles, and of edges with both nodes."""
    result, *_ = friction_terms(ROLLING, device, form)
    n, shapes = len(result.forces), result.search.shapes
    matrix, diagonal = assembled_hessian(result, n).transpose(0, 2, 1, 3), result.blocks.diagonal.numpy()
    largest = np.abs(matrix).max(axis=(0, 1, 2, 3))
    flat = matrix.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
    assert np.abs(flat - flat.T).max() < 1e-14 * largest
    assert np.linalg.eigvalsh(flat).min() > -1e-13 * largest
    result.join()
    first, second, neighbour = (array.numpy() for array in result.blocks.turned)
    (nodes, *_), angles = shapes.primitives(2), shapes.angles(2)[:, 0]
    rolling = np.flatnonzero(angles >= 0)
    assert np.abs(first).max() > 1e-3 * largest and np.abs(neighbour).max() > 1e-7 * largest
    index = np.arange(n)
    turning = np.append(angles[rolling], shapes.body_rotations[-2:])
    assert np.abs(diagonal[turning] - matrix[index, index][turning]).max() < 1e-13 * largest
    for e in rolling:
        # neighbouring edges of a rod are no pair of one edge: rows of two rods alone have both
        assert np.abs(first[e] - matrix[angles[e], nodes[e, 0], 0]).max() < 1e-13 * largest
        assert np.abs(second[e] - matrix[angles[e], nodes[e, 1], 0]).max() < 1e-13 * largest
        if e + 1 in rolling and nodes[e + 1, 0] == nodes[e, 1]:
            assert abs(neighbour[e] - matrix[angles[e], angles[e + 1], 0, 0]) < 1e-13 * largest


def test_runs_and_worlds_agree_bitwise(device):
    assert_repeatable(lambda: [friction_terms(ROLLING, device)[0].forces.numpy().copy()])
    scene = ddg.Scene()
    rod(scene, ALONG_Y + [0.0, 0.0, 5.0 * RADIUS])
    rod(scene, 0.6 * ALONG_Y[:, [1, 0, 2]] + [0.0, 0.0, 8.0 * RADIUS])
    scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0), (0.2, 0.1, 1.0)))
    scene.contact(friction=0.3, rolling=True)
    model = scene.build(device, worlds=2)
    first, second = (run(model, 80) for _ in range(2))
    assert np.abs(spin(model, first)).max() > 1.0
    np.testing.assert_array_equal(first.points(), second.points())
    np.testing.assert_array_equal(first.points()[0], first.points()[1])


def test_rolling_is_refused_without_twist_or_friction(device):
    def scene(**options):
        made = ddg.Scene()
        made.add_rod(ALONG_Y, section=ddg.Circle(RADIUS), material=STIFF, **options)
        made.add_obstacle(ddg.Plane((0.0, 0.0, -0.01)))
        return made

    without = scene(twist=False)
    without.contact(friction=0.3, rolling=True)
    with pytest.raises(SceneError, match=r"rolling, and rod 0 \('rod'\) has no twist"):
        without.build(device)
    smooth = scene()
    smooth.contact(rolling=True)
    with pytest.raises(SceneError, match="rolling, and there is no friction; leave rolling out"):
        smooth.build(device)
    with pytest.raises(SceneError, match="contact: rolling"):
        scene().contact(friction=0.3, rolling=2)


@pytest.mark.parametrize("rolling, kept, off", [(False, 0.0, 0.01), (True, 4.0e-3 / 4.35e-3, 0.05)])
def test_rolling_friction_keeps_angular_momentum(device, rolling, kept, off):
    """Two free parallel rods meet and slide across each other, which ends the angular momentum m v d of sliding.

    d is the distance of the centrelines. Surface friction replaces the loss by spins, but for the fraction of the gap in d; friction
    between centrelines does not.
    """
    radius, line = 2e-3, np.linspace(-0.03, 0.03, 7)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    for height in (0.0, 2.0 * radius + 1.1e-3):
        points = np.stack([line, 0.0 * line, 0.0 * line + height], 1)
        scene.add_rod(
            points, section=ddg.Circle(radius), material=ddg.Material(1e7, density=1000.0), name=f"{height:g}"
        )
    scene.contact(friction=0.5, rolling=rolling, range=1e-3, stiffness=500.0)
    model = scene.build(device, precision="float64")
    state = model.state(velocities=np.repeat([[0.0, -0.05, 0.3], [0.0, 0.05, -0.3]], 7, axis=0))
    host, integrator = model.coupled.host, ddg.Integrator(model, rtol=1e-8)

    def momentum(state) -> float:
        """Return the angular momentum of positions and spins about x, the common direction."""
        points, moves = state.points(), host.mass[:14, :1] * state.velocities()
        spins = [host.mass[rod.edges, 0] @ state.coupled.v.numpy()[rod.edges, 0] for rod in host.rods]
        return float(np.cross(points - points.mean(0), moves).sum(0)[0] + sum(spins))

    before = momentum(state)
    for _ in range(200):
        state = integrator.step(state, 5e-5)
    assert momentum(state) / before == pytest.approx(kept, abs=off)
