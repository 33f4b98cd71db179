"""Energies, reactions, stresses, writhe and twist against closed forms and balances."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.postprocess.quantities import reactions, stresses, total_twist, writhe
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.equilibrium.tangent import Tangent

SECTION = ddg.Stiffness(EA=50.0, EI1=3.0, EI2=2.0, GJ=1.5, mass_per_length=0.8, rotary_inertia=0.1)


def straight(nodes: int, length: float = 2.0) -> np.ndarray:
    points = np.zeros((nodes, 3))
    points[:, 0] = np.linspace(0.0, length, nodes)
    return points


def circle(nodes: int, radius: float = 1.0) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(nodes) / nodes
    return radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)


def built(points, device, gravity=(0.0, 0.0, 0.0), **options):
    scene = ddg.Scene(gravity=gravity)
    scene.add_rod(points, **({"section": SECTION} | options))
    return scene.build(device, "float64")


# EA / 2 strain^2 L, of a homogeneous stretch.
def test_energy_of_stretch(device):
    model = built(straight(9), device)
    energies = model.energies(model.state(points=1.1 * straight(9)))
    assert energies["rod_stretch"] == pytest.approx(0.5 * 50.0 * 0.1**2 * 2.0)
    assert energies["rod_bend_twist"] == pytest.approx(0.0, abs=1e-12)


# A closed rod, straight when free, on a polygon of n edges l: kappa = 2 tan(pi / n) / l at all vertices.
# E = n EI kappa^2 l / 2, which tends to pi EI / R.
@pytest.mark.parametrize("director", [(0.0, 0.0, 1.0), None], ids=["out of plane", "chosen"])
def test_energy_of_bending(device, director):
    for n, tolerance in ((10, None), (400, 1e-3)):
        ring = circle(n)
        section = ddg.Stiffness(EA=50.0, EI1=2.0, EI2=2.0 if director is None else 7.0, GJ=1.5)
        model = built(ring, device, closed=True, natural="straight", section=section, director=director)
        energy = model.energies(model.state())["rod_bend_twist"]
        stiffness, edge = 2.0 if director is None else 7.0, 2.0 * np.sin(np.pi / n)
        assert energy == pytest.approx(n * 0.5 * stiffness * (2.0 * np.tan(np.pi / n) / edge) ** 2 * edge, rel=1e-12)
        if tolerance:
            assert energy == pytest.approx(np.pi * stiffness, rel=tolerance)


# GJ / 2 (rate)^2 over the n - 2 Voronoi cells of inner nodes.
def test_energy_of_twist(device):
    model = built(straight(9), device)
    tangent, state = Tangent(model), model.state()
    q = tangent.dofs(state)
    q[tangent.angle] = 0.3 * np.arange(9)
    tangent.assign(state, q)
    assert model.energies(state)["rod_bend_twist"] == pytest.approx(0.5 * 1.5 * (0.3 / 0.25) ** 2 * 7 * 0.25)
    assert total_twist(model, state) == pytest.approx(7 * 0.3 / (2.0 * np.pi))


# m v^2 / 2 + rho (I1 + I2) L omega^2 / 2, and - m g . x of the middle.
def test_kinetic_and_potential_energy(device):
    points = straight(9) + [0.0, 0.0, 3.0]
    model = built(points, device, gravity=(1.0, 0.0, -10.0))
    state = model.state(velocities=np.tile([1.0, 2.0, 2.0], (9, 1)), spins=np.full(8, 5.0))
    energies = model.energies(state)
    assert energies["kinetic"] == pytest.approx(0.5 * 1.6 * 9.0 + 0.5 * 0.2 * 25.0)
    assert energies["gravity"] == pytest.approx(-1.6 * (1.0 * 1.0 - 10.0 * 3.0))


def test_reactions_balance_all_loads(device):
    """Reactions of a curved cantilever balance forces, a twisting moment, a couple and weight about any point."""
    angle = np.linspace(0.0, 1.5, 31)
    points = np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.2 * angle], -1)
    scene = ddg.Scene(gravity=(0.0, 0.0, -2.0))
    rod = scene.add_rod(points, section=SECTION, director=(0.0, 0.0, 1.0))
    scene.clamp_end(rod)
    forces = {12: np.array([0.3, -0.5, 0.2]), -1: np.array([-0.4, 0.6, 0.9])}
    for node, force in forces.items():
        scene.add_force(rod, node, force)
    couple = np.array([0.3, 0.2, -0.4])
    scene.add_twisting_moment(rod, 20, 0.35)
    scene.add_couple(rod, 25, couple)
    model = scene.build(device, "float64")
    state = statics.solve(model, load_steps=8, mode="follow")
    x = state.points()
    assert np.linalg.norm(x - points, axis=1).max() > 0.1  # far from linear
    edge = x[21] - x[20]
    weight = model.groups[0].host.mass[1:, 0, None] * [0.0, 0.0, -2.0]  # node 0 of the column is the ghost
    force = weight.sum(0) + sum(forces.values())
    for point in (None, (1.0, -2.0, 0.5)):
        pole = x[0] if point is None else np.array(point)
        moment = sum(np.cross(x[node] - pole, f) for node, f in forces.items())
        moment = moment + np.cross(x - pole, weight).sum(0) + couple + 0.35 * edge / np.linalg.norm(edge)
        (reaction,) = reactions(model, state, point)
        np.testing.assert_allclose(reaction.force, -force, atol=1e-7)
        np.testing.assert_allclose(reaction.moment, -moment, atol=1e-7)
        np.testing.assert_allclose(reaction.point, pole)


def test_reactions_of_several_supports(device):
    """Supports that fix different components of a beam carry half the weight each, in the plane and in space."""
    for dimension in (2, 3):
        scene = ddg.Scene(gravity=(0.0, 0.0, -1.0), dimension=dimension)
        rod = scene.add_rod(straight(21), section=ddg.Stiffness(EA=1e4, EI1=50.0, GJ=50.0, mass_per_length=0.8))
        scene.fix(rod, [0])
        scene.fix(rod, [-1], components="yz")
        scene.fix(rod, [10], components="y")
        if dimension == 3:
            scene.fix_twist(rod, [0])
        model = scene.build(device, "float64")
        first, last, middle, *twist = model.reactions(statics.solve(model))
        np.testing.assert_allclose(first.force, (0.0, 0.0, 0.8), atol=1e-6)
        np.testing.assert_allclose(last.force, (0.0, 0.0, 0.8), atol=1e-6)
        np.testing.assert_allclose(middle.force, 0.0, atol=1e-9)
        for reaction in (first, middle, *twist):
            np.testing.assert_allclose(reaction.moment, 0.0, atol=1e-6)


# A couple at the free end: the same moment at all vertices, kappa = M / EI, and no axial force.
def test_stresses_of_a_uniform_moment(device):
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    rod = scene.add_rod(straight(33), section=SECTION)
    scene.clamp_end(rod)
    scene.add_couple(rod, -1, (0.0, -2.0, 0.0))
    model = scene.build(device, "float64")
    result = stresses(model, statics.solve(model, load_steps=4))
    moments, forces = result["planar_bend"][0], result["planar_stretch"][0]
    assert len(moments) == 32  # vertices between edges, the clamped end's included
    np.testing.assert_allclose(np.abs(moments), 2.0, rtol=1e-3)
    assert np.ptp(moments[1:]) < 1e-6
    np.testing.assert_allclose(forces[1:-1], 0.0, atol=1e-6)


def test_stresses_of_a_hanging_rod(device):
    """The axial force is the weight below."""
    scene = ddg.Scene(gravity=(10.0, 0.0, 0.0))
    rods = scene.add_rods(np.stack([straight(11), straight(11) + [0.0, 1.0, 0.0]]), section=SECTION)
    scene.clamp(rods)
    model = scene.build(device, "float64")
    mass = 0.8 * 0.2
    below = mass * 10.0 * (np.arange(9, 0, -1) - 0.5)  # weight below edges 1 to 9
    for forces in stresses(model, statics.solve(model))["rod_stretch"]:
        np.testing.assert_allclose(forces[1:, 0], below, rtol=1e-8)


def trefoil(nodes: int, height: float = 1.0) -> np.ndarray:
    s = 2.0 * np.pi * np.arange(nodes) / nodes
    radius = 2.0 + np.cos(3.0 * s)
    return np.stack([radius * np.cos(2.0 * s), radius * np.sin(2.0 * s), height * np.sin(3.0 * s)], -1)


def gauss_integral(curve, nodes: int) -> float:
    """Return the writhe of a smooth closed curve by the trapezoidal rule on Gauss' double integral."""
    fine, h = curve(nodes), 2.0 * np.pi / nodes
    modes = np.fft.fftfreq(nodes, 1.0 / nodes)[:, None]
    tangent = np.fft.ifft(1j * modes * np.fft.fft(fine, axis=0), axis=0).real
    total = 0.0
    for k in range(nodes):
        gap = fine[k] - np.delete(fine, k, axis=0)
        triple = np.cross(tangent[k], np.delete(tangent, k, axis=0))
        total += ((triple * gap).sum(1) / np.linalg.norm(gap, axis=1) ** 3).sum()
    return total * h * h / (4.0 * np.pi)


