"""Contact at lengths from 1e-9 to 1e5 m: scenes of equal nondimensional numbers behave alike, in float64 and mixed.

Scaling lengths by a power of two keeps all bits, as no sum mixes dimensions.
"""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes

YOUNG, DENSITY = 1e6, 1000.0
SPEED = np.sqrt(YOUNG / DENSITY)  # wave speed [m/s]; speeds scale with SPEED, times with L / SPEED
RUBBER = ddg.Material(young=YOUNG, poisson=0.3, density=DENSITY)
GRAVITY = 1e-3 * YOUNG / DENSITY  # times 1 / L
STEPS, DT = 12, 2.0


def base(length: float) -> ddg.Scene:
    return ddg.Scene(gravity=(0.0, 0.0, -GRAVITY / length), mass_damping=1e-2 * SPEED / length)


def rod(scene, length: float, start, end, name: str = "rod") -> int:
    return scene.add_rod(
        np.linspace(start, end, 9) * length, section=ddg.Circle(0.02 * length), material=RUBBER, name=name
    )


def rod_on_floor(length: float) -> ddg.Scene:
    scene = base(length)
    rod(scene, length, (0.0, 0.0, 0.03), (1.0, 0.1, 0.1))
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(friction=0.3)
    return scene


def rod_on_rod(length: float) -> ddg.Scene:
    scene = base(length)
    scene.fix(rod(scene, length, (-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), "lower"), list(range(9)))
    rod(scene, length, (0.03, -0.5, 0.06), (0.0, 0.5, 0.06), "upper")
    scene.contact(friction=0.3)
    return scene


def shell_on_ball(length: float) -> ddg.Scene:
    scene, (points, triangles) = base(length), meshes.rectangle(4, 4)[:2]
    points = (np.array(points, float) - np.mean(points, 0) + [0.0, 0.0, 0.35]) * length
    scene.add_shell(points, triangles, thickness=0.02 * length, material=RUBBER)
    scene.add_obstacle(ddg.Sphere((0.03 * length, 0.0, 0.0), 0.3 * length))
    scene.contact(friction=0.3)
    return scene


def rod_on_capsule(length: float) -> ddg.Scene:
    scene = base(length)
    rod(scene, length, (-0.5, 0.02, 0.25), (0.5, -0.02, 0.25))
    scene.add_obstacle(ddg.Capsule((0.01 * length, -length, 0.0), (0.01 * length, length, 0.0), 0.2 * length))
    scene.contact(friction=0.3)
    return scene


def rod_on_mesh(length: float) -> ddg.Scene:
    scene = base(length)
    rod(scene, length, (-0.5, 0.02, 0.24), (0.5, -0.02, 0.26))
    scene.add_obstacle(ddg.Box((0.0, 0.0, 0.0), np.array([0.3, 0.3, 0.2]) * length))
    scene.contact(friction=0.3)
    return scene


def scaled_results(build, length: float, device, precision: str):
    """Return positions over L, contact force over E L^2 and smallest gap over L after some steps."""
    model = build(length).build(device, precision=precision)
    integrator, state = ddg.Integrator(model, rtol=1e-8), model.state()
    for _ in range(STEPS):
        state = integrator.step(state, DT * length / SPEED)
    contacts = model.contacts(state)
    assert len(contacts.gap)
    assert (contacts.gap > 0.0).all()
    assert np.linalg.norm(state.points() - model.state().points(), axis=1).max() > 1e-3 * length
    return state.points() / length, contacts.force.sum(0) / (YOUNG * length**2), contacts.gap.min() / length


# Below 1e-6 m squared forces underflow in float32 conjugate gradients, and shells are slow even without contact.
CASES = [(build, "float64", 1e-9) for build in (rod_on_floor, rod_on_rod, rod_on_capsule, rod_on_mesh)]
CASES += [(build, "mixed", 1e-6) for build in (rod_on_floor, rod_on_rod, shell_on_ball, rod_on_capsule, rod_on_mesh)]
CASES += [(shell_on_ball, "float64", 1e-6)]


FAST = [
    (rod_on_floor, "float64"),
    (rod_on_mesh, "float64"),
    *((build, "mixed") for build in (rod_on_rod, shell_on_ball)),
]
FAST += [(rod_on_capsule, "mixed")]


@pytest.mark.parametrize(
    "build, precision, small",
    [pytest.param(*case, marks=() if case[:2] in FAST else pytest.mark.slow) for case in CASES],
)
def test_contact_is_the_same_at_every_scale(device, build, precision, small):
    points, force, gap = scaled_results(build, 1.0, device, precision)
    for length in (small, 1e5):
        scaled = scaled_results(build, length, device, precision)
        np.testing.assert_allclose(scaled[0], points, atol=1e-6)
        np.testing.assert_allclose(scaled[1], force, atol=1e-4 * np.abs(force).max())
        assert scaled[2] == pytest.approx(gap, rel=1e-4)


@pytest.mark.parametrize(
    "build, precision", [(rod_on_floor, "float64"), (rod_on_rod, "mixed"), (shell_on_ball, "float64")]
)
def test_scaling_by_powers_of_two_keeps_all_bits(device, build, precision):
    points, _, gap = scaled_results(build, 1.0, device, precision)
    scaled = scaled_results(build, 2.0**-18, device, precision)
    np.testing.assert_array_equal(scaled[0], points)
    assert scaled[2] == gap


@pytest.mark.parametrize("build", [rod_on_floor, shell_on_ball])
def test_overlapping_starts_are_refused_and_resolved_at_every_scale(device, build):
    """Overlaps are resolved by the same fraction of the length."""
    displacements = []
    for length in (1e-9, 1.0, 1e5):
        model = build(length).build(device)
        low = model.state().points() - [0.0, 0.0, 0.045 * length]
        state = model.state(points=low)
        with pytest.raises(ddg.SceneError, match="overlap"):
            ddg.Integrator(model).step(state, DT * length / SPEED)
        separated, _ = model.resolve_overlaps(state)
        displacements.append((separated.points() - low) / length)
    np.testing.assert_allclose(displacements[0], displacements[1], atol=1e-6)
    np.testing.assert_allclose(displacements[2], displacements[1], atol=1e-6)
