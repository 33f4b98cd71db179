"""Anisotropic friction of rods, forwards, backwards and across: derivatives, closed forms, energy, sliding and sticking."""

import numpy as np
import pytest
import warp as wp
from friction_cases import MU, SLIP, VELOCITY, assert_central_differences, each_case, each_form, friction_terms, rates
from pair_cases import CASES, assembled_hessian, assert_repeatable, hessian_product, state, terms

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

FACTORS = np.array([1.0, 1.7, 2.5])  # forwards, backwards and across, over MU
RADIUS, RANGE = 5e-3, 1e-4


def anisotropic(case: str) -> dict:
    """Return groups and anisotropic factors: rods in one group, shells in the other.

    Rods are the first of every pair with a shell; the factors are along the rods.
    """
    shapes, _ = CASES[case]()
    factors = np.ones((2, 2, 3))
    factors[0] = factors[:, 0] = FACTORS
    return {"groups": np.array([int(name.startswith("shell")) for name in shapes.names]), "ways": factors}


@each_case
@each_form
def test_forces_and_products_equal_central_differences(device, case, form):
    """No slip changes between forwards and backwards within the differences, where second derivatives jump."""
    result, positions, _, after = friction_terms(case, device, form, seed=5, **anisotropic(case))
    plain, *_ = friction_terms(case, device, form, seed=5, groups=anisotropic(case)["groups"])
    forces = result.forces.numpy()
    assert np.abs(forces - plain.forces.numpy()).max() > 0.1 * np.abs(forces).max()
    assert_central_differences(result, positions, after)


@each_case
@each_form
def test_matrix_is_symmetric_and_positive(device, case, form):
    result, *_ = friction_terms(case, device, form, **anisotropic(case))
    n = len(result.forces)
    flat = assembled_hessian(result, n).reshape(3 * n, 3 * n)
    largest = np.abs(flat).max()
    assert np.abs(flat - flat.T).max() < 1e-14 * largest
    assert np.linalg.eigvalsh(flat).min() > -1e-13 * largest


@each_case
@each_form
def test_friction_dissipates_energy_without_resultant(device, case, form):
    for seed, slip in enumerate(SLIP * np.array([0.01, 0.3, 1.0, 10.0])):
        result, _, x, after = friction_terms(case, device, form, slip, seed, **anisotropic(case))
        forces, taken = result.forces.numpy(), result.dissipated.numpy()[0]
        assert taken == pytest.approx(-(forces * (after - x)).sum(), rel=1e-10)
        assert 0.0 < result.energy.numpy()[0] < taken
        assert np.abs(forces.sum(0)).max() < 1e-13 * np.abs(forces).sum()


@each_case
def test_runs_agree_bitwise(device, case):
    def run():
        result, _, x, _ = friction_terms(case, device, **anisotropic(case))
        return [*state(result), hessian_product(result, np.random.default_rng(3).normal(size=x.shape))]

    assert_repeatable(run)


@each_case
def test_float32_factors_keep_forces_and_products(device, case):
    whole, _, x, _ = friction_terms(case, device, **anisotropic(case))
    single, *_ = friction_terms(case, device, linear=wp.float32, **anisotropic(case))
    v = np.random.default_rng(6).normal(size=x.shape)
    assert (single.forces.numpy() == whole.forces.numpy()).all()
    exact = hessian_product(whole, v)
    assert np.abs(hessian_product(single, v) - exact).max() < 1e-5 * np.abs(exact).max()


def rod_on_triangle(tilt: float) -> tuple[CollisionMesh, np.ndarray]:
    """Return a rod in contact with a triangle at one edge, along x but for the `tilt` [rad]."""
    s = np.array([0.0, 0.05, 0.1])
    rod = np.stack([0.05 + s * np.cos(tilt), 0.05 + 0.0 * s, 0.0065 + s * np.sin(tilt)], 1)
    x = np.concatenate([[[-1.0, -1.0, 0.0], [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]], rod])
    shapes = CollisionMesh(x)
    shapes.shell(np.array([[0, 1, 2]]), 0.004)
    shapes.rod([3, 4, 5], 0.003)
    return shapes, x


