"""Every shell term: derivatives against automatic differentiation and differences, invariance, and degenerate triangles."""

import numpy as np
import pytest
from first_terms import first_of_their_kind
from shell_cases import Elements, differences, error

from ddg_warp.kernels.terms import SHELLS

PRECISIONS = {"float64": 1e-13, "float32": 2e-5}
COUNT = 8
# Each has kernels of its own in each precision: every day every measure that the derivative tables of every day leave out.
FIRST = first_of_their_kind(SHELLS) - {"shell_stretch_damped", "shell_hinge", "shell_hinge_damped", "shell_tilt"}
EVERY_TERM = pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, precision, marks=() if name in daily else pytest.mark.slow)
        for precision, daily in (("float64", FIRST), ("float32", ()))
        for name in SHELLS
    ],
)
EVERY_TERM_IN_FLOAT64 = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FIRST else pytest.mark.slow) for name in SHELLS]
)
FLAP = np.array(
    [[0.0, 0.0, 0.0], [1.0, 0.1, 0.2], [0.3, 0.9, -0.1], [1.2, 1.1, 0.4], [-0.7, 0.6, 0.3], [0.5, -0.8, 0.2]]
)
FLAT = ("shell_stretch", "shell_stretch_damped", "shell_isometric", "shell_isometric_damped")  # without angles
KINDS = np.array([[1, 1, 1], [0, 1, 2], [1, 2, 3], [2, 3, 0], [3, 0, 1], [3, 3, 3], [2, 2, 2], [0, 0, 0]])


def sample(name: str) -> Elements:
    """Random elements at which no dof, strain or parameter is zero; exact in float32."""
    term, random = SHELLS[name], np.random.default_rng(11)
    measure, n = term.measure, len(term.measure.strains)
    nodes = FLAP[[0, 1, 2, 5]] if len(measure.edges) == 3 else FLAP
    x = nodes + 0.15 * random.normal(size=(COUNT, *nodes.shape))
    q = np.concatenate([x[:, j] - x[:, i] for i, j in measure.edges], axis=1)
    q = np.concatenate([q, 0.4 * random.normal(size=(COUNT, measure.angles))], axis=1)
    s = random.normal(size=(COUNT, max(1, measure.data_size)))
    if measure.name.startswith("midedge"):
        vectors = unit(random.normal(size=(COUNT, 3, 3)) + [0.0, 0.0, 3.0])
        signs = np.where(random.normal(size=(COUNT, measure.angles)) > 0.0, 1.0, -1.0)
        s = np.concatenate([KINDS, vectors.reshape(COUNT, 9), signs], axis=1)
    if measure.name == "edge_tilt":
        s[:, 0], s[:, 1:] = 2 + np.arange(COUNT) % 2, unit(s[:, 1:] + [0.0, 0.0, 3.0])
    p = random.uniform(0.6, 1.4, size=(COUNT, term.density.parameter_size(n)))
    known = term.density.parameters(n)
    for i, parameter in enumerate(known):
        p[:, i] *= 0.4 if parameter.family == "rest" else {"poisson": 0.3, "metric_12": 0.3}.get(parameter.name, 1.0)
    p[:, len(known) : len(known) + n] *= 0.3  # strains of the last step
    w = random.uniform(0.6, 1.4, size=COUNT)
    return Elements(name, *(values.astype(np.float32).astype(float) for values in (q, s, w, p)))


def folded(name: str) -> Elements:
    """The sample with edges folded by 90 to 170 degrees, to either side, and clamped normals as far from the triangles'."""
    elements, random = sample(name), np.random.default_rng(3)
    measure, q, s = SHELLS[name].measure, elements.q.copy(), elements.s.copy()
    # an edge and its corner, all from node 0: that of hinges and tilts, or the three of a triangle
    edges = [(0, 1, 2)] if len(measure.edges) < 5 else [(1, 2, 0), (2, 0, 1), (0, 1, 2)]
    x = np.concatenate([np.zeros((COUNT, 3)), q[:, :6]], 1).reshape(COUNT, 3, 3)
    for k, (first, second, corner) in enumerate(edges):
        e, a = x[:, second] - x[:, first], x[:, corner] - x[:, first]
        t = unit(e)
        d = a - t * np.sum(a * t, -1, keepdims=True)
        angle = np.radians(random.uniform(90.0, 170.0, COUNT) * random.choice([-1.0, 1.0], COUNT))[:, None]
        if measure.name != "edge_tilt":
            place = 6 + 3 * k
            q[:, place : place + 3] = random.uniform(0.2, 0.8, (COUNT, 1)) * e - turned(d, t, angle) * 1.2
        if measure.name != "hinge_angle":
            kinds = s[:, :1] if measure.name == "edge_tilt" else s[:, k : k + 1]
            place = 1 if measure.name == "edge_tilt" else 3 + 3 * k
            plane, clamp = turned(unit(d), t, 0.5 * angle), unit(turned(unit(np.cross(e, a)), t, angle) + 0.1 * t)
            s[:, place : place + 3] = np.where(kinds > 2.5, plane, clamp)
    return elements.changed(q=q, s=s)