def test_writhe_of_a_planar_curve():
    assert writhe(circle(30)) == pytest.approx(0.0, abs=1e-12)
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    assert writhe(circle(31) @ rotation.T + [1.0, 2.0, 3.0]) == pytest.approx(0.0, abs=1e-12)


def test_writhe_of_a_knot():
    """The writhe converges to Gauss' integral with order two in the edge; a mirror image changes the sign."""
    reference = gauss_integral(trefoil, 1200)
    errors = np.array([writhe(trefoil(n)) - reference for n in (50, 100, 200)])
    assert abs(reference) > 3.0
    assert abs(errors[-1]) < 2e-3
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx((2.0, 2.0), abs=0.25)
    assert writhe(trefoil(60) * [1.0, 1.0, -1.0]) == pytest.approx(-writhe(trefoil(60)), rel=1e-12)


def test_writhe_is_invariant_under_similarity_and_seam():
    random = np.random.default_rng(0)
    for _ in range(20):
        curve = random.normal(size=(12, 3))
        rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
        rotation *= np.linalg.det(rotation)
        value = writhe(curve)
        assert writhe(3.0 * curve @ rotation.T + 0.7) == pytest.approx(value, abs=1e-9)
        assert writhe(np.roll(curve, 5, axis=0)) == pytest.approx(value, abs=1e-9)
        assert writhe(curve[::-1]) == pytest.approx(value, abs=1e-9)


