"""Newton's method on the coupled system by preconditioned conjugate gradients; one device-side loop a world."""

import math
from functools import cached_property, partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.compile.residual_tolerance import outer_forces
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.coupled_element import coupled_storage
from ddg_warp.kernels.forces.drag import block_inertia
from ddg_warp.kernels.linear import rod_pcg
from ddg_warp.kernels.linear.rod_dof_map import splits
from ddg_warp.kernels.newton import coupled_newton
from ddg_warp.solve.linear.pcg import SPARE, NewtonPCG, natural_scale
from ddg_warp.solve.linear.rod_substructuring import RodSubstructuring
from ddg_warp.solve.linear.skew_supports import SkewSupports
from ddg_warp.solve.linear.sparse_system import MatrixAssembly, SparseSystem, Sums
from ddg_warp.solve.newton.contact_newton import NewtonContact
from ddg_warp.solve.newton.edge_rotation import EdgeRotations
from ddg_warp.solve.newton.frozen_hessian import FrozenHessian
from ddg_warp.solve.newton.relaxed_convergence import RelaxedConvergence
from ddg_warp.solve.newton.residual import ResidualAssembler
from ddg_warp.solve.newton.residual_tolerance import ResidualTolerances
from ddg_warp.solve.newton.rod_newton import FIRST_EXACT_ITERATION, FROZEN, FROZEN_ONLY, NewtonOptions
from ddg_warp.solve.newton.sleeping_islands import SleepingIslands
from ddg_warp.timers import timer

PRECONDITIONERS = ("block_jacobi", "chain", "multilevel", "chain_multilevel")
STRAIGHT = 1e-9  # rest turning angle between edges that may be rounding [rad]
RESCALED = 2.0**12  # change of the natural scale that conjugate gradients tolerate
LOOSEST = 0.1  # largest forcing term (Eisenstat and Walker): relative tolerance of a direction


