"""Projected Newton on chains: every rod has its own loop, line search and outcome, all on the device."""

from dataclasses import dataclass

import warp as wp

from ddg_warp import argument_checks, device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import element_path, rod_layout
from ddg_warp.kernels.linear import geometric_stiffness, mixed_axial_force
from ddg_warp.kernels.newton import rod_iterate
from ddg_warp.kernels.newton import rod_sweep as sweep
from ddg_warp.kernels.residual import rod_residual
from ddg_warp.kernels.stepping import rod_step, rod_warm_start

FIRST_EXACT_ITERATION = (
    2  # iterations that "progressive" makes by Gauss-Newton: far from a solution the exact matrix is no better
)
PSD_MODES = ("auto", "gauss_newton", "project", "progressive", "none")
FROZEN = ("auto", "gauss_newton")  # modes of the matrix that serves a whole step
FROZEN_ONLY = "psd {!r}: the solver 'projective' freezes the matrix of 'gauss_newton'"
MANY = 50_000  # rods from which full blocks of the sweep pay on a GPU; below, small ones reach more multiprocessors


@argument_checks.called
@dataclass(frozen=True)
class NewtonOptions:
    """How a Newton solve searches and when it stops.

    Attributes:
        rtol: a dof is in equilibrium where its residual is below rtol times the load scale of its rod or shell (sum of its outer
            forces; without any, the first residual), in shells times the root of its share of the area, or below what rounding
            leaves of it; so are sums of residuals over parts. See `ddg_warp.compile.residual_tolerance`.
        floor_factor: how many rounding units of the forces that meet at a node count as rounding.
        max_iterations: Newton iterations of one solve.
        max_halvings: shortenings of one step by the line search.
        rotation_cap: largest turn of an edge, a joint or the angle of a rod in one update [rad].
        linear_rtol: reduction of the residual by PCG, in the norm of the preconditioner.
        psd: the matrix. "gauss_newton": without second derivatives of bending and twist, never indefinite but for
            compression, which is left out where a pivot is lost. "progressive": from the third iteration on the exact Hessian, and
            in iterations where it is not positive definite Gauss-Newton without compression: for curved, twisted or compressed rods
            and long steps, where Gauss-Newton takes many iterations. Where many iterations are such, a time step is tried again
            with a shorter one (outcome `indefinite`; see `kernels.core.islands.projected_limit_function`). "project": the exact one
            with every element made positive semi-definite by its eigenvalues, at twenty times the cost of an iteration. "none": the
            exact one; where it is indefinite the solve ends with the outcome `indefinite`, and a time step is tried again with a
            shorter one. "auto": "progressive" for rods that are curved or twisted at rest, or stiff over a time step
            (`compile.precision.stiff`), on their own or in nets, else "gauss_newton". Nets take all but "project". Their exact
            Hessian is that of rods and rigid joints; second derivatives of shells' bending, of glue and of magnets are left out,
            which "none" refuses. It is indefinite where a pivot is lost, or conjugate gradients meet negative curvature; by
            "gauss_newton" nets go on with the direction found so far, and leave compression out of the next matrix.
        unconverged_fraction: in contact, part of the bodies of a world (rods, shells, and what is joined of them) that may be out
            of balance at the end of a step, each by no more than ten times the tolerance: in crowds some slip off others at any
            time, and hold up all the rest. What is left of its residual acts on such a body like a force, in that step. Where
            contact cuts nothing, directions are solved until all but half as many balance by what is linear.
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
    """Newton on one group of uncoupled open rods by the chain sweep. Owns what is needed while a solve runs.

    Args:
        model, group, options: what to solve, and how.
        linear: scalar type of the linear algebra; that of the model by default.
        midpoint: whether predicted iterates are midpoints, to which the lagged frames are carried.
        split: whether edges may be stiffer than the matrix carries, by tensions that are unknowns; see
            `kernels.linear.mixed_axial_force`.

    Attributes:
        x, theta, frame: the iterate and its lagged frames; base: the accepted positions it was reached from.
        target, target_angle, coefficient: the quadratic of inertia, coefficient * m |x - target|^2 / 2.
        mass, rotary: m; with drag, of which `kernels.forces.drag` makes them at the start of a solve, its own.
        load, load_angle: forces on nodes and moments about edges, where there are any (`loaded`).
        islands: state of every rod's search; see `kernels.core.islands`.
    """

    reuse = False  # whether the matrix of a step's first iterate serves the whole step

    def __init__(self, model, group, options: NewtonOptions, linear=None, midpoint: bool = False, split: bool = False):
        self.group, self.options = group, options
        self.real, self.linear = model.types.real, linear or model.types.linear
        self.eps = model.types.eps
        kind, device = group.kind, model.wp_device
        vector = wp.types.vector(kind.dim, self.real)
        nodes, columns = (group.nodes, group.columns), group.columns

        def make(*shape, dtype=self.real):
            return device_arrays.allocate(shape, dtype, device)

        twisted = nodes if kind.twist else (1, 1)
        self.x, self.base, self.target = (make(*nodes, dtype=vector) for _ in range(3))
        self.theta, self.target_angle = make(*twisted), make(*twisted)
        self.frame = make(7, *twisted)
        self.load, self.load_angle, self.loaded = group.load, group.load_angle, group.host.loaded
        self.mass, self.rotary = group.mass, group.rotary
        if kind.drag:
            self.mass = make(*nodes, dtype=rod_layout.inertia_type(kind, self.real))
            self.rotary = make(*twisted)
        self.factor = make(kind.factor_rows + split, *nodes, dtype=self.linear)
        self.gradient = make(kind.window, *nodes)
        self.energy = make(2, *nodes)
        self.stiffness = make(*nodes, dtype=self.linear)
        kept = 2 * kind.block**2 + kind.block + (mixed_axial_force.kept_rows(kind.block) if split else 0)
        self.elimination = make(kept, *nodes, dtype=self.linear) if not kind.closed else None
        self.rhs, self.direction = (make(rows, *nodes, dtype=self.linear) for rows in (kind.block, kind.block + split))
        self.energy_change, self.energy_noise = make(*nodes), make(*nodes, dtype=self.linear)
        self.islands = Islands(columns, self.real, device)
        self.psd = self.automatic_psd() if options.psd == "auto" else options.psd
        self.exact = self.psd != "gauss_newton" and kind.span == 2  # a rod that only stretches has its Hessian anyway
        rows = kind.geometric_rows if self.exact else 1
        self.exact_from = (FIRST_EXACT_ITERATION if self.psd == "progressive" else 0) if self.exact else None
        self.geometric = make(rows, *(nodes if self.exact else (1, 1)), dtype=self.linear)
        self._project = None
        if self.psd == "project" and self.exact:
            self._project = geometric_stiffness.project_kernel(kind, self.real, self.linear)
        self.device = device
        self._evaluate = element_path.evaluate_kernel(
            rod_layout.rod_storage(kind, self.real, self.linear),
            self.real,
            self.linear,
            self.exact_from,
            split,
            self.definite,
            self.reuse,
        )
        self._results = element_path.results_type(self.real, self.linear)()
        self._results.factor = self._results.tension = device_arrays.columns(self.factor)
        self._results.second, self._results.gradient = (
            device_arrays.columns(self.geometric),
            device_arrays.columns(self.gradient),
        )
        self._results.energy, self._results.stiffness = (
            device_arrays.columns(self.energy),
            device_arrays.columns(self.stiffness),
        )
        self._check = rod_residual.check_kernel(kind, self.real, self.linear)
        self._predict = rod_step.predict_kernel(kind, self.real, self.linear, midpoint)
        self._further = None if midpoint else rod_warm_start.further_kernel(kind, self.real, self.linear)
        self._sweep, self._threads = None, 32 if columns < MANY else 128
        if not kind.closed:
            self._sweep = sweep.sweep_kernel(kind, self.real, self.linear, self.exact_from, self.psd == "none", split)
        self._adjust = None if kind.closed else rod_iterate.adjust_kernel(kind, self.real, self.linear, split)

    def automatic_psd(self) -> str:
        """The mode of `NewtonOptions.psd` that suits the rods: Gauss-Newton lacks what a natural curvature does to their roll."""
        group = self.group
        rest = [f"{term.name}.{name}" for term in group.kind.terms if term.measure.span == 2 for name in term.rest]
        return "progressive" if any(map(group.parameters.may_be_other_than_zero, rest)) else "gauss_newton"

    @property
    def outdated(self) -> bool:
        """Whether parameters have changed so that another mode suits the rods than the one that was chosen."""
        return self.options.psd == "auto" and self.psd != self.automatic_psd()

    @property
    def definite(self) -> bool:
        """True if matrices always drop compression."""
        return self.psd == "project" and self.exact

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.kernels_around, (self._sweep, self._threads), self._adjust]

    @property
    def kernels_around(self) -> list:
        """Those that do not depend on how the system is solved."""
        own = [self._predict, (self._evaluate, 128), self._check]
        return [*own, *(kernel for kernel in (self._further, self._project) if kernel)]

    def pcg_iterations(self) -> int:
        """None: the sweep is direct."""
        return 0

    def take_loads(self) -> None:
        """Have loads of its own, on all nodes and angles, instead of the constant ones of the group."""
        self.load, self.loaded = device_arrays.allocate(self.x.shape, self.x.dtype, self.device), True
        self.load_angle = device_arrays.allocate(self.theta.shape, self.real, self.device)

    def predict(self, before) -> None:
        """Redo the predictor of bent rods from the state `before`, with edges turned; carry frames to midpoints."""
        wp.launch(
            self._predict,
            self.group.columns,
            [before.x, before.v, self.group.fixed, self.group.anchor, self.group.count, *self.islands.arrays],
            [self.base, self.direction, self.x, self.frame],
            device=self.device,
        )

    def go_further(self, before, predicted: wp.array) -> None:
        """Start bent rods from where accelerations lead from their predictor, `direction`, with edges turned."""
        group = self.group
        wp.launch(
            self._further,
            group.columns,
            [before.x, group.fixed, group.anchor, group.count, *self.islands.arrays, predicted, self.direction],
            [self.x],
            device=self.device,
        )

    def solve(self, last: wp.array) -> None:
        """Iterate until no rod is active; can be captured. `last` holds the strains of the last step."""
        wp.capture_while(self.islands.any_active, lambda: self.iterate(last))

    def iterate(self, last: wp.array) -> None:
        """One iteration of every active rod."""
        self.evaluate(last)
        self.check()
        self.sweep()

    def evaluate(self, last: wp.array) -> None:
        """Energies, gradients and factors of all elements at the iterate."""
        group = self.group
        wp.launch(
            self._evaluate,
            group.element_threads,
            [group.element_inputs(self, last, self.islands.inverse_step), *self.islands.arrays],
            [self._results],
            device=self.device,
            block_dim=128,
        )
        if self._project:
            wp.launch(
                self._project,
                (group.elements, group.columns),
                [self.x, group.count, self.islands.status, group.kind.window, self.factor],
                [self.geometric],
                device=self.device,
            )

    def check(self) -> None:
        """Residuals, the change of the energy, and the rods that are out of equilibrium."""
        group, options = self.group, self.options
        wp.launch(
            self._check,
            group.node_threads,
            [self.gradient, self.energy, self.stiffness, group.count, self.mass, self.rotary, *self.islands.arrays]
            + [self.x, self.theta, self.base, self.direction, self.target, self.target_angle]
            + [group.gravity, self.load, self.load_angle, int(self.loaded), group.fixed, group.length]
            + [options.rtol, options.floor_factor * self.eps],
            [self.rhs, self.energy_change, self.energy_noise],
            device=self.device,
        )

    def sweep(self) -> None:
        """Factor, decide, and take the next step."""
        self.eliminate()
        group = self.group
        wp.launch(
            self._adjust,
            group.columns,
            [group.count, group.fixed, group.anchor, self.direction, *self.islands.arrays],
            [self.x, self.theta, self.frame, self.base],
            device=self.device,
        )

    def eliminate(self) -> None:
        """Factor, decide, find a direction and move straight along it."""
        group, options = self.group, self.options
        wp.launch(
            self._sweep,
            group.columns,
            [self.factor, self.geometric, self.rhs, self.energy_change, self.energy_noise, group.count]
            + [self.mass, self.rotary, *self.islands.arrays, group.fixed]
            + [options.floor_factor * self.eps, options.rotation_cap]
            + [options.max_iterations, options.max_halvings]
            + [self.x, self.theta, self.base, self.elimination, self.direction],
            device=self.device,
            block_dim=self._threads,
        )
