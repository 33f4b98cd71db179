"""Derivative table: every derivative of every term, compared with an independent computation.

The state is random, without zeros (see `ddg_warp.run.derivative_samples`). References are central differences in float64, or automatic
differentiation of another kernel. Errors are relative to the largest reference. e are the strains, w the rest measure
and q the local dofs of an element. Collisions (`ddg_warp.run.derivative_samples_contact`) check the kernels of steps and adjoints:

    gradient     w J^T psi' scattered to dofs = reverse mode of the energy kernel
    energy       of collisions instead: gradient kernel of steps = differences of the energy
    reverse      reverse mode of the gradient kernel, seeded with v, = differences of v . gradient in the dofs
    parameters   likewise in every row of the parameter buffer, element by element
    lagged       likewise in the lagged frames, the strains of the last step and 1/h, row by row along a random direction
    hessian      Hessian kernel = differences of the gradient by the local dofs
    symmetry     Hessian kernel = its transpose
    evaluate     energy and gradient of the fused kernel = sum over the terms' own kernels
    factor       F^T F + C of the fused kernel = w J^T psi'' J with the positive part of psi'', and the geometric stiffness under
                 tension, derivatives by differences
    definite     F^T F + C has no negative eigenvalue
    exact        F^T F + C, compression included, and second derivatives of measures of rods = Hessian kernels; of collisions
                 F^T F and `geometric_stiffness` where no edges are mollified
    rest         no force at the rest strains; for laws of rods without rest strains, in straight rods
    invariance   a rigid motion keeps the energy, with rotated lagged data or with compensating angles
    rigid        the gradient of a rod is orthogonal to translations and infinitesimal rotations
    resultant    forces of a collision have no resultant, and contact forces no moment
    nonzero      every dof in the energy has a force, so that no zero counts as agreement
    downcast     energy and gradient resolve a relative change of 2^-30 in every input, which float32 cannot represent
"""

import numpy as np

from ddg_warp.kernels.terms import ALL, REGISTRY, Potential, Term
from ddg_warp.run.derivative_samples import Sample, rotation
from ddg_warp.run.derivative_samples_contact import ContactSample, FrictionSample
from ddg_warp.run.derivative_samples_coupled import Elements
from ddg_warp.run.derivative_samples_rod import RodSample, rods_of

TRAP = 2.0**-30


def relative(value, reference) -> float:
    """Return the largest difference over the largest reference; zero if both are zero."""
    error = np.abs(value - reference).max()
    return 0.0 if error == 0.0 else float(error / max(np.abs(reference).max(), 1e-100))


def largest(errors) -> float:
    """Return the largest error; NaN if one is NaN."""
    return float(np.max(list(errors)))


def gradient(sample: Sample) -> float:
    adjoint = sample.reverse(0, np.ones(sample.shape))
    return relative(sample.scatter(sample.gradient(sample.real)), adjoint["q"])


def energy(sample: Sample) -> float:
    slopes = sample.local_derivative(lambda **data: sample.energy(**data)[None])[0]
    return relative(sample.gradient(sample.real), slopes)


def reverse(sample: Sample) -> float:
    product = np.einsum("i...,ij...->j...", sample.seed, sample.gradient_derivative)
    return relative(sample.adjoint["q"], sample.scatter(product))


def parameters(sample: Sample) -> float:
    slopes = sample.adjoint["buffer"]
    rows = [(row, sample.difference(sample.seeded, "buffer", (row,))) for row in sample.parameter_rows()]
    return largest(relative(slopes[row], reference) for row, reference in rows)


def lagged(sample: Sample) -> float:
    errors, random = [], np.random.default_rng(9)
    for name in sample.adjoint.keys() - {"q", "buffer"}:
        pairs = []
        for row, slope in enumerate(np.atleast_2d(sample.adjoint[name])):
            along = np.where(slope < 0.0, -1.0, 1.0) * random.uniform(0.5, 1.5, size=slope.shape)  # nothing cancels
            where = (row,) if sample.data[name].ndim > 1 else ...
            pairs.append(((slope * along).sum(), sample.difference(sample.seeded, name, where, along).sum()))
        errors.append(relative(*np.array(pairs).T))
    return largest(errors)


def hessian(sample: Sample) -> float:
    return relative(sample.hessian(sample.real), sample.gradient_derivative)


def symmetry(sample: Sample) -> float:
    value = sample.hessian(sample.real)
    return relative(value, value.swapaxes(0, 1))


def evaluate(sample: Sample) -> float:
    _, force, energy = sample.evaluate()
    forces, energies = (sum(values) for values in zip(*((p.gradient(), p.energy()) for p in sample.parts), strict=True))
    return largest((relative(force, forces), relative(energy, energies)))


def factor(sample: Sample) -> float:
    return relative(sample.evaluate()[0], sum(part.gauss_newton() for part in sample.parts))


def definite(sample: Sample) -> float:
    values = np.linalg.eigvalsh(np.moveaxis(sample.evaluate()[0], (0, 1), (-2, -1)))
    return float(max(0.0, -values.min()) / values.max())