def turned(vectors, axes, angles):
    """Vectors square to axes, turned about them."""
    return vectors * np.cos(angles) + np.cross(axes, vectors) * np.sin(angles)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def vectors_of(name, s):
    """Places of the vectors of space in the data."""
    start = {"midedge_curvature": 3, "midedge_curvature_dof": 3, "midedge_metric": 3, "edge_tilt": 1}.get(
        SHELLS[name].measure.name
    )
    return [] if start is None else [slice(i, i + 3) for i in range(start, start + (9 if start == 3 else 3), 3)]


@EVERY_TERM
def test_gradient(device, name, precision):
    """w J^T psi' = reverse mode of the energy = central differences, and the energy is the same in both precisions."""
    elements = sample(name)
    exact, at = elements.evaluate(device=device), elements.evaluate(precision, device)
    reverse = elements.reverse(device=device)
    assert error(at["gradient"], reverse) < PRECISIONS[precision]
    assert error(elements.reverse(precision, device), reverse) < PRECISIONS[precision]
    assert error(at["energy"], exact["energy"]) < PRECISIONS[precision]
    assert error(exact["gradient"], differences(elements, "energy", device)[:, 0]) < 1e-9


@EVERY_TERM_IN_FLOAT64
def test_jacobian(device, name):
    """Rows of J = central differences of the strains, strain by strain; no derivative is zero that should not be."""
    elements = sample(name)
    at = elements.evaluate(device=device)
    reference = differences(elements, "strain", device)
    for strain in range(at["strain"].shape[1]):
        assert error(at["jacobian"][:, strain], reference[:, strain]) < 1e-9
    felt = np.ones(elements.q.shape, bool)
    if SHELLS[name].measure.name.startswith("midedge"):
        felt[:, 6:15] = np.repeat(KINDS == 1, 3, axis=1)  # only neighbours have a corner behind the edge
        felt[:, 15:] = (KINDS <= 1)[:, : felt.shape[1] - 15]
        felt[7] &= felt.shape[1] == 18  # all edges free: no curvature without angles
    size = np.abs(at["gradient"])
    assert np.array_equal(size > 1e-6 * size.max(), felt)


@EVERY_TERM
def test_hessian(device, name, precision):
    """Reverse mode of the gradient = central differences of it, and symmetric."""
    elements = sample(name)
    hessian = elements.hessian(precision, device)
    tolerance = 1e-8 if precision == "float64" else 1e-4
    assert error(hessian, differences(elements, "gradient", device)) < tolerance
    assert error(hessian, hessian.swapaxes(1, 2)) < 10.0 * PRECISIONS[precision]


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in FIRST else pytest.mark.slow) for n in SHELLS if n not in FLAT],
)
def test_derivatives_of_folds(device, name):
    """At 90 to 170 degrees: reverse mode, differences and the hand-derived Jacobian agree as at small angles."""
    elements = folded(name)
    at = elements.evaluate(device=device)
    if SHELLS[name].measure.name in ("hinge_angle", "edge_tilt"):
        halved = SHELLS[name].measure.name == "edge_tilt" and elements.s[:, :1] > 2.5
        size = np.degrees(np.abs(at["strain"])) * np.where(halved, 2.0, 1.0)
        assert size.min() > 89.0 and size.max() < 171.0
    assert error(at["gradient"], elements.reverse(device=device)) < PRECISIONS["float64"]
    assert error(at["gradient"], differences(elements, "energy", device)[:, 0]) < 1e-9
    reference = differences(elements, "strain", device)
    for strain in range(at["strain"].shape[1]):
        assert error(at["jacobian"][:, strain], reference[:, strain]) < 1e-9
    hessian = elements.hessian(device=device)
    assert error(hessian, differences(elements, "gradient", device)) < 1e-8
    assert error(hessian, hessian.swapaxes(1, 2)) < 10.0 * PRECISIONS["float64"]


@pytest.mark.parametrize("kind", [1, 2])
def test_curvature_grows_with_the_fold(device, kind):
    """c = -2 h phi of an edge of height 0.5, phi half the dihedral angle or the angle to the clamp's normal, to 175 degrees."""
    angles = np.radians([-175.0, -135.0, -91.0, -1.0, 30.0, 89.0, 91.0, 135.0, 175.0])
    zero = np.zeros_like(angles)
    e, a = np.array([1.0, 0.0, 0.0]), np.array([0.4, 0.5, 0.0])
    across = np.stack([0.3 + zero, -0.7 * np.cos(angles), -0.7 * np.sin(angles)], -1)
    normal = np.stack([zero, -np.sin(angles), np.cos(angles)], -1)
    # edge 2, from node 0 to node 1, is folded; the others are free, their angles zero
    q = np.concatenate([np.tile(np.concatenate([e, a, e, a]), (9, 1)), across, np.zeros((9, 3))], 1)
    s = np.concatenate([np.tile([0.0, 0.0, kind], (9, 1)), np.zeros((9, 6)), normal, np.ones((9, 3))], 1)
    p = np.tile(sample("shell_bend_dof").p[:1], (9, 1))
    strain = Elements("shell_bend_dof", q, s, np.ones(9), p).evaluate(device=device)["strain"]
    expected = -2.0 * 0.5 * angles * (0.5 if kind == 1 else 1.0)
    np.testing.assert_allclose(strain, np.outer(expected, [0.0, 0.0, 1.0]), atol=1e-14)


