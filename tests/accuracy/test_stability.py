"""Critical loads by the lowest eigenvalue of the tangent, and the localised helix, at three resolutions with the observed order."""

import numpy as np
import pytest
from convergence import order

from ddg_warp.scenes import bend_twist, greenhill, localized_helix, michell_ring
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions


# Critical M [B/L] for a tension T [B/L^2], from the determinant (Greenhill 1883). EA L^2 / B = 1e9.
@pytest.mark.parametrize(
    ("tension", "edges", "moment"),
    [
        pytest.param(-20.0, (40, 80, 160), 5.771135703, marks=pytest.mark.slow),
        (0.0, (40, 80, 160), 8.986818916),
        pytest.param(10.0, (60, 120, 240), 10.42885644, marks=pytest.mark.slow),
        pytest.param(50.0, (80, 160, 320), 15.58932393, marks=pytest.mark.slow),
        pytest.param(100.0, (120, 240, 480), 20.98350083, marks=pytest.mark.slow),
        pytest.param(400.0, (200, 400, 800), 40.49623334, marks=pytest.mark.slow),
        pytest.param(2500.0, (400, 800, 1600), 100.1978301, marks=pytest.mark.slow),
    ],
)
def test_greenhill_moment_under_tension(device, tension, edges, moment):
    assert greenhill.exact(tension) == pytest.approx(moment, rel=1e-7)
    errors = [greenhill.critical_moment(tension, n, device) / moment - 1.0 for n in edges]
    assert abs(errors[-1]) < 1e-3
    assert order(edges, errors) == pytest.approx(2.0, abs=0.1)


# Critical twist [rad], 2 pi sqrt(3) B / C (Michell 1889, Zajac 1962). EA R^2 / B = 1e7.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "twist"),
    [
        (1.0, 10.88279619),
        (2.0 / 3.0, 16.32419428),
        (10.0 / 13.0, 14.14763505),
    ],
)
def test_michell_twist_of_a_ring(device, ratio, twist):
    edges = (60, 120, 240)
    errors = [michell_ring.critical_twist(ratio, n, device) / twist - 1.0 for n in edges]
    assert abs(errors[-1]) < 1e-3
    assert order(edges, errors) == pytest.approx(2.0, abs=0.1)


# Weight G [B/L^3] at which the planar equilibrium of an arc loses or regains stability: second variation of the Kirchhoff rod,
# spectral against determinant to 6e-8. EA L^2 / B = 1e7.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("curvature", "weight", "loses"),
    [
        (6.0, 11.86875074, True),
        (6.0, 37.76390898, False),
        (7.0, 14.53972482, True),
        (8.0, 19.24842318, True),
        (10.0, 28.7697064, True),
    ],
)
def test_critical_weight_of_a_planar_arc(device, curvature, weight, loses):
    edges, errors = (40, 80, 160), []
    for n in edges:
        branch = bend_twist.PlanarBranch(curvature, n, device)
        errors.append(branch.flip(0.8 * weight, 1.2 * weight) / weight - 1.0)
        assert (branch.lowest(0.8 * weight) > 0.0) == loses
        assert not branch.at(1.2 * weight)[1].points()[:, 1].any()  # in the plane, to the last bit
    assert abs(errors[0]) < 0.02  # at 40 edges already
    assert order(edges, errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("curvature", [4.0, 5.0, 5.5])
def test_bend_twist_never_flips(device, curvature):
    """The arc stays planar up to G = 1000."""
    branch = bend_twist.PlanarBranch(curvature, 140, device)
    assert min(branch.lowest(weight) for weight in np.geomspace(1.0, 1000.0, 60)) > 0.0


def localized_helix_state(device, n, stiffer=()):
    """Return model and state of the localised helix at EA L^2 / B = 1e6, then continued to stiffer rods in succession."""
    scene = localized_helix.build(n=n)
    model = scene.build(device, "float64")
    solver = Equilibrium(model)
    state = solver.load(model.state(), scene.analysis.load_steps)
    for axial in stiffer:
        blocks, end = solver.tangent.dofs(state).reshape(-1, 4), state.points()[-1, 0]
        model = localized_helix.build(n=n, axial=axial).build(device, "float64")
        solver = Equilibrium(model, StaticsOptions(mode="follow"))
        shift = model.motions[0].translation(1.0)[0] + localized_helix.LENGTH - end
        blocks[:, 0] += shift * (np.arange(len(blocks)) - 1.0) / n  # the first node is the ghost of a clamp
        state = model.state()
        solver.tangent.assign(state, blocks.ravel())
        state = solver.load(state, 1, 1.0 - 1e-12, 1.0)
    return model, state


# 27 windings, shortening 0.3: largest angle p [rad], s* [m], moment [N m], tension [N] of the infinite rod (Coyne 1990).
HELIX = (0.9185495351, 0.3816536653, 14.25201565, 46.98850021)


def test_localized_helix_closed_form():
    assert localized_helix.exact(27.0, 0.3) == pytest.approx(HELIX, rel=1e-8)


@pytest.mark.slow
def test_localized_helix_error_at_coarse_edges(device):
    """Errors below 5 % at EA L^2 / B = 1e6."""
    errors = np.array(localized_helix.measure(*localized_helix_state(device, 400))) / HELIX - 1.0
    assert np.all(np.abs(errors) < 0.05)


@pytest.mark.slow
def test_localized_helix_converges(device):
    """Errors below 1 % at EA L^2 / B = 1e8, of second order."""
    edges = (400, 600, 800)
    errors = (
        np.array([localized_helix.measure(*localized_helix_state(device, n, (1e7, 1e8))) for n in edges]) / HELIX - 1.0
    )
    assert np.all(np.abs(errors[-1]) < 0.01)
    for column in errors.T:
        assert order(edges, column) == pytest.approx(2.0, abs=0.1)