@each_form
@pytest.mark.parametrize("tilt", [0.0, 0.4, 0.5 * np.pi])
def test_anisotropic_coulomb_law(device, form, tilt):
    """Sliding friction is -N D^2 u / |D u|, D of the components along and across the rod; a standing rod has the coefficient across."""
    shapes, x = rod_on_triangle(tilt)
    factors = np.ones((2, 2, 3))
    factors[0, 1] = factors[1, 0] = FACTORS
    options = {"groups": np.array([1, 0]), "friction": MU, "ways": factors, "velocity": VELOCITY, "friction_law": form}
    result, positions = terms(shapes, x, device, **options)
    result.lag(positions)
    normal = result.forces.numpy()[3:].sum(0)[2]
    result.law.stiffness.zero_()
    assert normal > 0.0
    for angle in np.linspace(0.0, 2.0 * np.pi, 9)[:-1] + 0.1:
        u = np.array([np.cos(angle), np.sin(angle)])
        along = FACTORS[0] if u[0] > 0.0 else FACTORS[1]
        D2 = MU**2 * np.array([np.cos(tilt) ** 2 * along**2 + np.sin(tilt) ** 2 * FACTORS[2] ** 2, FACTORS[2] ** 2])
        after = x.copy()
        after[3:, :2] += 1e3 * SLIP * u
        positions.assign(after)
        result.evaluate(positions, rates(result))
        force = result.forces.numpy()[3:].sum(0)
        size = np.sqrt(D2 @ u**2)
        assert force == pytest.approx([*(-normal * D2 * u / size), 0.0], rel=1e-9, abs=1e-12 * normal)
        assert result.dissipated.numpy()[0] == pytest.approx(normal * size * 1e3 * SLIP, rel=1e-9)


@each_form
def test_friction_is_continuous_where_slip_reverses(device, form):
    shapes, x = rod_on_triangle(0.0)
    factors = np.ones((2, 2, 3))
    factors[0, 1] = factors[1, 0] = [1.0, 3.0, 2.0]
    options = {"groups": np.array([1, 0]), "friction": MU, "ways": factors, "velocity": VELOCITY, "friction_law": form}
    result, positions = terms(shapes, x, device, **options)
    result.lag(positions)

    def force(along):
        after = x.copy()
        after[3:, 0] += along
        after[3:, 1] += 0.1 * SLIP
        positions.assign(after)
        result.evaluate(positions, rates(result))
        return result.forces.numpy()[3:].sum(0)

    before, after = (force(s * 1e-9 * SLIP) for s in (-1.0, 1.0))
    assert np.linalg.norm(after - before) < 1e-6 * np.linalg.norm(after[:2])
    assert force(-SLIP)[0] > 1.5 * -force(SLIP)[0] > 0.0


FORWARDS, BACKWARDS, ACROSS = 0.2, 0.45, 0.6


def rod_on(obstacle, friction=(FORWARDS, BACKWARDS, ACROSS), along=(1.0, 0.0, 0.0), up=(0.0, 0.0, 1.0)) -> ddg.Scene:
    """Return a stiff rod about the origin, just above an obstacle."""
    along, up = np.array(along), np.array(up)
    scene = ddg.Scene()
    points = np.linspace(-0.05, 0.05, 11)[:, None] * along + up * (RADIUS + 1.01 * RANGE)
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=ddg.Material(young=1e9, density=1000.0), name="rod")
    scene.add_obstacle(obstacle, name="ground")
    scene.contact(range=RANGE, velocity=1e-4)
    scene.contact_between("rod", "ground", friction=friction)
    return scene


def throw_rod(scene, direction, device, count: int, dt: float = 1e-3, **options):
    """Return mean velocities over `count` steps of a settled rod thrown at 1 m/s; model, integrator and last state."""
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(30):
        state = integrator.step(state, 2e-3)
    state = model.state(points=state.points(), velocities=np.tile(np.array(direction, float), (11, 1)))
    integrator, speeds = ddg.Integrator(model, **options), [state.velocities().mean(0)]
    for _ in range(count):
        state = integrator.step(state, dt)
        speeds.append(state.velocities().mean(0))
    return np.array(speeds), model, integrator, state


@pytest.mark.parametrize(
    ("direction", "mu"),
    [
        ((1.0, 0.0, 0.0), FORWARDS),
        ((-1.0, 0.0, 0.0), BACKWARDS),
        ((0.0, 1.0, 0.0), ACROSS),
        ((0.0, -1.0, 0.0), ACROSS),
    ],
)
def test_deceleration_is_that_of_the_sliding_direction(device, direction, mu):
    count = round(1.3 / (mu * 9.81) / 5e-3)
    speeds, _, integrator, _ = throw_rod(rod_on(ddg.Plane()), direction, device, count, 5e-3)
    start, end = 2, count // 2
    braked = (speeds[start] - speeds[end]) / ((end - start) * 5e-3)
    assert braked @ direction == pytest.approx(mu * 9.81, rel=1e-3)
    assert np.abs(np.cross(braked, direction)[[0, 2]]).max() < 1e-3
    assert np.linalg.norm(speeds[-1]) < 1e-4
    statistics = integrator.statistics()
    assert set(statistics["outcomes"]) == {"converged"} and statistics["contact"]["refused_crossings"] == 0


