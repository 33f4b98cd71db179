"""Derivative table of every term and potential in both precisions, and its detection of wrong derivatives."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.terms import ALL, CONTACT, FRICTION, REGISTRY
from ddg_warp.run import derivative_checks
from ddg_warp.run.cli import main
from ddg_warp.run.scene_registry import load_file

# Terms with kernels of their own, tested daily: every density and element kind, for rods edges and vertices, damped, in space and in
# the plane. (A stretch has the measure of the damped one and the density of bending.)
DAILY = {
    *("rod_stretch_damped", "rod_bend_twist", "planar_bend"),
    *("shell_stretch_damped", "shell_stretch_curved", "shell_hinge_damped", "shell_tilt", "shell_isometric"),
    *(
        "axisymmetric_stretch",
        "axisymmetric_bend",
        "axisymmetric_rim",
        "rigid_joint",
        "glued_edge",
        "ball_joint",
        "hinge",
    ),
    *("penalty_edge_edge", "penalty_edge_point", "penalty_point_plane", "barrier_edge_edge", "barrier_point_triangle"),
    *("friction_logistic_edge_edge", "friction_polynomial_edge_point", "friction_logistic_point_triangle"),
    *("friction_logistic_point_plane", "penalty_point_point", "friction_logistic_point_point"),
}
POTENTIALS = {**CONTACT, **FRICTION}
SAMPLES = {
    (precision, name, sample.layout): sample
    for precision in ("float64", "float32")
    for name, term in ALL.items()
    for sample in derivative_checks.samples_of(term, precision)
}
CASES = [
    pytest.param(
        *key,
        check,
        marks=[] if key[0] == "float64" and key[1] in DAILY and key[2] != "closed" else pytest.mark.slow,
        id="-".join((*key, check)),
    )
    for key, sample in SAMPLES.items()
    for check in derivative_checks.checks_of(sample)
]
# User-defined terms in a file: one right, one with an error of 0.1 % in an entry of the Jacobian.
OWN = """
from dataclasses import replace
from functools import cache
import numpy as np
import warp as wp
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.terms import Term

def functions_of(measure_of, wrong):
    @cache
    def functions(real):
        Q, S, E, M = measure_of().types(real)
        V = wp.types.vector(3, real)

        @wp.func
        def strains(q: Q, s: S, w: real):
            return E(s[0] * wp.dot(V(q[0], q[1], q[2]), V(q[3], q[4], q[5])))

        @wp.func
        def jacobian(q: Q, s: S, w: real):
            g = Q(q[3], q[4], q[5], q[0], q[1] * real(wp.static(wrong)), q[2])
            return strains(q, s, w), wp.matrix_from_rows(g * s[0])

        return strains, jacobian, None, None

    return functions

def sample(random, count):
    return {"nodes": np.eye(3), "data": np.full((1, count), 2.0)}

def term(name, wrong):
    measure = Measure(
        "product", 3, ((0, 1), (0, 2)), ("product [m^2]",), functions_of(lambda: measure, wrong), data_size=1, sample=sample
    )
    return Term(name, measure, quadratic, "product of two edges")

