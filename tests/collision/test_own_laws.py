"""User-defined contact laws: closed forms, laws of the package as user laws, and refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.kernels.densities import NOT_NEGATIVE, POSITIVE, Density, Parameter
from ddg_warp.kernels.densities.contact import log_barrier, smooth_penalty
from ddg_warp.solve.equilibrium import statics

G, RANGE, STIFFNESS, HEIGHT = 9.81, 2e-3, 40.0, 0.002
RUBBER = ddg.Material(1e6, 0.3, 1000.0)


@cache
def _power(real, n):
    """Return the functions of psi = k r^2 (1 - g / r)^p / p."""
    E, P = wp.types.vector(1, real), wp.types.vector(3, real)
    one = wp.constant(real(1.0))

    @wp.func
    def energy(e: E, p: P):
        return p[0] * p[1] * p[1] * wp.pow(one - e[0] / p[1], p[2]) / p[2]

    @wp.func
    def slope(e: E, p: P):
        return E(-p[0] * p[1] * wp.pow(one - e[0] / p[1], p[2] - one))

    @wp.func
    def curvature(e: E, p: P):
        return E(p[0] * (p[2] - one) * wp.pow(one - e[0] / p[1], p[2] - real(2.0)))

    return energy, slope, curvature


def _wrong(real, n):
    energy, _, curvature = _power(real, n)
    return energy, _doubled(real), curvature


@cache
def _doubled(real):
    E, P, slope = wp.types.vector(1, real), wp.types.vector(3, real), _power(real, 1)[1]

    @wp.func
    def doubled(e: E, p: P):
        return slope(e, p) * real(2.0)

    return doubled


def parameters(n):
    return (
        Parameter("stiffness", "N/m", NOT_NEGATIVE),
        Parameter("range", "m", POSITIVE),
        Parameter("power", "1", POSITIVE),
    )


power = Density("power", parameters, _power, strains=1)
wrong = Density("wrong", parameters, _wrong, strains=1)


def sheet_on_floor(law, stiffness: float | None = STIFFNESS, gap: float = 0.8 * RANGE, **options) -> ddg.Scene:
    """Return a sheet over a floor, with vertices that move only vertically."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    points, triangles = meshes.rectangle(3, 3, (0.1, 0.1))
    points = np.asarray(points) + [0.0, 0.0, 0.5 * HEIGHT + gap]
    sheet = scene.add_shell(points, triangles, thickness=HEIGHT, material=RUBBER, name="sheet")
    scene.hold(sheet, np.arange(len(points)), "xy")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(law=law, range=RANGE, stiffness=stiffness, **options)
    return scene