def wound_ring(nodes: int, revolutions: int, device):
    """Return a closed ring with a first director that winds about the tangent `turns` times."""
    ring = circle(nodes)
    tangents = np.roll(ring, -1, axis=0) - ring
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    angle = 2.0 * np.pi * revolutions * np.arange(nodes)[:, None] / nodes
    up = np.array([0.0, 0.0, 1.0])
    directors = np.cos(angle) * up + np.sin(angle) * np.cross(tangents, up)
    return built(ring, device, closed=True, director=directors[None])


@pytest.mark.parametrize("revolutions", [0, 1, -3, 12])
def test_link_is_twist_plus_writhe(device, revolutions):
    """White 1969, Fuller 1971; exact for polygons with parallel-transported frames."""
    nodes = 60
    model = wound_ring(nodes, revolutions, device)
    state = model.state()
    assert total_twist(model, state) == pytest.approx(revolutions, abs=1e-10)
    random, shape, writhes = np.random.default_rng(1), circle(nodes), []
    s = 2.0 * np.pi * np.arange(nodes) / nodes
    for amount in np.linspace(0.0, 1.0, 11):  # in steps, as a simulation deforms it
        shape = circle(nodes) + amount * np.stack([np.cos(2.0 * s), 0.5 * np.sin(3.0 * s), 1.2 * np.sin(2.0 * s)], -1)
        shape += 0.01 * amount * random.normal(size=shape.shape)
        tangent = Tangent(model)
        q = tangent.dofs(state).reshape(nodes, 4)
        q[:, :3] = shape
        tangent.assign(state, q.ravel())
        writhes.append(writhe(shape))
        assert total_twist(model, state) + writhes[-1] == pytest.approx(revolutions, abs=1e-9)
    assert np.abs(writhes).max() > 0.1


def test_twist_of_two_rods_and_of_none(device):
    scene = ddg.Scene()
    scene.add_rod(straight(9), section=SECTION, natural="straight")
    scene.add_rod(straight(9), section=ddg.Stiffness(EA=1.0, EI1=1.0), twist=False)
    model = scene.build(device, "float64")
    assert total_twist(model, model.state(), 0) == 0.0
    with pytest.raises(ValueError, match="rod 1 has no twist"):
        total_twist(model, model.state(), 1)