@EVERY_TERM
def test_root(device, name, precision):
    """R^T R = psi'': with J of full row rank, d(slope)/dq = R^T R J."""
    elements = sample(name)
    at = elements.evaluate(precision, device)
    curvature = np.einsum("kli,klj->kij", at["root"], at["root"])
    exact = elements.evaluate(device=device)
    expected = differences(elements, "stress", device)
    assert error(curvature @ exact["jacobian"], expected) < max(1e-8, PRECISIONS[precision])


@pytest.mark.parametrize("name", ["shell_stretch", "shell_stretch_damped"])
def test_tension_completes_the_hessian(device, name):
    """w J^T R^T R J + C with the blocks c_ij I is the exact Hessian of the membrane."""
    elements = sample(name)
    at = elements.evaluate(device=device)
    factor = at["root"] @ at["jacobian"] * np.sqrt(elements.w)[:, None, None]
    c11, c12, c22 = at["tension"].T
    blocks = np.stack([np.stack([c11, c12], -1), np.stack([c12, c22], -1)], -1)
    whole = factor.swapaxes(1, 2) @ factor + np.einsum("kij,ab->kiajb", blocks, np.eye(3)).reshape(-1, 6, 6)
    assert error(whole, elements.hessian(device=device)) < 1e-13


@pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, precision, marks=() if precision == "float64" or name == "shell_hinge" else pytest.mark.slow)
        for precision in PRECISIONS
        for name in SHELLS
        if "damped" not in name
    ],
)
def test_rigid_motion(device, name, precision):
    """A rotation of the element, its supports with it, keeps the energy and turns the forces."""
    elements = sample(name)
    if SHELLS[name].measure.name == "isometric_bending":  # its strain is a vector: isotropic, without rest value
        elements.p[:, :3], elements.p[:, 3:] = elements.p[:, :1], 0.0
    a, b = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    turn = a * np.sign(np.diag(b)) * np.linalg.det(a * np.sign(np.diag(b)))
    edges = 3 * len(SHELLS[name].measure.edges)

    def moved(values):
        return np.concatenate(
            [(values[:, :edges].reshape(COUNT, -1, 3) @ turn.T).reshape(COUNT, -1), values[:, edges:]], 1
        )

    s = elements.s.copy()
    for place in vectors_of(name, s):
        s[:, place] = s[:, place] @ turn.T
    before, after = (e.evaluate(precision, device) for e in (elements, elements.changed(q=moved(elements.q), s=s)))
    assert error(after["energy"], before["energy"]) < PRECISIONS[precision]
    assert error(after["gradient"], moved(before["gradient"])) < 2.0 * PRECISIONS[precision]


@EVERY_TERM
def test_degenerate(device, name, precision):
    """Triangles without area, folded onto each other or inverted give finite values; edges keep their length."""
    elements = sample(name)
    q = elements.q.copy()
    q[0:2, 3:6] = 0.5 * q[0:2, 0:3]  # corner 2 on the edge
    q[2:4, 3:6] *= -1.0  # inverted
    if q.shape[1] == 9:
        q[4:6, 6:9] = q[4:6, 3:6]  # folded: the corner behind is the corner
    if q.shape[1] >= 15:
        q[4:6, 12:15] = q[4:6, 3:6]
        q[6:8, 12:15] = 0.5 * q[6:8, 0:3]  # a neighbour without area
    at = elements.changed(q=q).evaluate(precision, device)
    for what in ("energy", "gradient", "strain", "jacobian"):
        assert np.isfinite(at[what]).all(), what


@pytest.mark.parametrize(("kind", "vector"), [(2, (0.0, 0.0, 1.0)), (3, (0.0, 1.0, 0.0))])
def test_tilt_is_half_the_mirrored_hinge(device, kind, vector):
    """A triangle that rises by the angle b from its edge along x: alpha = -b at a clamp to z, -b at the plane y = 0."""
    b = 0.3
    e, a = [1.0, 0.0, 0.0], [0.4, np.cos(b), np.sin(b)]
    tilt = Elements("shell_tilt", np.array([e + a]), np.array([[kind, *vector]]), np.ones(1), np.array([[1.0, 0.0]]))
    mirrored = [a[0], -a[1], a[2]]
    hinge = Elements("shell_hinge", np.array([e + a + mirrored]), np.zeros((1, 1)), np.ones(1), np.array([[1.0, 0.0]]))
    assert abs(tilt.evaluate(device=device)["strain"][0, 0] + b) < 1e-15
    assert abs(hinge.evaluate(device=device)["strain"][0, 0] + 2.0 * b) < 1e-15