def test_friction_work_equals_lost_kinetic_energy(device):
    """Friction work is the sum of -m v1 . (v1 - v0) of implicit Euler steps.

    The rod is thrown obliquely; anisotropic friction rotates the velocity towards the rod.
    """
    speeds, model, integrator, _ = throw_rod(rod_on(ddg.Plane()), (0.6, 0.8, 0.0), device, 40, rtol=1e-10)
    mass = model.coupled.host.mass[:11, 0].sum()
    taken = -mass * ((speeds[1:] - speeds[:-1]) * speeds[1:])[:, :2].sum()
    assert integrator.statistics()["contact"]["friction_work"] == pytest.approx(taken, rel=1e-3)
    assert taken > 0.0
    angles = np.arctan2(speeds[:, 1], speeds[:, 0])
    assert (np.diff(angles) < 0.0).all()


@pytest.mark.parametrize(("heading", "holds"), [(0.0, False), (np.pi, True), (0.5 * np.pi, True)])
def test_slope_between_coefficients_holds_backwards_and_across(device, heading, holds):
    """The slope has tan = 0.35: forwards a rod slides by g (sin - mu cos), else it sticks, creeping below the threshold."""
    slope = np.arctan(0.35)
    normal = np.array([np.sin(slope), 0.0, np.cos(slope)])
    down = np.array([np.cos(slope), 0.0, -np.sin(slope)])
    along = np.cos(heading) * down + np.sin(heading) * np.cross(normal, down)
    model = rod_on(ddg.Plane(normal=tuple(normal)), along=along, up=normal).build(device=device)
    integrator, state, speeds = ddg.Integrator(model), model.state(), []
    for _ in range(60):
        state = integrator.step(state, 2e-3)
        speeds.append(state.velocities().mean(0) @ down)
    if holds:
        assert 0.0 < speeds[-1] < 1e-4
    else:
        expected = 9.81 * (np.sin(slope) - FORWARDS * np.cos(slope))
        assert (speeds[-1] - speeds[29]) / (30 * 2e-3) == pytest.approx(expected, rel=1e-3)


OBSTACLES = {
    "capsule": ddg.Capsule((-1.0, 0.0, -0.1), (1.0, 0.0, -0.1), 0.1),
    "box": ddg.Box((0.0, 0.0, -0.1), (1.0, 1.0, 0.1)),
    "ball": ddg.Sphere((0.0, 0.0, -1e3), 1e3),
}


@pytest.mark.parametrize("shape", OBSTACLES)
@pytest.mark.parametrize(("sign", "mu"), [(1.0, FORWARDS), (-1.0, BACKWARDS)])
def test_every_obstacle_has_anisotropic_friction(device, shape, sign, mu):
    """A constraint keeps the rod in one plane, as balls and capsules are round. A large ball has one contact point."""
    scene = rod_on(OBSTACLES[shape])
    scene.fix(0, range(11), "y")
    speeds, *_ = throw_rod(scene, (sign, 0.0, 0.0), device, 20)
    assert sign * (speeds[4, 0] - speeds[-1, 0]) / 16e-3 == pytest.approx(mu * 9.81, rel=1e-3)


def test_coefficient_may_be_zero(device):
    """A rod moves like a skate, free along the axis and braked across."""
    for direction, mu in (((1.0, 0.0, 0.0), 0.0), ((0.0, 1.0, 0.0), ACROSS)):
        speeds, *_ = throw_rod(rod_on(ddg.Plane(), (0.0, 0.0, ACROSS)), direction, device, 20)
        assert (speeds[4] - speeds[-1]) @ direction / 16e-3 == pytest.approx(mu * 9.81, rel=1e-3, abs=1e-4)


def test_equal_coefficients_equal_isotropic_friction_bitwise(device):
    ends = [
        throw_rod(rod_on(ddg.Plane(), friction), (0.6, 0.8, 0.0), device, 20)[3].points()
        for friction in (0.3, (0.3,) * 3)
    ]
    assert (ends[0] == ends[1]).all()


def test_asymmetric_factors_are_refused_by_name(device):
    options = anisotropic("parallel")
    options["ways"][0, 1, 2] = 3.0
    shapes, x = CASES["parallel"]()
    with pytest.raises(SceneError, match=r"ways = 3.0 of contact between groups 0 and 1 is not symmetric"):
        terms(shapes, x, device, friction=MU, **options)
