"""Every derivative of the terms of shells, shells of revolution, rigid joints, glued edges and magnets, in both precisions,
against something else that computes it."""

from functools import cache

import numpy as np
import pytest

from ddg_warp.kernels.terms import ALL, AXISYMMETRIC, MAGNETS, REGISTRY, SHELLS
from ddg_warp.run import derivatives, net_derivatives
from ddg_warp.run.net_derivatives import TERMS


@cache
def rows(term: str, precision: str, device: str) -> dict:
    """The derivative table of a term by check."""
    return {row["check"]: row for row in derivatives.table(term, precision, device)}


# Each has kernels of its own: every day one of every density and of every sort of element. The other measures are met every day by
# test_shell_measures and test_axisymmetric_measures.
DAILY = (
    *("shell_stretch_damped", "shell_hinge_damped", "shell_tilt"),
    *("axisymmetric_bend", "rigid_joint", "glued_edge"),
)
CASES = [
    pytest.param(precision, term, check, marks=[] if precision == "float64" and term in DAILY else pytest.mark.slow)
    for precision, column in (("float64", 1), ("float32", 2))
    for term in TERMS
    for check in net_derivatives.CHECKS
    if derivatives.CHECKS[check][column] is not None
]


@pytest.mark.parametrize(("precision", "term", "check"), CASES)
def test_derivative(device, precision, term, check):
    row = rows(term, precision, device)[check]
    assert row["passed"], f"error {row['error']:.2e}, tolerance {row['tolerance']:.0e}"


def test_nothing_is_left_out():
    """Terms of nets meet the checks of chains but `rigid`, of which `invariance` is the whole."""
    assert set(derivatives.CHECKS) - set(net_derivatives.CHECKS) == {"rigid"}
    assert set(net_derivatives.CHECKS) < set(derivatives.CHECKS)


def test_every_day_has_every_kind():
    """Every density and every sort of element; left to other tests are measures of shells and of shells of revolution, curvature by
    the angle, and magnets, which meet closed forms in test_magnets."""
    densities = {term.density.name for name, term in TERMS.items() if name not in MAGNETS}
    assert {TERMS[name].density.name for name in DAILY} == densities
    assert set(TERMS) - set(DAILY) <= {*SHELLS, *AXISYMMETRIC, *MAGNETS, "rigid_joint_angle"}


def test_every_listed_term_has_a_table():
    """What `ddg-warp list` shows, `ddg-warp check` checks."""
    assert set(ALL) == {*REGISTRY, *TERMS}
    assert {name for name in ALL if name.startswith("axisymmetric")} <= TERMS.keys()


@pytest.mark.slow
def test_table_has_chains_and_nets(device):
    """The same columns for both, so that one table shows them."""
    chain, net = (derivatives.table(name, "float64", device) for name in ("planar_stretch", "shell_tilt"))
    assert chain[0].keys() == net[0].keys()
    assert {row["chain"] for row in net} == {"net"}
    assert len(net) == len(net_derivatives.CHECKS)


def test_sample_is_general():
    """All kinds of edges, both signs of a joint, frames that are old: no check passes by accident."""
    bend = net_derivatives.NetCase(TERMS["shell_bend_dof"], "float64", "cpu").sample
    assert set(bend.data["constants"][:3].ravel()) == {0.0, 1.0, 2.0, 3.0}
    joint = net_derivatives.NetCase(TERMS["rigid_joint"], "float64", "cpu").sample
    assert set(joint.data["constants"][0]) == {-1.0, 1.0}
    edge = joint.data["q"][joint.slots[1]] - joint.data["q"][joint.slots[0]]
    t = joint.data["frame"][3:6].T * joint.data["constants"][0][:, None]
    age = np.degrees(np.arccos(np.sum(t * edge, -1) / np.linalg.norm(edge, axis=-1)))
    assert 5.0 < age.min() and age.max() < 60.0
    assert np.abs(joint.data["lag"][6]).max() > 2.0 * np.pi
    glue = net_derivatives.NetCase(TERMS["glued_edge"], "float64", "cpu").sample
    assert set(glue.data["constants"][1]) == {-1.0, 0.0, 1.0}
    assert 0.0 in glue.data["constants"][0] and np.abs(glue.data["lag"]).max() > 2.0 * np.pi