right, wrong = term("right", 1.0), term("wrong", 1.001)
plane = replace(right, measure=replace(right.measure, dim=2))
"""


@cache
def sample_on(device: str, precision: str, term: str, layout: str) -> derivative_checks.Sample:
    """Return the sample on the device under test."""
    closed = {"open": (False,), "closed": (True,)}.get(layout, ())
    (sample,) = derivative_checks.samples_of(ALL[term], precision, device, closed)
    return sample


@pytest.mark.parametrize(("precision", "term", "layout", "check"), CASES)
def test_derivative(device, precision, term, layout, check):
    row = derivative_checks.row(sample_on(device, precision, term, layout), check)
    assert row["passed"], f"error {row['error']:.2e}, tolerance {row['tolerance']:.0e}"


@pytest.fixture
def own_term_file(tmp_path):
    path = tmp_path / "own_term.py"
    path.write_text(OWN)
    return path


def test_a_wrong_derivative_fails(device, own_term_file, capsys):
    """The wrong Jacobian affects forces and factor, not energy and strains; the Hessian is unsymmetric."""
    assert main(["check", f"{own_term_file}:wrong", "--device", device]) == 1
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert {row[2] for row in rows if row[-1] == "FAILED"} == {"gradient", "hessian", "symmetry", "factor"}
    error = {row[2]: float(row[3]) for row in rows}
    assert 1e-5 < error["gradient"] < 1e-2
    assert main(["check", f"{own_term_file}:plane", "--device", device]) == 2
    assert "give product dim = 3" in capsys.readouterr().err


def test_what_is_no_number_fails():
    assert np.isnan(derivative_checks.largest([derivative_checks.relative(np.array([np.nan, 1.0]), np.ones(2)), 0.0]))
    assert derivative_checks.relative(np.ones(2), np.zeros(2)) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_term_of_ones_own_passes(device, own_term_file, precision):
    term = load_file(str(own_term_file)).right
    for row in derivative_checks.table(term, precision, device):
        assert row["passed"], row


def test_every_term_has_every_check():
    """Checks left out: for indexed elements `rigid`, covered by `invariance`, and `exact` without second derivatives.

    Dipoles have no rest shape. Potentials have no rest shape and no reverse mode of the energy. Only friction has lagged data.
    """
    of_terms, of_collisions = {"energy", "resultant"}, {"gradient", "rest", "rigid"}
    for (precision, name, layout), sample in SAMPLES.items():
        left_out = {
            "open": of_terms,
            "closed": of_terms,
            "coupled": of_terms | {"rigid"} | (set() if name.startswith("rigid_joint") else {"exact"}),
            "pair": of_collisions | ({"symmetry", "factor", "exact"} if name in FRICTION else {"lagged"}),
        }[layout]
        left_out = left_out | ({"downcast"} if precision == "float32" else set())
        left_out = left_out | ({"rest"} if name.startswith(("magnetic", "dipoles")) else set())
        assert set(derivative_checks.CHECKS) - set(derivative_checks.checks_of(sample)) == left_out


def test_every_day_has_every_kind():
    """Daily terms cover every density, every kind of collision, and every measure with few exceptions.

    Exceptions: curvature by rotation angles and of rods without twist. Mid-edge normals are covered by shell_stretch_curved, magnets
    by closed forms in test_magnets.
    """
    terms = {name: term for name, term in ALL.items() if not name.startswith(("magnetic", "dipoles"))}
    assert {ALL[name].density.name for name in DAILY} == {term.density.name for term in terms.values()}
    measures = {
        term.measure.name for name, term in terms.items() if name not in POTENTIALS and not term.measure.by_angle
    }
    left_out = {"edge_stretch_2d", "curvature_binormal", "midedge_curvature", "midedge_curvature_dof"}
    assert measures - {ALL[name].measure.name for name in DAILY - POTENTIALS.keys()} == left_out
    kinds = {potential.kind for potential in POTENTIALS.values()}
    for potentials in (CONTACT, FRICTION):
        assert {potentials[name].kind for name in DAILY & potentials.keys()} == kinds


@pytest.mark.parametrize("term", ["rod_bend_twist", "rod_stretch_damped"])
def test_sample_of_chains_is_general(term):
    """The state has no zeros, frames differ by 25 degrees, and twist exceeds a revolution, so that no check passes by accident."""
    sample = SAMPLES["float64", term, "closed"]
    inside = np.arange(6)[:, None] < sample.count
    for name, values in sample.data.items():
        assert np.all(values[..., inside] if values.shape[-2:] == inside.shape else values), name
    t, t0 = sample.edges(), np.moveaxis(sample.data["frame"][3:6], 0, -1)
    age = np.arccos(np.sum(t * t0, -1) / np.linalg.norm(t, axis=-1))
    np.testing.assert_allclose(age[inside], np.radians(25.0), rtol=1e-12)
    assert np.abs(sample.data["frame"][6]).max() > 2.0 * np.pi


def test_sample_of_nets_is_general():
    """Samples have all kinds of edges, both signs of a joint, and old frames."""
    bend, joint, glue = (
        SAMPLES["float64", name, "coupled"] for name in ("shell_bend_dof", "rigid_joint", "glued_edge")
    )
    assert set(bend.data["constants"][:3].ravel()) == {0.0, 1.0, 2.0, 3.0}
    assert set(joint.data["constants"][0]) == {-1.0, 1.0}
    edge = joint.data["q"][joint.slots[1]] - joint.data["q"][joint.slots[0]]
    t = joint.data["frame"][3:6].T * joint.data["constants"][0][:, None]
    age = np.degrees(np.arccos(np.sum(t * edge, -1) / np.linalg.norm(edge, axis=-1)))
    assert 5.0 < age.min() and age.max() < 60.0
    assert np.abs(joint.data["lag"][6]).max() > 2.0 * np.pi
    assert set(glue.data["constants"][1]) == {-1.0, 0.0, 1.0}
    assert 0.0 in glue.data["constants"][0] and np.abs(glue.data["lag"]).max() > 2.0 * np.pi


@pytest.mark.slow
def test_table_has_chains_and_nets(device):
    """Rows of rods and indexed elements have equal columns, so that one table shows them."""
    layout, coupled = (derivative_checks.table(name, "float64", device) for name in ("planar_stretch", "shell_tilt"))
    assert layout[0].keys() == coupled[0].keys()
    count = len(derivative_checks.CHECKS) - 2  # without the checks of collisions
    assert [row["layout"] for row in layout] == ["open"] * count + ["closed"] * count
    assert {row["layout"] for row in coupled} == {"coupled"}


def test_sample_of_collisions_is_general():
    """Samples have edges with and without active ends, and sliding friction."""
    sample = SAMPLES["float64", "barrier_edge_edge", "pair"]
    _, _, factor = sample._evaluated(wp.float64)
    ends = (factor.used.numpy() & 0b111100) != 0
    assert ends.any() and not ends.all() and (sample.compared() == ~ends).all()
    sample = SAMPLES["float64", "friction_logistic_edge_edge", "pair"]
    sticking = sample.like({**sample.data, "start": sample.data["q"] - 1e-6})
    force, most = (np.linalg.norm(each.gradient().reshape(-1, 3, 8)[:2].sum(0), axis=0) for each in (sample, sticking))
    assert (most < 1e-4 * force).all()


def test_measures_are_those_of_chains_or_nets():
    """Every listed term has samples: open and closed rods, collisions as pairs, other terms by index."""
    for name in ALL:
        layouts = {layout for precision, term, layout in SAMPLES if term == name and precision == "float64"}
        assert layouts == ({"open", "closed"} if name in REGISTRY else {"pair" if name in POTENTIALS else "coupled"})