def rods(law, friction: float = 0.3) -> ddg.Scene:
    """Return rods that fall across each other onto a floor."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    for k, angle in enumerate((0.0, 1.0, 1.02)):
        half = 0.05 * np.array([np.cos(angle), np.sin(angle), 0.0])
        middle = np.array([0.0, 0.002 * k, 0.0062 + 0.0115 * k])
        scene.add_rod(np.linspace(middle - half, middle + half, 7), section=ddg.Circle(0.005), material=RUBBER)
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(law=law, friction=friction)
    return scene


def moved(scene: ddg.Scene, device, steps: int = 20, **options) -> np.ndarray:
    model = scene.build(device, "float64", **options)
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(steps):
        state = integrator.step(state, 0.004)
    integrator.check(state)
    return state.points()


@pytest.mark.parametrize("exponent", [2.0, 3.0])
def test_a_weight_has_the_gap_of_its_law(device, exponent):
    """The weight of all vertices equals the sum of k r (1 - g / r)^(p - 1)."""
    scene = sheet_on_floor(ddg.Law(power, power=exponent))
    model = scene.build(device, "float64")
    gap = statics.solve(model).points()[:, 2] - 0.5 * HEIGHT
    weight = 0.1 * 0.1 * HEIGHT * 1000.0 * G
    assert (STIFFNESS * RANGE * (1.0 - gap / RANGE) ** (exponent - 1.0)).sum() == pytest.approx(weight, rel=1e-7)
    assert 0.1 * RANGE < gap.min() < gap.max() < RANGE


def test_a_law_without_end_may_overlap(device):
    """The quadratic law is finite at zero gap, so that a soft contact penetrates by the closed form."""
    scene = sheet_on_floor(ddg.Law(power, power=2.0), 9.0)
    gap = statics.solve(scene.build(device, "float64")).points()[:, 2] - 0.5 * HEIGHT
    weight = 0.1 * 0.1 * HEIGHT * 1000.0 * G
    assert (9.0 * (RANGE - gap)[gap < RANGE]).sum() == pytest.approx(weight, rel=1e-7)
    assert gap.min() < -0.05 * RANGE


@pytest.mark.parametrize(("law", "density"), [("barrier", log_barrier), ("penalty", smooth_penalty)])
def test_laws_of_the_package_given_by_hand_are_the_same(device, law, density):
    """Laws by name and by hand give equal steps with friction, of rods on each other and on the floor; bitwise on the CPU.

    On CUDA multiplications and additions are fused differently in the module of a user's law.
    """
    usual, by_hand = (moved(rods(each), device) for each in (law, ddg.Law(density)))
    np.testing.assert_allclose(by_hand, usual, rtol=0.0, atol=0.0 if device == "cpu" else 1e-12)
    start = rods(law).build(device, "float64").state().points()
    assert (start - usual)[:, 2].max() > 1e-3


def test_worlds_and_gradients(device):
    """Each world has its own stiffness, and gradients of a step by stiffness equal differences."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    law = ddg.Law(power, power=3.0)
    model = sheet_on_floor(law, gap=0.5 * RANGE).build(device, "float64", worlds=2)
    simulator = Simulator(model, 2e-3, rtol=1e-12)
    start, k = simulator.world_state(model.state()), simulator.parameter("contact.stiffness").clone()
    k[1] *= 2.0

    def heights(k):
        return simulator.step(start, {"contact.stiffness": k}).positions[..., 2].sum(1)

    alone = Simulator(sheet_on_floor(law, 2.0 * STIFFNESS, gap=0.5 * RANGE).build(device, "float64"), 2e-3, rtol=1e-12)
    sums = heights(k)
    assert sums[1].item() == alone.step(alone.world_state(alone.model.state())).positions[..., 2].sum().item()
    assert (sums[1] - sums[0]).item() > 1e-7
    stiffness = k.clone().requires_grad_()
    (slope,) = torch.autograd.grad(heights(stiffness).sum(), stiffness)
    h = 1e-3 * STIFFNESS
    difference = (heights(k + h) - heights(k - h)) / (2.0 * h)
    torch.testing.assert_close(slope.sum(1), difference, rtol=1e-5, atol=0.0)


WRONG = {
    "derivative": (ddg.Law(wrong, power=2.0), {}, "slope of the law 'wrong'"),
    "missing": (ddg.Law(power), {}, "power is missing"),
    "unknown": (ddg.Law(power, power=2.0, stiff=1.0), {}, "stiff does not fit; it takes stiffness, range, power"),
    "value": (ddg.Law(power, power=-1.0), {}, r"power = -1.0; it is finite and positive"),
    "array": (ddg.Law(power, power=np.ones(2)), {}, "of contact it is one number"),
    "own stiffness": (ddg.Law(power, power=2.0, stiffness=1.0), {}, r"give contact\(stiffness=...\)"),
    "strains": (ddg.Law(replace(power, strains=3), power=2.0), {}, "no law of one strain, the gap"),
    "no end": (ddg.Law(power, power=1.0), {}, "has the force .* at the range"),
    "no law": (3.0, {}, "law"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_refused(device, name):
    law, options, words = WRONG[name]
    with pytest.raises(ddg.SceneError, match=words):
        sheet_on_floor(law, **options).build(device)


def test_a_law_that_pulls_is_refused(device):
    """The quadratic law of the package is attractive beyond the rest length."""
    from ddg_warp.kernels.densities.quadratic import quadratic

    law = ddg.Law(quadratic, rest=0.5 * RANGE)
    with pytest.raises(ddg.SceneError, match=r"'quadratic' pulls at a gap of 0.0014 m"):
        sheet_on_floor(law).build(device)
    flat = ddg.Law(quadratic, rest=RANGE)  # zero at the range
    usual, same = (moved(sheet_on_floor(each), device, 5) for each in (ddg.Law(power, power=2.0), flat))
    np.testing.assert_allclose(same, usual, atol=1e-12)


def test_one_law_is_compiled_once_for_all_numbers_of_contact(device):
    """Kernels take stiffness and range as arguments, and other parameters of the law as constants."""
    law, cubic = (ddg.Law(power, power=exponent) for exponent in (2.0, 3.0))
    touching = [
        sheet_on_floor(*arguments).build(device, "float64").coupled.host.contact_parameters.density
        for arguments in ((law, 40.0), (law, 50.0), (cubic, 40.0))
    ]
    assert touching[0] is touching[1]
    assert touching[0] is not touching[2]


def test_the_report_names_the_law(device):
    text = sheet_on_floor(ddg.Law(power, power=2.0)).build(device, "float64").report()
    assert "contact: power between 1 bodies and 1 obstacles" in text
    assert "  power_point_plane: power, power between a point and a half-space" in text