class CoupledNewton:
    """Newton's method on all worlds of the coupled system, with the buffers of a solve. Attributes: see also `RodNewton`.

    Args:
        preconditioner: of conjugate gradients: "block_jacobi", "chain" (substructuring, see `kernels.linear.rod_substructuring`),
            "multilevel" (see `kernels.linear.multilevel`), or "chain_multilevel", both.
        linear: scalar type of the linear algebra; default: the model's.
        drag: True if blocks have more than a mass; see `kernels.forces.drag`.
        reuse: True if the matrix of a step's first iterate serves the whole step.
        split: True if edges may be stiffer than the matrix carries, where possible; see `RodSubstructuring.splits`.

    Attributes:
        inactive_mask: (W N,) bits of dofs that a direction leaves unchanged: fixed dofs and, in contact, dofs of sleeping islands.
    """

    banded = True  # True if substructuring stores its blocks of H, which are valid on free dofs alone

    def __init__(
        self,
        model,
        options: NewtonOptions,
        preconditioner: str = "block_jacobi",
        linear=None,
        drag: bool = False,
        reuse: bool = False,
        split: bool = False,
    ):
        if reuse and options.psd not in FROZEN:
            raise SceneError(FROZEN_ONLY.format(options.psd))
        if preconditioner not in PRECONDITIONERS:
            raise SceneError(
                f"preconditioner {preconditioner!r}: for a coupled system it is one of {', '.join(PRECONDITIONERS)}"
            )
        coupled = model.coupled
        self.coupled, self.options, self.device = coupled, options, coupled.device
        self.real, self.linear = model.types.real, linear or model.types.linear
        self.eps = model.types.eps
        worlds, blocks, host, device = coupled.worlds, coupled.blocks, coupled.host, coupled.device
        serial = device_arrays.serial(device)
        self.worlds, self.all = worlds, worlds * blocks
        V, H = coupled.vector, wp.types.vector(3, self.linear)
        self.chains = RodSubstructuring.of(coupled, preconditioner, self.banded, split)
        self.system = SparseSystem(coupled, self.chains and self.chains.kept)

        def make(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        self.q, self.base, self.target = (make(self.all, V) for _ in range(3))
        self.load = wp.array(np.tile(host.constant_loads(), (worlds, 1)), dtype=V, device=device)
        self._weights, self._weight = make((3, worlds, blocks), self.real), make((3, worlds), self.real)
        self.change, self.noise, self.square = (self._weights[i] for i in range(3))
        self.dots = make((worlds, device_arrays.takers(blocks, device)), self.real)
        self.mass = make((worlds, blocks), block_inertia(self.real)) if drag else coupled.mass
        bits = (host.fixed * [1, 2, 4]).sum(1).astype(np.uint8)
        self.fixed = wp.array(bits, dtype=wp.uint8, device=device)
        self.held = self.fixed  # spatial components, for predictors: rates along skew supports stay in their planes
        self.planes = SkewSupports(coupled, self.system, self.real, self.linear) if host.frames else None
        self.inactive_mask = wp.array(np.tile(bits, worlds), dtype=wp.uint8, device=device)
        if self.planes:
            bits[list(host.frames)] = 0
            self.held = wp.array(bits, dtype=wp.uint8, device=device)
        gravity = np.asarray(model.scene.gravity, float)
        self.gravity = wp.array(gravity[None], dtype=V, device=device)
        self.rhs, self.direction = (make(self.all, H) for _ in range(2))
        self.matrix = make((9, worlds * self.system.positions), self.linear)
        self.krylov_dots = make((worlds, blocks), self.linear)
        self.islands = Islands(worlds, self.real, device)
        self.iterations, self.stalled = (make(worlds, int) for _ in range(2))
        self.best, self.decrease, self.turn, self.worst, self.goal, self.limit = (
            make(worlds, self.real) for _ in range(6)
        )
        self.goal.fill_(math.inf)
        self.forcing = make(worlds, self.linear)
        self.pcg_work = make(1, wp.int64)
        self.frozen = FrozenHessian(self.islands) if reuse else None
        self.psd = self.automatic_psd() if options.psd == "auto" else options.psd
        if self.psd == "none":
            self._require_exact()
        self.contact = NewtonContact(self, model) if host.touching else None
        exact = [self.psd != "gauss_newton" and part.term.measure.packed > 0 for part in coupled.sets]
        self.exact_from = tuple(
            (0 if self.psd == "none" else FIRST_EXACT_ITERATION) if wanted else None for wanted in exact
        )
        banded = self.chains is not None and self.chains.banded
        self.local = tuple(
            banded and part.host.along for part in coupled.sets
        )  # True if derivatives are of the local dofs
        self.split = tuple(
            split and is_local and splits(part.term) for is_local, part in zip(self.local, coupled.sets, strict=True)
        )
        sets = zip(coupled.sets, exact, self.local, self.split, strict=True)
        self.parts = [self._part(*inputs, make, H) for inputs in sets]
        ends = host.edges
        self.ends = wp.array(np.ascontiguousarray(ends, np.int32), dtype=int, device=device)
        # curvature is linear in the angles of mesh edges: no cap, which would shorten the steps of all other dofs
        capless = np.concatenate([np.zeros(0, int), *(shell.edges for shell in host.shells)])
        spins = np.arange(host.nodes, blocks)
        spins = spins[~np.isin(spins, capless)]
        self.spins = wp.array(spins.astype(np.int32), dtype=int, device=device)
        turning = device_arrays.takers(len(ends) + len(spins), device)
        self.squares = make((worlds, turning), self.real)
        self._sum = Sums(worlds, self.dots.shape[1], self.real, device)
        self._sum_weights = Sums(3 * worlds, blocks, self.real, device)
        self._largest = Sums(worlds, turning, self.real, device, largest=True)
        lengths = host.edge_lengths
        self.arm, self.longest = float(lengths.mean()), float(lengths.max())
        self._evaluate = [
            element_path.evaluate_kernel(
                coupled_storage(part.term, self.real, not local, serial), self.real, self.linear, iteration, is_split
            )
            for part, iteration, local, is_split in zip(
                coupled.sets, self.exact_from, self.local, self.split, strict=True
            )
        ]
        if self.chains:
            self.chains.bind(self.system, self.parts, self.real, self.linear, self.exact_from, drag, reuse)
            if self.contact:
                self.contact.bind(self.chains)
        self._direct = self.chains is not None and self.chains.exact
        fails = self.psd == "none"
        curved = any(exact) or (self.contact is not None and self.contact.bends)
        repeats = not reuse and (fails or curved or self._direct)
        self._repeat = rod_pcg.repeat_kernel(self.real, fails, curved) if repeats else None
        self.negative = make(worlds, int)
        self._assembly = MatrixAssembly(
            coupled, self.system, self.parts, self.real, self.linear, self.exact_from, self.local, drag
        )
        self.turns = EdgeRotations(self) if host.rods else None
        most = int(options.unconverged_fraction * self.contact.touching_bodies) if self.contact else 0
        self._judge, self._measure, self._rotate, self._take, self._move = coupled_newton.search_kernels(
            self.real, self.linear, serial, bool(host.rods), bool(coupled.edges), self.contact is not None, most > 0
        )
        self.allowed = ResidualTolerances(coupled, self.real, self.linear)
        outer = outer_forces(host, gravity)
        self.outer = self.allowed.assign(self.allowed.bodies.loads(outer)[None])
        self.resting = SleepingIslands(self, *self.contact.bodies) if self.contact else None
        self.unconverged_fraction = RelaxedConvergence(self, most) if most else None
        self.here = self.contact.bound if self.contact else self.q
        self._balance = ResidualAssembler(self, drag)
        self._worst = Sums(worlds, self.allowed.ratio.shape[1], self.real, device, largest=True)
        self._multilevel = preconditioner in ("multilevel", "chain_multilevel")

    def _require_exact(self) -> None:
        """Refuse the exact Hessian for measures without second derivatives."""
        for part in self.coupled.sets:
            if not (part.term.measure.packed or part.term.measure.tensions):
                raise SceneError(
                    f"psd 'none': second derivatives of {part.term.name} are left out of the matrix of a coupled system; "
                    "use 'auto', 'gauss_newton' or 'progressive'"
                )

    def automatic_psd(self) -> str:
        """Return the `psd` mode that suits the rods; see `RodNewton.automatic_psd`. Rest curvature within rounding counts as none.

        Bodies in contact rotate and bend: without second derivatives the last digits take tens of iterations.
        """
        if self.coupled.host.touching:
            return "progressive"
        bending = [part for part in self.coupled.sets if part.term.measure.packed and not self.frozen]
        if any(part.parameters.foreign.intersection(part.term.rest) for part in bending):
            return "progressive"
        turns = (part.parameters[name] * part.parameters["measure"] for part in bending for name in part.term.rest)
        return "progressive" if any(np.abs(turn).max() > STRAIGHT for turn in turns) else "gauss_newton"

    @property
    def outdated(self) -> bool:
        """True if another `psd` mode suits the parameters, or a changed stretching stiffness needs another scale in conjugate
        gradients.
        """
        if self.options.psd == "auto" and self.psd != self.automatic_psd():
            return True
        return not 1.0 / RESCALED < natural_scale(self.coupled) / self.krylov.scale < RESCALED

    def _part(self, part, exact: bool, local: bool, split: bool, make, H) -> dict:
        """Return the output arrays of an element set."""
        measure, count = part.term.measure, self.worlds * part.elements
        rows, factor, gradient = (
            (measure.size, self.linear, self.real) if local else (measure.slots, H, self.coupled.vector)
        )

        def lay(rows, dtype):
            return device_arrays.allocate((rows, count), dtype, self.device)

        return {
            "factor": lay(len(measure.strains) * rows, factor),
            "tension": lay(max(1, measure.tensions) + split, self.linear),
            "second": lay(measure.packed, self.linear) if exact else make((1, 1), self.linear),
            "gradient": lay(rows, gradient),
            "energy": lay(2, self.real),
            "stiffness": make(count, self.linear),
        }

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        result = [*self._balance.kernels, self._judge, self._measure, self._rotate, self._take]
        result += [*self.allowed.kernels, *([self._repeat] if self._repeat else [])]
        used = (self.chains, None if self._direct else self.krylov, self.planes, self.turns, self.contact, self.resting)
        used += (self.unconverged_fraction,)
        parts = [self._move, *self.coupled.carries, *(k for part in used if part for k in part.kernels)]
        evaluate = [(kernel, 128) for kernel in self._evaluate]
        sums = (self._sum, self._sum_weights, self._largest, self._worst)
        sums = [kernel for part in sums for kernel in part.kernels]
        result += self.frozen.kernels if self.frozen else []
        return [*result, *evaluate, *self._assembly.kernels, *parts, *sums]

    def pcg_iterations(self) -> int:
        """Return the iterations of all solves so far."""
        return int(self.pcg_work.numpy()[0])

    @timer("newton")
    def solve(self, state) -> None:
        """Iterate until no world is active, with the lagged data of `state`; can be captured."""
        if self.frozen:
            self.frozen.begin()
        if self.resting:
            self.resting.wake()
        wp.capture_while(self.islands.any_active, lambda: self.iterate(state))

    def iterate(self, state) -> None:
        """Perform one iteration of every active world."""
        self.islands.signals.zero_()
        self.evaluate(state)
        self.balance()
        self.judge()
        wp.capture_if(self.islands.any_active, lambda: self._step(state))

    def _step(self, state) -> None:
        """Advance active worlds to the next iterate."""
        wp.capture_if(self.islands.any_needs_direction, self._aim)
        self.move()
        if self.turns:
            wp.capture_if(self.islands.any_edge_rotation, lambda: self.turns.turn(state))
        if self.contact:
            self.contact.hold()

    def _aim(self) -> None:
        """Compute search directions and step lengths of worlds that do not backtrack."""
        if self.resting:
            self.resting(self.contact.terms.products)
        self.assemble()
        self.direct()
        self.take()

    @timer("evaluate")
    def evaluate(self, state) -> None:
        """Evaluate energies, gradients and Gauss-Newton factors of all elements at the iterate, `here`."""
        parts = [partial(self._evaluate_set, state, index) for index in range(len(self.coupled.sets))]
        device_arrays.side_by_side([self.contact.evaluate, *parts] if self.contact else parts, self.device)

    def _evaluate_set(self, state, index: int) -> None:
        results = element_path.results_type(self.real, self.linear, not self.local[index])()
        for name, values in self.parts[index].items():
            setattr(results, name, values)
        wp.launch(
            self._evaluate[index],
            (self.worlds, device_arrays.takers(self.coupled.sets[index].elements, self.device)),
            [self.coupled.elements(state, index, self.here, self.islands.inverse_step), *self.islands.arrays],
            [results],
            device=self.device,
            block_dim=128,
        )

    @timer("residual")
    def balance(self) -> None:
        """Compute residuals, the change of the energy, and the worlds that are out of equilibrium."""
        islands = self.islands
        self._balance()
        flags = islands.not_converged, islands.below_rounding_floor
        self.allowed.sum_up(self.rhs, self.options.rtol, islands, *flags, self._direct and not self.frozen)

    @timer("line search")
    def judge(self) -> None:
        """Stop worlds, reject their iterates, or request a direction."""
        options = self.options
        weights = self._weights.reshape((3 * self.worlds, -1)), self._weight.flatten()
        sums = [partial(self._sum_weights, *weights), partial(self._worst, self.allowed.ratio, self.worst)]
        counts = [partial(self.unconverged_fraction.count, options.rtol)] if self.unconverged_fraction else []
        device_arrays.side_by_side([*sums, *counts], self.device)
        if self.unconverged_fraction:
            self.unconverged_fraction.excuse()
        if self.contact:
            self.contact.account(self._weight[0], self._weight[1])
        wp.launch(
            self._judge,
            self.worlds,
            [*(self._weight[i] for i in range(3)), self.worst, options.rtol]
            + [options.floor_factor * self.eps]
            + [options.max_iterations, options.max_halvings, LOOSEST, options.linear_rtol, SPARE]
            + [*self.islands.arrays, self.best, self.stalled, self.forcing, self.goal, self.limit],
            device=self.device,
        )

    @timer("assemble")
    def assemble(self) -> None:
        """Assemble H of the worlds that need a direction."""
        if self.frozen:
            self.frozen.update()
        if not self.contact:
            self._assemble_own()
            return
        device_arrays.side_by_side([self._assemble_own, self.contact.assemble], self.device)
        self.contact.join()

    def _assemble_own(self) -> None:
        updated_islands = self.anew
        self._assembly(self.mass, updated_islands, self.matrix)
        if self.planes:
            self.planes.matrix(self.matrix, updated_islands.needs_direction)
        if self.chains and not self._direct:
            self.chains.assemble(self.matrix, self.mass, updated_islands)

    @timer("direction")
    def direct(self) -> None:
        """Compute directions: by elimination if exact, otherwise by conjugate gradients."""
        if self._direct:
            self.negative.zero_()
            self.forcing.zero_()  # only rounding is left
            self.chains.direct(
                self.matrix,
                self.mass,
                self.islands,
                self.anew,
                self.fixed,
                self.inactive_mask,
                self.rhs,
                self.negative,
                self.direction,
                self.krylov_dots,
            )
        elif self.contact:
            self.contact.direct()
        else:
            self.krylov.solve()
        if self._repeat:  # repeat indefinite iterates without second derivatives and compression
            wp.launch(self._repeat, self.worlds, [1, *self.islands.arrays, self.negative], device=self.device)

    @cached_property
    def krylov(self) -> NewtonPCG:
        """Solver of directions if elimination is not exact."""
        return NewtonPCG(self, self._multilevel)

    @property
    def anew(self) -> Islands | FrozenHessian:
        """Islands with a new matrix."""
        return self.frozen or self.islands

    @property
    def indefinite(self) -> wp.array:
        """Target of conjugate gradients' flags of indefiniteness: repeat the iterate, or drop compression in the next one."""
        return self.negative if self._repeat else self.islands.drop_compression

    def watch(self) -> None:
        """Do nothing: hook that runs after every iteration of conjugate gradients."""

    @timer("step length")
    def take(self) -> None:
        """Compute the step lengths along the directions."""
        blocks = self.coupled.blocks
        inputs = [self.rhs, self.direction, self.islands.needs_direction, blocks]
        device_arrays.sweep(self._measure, blocks, inputs, [self.dots], self.device, worlds=self.worlds)
        self._sum(self.dots, self.decrease)
        self.measure_turns()
        wp.launch(
            self._take,
            self.worlds,
            [self.decrease, self.turn, self.options.rotation_cap, self.iterations],
            [*self.islands.arrays, self.stalled, self.pcg_work],
            device=self.device,
        )

    def measure_turns(self) -> None:
        """Compute the largest squared rotation of the directions, transformed to spatial components."""
        if self.planes:
            self.planes.back(self.direction, self.islands.needs_direction)
        device_arrays.sweep(
            self._rotate,
            len(self.ends) + len(self.spins),
            [self.q, self.direction, self.ends, self.spins, self.islands.needs_direction, self.coupled.blocks],
            [self.squares],
            self.device,
            worlds=self.worlds,
        )
        self._largest(self.squares, self.turn)

    @timer("update")
    def move(self) -> None:
        """Move the iterates by the step, or by the fraction that the line search has left."""
        islands = self.islands
        device_arrays.sweep(
            self._move,
            self.coupled.blocks,
            [self.direction, islands.step_length, islands.iterate_action, islands.backtracks, self.coupled.blocks],
            [self.base, self.q],
            self.device,
            worlds=self.worlds,
        )
