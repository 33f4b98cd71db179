"""The derivative table: every derivative of every term against something else that computes it.

The state is random and nothing in it is zero (see `Sample`). References are central differences, always taken in
float64, or automatic differentiation of another kernel; errors are relative to the largest reference. e are the
strains, w the rest measure and q the window of an element:

    gradient     w J^T psi' scattered to dofs = reverse mode of the energy kernel
    reverse      reverse mode of the gradient kernel, seeded with v, = differences of v . gradient in x and theta
    parameters   the same in every row of the parameter buffer, element by element
    lagged       the same in the lagged frames, the strains of the last step and 1/h
    hessian      Hessian kernel = differences of the gradient on the window
    symmetry     Hessian kernel = its transpose
    evaluate     energy and gradient of the fused kernel = sum over the terms' own kernels
    factor       F^T F + c of the chain = w J^T (d stress / dq) + max(N, 0)/|e| (I - t t^T), derivatives by differences
    definite     F^T F + c has no negative eigenvalue
    exact        F^T F + c, compression included, and the geometric stiffness = Hessian kernels of all terms
    rest         no force in the rest shape
    invariance   a rigid motion keeps the energy when the lagged data turn too, or when angles make up for the frames
    rigid        the gradient is orthogonal to translations and infinitesimal rotations
    nonzero      every dof feels a force, so that no zero passes for agreement
    downcast     energy and gradient feel a relative change of 2^-30 in every input, which no float32 can hold
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.compile.precision import PRECISIONS
from ddg_warp.kernels import element
from ddg_warp.kernels.element import ChainKind
from ddg_warp.kernels.terms import ALL, REGISTRY, Term
from ddg_warp.run.samples import Sample, is_vector, rotation
from ddg_warp.scene.descriptions import Law
from ddg_warp.scene.material import Stiffness
from ddg_warp.scene.scene import Scene

TRAP = 2.0**-30


def chain_of(term: Term, closed: bool) -> ChainKind:
    """The chain that a rod with this term is: bending first, then stretch, both damped or neither."""
    known = ("planar_bend", "planar_stretch") if term.measure.dim == 2 else ("rod_bend_twist", "rod_stretch")
    bending, stretch = (REGISTRY[name].damped(term.density.lagged) for name in known)
    terms = (term, stretch) if term.measure.span == 2 else (bending, term)
    return ChainKind(term.measure.dim, terms[0].measure.angles > 0, closed, terms)


def _rest_scene(term: Term, kind: ChainKind) -> Scene:
    """A rod of that kind, at rest in a random shape; straight where the measure, or the law, knows no other."""
    random = np.random.default_rng(5)
    angle = np.linspace(0.0, 2.0 * np.pi, 7)[:-1, None]
    points = np.concatenate([np.cos(angle), np.sin(angle), np.sin(angle)], -1) + 0.1 * random.normal(size=(6, 3))
    if any(map(is_vector, kind.terms)) or not term.rest:
        points = np.cumsum(random.uniform(0.5, 1.5, size=(6, 1)), axis=0) * random.normal(size=3)
    if kind.dim == 2:
        points[:, 1] = 0.0
    bending = 0.7 if kind.twist else 0.9
    viscosity = 0.4 if term.density.lagged else 0.0
    section = Stiffness(EA=2.0, EI1=0.9, EI2=bending, GJ=0.8, mass_per_length=1.0, viscosity=viscosity)
    scene = Scene(dimension=kind.dim)
    brought = {"stiffness", *(known.family for known in term.parameters if known.rest or known.default is not None)}
    own = term.density.undamped or term.density
    values = {known.family: 0.5 for known in term.parameters if known.family not in brought}
    laws = {term.name: Law(own, **values)}
    natural = "shape" if term.rest else "straight"
    curvature = "angle" if any(one.measure.by_angle for one in kind.terms) else "tangent"
    options = {"natural": natural, "twist": kind.twist, "curvature": curvature, "laws": laws}
    scene.add_rod(points, section=section, closed=kind.closed, **options)
    return scene


@dataclass
class Case:
    """A term in a chain, at a sample state, in one precision."""

    term: Term
    kind: ChainKind
    precision: str
    device: str

    @property
    def real(self):
        """The scalar type under test."""
        return PRECISIONS[self.precision].real

    @property
    def index(self) -> int:
        """Place of the term in its chain."""
        return self.kind.terms.index(self.term)

    @cached_property
    def sample(self) -> Sample:
        """The random state."""
        return Sample(self.kind, self.device, exact_in_float32=self.real == wp.float32)

    @cached_property
    def seed(self) -> np.ndarray:
        """Weights v of the window gradient (window, n, R)."""
        return np.random.default_rng(7).normal(size=(self.kind.window, *self.sample.shape))

    @cached_property
    def gradient(self) -> np.ndarray:
        """Window gradient (window, n, R) in the precision under test."""
        return self.sample.gradient(self.index, self.real)

    @cached_property
    def reverse(self) -> dict[str, np.ndarray]:
        """Reverse mode of v . gradient."""
        return self.sample.reverse(self.index, 1, self.seed, self.real)

    @cached_property
    def gradient_derivative(self) -> np.ndarray:
        """Differences of the window gradient (window, window, n, R)."""
        return self.sample.window_derivative(lambda **data: self.sample.gradient(self.index, **data))

    def difference(self, name: str, where) -> np.ndarray:
        """Differences of v . gradient of every element (n, R) along data[name][where]."""
        return self.sample.difference(
            lambda **data: (self.seed * self.sample.gradient(self.index, **data)).sum(0), name, where
        )


def relative(value, reference) -> float:
    """Largest difference over the largest reference."""
    return float(np.abs(value - reference).max() / np.abs(reference).max())


def gradient(case: Case) -> float:
    sample = case.sample
    adjoint = sample.reverse(case.index, 0, np.ones(sample.shape), case.real)
    scattered = sample.scatter(case.gradient)
    return relative(scattered, np.concatenate([adjoint["x"], adjoint["theta"][..., None]], -1)[..., : case.kind.block])


def reverse(case: Case) -> float:
    product = np.einsum("inr,ijnr->jnr", case.seed, case.gradient_derivative)
    adjoint = np.concatenate([case.reverse["x"], case.reverse["theta"][..., None]], -1)[..., : case.kind.block]
    return relative(adjoint, case.sample.scatter(product))


def parameters(case: Case) -> float:
    first = case.kind.places()[case.index][0]
    return max(
        relative(case.reverse["buffer"][row], case.difference("buffer", (row,)))
        for row in range(first, first + len(case.term.parameter_names))
    )


def lagged(case: Case) -> float:
    errors = [0.0]
    if case.term.measure.lag_size:
        expected = np.zeros((7, *case.sample.shape))
        for c, k in np.ndindex(7, case.sample.shape[0]):
            expected[c, k] = case.difference("frame", (c, k)).sum(0)
        errors.append(relative(case.reverse["frame"], expected))
    if case.term.density.lagged:
        first = case.kind.places()[case.index][3]
        for row in range(first, first + len(case.term.measure.strains)):
            errors.append(relative(case.reverse["last"][row], case.difference("last", (row,))))
        errors.append(relative(case.reverse["rate"], case.difference("rate", ...).sum(0)))
    return max(errors)


def hessian(case: Case) -> float:
    return relative(case.sample.hessian(case.index, case.real), case.gradient_derivative)


def symmetry(case: Case) -> float:
    value = case.sample.hessian(case.index, case.real)
    return relative(value, value.swapaxes(0, 1))


def evaluate(case: Case) -> float:
    sample, terms = case.sample, range(len(case.kind.terms))
    _, force, energy, _ = sample.evaluate(case.real)
    return max(
        relative(force, sum(sample.gradient(i) for i in terms)), relative(energy, sum(sample.energy(i) for i in terms))
    )


def factor(case: Case) -> float:
    sample, kind = case.sample, case.kind
    strain_rate, stress_rate = (
        sample.window_derivative(lambda i=i, **data: sample.strains(**data)[i]) for i in range(2)
    )
    stress = sample.strains()[1]
    expected = np.zeros((kind.window, kind.window, *sample.shape))
    for term, (first, *_, row) in zip(kind.terms, kind.places(), strict=True):
        rows = slice(row, row + len(term.measure.strains))
        w = sample.data["buffer"][first]
        stiff = raised(strain_rate[rows], stress_rate[rows]) if term.density.coupled else stress_rate[rows]
        expected += w * np.einsum("minr,mjnr->ijnr", strain_rate[rows], stiff)
        if term.measure.tensions:
            edge = np.moveaxis(sample.edges(), -1, 0)
            length = np.linalg.norm(edge, axis=0)
            across = np.eye(kind.dim)[..., None, None] - edge * edge[:, None] / length**2
            expected[: kind.dim, : kind.dim] += np.maximum(stress[row], 0.0) / length * across
    return relative(_gauss_newton(case), expected)


def raised(strain_rate: np.ndarray, stress_rate: np.ndarray) -> np.ndarray:
    """psi'' de/dq (m, window, n, R) without what is negative of psi'', which is in the exact matrix alone."""
    J, S = (np.moveaxis(rate, (0, 1), (-2, -1)) for rate in (strain_rate, stress_rate))
    values, vectors = np.linalg.eigh(S @ np.linalg.pinv(J))
    raised = (vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.moveaxis(raised @ J, (-2, -1), (0, 1))


def definite(case: Case) -> float:
    values = np.linalg.eigvalsh(np.moveaxis(_gauss_newton(case), (0, 1), (-2, -1)))
    return float(max(0.0, -values.min()) / values.max())


def exact(case: Case) -> float:
    expected = sum(case.sample.hessian(i, wp.float64) for i in range(len(case.kind.terms)))
    return relative(_gauss_newton(case, exact=True), expected)


def rest(case: Case) -> float:
    model = _rest_scene(case.term, case.kind).build(device=case.device, precision=case.precision)
    group, data = model.groups[0], model.state().groups[0]
    out = arrays.allocate((group.kind.window, group.nodes, group.columns), case.real, case.device)
    still = wp.full(group.columns, 1.0, dtype=case.real, device=case.device)
    wp.launch(
        element.term_kernels(group.kind, group.kind.terms.index(case.term), case.real, reverse=True)[1],
        (group.elements, group.columns),
        [data.x, data.theta, data.frame, data.last, still, *group.parameters.arrays, group.count],
        [out],
        device=case.device,
    )
    return float(np.abs(arrays.download(out)).max())  # moduli and lengths of the scene are of order one


def invariance(case: Case) -> float:
    sample = case.sample.isotropic()
    turn = rotation(case.kind.dim, 0.4)
    moved = sample.turned(turn)
    before = sample.energy(case.index, case.real).sum()
    errors = [relative(sample.energy(case.index, case.real, **moved).sum(), before)]
    if case.kind.twist:
        # lagged frames stay, angles make up for what the transport turns them differently
        angles = sample.data["theta"] + sample.frame_lead(turn)
        kept = {"x": moved["x"], "theta": angles}
        errors.append(relative(sample.energy(case.index, case.real, **kept).sum(), before))
    return max(errors)


def rigid(case: Case) -> float:
    sample = case.sample.isotropic()
    force = sample.scatter(sample.gradient(case.index, case.real))
    adjoint = sample.reverse(case.index, 0, np.ones(sample.shape), case.real)
    worst = np.abs(force[..., : case.kind.dim].sum(0)).max() / np.abs(force).max()
    for velocity, last in sample.rotations():
        work = (force * velocity).sum() + (adjoint["last"] * last).sum()
        size = np.abs(force * velocity).sum() + np.abs(adjoint["last"] * last).sum()
        worst = max(worst, abs(work) / size)
    return float(worst)


def nonzero(case: Case) -> float:
    """Share of the dofs without a force."""
    size = np.abs(case.sample.scatter(case.gradient))
    used = np.arange(case.kind.block) < (case.kind.dim if not case.term.measure.angles else case.kind.block)
    felt = size[..., used] > 1e-6 * size.max()
    return float(1.0 - felt[case.sample.has_dof[..., : case.kind.block][..., used]].mean())


def downcast(case: Case) -> float:
    sample, worst = case.sample, 0.0
    for which, seed in enumerate((np.ones(sample.shape), case.seed)):
        value = (sample.energy, sample.gradient)[which]
        adjoint = sample.reverse(case.index, which, seed, case.real)
        before = value(case.index)
        for name, values in sample.data.items():
            slope = adjoint[name] * values
            for row in range(len(values)) if name in ("buffer", "last") else [...]:
                size = np.abs(slope[row]).sum()
                if size == 0.0:
                    continue  # not an input of this term
                scaled = values.copy()
                scaled[row] *= 1.0 + TRAP
                change = (seed * (value(case.index, **{name: scaled}) - before)).sum()
                worst = max(worst, abs(change - TRAP * slope[row].sum()) / (TRAP * size))
    return worst


# name -> (error, tolerance in float64, tolerance in float32 or None where that says nothing)
CHECKS = {
    "gradient": (gradient, 1e-13, 1e-5),
    "reverse": (reverse, 1e-8, 1e-5),
    "parameters": (parameters, 1e-8, 1e-5),
    "lagged": (lagged, 1e-8, 1e-5),
    "hessian": (hessian, 1e-8, 1e-5),
    "symmetry": (symmetry, 1e-12, 1e-5),
    "evaluate": (evaluate, 1e-13, 1e-5),
    "factor": (factor, 1e-8, 1e-5),
    "definite": (definite, 1e-14, 1e-6),
    "exact": (exact, 1e-14, 1e-5),
    "rest": (rest, 1e-13, 1e-5),
    "invariance": (invariance, 1e-13, 1e-5),
    "rigid": (rigid, 1e-13, 1e-5),
    "nonzero": (nonzero, 0.0, 0.0),
    "downcast": (downcast, 1e-3, None),
}


def checks_of(term: Term, closed: bool, precision: str) -> list[str]:
    """Checks that make sense: a rod that is straight at rest has no rest shape when closed."""
    straight = is_vector(term) or not term.rest
    return [
        name
        for name, (_, _, single) in CHECKS.items()
        if not (name == "rest" and straight and closed) and not (precision == "float32" and single is None)
    ]


def table(
    term: str | Term | None = None,
    precision: str = "float64",
    device: str = "cpu",
    chains: tuple[bool, ...] = (False, True),
) -> list[dict]:
    """Rows of the derivative table: term, chain, check, error, tolerance, passed.

    Args:
        term: a term of chains or nets, one's own or one of `kernels.terms.ALL` by key; all of these by default.
        precision: "float64" or "float32", that of the kernels under test.
        device: Warp device.
        chains: of terms of chains, which are tried: open ones (False), closed ones (True), or both.
    """
    from ddg_warp.run import net_derivatives

    rows = []
    for one in [ALL[term] if isinstance(term, str) else term] if term else ALL.values():
        if not on_chains(one):
            case = net_derivatives.NetCase(one, precision, device)
            rows += [
                _row(one.key, "net", name, error(case), precision) for name, error in net_derivatives.CHECKS.items()
            ]
            continue
        for closed in chains:
            case = Case(one, chain_of(one, closed), precision, device)
            for check in checks_of(one, closed, precision):
                rows.append(_row(one.key, "closed" if closed else "open", check, CHECKS[check][0](case), precision))
    return [row for row in rows if row["tolerance"] is not None]


def on_chains(term: Term) -> bool:
    """Whether a term runs along rods of their own."""
    return term.measure.name in {known.measure.name for known in REGISTRY.values()}


def _row(term: str, chain: str, check: str, error: float, precision: str) -> dict:
    tolerance = CHECKS[check][1 if precision == "float64" else 2]
    passed = tolerance is not None and bool(error <= tolerance)
    return {"term": term, "chain": chain, "check": check, "error": error, "tolerance": tolerance, "passed": passed}


def _gauss_newton(case: Case, exact: bool = False) -> np.ndarray:
    """F^T F + c, or the exact matrix, on the windows (window, window, n, R), from what the evaluate kernel writes."""
    kind = case.kind
    rows, _, _, geometric = case.sample.evaluate(case.real, exact)
    edge_row, tension_row = kind.vertex_strains * kind.window, kind.factor_rows - kind.tensions
    vertex = rows[:edge_row].reshape(kind.vertex_strains, kind.window, *case.sample.shape)
    edge = rows[edge_row:tension_row].reshape(kind.edge_strains, kind.dim, *case.sample.shape)
    result = np.einsum("minr,mjnr->ijnr", vertex, vertex)
    result[: kind.dim, : kind.dim] += np.einsum("minr,mjnr->ijnr", edge, edge)
    result[: kind.dim, : kind.dim] += np.eye(kind.dim)[..., None, None] * rows[tension_row:].sum(0)
    if exact:
        i, j = np.triu_indices(kind.window)
        result[i, j] += geometric
        result[j[i != j], i[i != j]] += geometric[i != j]
    return result
