"""Projected Newton on rod groups; every rod has its own loop, line search and outcome, all on the device."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ddg_warp import argument_checks, device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.linear import geometric_stiffness
from ddg_warp.kernels.newton import rod_iterate, rod_sweep
from ddg_warp.kernels.residual import rod_residual
from ddg_warp.kernels.stepping import rod_step, warm_start
from ddg_warp.solve.newton.rod_state import RodElements, RodIterates, RodLoading, RodResidualNorms
from ddg_warp.timers import timer

FIRST_EXACT_ITERATION = 2  # Gauss-Newton iterations of "progressive": far from a solution the exact matrix is no better
PSD_MODES = ("auto", "gauss_newton", "project", "progressive", "none")
FROZEN = ("auto", "gauss_newton")  # `psd` modes of a frozen Hessian
FROZEN_ONLY = "psd {!r}: the solver 'projective' freezes the matrix of 'gauss_newton'"
RESIDENT = 256  # threads of an evaluation that a multiprocessor runs at once
# Rods up to which a GPU eliminates from both ends, without and with second derivatives.
# Measured, 64 nodes on an H100, from one end and from both [ms a step]: 10,000 straight rods 1.17 and 1.06; 5,000 curved rods 1.23 and
# 1.04, 10,000 curved rods 1.73 and 1.84.
FEW = {False: 20_000, True: 5_000}
MANY = 50_000  # rods from which full blocks of the sweep pay on a GPU; below, small ones reach more multiprocessors


@argument_checks.called
@dataclass(frozen=True)
class NewtonOptions:
    """Options of a Newton solve: convergence test, line search and matrix.

    Attributes:
        rtol: a dof converges where its residual is below rtol times the load scale of its rod or shell, or below the rounding
            floor. The load scale is the sum of the body's outer forces; without any, the first residual. In shells it is scaled by
            the root of the dof's fraction of the area. Subset sums of residuals obey the same test. See
            `ddg_warp.compile.residual_tolerance`.
        floor_factor: rounding units of the forces on a node that count as rounding.
        max_iterations: Newton iterations of one solve.
        max_halvings: backtracks of one step by the line search.
        rotation_cap: largest rotation of an edge, a joint or a twist angle in one update [rad].
        linear_rtol: reduction of the residual by PCG, in the norm of the preconditioner.
        psd: the matrix. Mode "gauss_newton": no second derivatives of bending and twist. Only compression can make this matrix
            indefinite; it is dropped where a pivot is lost. Mode "progressive": the exact Hessian from the third iteration on, and
            Gauss-Newton without compression in iterations where it is indefinite. This suits curved, twisted or compressed rods and
            long steps, where Gauss-Newton takes many iterations. Too many projected iterations shorten a time step: outcome
            `indefinite`, see `kernels.core.islands.projected_limit_function`. Mode "project": the exact Hessian with every element
            projected to positive semi-definite by its eigenvalues, at twenty times the cost of an iteration. Mode "none": the exact
            Hessian. An indefinite one ends the solve with the outcome `indefinite`, and a time step is retried with a shorter one.
            Mode "auto": "progressive" for rods that are curved or twisted at rest, or stiff over a time step
            (`compile.precision.stiff`), else "gauss_newton". The coupled system takes all but "project". Its exact Hessian covers
            rods and rigid joints. Second derivatives of shells' bending, of rod-shell coupling and of magnets are omitted, which
            "none" refuses. A lost pivot or negative curvature in conjugate gradients makes it indefinite. With "gauss_newton" the
            coupled system then keeps the direction reached, and drops compression from the next matrix.
        unconverged_fraction: in contact, fraction of the bodies of a world (rods, shells, or joined ones) that may exceed the
            tolerance at the end of a step, each by at most ten times. The remaining residual acts on such a body like a force in
            that step. With many bodies in contact some slip off others at any time, and delay all others. Where contact cuts no
            motion, directions are solved until all but half as many bodies satisfy the linear system.
    """

    rtol: float = 1e-6
    floor_factor: float = 4.0
    max_iterations: int = 100
    max_halvings: int = 20
    rotation_cap: float = 1.0
    linear_rtol: float = 1e-8
    psd: str = "auto"
    unconverged_fraction: float = 0.0

    def __post_init__(self):
        argument_checks.part("unconverged_fraction", self.unconverged_fraction)
        argument_checks.check_options(
            self, ("rtol", "floor_factor", "rotation_cap", "linear_rtol"), ("max_iterations", "max_halvings")
        )
        if self.psd not in PSD_MODES:
            raise SceneError(f"psd {self.psd!r}: it is one of {', '.join(PSD_MODES)}")


class RodNewton:
    """Newton's method on one group of uncoupled open rods by the block LDL^T sweep, with the buffers of a solve.

    Args:
        model, group, options: the problem, and the options of its solve.
        linear: scalar type of the linear algebra; default: the model's.
        midpoint: True if predicted iterates are midpoints, to which the lagged frames are carried.
        mixed_axial: True if edges may be stiffer than the matrix carries, with tensions as unknowns; see
            `kernels.linear.mixed_axial_force`.

    Attributes:
        iterates, loading, elements, norms: state of a solve; see `ddg_warp.solve.newton.rod_state`.
        rhs, direction: right-hand side and solution of the linear system (rows, nodes, columns).
        islands: state of every rod's line search; see `kernels.core.islands`.
    """

    reuse = False  # True if the matrix of a step's first iterate serves the whole step

    def __init__(
        self, model, group, options: NewtonOptions, linear=None, midpoint: bool = False, mixed_axial: bool = False
    ):
        self.group, self.options = group, options
        self.real, self.linear = model.types.real, linear or model.types.linear
        self.eps = model.types.eps
        kind, device = group.kind, model.wp_device
        self.iterates = RodIterates.of(group, self.real)
        self.loading = RodLoading.of(group, self.iterates)
        self.run = _run(group)
        self.runs = -(-group.nodes // self.run)
        self.norms = RodResidualNorms.of(group, self.runs, self.real, self.linear)
        self.rhs, self.direction = (
            device_arrays.allocate((rows, group.nodes, group.columns), self.linear, device)
            for rows in (kind.block, kind.block + mixed_axial)
        )
        self.islands = Islands(group.columns, self.real, device)
        self.psd = self.automatic_psd() if options.psd == "auto" else options.psd
        self.exact = self.psd != "gauss_newton" and kind.span == 2  # a rod that only stretches has its Hessian anyway
        self.exact_from = (FIRST_EXACT_ITERATION if self.psd == "progressive" else 0) if self.exact else None
        self.sides = self._sides(mixed_axial)
        # One array serves both: a sweep reads the factor of a node before it writes the node's data.
        shared_rows = rod_sweep.kept_rows(kind) if self.sides == 1 and not mixed_axial else 0
        self.elements = RodElements.of(group, self.real, self.linear, self.exact, mixed_axial, shared_rows)
        self._project = None
        if self.psd == "project" and self.exact:
            self._project = geometric_stiffness.project_kernel(kind, self.real, self.linear)
        self.device = device
        self._evaluate = rod_residual.evaluate_kernel(
            kind, self.real, self.linear, self.exact, mixed_axial, self.definite, self.reuse
        )
        self._results = self.elements.results()
        self._predict = rod_step.predict_kernel(kind, self.real, self.linear, midpoint)
        self._further = None if midpoint else warm_start.further_kernel(kind, self.real, self.linear)
        self._prepare_sweep(mixed_axial)

    def _sides(self, mixed_axial: bool) -> int:
        """Return the number of ends of a rod where a sweep starts."""
        return 1 if mixed_axial else swept_ends(self.group, self.exact)

    def _prepare_sweep(self, mixed_axial: bool) -> None:
        """Allocate the data of eliminated nodes, and build the kernels of an iteration."""
        group, kind, sides = self.group, self.group.kind, self.sides
        size, options = (group.nodes, group.columns), (self.exact_from, self.psd == "none")
        self.elimination = self.elements.factor
        if sides == 2 or mixed_axial:
            kept = rod_sweep.kept_rows(kind, mixed_axial, sides)
            self.elimination = device_arrays.allocate((kept, *size), self.linear, self.device)
        if sides == 2:
            self._sweeps = rod_sweep.two_sided_kernels(kind, self.real, self.linear, *options)
            shape = 3 * kind.block**2 + 2 * kind.block + 2, sides, group.columns
            self._fronts = device_arrays.allocate(shape, self.linear, self.device)
            self._sums = device_arrays.allocate((sides, group.columns), self.real, self.device)
        else:
            self._sweeps = (rod_sweep.sweep_kernel(kind, self.real, self.linear, *options, mixed_axial),)
            self._sums = None
        self._threads = 128 if group.columns >= MANY else 32
        self._adjust = rod_iterate.adjust_kernel(kind, self.real, self.linear, mixed_axial, two_sided=sides == 2)

    def automatic_psd(self) -> str:
        """Return the mode of `NewtonOptions.psd` that suits the rods: Gauss-Newton lacks the effect of natural curvature on roll."""
        return "progressive" if has_natural_curvature(self.group) else "gauss_newton"

    @property
    def outdated(self) -> bool:
        """True if changed parameters suit another `psd` mode than the one chosen."""
        return self.options.psd == "auto" and self.psd != self.automatic_psd()

    @property
    def definite(self) -> bool:
        """True if matrices always drop compression."""
        return self.psd == "project" and self.exact

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.kernels_around, *self.sweeps, self._adjust]

    @property
    def sweeps(self) -> list:
        """Kernels of a sweep, with their block size."""
        return [(kernel, self._threads) for kernel in self._sweeps]

    @property
    def kernels_around(self) -> list:
        """Kernels that do not depend on the linear solver."""
        result = [self._predict, (self._evaluate, 128)]
        return [*result, *(kernel for kernel in (self._further, self._project) if kernel)]

    def pcg_iterations(self) -> int:
        """Return zero: the sweep is direct."""
        return 0

    @property
    def node_loads(self) -> tuple[wp.array, wp.array, wp.array]:
        """Nodes of the iterate, forces on them and moments about edges [node][column]."""
        return self.iterates.x, self.loading.force, self.loading.moment

    def take_loads(self) -> None:
        """Allocate loads on all nodes and angles, in place of the group's constant ones."""
        x, theta = self.iterates.x, self.iterates.theta
        force, moment = (device_arrays.allocate(array.shape, array.dtype, self.device) for array in (x, theta))
        self.loading = replace(self.loading, force=force, moment=moment, loaded=True)

    def predict(self, before) -> None:
        """Recompute the predictor of bent rods from the state `before` by rotating edges; carry frames to midpoints."""
        wp.launch(
            self._predict,
            self.group.columns,
            [before.x, before.v, self.group.fixed, self.group.anchor, self.group.count, *self.islands.arrays],
            [self.iterates.base, self.direction, self.iterates.x, self.iterates.frame],
            device=self.device,
        )

    def go_further(self, before, predicted: wp.array) -> None:
        """Warm-start bent rods: rotate edges of the predictor by the extrapolated correction `direction`."""
        group = self.group
        wp.launch(
            self._further,
            group.columns,
            [before.x, group.fixed, group.anchor, group.count, *self.islands.arrays, predicted, self.direction],
            [self.iterates.x],
            device=self.device,
        )

    @timer("newton")
    def solve(self, last: wp.array) -> None:
        """Iterate until no rod is active; can be captured. `last` holds the strains of the last step."""
        wp.capture_while(self.islands.any_active, lambda: self.iterate(last))

    def iterate(self, last: wp.array) -> None:
        """Perform one iteration of every active rod."""
        self.evaluate(last)
        self.sweep()

    @timer("evaluate")
    def evaluate(self, last: wp.array) -> None:
        """Evaluate elements at the iterate, residuals, the change of the energy, and the rods that are out of equilibrium."""
        group, islands, options = self.group, self.islands, self.options
        iterates, loading = self.iterates, self.loading
        wp.launch(
            self._evaluate,
            (self.runs, group.columns),
            [group.element_inputs(iterates, last, islands.inverse_step), self.run, self.exact_from or 0]
            + [loading.mass, loading.rotary, *islands.arrays]
            + [iterates.base, self.direction, iterates.target, iterates.target_angle]
            + [group.gravity, loading.force, loading.moment, int(loading.loaded), group.fixed, group.length]
            + [options.rtol, options.floor_factor * self.eps],
            [self._results, self.rhs, self.norms.change, self.norms.rounding_error],
            device=self.device,
            block_dim=128,
        )
        if self._project:
            wp.launch(
                self._project,
                (group.elements, group.columns),
                [self.iterates.x, group.count, islands.status, group.kind.window, self.elements.factor],
                [self.elements.geometric],
                device=self.device,
            )

    def sweep(self) -> None:
        """Factorise, decide, and take the next step."""
        self.eliminate()
        self.adjust()

    @timer("edge rotation")
    def adjust(self) -> None:
        """Complete an iteration: shorten or rotate steps, and update frames."""
        group = self.group
        wp.launch(
            self._adjust,
            group.columns,
            [group.count, group.fixed, group.anchor, self.direction, *self.islands.arrays],
            [self.iterates.x, self.iterates.theta, self.iterates.frame, self.iterates.base]
            + [self._sums, self.options.rotation_cap],
            device=self.device,
        )

    @timer("block LDL^T sweep")
    def eliminate(self) -> None:
        """Factorise, decide, find a direction and take a straight update along it."""
        options, islands, iterates, sides = self.options, self.islands.arrays, self.iterates, self.sides
        data, rounding = self._sweep_data(), options.floor_factor * self.eps
        limits = options.max_iterations, options.max_halvings
        if sides == 1:
            self._launch_sweep(self._sweeps[0], 1, [data, *islands, rounding, options.rotation_cap, *limits])
            return
        inward, middle, outward = self._sweeps
        self._launch_sweep(inward, sides, [data, *islands, self._fronts, self._sums])
        self._launch_sweep(middle, 1, [data, *islands, rounding, *limits, self._fronts, self._sums, iterates.base])
        self._launch_sweep(outward, sides, [data, *islands, iterates.base, self._sums])

    def _launch_sweep(self, kernel, sides: int, inputs: list) -> None:
        columns = self.group.columns
        size = columns if sides == 1 else (sides, columns)
        wp.launch(kernel, size, inputs, device=self.device, block_dim=self._threads)

    def _sweep_data(self):
        """Return the arrays of a sweep."""
        group, iterates, loading = self.group, self.iterates, self.loading
        data = rod_sweep.data_type(group.kind, self.real, self.linear)()
        data.factor, data.second, data.kept = self.elements.factor, self.elements.geometric, self.elimination
        data.rhs, data.direction, data.run = self.rhs, self.direction, self.run
        data.change, data.rounding_error = self.norms.change, self.norms.rounding_error
        data.count, data.fixed, data.mass, data.rotary = group.count, group.fixed, loading.mass, loading.rotary
        data.x, data.theta = iterates.x, iterates.theta
        return data


def has_natural_curvature(group) -> bool:
    """Return True if rods of a group may be curved or twisted at rest."""
    rest = [f"{term.name}.{name}" for term in group.kind.terms if term.measure.span == 2 for name in term.rest]
    return any(map(group.parameters.may_be_other_than_zero, rest))


def swept_ends(group, exact: bool) -> int:
    """Return the number of ends of a rod where a sweep starts: two for few rods on a GPU, which give too few threads otherwise.

    `exact`: True if the matrix has second derivatives.
    """
    return 1 if group.kind.serial or group.columns > FEW[exact] else 2


def _run(group) -> int:
    """Return the nodes that a thread evaluates: all on the CPU, on a GPU the number with which all threads end first.

    Threads run in waves, and each also evaluates the elements before its run.
    """
    if group.kind.serial:
        return group.nodes
    resident = max(1, wp.get_device(group.device).sm_count) * RESIDENT
    runs = np.arange(1, group.nodes + 1)
    nodes = -(-group.nodes // runs)
    waves = -(-group.columns * runs // resident)
    return int(nodes[np.argmin(waves * (nodes + np.where(runs > 1, group.kind.span, 0) + 1))])
