"""Sweep from both ends of a rod against the sweep from one end: directions, decisions and lost pivots."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.kernels.core import outcome
from ddg_warp.solve.newton.rod_newton import NewtonOptions, RodNewton

KINDS = {
    "full": {},
    "untwisted": {"twist": False},
    "planar": {"dimension": 2},
    "stretch": {"bend": False},
}
COUNTS = (2, 3, 4, 5, 6, 9)


class OneSided(RodNewton):
    """Solver that sweeps from one end of a rod, on every device."""

    def _sides(self, mixed_axial: bool) -> int:
        return 1


class TwoSided(RodNewton):
    """Solver that sweeps from both ends of a rod, on every device."""

    def _sides(self, mixed_axial: bool) -> int:
        return 2


def solvers(kind, name: str, device, precision: str, compress: float = 1.0, **options) -> list[RodNewton]:
    """Return solvers of rods of 2 to 9 nodes, by size, with random supports at a random iterate, after one iteration.

    Args:
        compress: factor on all positions, by which edges are shorter than at rest.
    """
    random, rod_options = np.random.default_rng(3), {"dimension": 3} | KINDS[name]
    dimension = rod_options.pop("dimension")
    scene = ddg.Scene(gravity=(0.3, 0.2 if dimension == 3 else 0.0, -2.0), dimension=dimension)
    section = ddg.Stiffness(EA=9.0, EI1=0.6, EI2=0.6, GJ=0.5, mass_per_length=0.7, rotary_inertia=0.2)
    if dimension == 2 or name in ("untwisted", "stretch"):
        section = ddg.Stiffness(EA=9.0, EI1=0.6, GJ=0.5, mass_per_length=0.7)
    for nodes in COUNTS if name == "stretch" else COUNTS[1:]:  # a rod of two nodes only stretches
        points = np.cumsum(np.array([1.0, 0.0, 0.2]) + 0.3 * random.normal(size=(nodes, 3)), axis=0)
        points[:, 1] *= dimension == 3
        rod = scene.add_rod(points, section=section, natural="straight", **rod_options)
        for node in range(nodes):
            if components := "".join(c for c in "xyz" if random.random() < 0.2 and (dimension == 3 or c != "y")):
                scene.fix(rod, [node], components=components)
        if name == "full":
            scene.fix_twist(rod, [int(random.integers(nodes - 1))])
    model, solvers = scene.build(device, precision), []
    for group, state in zip(model.groups, model.state().groups, strict=True):
        newton = kind(model, group, NewtonOptions(**options))
        x = device_arrays.download(state.x)
        device_arrays.assign(newton.iterates.x, compress * x + 0.1 * random.normal(size=x.shape))
        device_arrays.assign(newton.iterates.target, x + 0.1 * random.normal(size=x.shape))
        if group.kind.twist:
            wp.copy(newton.iterates.frame, state.frame)
            device_arrays.assign(newton.iterates.theta, 0.2 * random.normal(size=newton.iterates.theta.shape))
        newton.islands.inertia_coefficient.fill_(2.0)
        newton.islands.inverse_step.fill_(1.0)
        newton.last = state.last
        newton.iterate(state.last)
        solvers.append(newton)
    return solvers


def results(newton: RodNewton) -> dict[str, np.ndarray]:
    """Return the dofs, directions and flags of an iteration, without entries past the ends of rods."""
    exists = np.arange(newton.group.nodes)[:, None] < newton.group.host.count
    arrays = {"x": newton.iterates.x, "direction": newton.direction}
    if newton.group.kind.twist:
        arrays["theta"] = newton.iterates.theta
    out = {name: device_arrays.download(array) for name, array in arrays.items()}
    out["x"] = np.moveaxis(out["x"], -1, 0)
    out = {name: np.where(exists, values, 0.0) for name, values in out.items()}
    scalars = ("predicted_decrease", "step_length", "angle_step_left", "max_residual")
    return out | {name: getattr(newton.islands, name).numpy() for name in scalars}


def assert_equal(one: RodNewton, two: RodNewton, tolerance: float) -> None:
    flags = [each.islands.arrays[0].numpy() for each in (one, two)]
    for name, row in (("status", 0), ("iteration", 1), ("drop_compression", 10)):
        assert (flags[0][row] == flags[1][row]).all(), name
    first, second = results(one), results(two)
    for name, values in first.items():
        np.testing.assert_allclose(
            second[name], values, rtol=0, atol=tolerance * max(np.abs(values).max(), 1e-30), err_msg=name
        )


def pairs(name: str, device, precision: str = "float64", **options) -> list[tuple[RodNewton, RodNewton]]:
    """Return solvers from one end and from both ends, of the same rods."""
    return list(zip(*(solvers(kind, name, device, precision, **options) for kind in (OneSided, TwoSided)), strict=True))


@pytest.mark.parametrize(("name", "precision"), [*((name, "float64") for name in KINDS), ("full", "mixed")])
def test_directions_and_steps_are_those_of_one_side(device, name, precision):
    """Rods of 2 to 9 nodes with supports anywhere: directions, steps and decisions agree over several iterations."""
    tolerance = 1e-11 if precision == "float64" else 2e-3
    for one, two in pairs(name, device, precision):
        assert_equal(one, two, tolerance)
        for _ in range(3):
            for each in (one, two):
                each.iterate(each.last)
            assert_equal(one, two, 10.0 * tolerance)
        assert (one.islands.iteration.numpy() > 1).any()
        assert np.abs(results(one)["direction"]).max() > 0.0


def test_exact_hessian_from_both_ends(device):
    """Second derivatives of reversed elements: directions agree."""
    definite = 0
    for one, two in pairs("full", device, psd="none"):
        definite += (one.islands.status.numpy() == outcome.ACTIVE).sum()
        assert_equal(one, two, 1e-10)
    assert definite > 1


@pytest.mark.parametrize(("psd", "result"), [("gauss_newton", outcome.ACTIVE), ("none", outcome.INDEFINITE)])
def test_lost_pivots_of_either_side_count(device, psd, result):
    """Compressed rods have an indefinite matrix: compression is dropped, or the solve ends where it may not be."""
    lost = 0
    for one, two in pairs("full", device, compress=0.2, psd=psd):
        assert_equal(one, two, 1e-10)
        dropped = one.islands.drop_compression.numpy()
        lost += ((one.islands.status.numpy() == result) & (dropped == (result == outcome.ACTIVE))).sum()
        for each in (one, two):
            each.iterate(each.last)
        assert_equal(one, two, 1e-10)
    assert lost > 2
