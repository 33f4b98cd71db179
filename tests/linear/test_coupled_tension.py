"""Mixed axial-force formulation in the coupled system: directions equal the plain ones, motion equals float64."""

import numpy as np
import pytest
import warp as wp
from test_tension import advance

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.scenes import hair
from ddg_warp.solve.newton.coupled_newton import CoupledNewton
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from tests.pairwise import chosen

HAIR = ddg.Material(young=4e9, poisson=0.4, density=1300.0, viscosity=1e-3)


def rods_with_fixed_joints(axial: float = 1e4, twist: bool = True) -> ddg.Scene:
    """Build wavy rods with fixed joints at the start, the end, both, and within; single nodes are fixed, too."""
    scene = ddg.Scene()
    along = np.linspace(0.0, 3.0, 25)
    bend = {"EI2": 0.9} if twist else {}
    section = ddg.Stiffness(EA=axial, EI1=0.6, GJ=0.5, mass_per_length=0.7, rotary_inertia=1e-3, **bend)
    for i, joints in enumerate(([0], [24], [0, 24], [9])):
        points = np.stack([along, 0.2 * np.sin(4.0 * along) + i, 0.2 * np.cos(3.0 * along)], axis=1)
        rod = scene.add_rod(points, section=section, natural="straight", twist=twist)
        for k in joints:
            stub = scene.add_rod(
                points[k] + np.linspace([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], 3), section=section, twist=twist
            )
            scene.fix(stub, [0, 1, 2])
            scene.join([(rod, k), (stub, -1)], rigid=False)
        scene.fix(rod, [14])
        scene.fix(rod, [17], components="y")
    return scene


def first_direction(
    scene: ddg.Scene, device, linear, carried: float | None, rounding_error: float = 1e-3
) -> tuple[CoupledNewton, np.ndarray]:
    """Return a solver of two worlds at iterates off rest by `rounding_error` [m], and the first direction (worlds, blocks, 3)."""
    random, model = np.random.default_rng(3), scene.build(device, "float64", worlds=2)
    newton = CoupledNewton(
        model, NewtonOptions(psd="gauss_newton"), "substructuring", linear, mixed_axial=carried is not None
    )
    state, islands = model.state().coupled, newton.islands
    q = state.q.numpy()
    free = np.tile(~model.coupled.host.fixed, (2, 1))
    for array, size in (
        (newton.iterates.q, rounding_error),
        (newton.iterates.base, rounding_error),
        (newton.iterates.target, 1e-3),
    ):
        array.assign(q + size * random.normal(size=q.shape) * free)
    islands.inertia_coefficient.fill_(100.0)
    islands.inverse_step.fill_(10.0)
    islands.drop_compression.fill_(1)
    islands.max_edge_stiffness.fill_(carried or 0.0)
    newton.evaluate(state)
    newton.balance()
    islands.needs_direction.fill_(1)
    newton.assemble()
    newton.direct()
    assert newton.substructuring.allows_mixed_axial
    assert (newton.system.indefinite.numpy() == 0).all()
    return newton, newton.system.direction.numpy().astype(float).reshape(2, -1, 3)


@chosen([True], twist=(True, False))
def test_directions_match_full_matrix(device, twist):
    """Directions are equal for any fraction of axial stiffness kept in H; lengthenings of mixed edges match them."""
    scene = rods_with_fixed_joints(twist=twist)
    _, exact = first_direction(scene, device, wp.float64, None)
    for carried in (1.0, 1e4, 1e9):  # axial stiffness is about 8e4: the last leaves no mixed edge
        newton, mixed = first_direction(scene, device, wp.float64, carried)
        np.testing.assert_allclose(mixed, exact, rtol=0, atol=1e-9 * np.abs(exact).max())
        element_set = next(element_set for element_set in newton.coupled.sets if element_set.term.measure.tensions)
        a, b = element_set.host.slots[:2]
        q = newton.iterates.q.numpy().reshape(2, -1, 3)
        edges, steps = q[:, b] - q[:, a], mixed[:, b] - mixed[:, a]
        along = np.sum(edges * steps, axis=-1) / np.linalg.norm(edges, axis=-1)
        element = newton.substructuring.plan.elements(newton.coupled.host, element_set.host)[1]
        k, c = np.nonzero(element >= 0)
        longer = device_arrays.download(newton.substructuring.bands.longer).reshape(
            2, newton.substructuring.paths.longest, 2, -1
        )
        slack, lengthening = longer[:, k, :, c].transpose(1, 2, 0)
        assert (slack > 0.0).any() == (carried < 1e9)
        expected = along[:, element[k, c]]
        is_mixed = slack > 0.0
        np.testing.assert_allclose(
            lengthening[is_mixed], expected[is_mixed], rtol=0, atol=1e-9 * np.abs(steps).max(initial=0.0)
        )