def exact(sample: Sample) -> float:
    where = sample.compared()
    return relative(
        sample.evaluate(exact=True)[0][..., where], sum(part.hessian() for part in sample.parts)[..., where]
    )


def rest(sample: Sample) -> float:
    force = sample.gradient(sample.real, **sample.at_rest())
    return float(np.abs(force).max() / np.abs(sample.gradient()).max())


def invariance(sample: Sample) -> float:
    sample = sample.isotropic()
    before = sample.energy(sample.real)
    moved = sample.moved(rotation(sample.dim, 0.4))
    return largest(relative(sample.energy(sample.real, **data), before) for data in moved)


def rigid(sample: RodSample) -> float:
    sample = sample.isotropic()
    force = sample.scatter(sample.gradient(sample.real))
    adjoint = sample.reverse(0, np.ones(sample.shape))
    errors = [np.abs(force[..., : sample.measure.dim].sum((0, 1))).max() / np.abs(force).max()]
    for velocity, last in sample.rotations():
        work, more = force * velocity, adjoint["last"] * last
        errors.append(abs(work.sum() + more.sum()) / (np.abs(work).sum() + np.abs(more).sum()))
    return largest(errors)


def resultant(sample: ContactSample) -> float:
    return sample.resultants()


def nonzero(sample: Sample) -> float:
    """Return the fraction of dofs without a force."""
    size = np.abs(sample.scatter(sample.gradient(sample.real)))
    return float(1.0 - (size > 1e-6 * size.max())[sample.felt].mean())


def downcast(sample: Sample) -> float:
    errors = []
    for order in sample.ORDERS:
        value, seed = (sample.energy, np.ones(sample.shape)) if order == 0 else (sample.gradient, sample.seed)
        adjoint, before = sample.reverse(order, seed), value()
        for name, slopes in adjoint.items():
            for row in range(len(slopes)) if name in ("buffer", "last") else [...]:
                slope = slopes[row] * sample.data[name][row]
                size = np.abs(slope).sum()
                if size == 0.0:
                    continue  # no input of this term
                scaled = sample.data[name].copy()
                scaled[row] *= 1.0 + TRAP
                change = (seed * (value(**{name: scaled}) - before)).sum()
                errors.append(abs(change - TRAP * slope.sum()) / (TRAP * size))
    return largest(errors)


# name -> (error, tolerance in float64, tolerance in float32 or None without a check)
CHECKS = {
    "gradient": (gradient, 1e-13, 1e-5),
    "energy": (energy, 1e-8, 1e-5),
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
    "resultant": (resultant, 1e-13, 1e-5),
    "nonzero": (nonzero, 0.0, 0.0),
    "downcast": (downcast, 1e-3, None),
}


def samples_of(
    term: Term | Potential, precision: str = "float64", device: str = "cpu", closures: tuple[bool, ...] = (False, True)
) -> list[Sample]:
    """Return the samples of a term: open and closed rods (`closures`), indexed elements, or collisions of a potential.

    Raises:
        ValueError: a planar measure other than the rods'.
    """
    if isinstance(term, Potential):
        return [(FrictionSample if term.frictional else ContactSample)(term, None, precision, device)]
    if term.measure in {rod_term.measure for rod_term in REGISTRY.values()}:
        return [RodSample(term, rods_of(term, closed), precision, device) for closed in closures]
    if term.measure.dim != 3:
        raise ValueError(f"{term.name}: of the plane are measures of rods alone; give {term.measure.name} dim = 3")
    return [Elements(term, None, precision, device)]


def checks_of(sample: Sample) -> list[str]:
    """Return the checks of a sample; closed rods without rest strains and dipoles have no rest shape."""
    left_out = set(sample.LEFT_OUT)
    if isinstance(sample, Elements) and not sample.measure.packed:
        left_out.add("exact")
    if isinstance(sample, RodSample | Elements) and not sample.term.rest and sample.layout != "open":
        left_out.add("rest")
    single = sample.precision == "float32"
    return [name for name, check in CHECKS.items() if name not in left_out and not (single and check[2] is None)]


def table(
    term: str | Term | Potential | None = None,
    precision: str = "float64",
    device: str = "cpu",
    closures: tuple[bool, ...] = (False, True),
) -> list[dict]:
    """Return the rows of the derivative table: term, layout, check, error, tolerance, passed.

    Args:
        term: a term or potential, user-defined or by its key in `kernels.terms.ALL`; by default all.
        precision: precision of the kernels under test, "float64" or "float32".
        device: Warp device.
        closures: for terms of rods, open (False) or closed rods (True), or both.
    """
    terms = ALL.values() if term is None else [ALL[term] if isinstance(term, str) else term]
    samples = (sample for one in terms for sample in samples_of(one, precision, device, closures))
    return [row(sample, check) for sample in samples for check in checks_of(sample)]


def row(sample: Sample, check: str) -> dict:
    """Return one row of the table."""
    error, *tolerances = CHECKS[check]
    value, tolerance = error(sample), tolerances[sample.precision == "float32"]
    return {
        "term": sample.term.key,
        "layout": sample.layout,
        "check": check,
        "error": value,
        "tolerance": tolerance,
        "passed": bool(value <= tolerance),
    }