def test_float32_error_is_independent_of_axial_stiffness(device):
    """Errors of mixed directions do not grow with EA; without mixed tensions they do. Iterates have edges of rest length."""
    errors = {1e2: [], None: []}
    for axial in (1e4, 1e6, 1e8):
        scene = rods_with_fixed_joints(axial)
        _, exact = first_direction(scene, device, wp.float64, 1e2, 0.0)
        for carried, error_list in errors.items():
            _, inexact = first_direction(scene, device, wp.float32, carried, 0.0)
            error_list.append(np.abs(inexact - exact).max() / np.abs(exact).max())
    assert max(errors[1e2]) < 1e-3
    assert errors[None][-1] > 30.0 * errors[1e2][-1]


def hair_island(nodes: int, strands: int = 3, backwards: bool = False) -> ddg.Scene:
    """Build hair in one island: each root is joined to a clamped stub."""
    scene = ddg.Scene(gravity=(3.0, 0.0, -9.81), analysis=ddg.Dynamics(dt=1.0 / 60.0, duration=1.0))
    options = {"section": ddg.Circle(40e-6), "material": HAIR}
    for points in hair.curls(strands, nodes):
        rod = scene.add_rod(points[::-1] if backwards else points, natural="shape", **options)
        stub = scene.add_rod(np.linspace(points[0] + [0.0, 0.0, 0.02], points[0], 3), **options)
        scene.clamp(stub, edges=[0, 1])
        scene.join([(rod, -1 if backwards else 0), (stub, -1)], rigid=False)
    return scene


@pytest.mark.parametrize(
    ("nodes", "backwards", "scheme"),
    [
        (32, False, "implicit_euler"),
        pytest.param(32, True, "implicit_euler", marks=pytest.mark.slow),
        pytest.param(128, False, "implicit_euler", marks=pytest.mark.slow),
        pytest.param(32, False, "implicit_midpoint", marks=pytest.mark.slow),
    ],
)
def test_hair_island_matches_float64(device, nodes, backwards, scheme):
    """Within 1e-6 m of float64 at rtol 1e-10, in as many iterations, and without retries."""
    steps = (1.0 / 60.0, 15) if scheme == "implicit_euler" else (1.0 / 120.0, 30)
    options = {"scheme": scheme} | ({"energy_bound": None} if scheme == "implicit_midpoint" else {})
    scene = hair_island(nodes, backwards=backwards)
    exact, _ = advance(scene, device, "float64", *steps, rtol=1e-10, **options)
    _, usual = advance(scene, device, "float64", *steps, **options)
    points, statistics = advance(scene, device, "mixed", *steps, **options)
    assert statistics["linear"] == ["float32 with tensions"]
    assert np.abs(points - exact).max() < 1e-6
    assert statistics["newton_iterations"]["mean"] < 1.1 * usual["newton_iterations"]["mean"]
    assert statistics["retries"] == statistics["pcg_iterations"] == 0


def test_report_names_linear_algebra_of_islands(device):
    """Uncoupled islands take mixed tensions; islands with a free joint are solved in float64."""
    said = "over steps of 0.0166667 s: edge-rotation update, exact Hessian, linear algebra in "
    assert said + "float32 with tensions" in hair_island(32).build(device, "mixed").report()
    scene = hair_island(32)
    tip = scene.batches[0].points[0, -1]
    twig = scene.add_rod(np.linspace(tip, tip + [0.1, 0.0, 0.0], 10), section=ddg.Circle(40e-6), material=HAIR)
    scene.join([(0, -1), (twig, 0)], rigid=False)
    assert said + "float64" in scene.build(device, "mixed").report()
