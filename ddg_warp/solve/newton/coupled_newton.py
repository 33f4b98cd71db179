"""Newton's method on the coupled system by preconditioned conjugate gradients; one device-side loop a world.

Why not shared with `ddg_warp.solve.newton.rod_newton`: that host launches evaluation, check and a fused sweep of one group. This one
assembles element sets, selects a preconditioner, iterates PCG, and leaves hooks for contact and friction.
"""

from functools import partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.newton import coupled_newton
from ddg_warp.solve.forces.user_force import UserForces
from ddg_warp.solve.linear.linear_system import LinearSystem
from ddg_warp.solve.linear.pcg import NewtonPCG, natural_scale
from ddg_warp.solve.linear.rod_substructuring import RodSubstructuring
from ddg_warp.solve.linear.skew_supports import SkewSupports
from ddg_warp.solve.linear.sparse_system import MatrixAssembly, SparseSystem, Sums
from ddg_warp.solve.newton.contact_newton import NewtonContact
from ddg_warp.solve.newton.coupled_state import Iterates, Loading, ResidualNorms, SearchState
from ddg_warp.solve.newton.edge_rotation import EdgeRotations
from ddg_warp.solve.newton.element_evaluation import ElementEvaluation
from ddg_warp.solve.newton.frozen_hessian import FrozenHessian
from ddg_warp.solve.newton.line_search import LineSearch
from ddg_warp.solve.newton.relaxed_convergence import RelaxedConvergence
from ddg_warp.solve.newton.residual import ResidualAssembler
from ddg_warp.solve.newton.residual_tolerance import ResidualTolerances
from ddg_warp.solve.newton.rigid_bodies import RigidBodies
from ddg_warp.solve.newton.rod_newton import FROZEN, FROZEN_ONLY, NewtonOptions
from ddg_warp.solve.newton.sleeping_islands import SleepingIslands
from ddg_warp.timers import timer

PRECONDITIONERS = ("block_jacobi", "substructuring", "multilevel", "substructuring_multilevel")
STRAIGHT = 1e-9  # rest turning angle between edges that may be rounding [rad]
RESCALED = 2.0**12  # change of the natural scale that conjugate gradients tolerate


class CoupledNewton:
    """Newton's method on all worlds of the coupled system, one loop a world.

    The state of a solve is in `islands`, `iterates`, `loading`, `norms`, `search_state` and `system`. All other attributes are
    solver components, which get the state that they read and write as arguments.

    Args:
        preconditioner: of conjugate gradients: "block_jacobi", "substructuring" (substructuring, see
            `kernels.linear.rod_substructuring`), "multilevel" (see `kernels.linear.multilevel`), or "substructuring_multilevel",
            both.
        linear: scalar type of the linear algebra; default: the model's.
        quadratic: True if blocks have a quadratic potential; see `kernels.core.inertia`.
        reuse: True if the matrix of a step's first iterate serves the whole step.
        mixed_axial: True if edges may be stiffer than the matrix carries, where possible; see `RodSubstructuring.allows_mixed_axial`.

    Attributes:
        `sparsity`, `substructuring`: `SparseSystem` and, with substructuring, `RodSubstructuring`.
        `frozen`, `planes`, `edge_rotations`, `contact`, `sleeping`, `relaxed`, `rigid_bodies`: components that not all models and
            options need, or None.
        krylov: conjugate gradients; None if substructuring is exact.
    """

    banded = True  # True if substructuring stores its blocks of H, which are valid on free dofs alone
    # True if the first multilevel preconditioner of a solve without contact serves all its matrices
    keeps_levels = True

    def __init__(
        self,
        model,
        options: NewtonOptions,
        preconditioner: str = "block_jacobi",
        linear=None,
        quadratic: bool = False,
        reuse: bool = False,
        mixed_axial: bool = False,
    ):
        if reuse and options.psd not in FROZEN:
            raise SceneError(FROZEN_ONLY.format(options.psd))
        if preconditioner not in PRECONDITIONERS:
            raise SceneError(
                f"preconditioner {preconditioner!r}: for a coupled system it is one of {', '.join(PRECONDITIONERS)}"
            )
        self.coupled = coupled = model.coupled
        self.options, self.linear = options, linear or model.types.linear
        host, real, self._eps = coupled.host, coupled.real, model.types.eps
        if host.contact_parameters and reuse:
            raise SceneError(
                "contact: solver 'projective' keeps the matrix of a step, which contact changes; use 'newton'"
            )
        if coupled.user_forces and reuse:
            raise SceneError(
                "user-defined forces: solver 'projective' keeps the matrix of a step, which they change; use 'newton'"
            )
        if host.rigid_bodies and reuse:
            raise SceneError(
                "rigid bodies: solver 'projective' keeps the matrix of a step, which they change; use 'newton'"
            )
        self.islands = Islands(coupled.worlds, real, coupled.device)
        self.frozen = FrozenHessian(self.islands) if reuse else None
        self.psd = self.automatic_psd() if options.psd == "auto" else options.psd
        if self.psd == "none":
            self._require_exact()

        self.substructuring = RodSubstructuring.of(coupled, preconditioner, self.banded, mixed_axial)
        self.sparsity = SparseSystem(coupled, self.substructuring and self.substructuring.kept)
        self.planes = SkewSupports(coupled, self.sparsity, real, self.linear) if host.frames else None
        banded = self.substructuring is not None and self.substructuring.banded
        self.elements = ElementEvaluation(coupled, self.psd, self.linear, banded, mixed_axial)
        matrix = self.sparsity, self.elements.outputs, self.linear, self.elements.exact_from
        self._assembly = MatrixAssembly(coupled, *matrix, self.elements.local, quadratic)
        if self.substructuring:
            self.substructuring.bind(*matrix, quadratic, reuse)
        self.iterates, self.norms = Iterates.of(coupled), ResidualNorms.of(coupled)
        self.search_state, self.tolerances = SearchState.of(coupled), ResidualTolerances(coupled, real, self.linear)
        self.loading = Loading.of(coupled, model.scene.gravity, quadratic, self.tolerances)
        self.contact = None
        if host.contact_parameters:
            self.contact = NewtonContact(model, self.iterates, self.islands.inverse_step, self.linear, self.psd)
            if self.substructuring:
                self.contact.hessian.bind(self.substructuring)
        self.user_forces, terms = None, self.contact and self.contact.terms
        outer = (terms.forces, terms.blocks.stiffness) if terms else None
        if coupled.user_forces:
            self.user_forces = UserForces(model, self.linear, quadratic, terms)
            outer = self.user_forces.total, self.user_forces.bound
        self.exact = self.substructuring is not None and self.substructuring.exact
        fails = self.psd == "none"
        curved = any(first is not None for first in self.elements.exact_from) or bool(
            self.contact and self.contact.bends
        )
        curved = curved or self.user_forces is not None
        repeats = not reuse and (fails or curved or self.exact)
        self._repeat = coupled_newton.repeat_kernel(real, fails, curved) if repeats else None
        # flags of indefiniteness: repeat the iterate, or drop compression in the next one
        self.system = LinearSystem.of(
            coupled,
            self.sparsity,
            self.substructuring,
            self.linear,
            self.islands.needs_direction,
            self.updated_islands.needs_direction,
            None if repeats or self.exact else self.islands.drop_compression,
        )
        self.residual = ResidualAssembler(
            coupled,
            self.elements,
            self.sparsity,
            self.substructuring,
            self.planes,
            self.tolerances,
            outer,
            self.linear,
            options.rtol,
            options.floor_factor * self._eps,
            quadratic,
        )
        most = int(options.unconverged_fraction * self.contact.touching_bodies) if self.contact else 0
        self.rigid_bodies = None
        if coupled.bodies:
            stiffened = coupled.has_quadratic_matrix(quadratic)
            self.rigid_bodies = RigidBodies(
                coupled.bodies, self.sparsity, self.linear, quadratic, stiffened, outer is not None
            )
            self.residual.leave_out(self.rigid_bodies)
            if self.contact:
                self.contact.rigid_bodies = self.rigid_bodies
            if self.contact and self.substructuring:
                self.substructuring.add_contact(self.contact.hessian.diagonal, self.rigid_bodies.cross)
        self.line_search = LineSearch(coupled, self.linear, most > 0)
        self._worst = Sums(coupled.worlds, self.tolerances.ratio.shape[1], real, coupled.device, largest=True)
        lengthened = self.substructuring if any(self.elements.mixed_axial) else None
        self.edge_rotations = EdgeRotations(coupled, self.linear, lengthened) if host.rods else None
        self.sleeping = self.relaxed = self.krylov = None
        if self.contact:
            tolerances, bodies = self.tolerances, self.contact.bodies
            self.sleeping = SleepingIslands(coupled, self.linear, tolerances, self.substructuring, *bodies)
        if most:
            self.relaxed = RelaxedConvergence(coupled, self.sleeping, most)
        if not self.exact:
            parts = self.sparsity, self.substructuring, self.contact and self.contact.hessian
            multilevel = preconditioner in ("multilevel", "substructuring_multilevel")
            keeps_levels = self.keeps_levels and not (self.contact or self.user_forces)
            stop = self.tolerances, options.rtol, self.relaxed, keeps_levels
            outer = self.user_forces, self.rigid_bodies
            self.krylov = NewtonPCG(coupled, *parts, self.linear, multilevel, *stop, *outer)

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
        if self.coupled.host.contact_parameters or self.coupled.user_forces:
            return "progressive"
        bending = [part for part in self.coupled.sets if part.term.measure.packed and not self.frozen]
        changing = [part.parameters.foreign | part.parameters.prescribed for part in bending]
        if any(names.intersection(part.term.rest) for names, part in zip(changing, bending, strict=True)):
            return "progressive"
        edge_rotations = (
            part.parameters[name] * part.parameters["measure"] for part in bending for name in part.term.rest
        )
        return "progressive" if any(np.abs(turn).max() > STRAIGHT for turn in edge_rotations) else "gauss_newton"

    @property
    def outdated(self) -> bool:
        """True if another `psd` mode suits the parameters, or a changed stretching stiffness needs another scale in conjugate
        gradients.
        """
        if self.options.psd == "auto" and self.psd != self.automatic_psd():
            return True
        rescaled = natural_scale(self.coupled) / self.krylov.scale if self.krylov else 1.0
        return not 1.0 / RESCALED < rescaled < RESCALED

    @property
    def updated_islands(self) -> Islands | FrozenHessian:
        """Islands with a new matrix."""
        return self.frozen or self.islands

    @property
    def node_loads(self) -> tuple[wp.array, wp.array, wp.array]:
        """Dof blocks of the iterate, forces on them and moments about angles [block][world]."""
        coupled, force = self.coupled, self.loading.force
        return coupled.points(self.iterates.q), coupled.points(force), coupled.angles(force)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        parts = (self.residual, self.tolerances, self.line_search, self._worst, self.elements, self._assembly)
        parts += (
            self.frozen,
            self.substructuring,
            self.krylov,
            self.planes,
            self.edge_rotations,
            self.contact,
            self.sleeping,
            self.user_forces,
            self.rigid_bodies,
        )
        kernels = [kernel for part in (*parts, self.relaxed) if part for kernel in part.kernels]
        return [*kernels, *self.coupled.carries, *([self._repeat] if self._repeat else [])]

    @property
    def inertia(self) -> wp.array:
        """Inertia of blocks (worlds, N) in matrices, with the stiffness of forces on single nodes."""
        return self.user_forces.inertia if self.user_forces else self.loading.mass

    @property
    def pcg_work(self) -> wp.array:
        """Iterations of all solves so far (1,)."""
        return self.search_state.pcg_work

    def pcg_iterations(self) -> int:
        """Return the iterations of all solves so far."""
        return int(self.pcg_work.numpy()[0])

    @timer("newton")
    def solve(self, state) -> None:
        """Iterate until no world is active, with the lagged data of `state`; can be captured."""
        if self.frozen:
            self.frozen.begin(self.islands)
        if self.sleeping:
            self.sleeping.wake(self.search_state, self.system, self.islands)
        wp.capture_while(self.islands.any_active, lambda: self.iterate(state))

    def iterate(self, state) -> None:
        """Perform one iteration of every active world."""
        self.islands.signals.zero_()
        self.evaluate(state)
        self.balance()
        self.decide_action()
        wp.capture_if(self.islands.any_active, lambda: self._step(state))

    def _step(self, state) -> None:
        """Advance active worlds to the next iterate."""
        wp.capture_if(self.islands.any_needs_direction, self._find_direction)
        self.line_search.move(self.iterates, self.system, self.islands)
        if self.rigid_bodies:
            self.rigid_bodies.place(self.iterates, self.islands)
        if self.edge_rotations:
            wp.capture_if(self.islands.any_edge_rotation, lambda: self._rotate(state))
        if self.contact:
            self.contact.hold(self.iterates, self.search_state, self.system, self.islands)

    def _find_direction(self) -> None:
        """Compute search directions and step lengths of worlds that do not backtrack."""
        if self.sleeping:
            products, ratio, rtol = self.contact.terms.products, self.tolerances.ratio, self.options.rtol
            self.sleeping(products, ratio, rtol, self.search_state, self.system, self.islands)
        self.assemble()
        self.direct()
        self.take()

    @timer("evaluate")
    def evaluate(self, state) -> None:
        """Evaluate energies, gradients and Gauss-Newton factors of all elements and of contact at the iterate."""
        launches = self.elements.launches(state, self.iterates.proposed, self.islands)
        if self.contact:
            launches.insert(0, partial(self.contact.evaluate, self.iterates, self.islands))
        device_arrays.side_by_side(launches, self.coupled.device)

    @timer("residual")
    def balance(self) -> None:
        """Compute residuals, the change of the energy, and the worlds that are out of equilibrium."""
        system, islands = self.system, self.islands
        if self.user_forces:
            self.user_forces.evaluate(self.iterates.proposed, islands)
        self.residual(self.iterates, self.loading, self.norms, system, islands)
        if self.user_forces:
            self.user_forces.account(self.iterates, self.norms, islands)
        flags = islands.not_converged, islands.below_rounding_floor
        self.tolerances.sum_up(system.rhs, self.options.rtol, islands, *flags, self.exact and not self.frozen)

    @timer("line search")
    def decide_action(self) -> None:
        """Stop worlds, reject their iterates, or request a direction."""
        norms, islands, ratio, rtol = self.norms, self.islands, self.tolerances.ratio, self.options.rtol
        sums = [partial(self.line_search.sum_norms, norms), partial(self._worst, ratio, norms.worst)]
        if self.relaxed:
            sums.append(partial(self.relaxed.count, rtol, ratio, islands))
        device_arrays.side_by_side(sums, self.coupled.device)
        if self.relaxed:
            self.relaxed.excuse(rtol, norms, islands)
        if self.contact:
            self.contact.account(norms, islands)
        self.line_search.decide_action(norms, self.search_state, self.system, islands, self.options, self._eps)

    @timer("assemble")
    def assemble(self) -> None:
        """Assemble H of the worlds that need a direction."""
        if self.frozen:
            self.frozen.update(self.islands)
        if self.user_forces:
            self.user_forces.assemble(self.iterates.proposed, self.loading.mass, self.islands)
        if not self.contact:
            self._assemble_elements()
            return
        contact = partial(self.contact.assemble, self.iterates, self.islands)
        device_arrays.side_by_side([self._assemble_elements, contact], self.coupled.device)
        if self.rigid_bodies:
            hessian = self.contact.hessian
            self.rigid_bodies.condense_contact(hessian.products.sets, hessian.diagonal)
        self.contact.hessian.add_to_bands(self.islands.arrays[0])

    def _assemble_elements(self) -> None:
        matrix, mass, updated_islands = self.system.matrix, self.inertia, self.updated_islands
        self._assembly(mass, updated_islands, matrix)
        if self.rigid_bodies:
            self.rigid_bodies.condense(mass, updated_islands, matrix)
        if self.planes:
            self.planes.matrix(matrix, updated_islands.needs_direction)
        if self.substructuring and not self.exact:
            self.substructuring.bands.assemble(matrix, mass, updated_islands)

    @timer("direction")
    def direct(self) -> None:
        """Compute directions: by elimination if exact, otherwise by conjugate gradients."""
        system, islands = self.system, self.islands
        if self.exact:
            system.indefinite.zero_()
            system.forcing.zero_()  # only rounding is left
            self.substructuring.direct(system, self.inertia, islands, self.updated_islands)
        else:
            if self.contact:
                self.contact.pending.approach(self.iterates, system, self.contact.terms, self.rigid_bodies)
            self.krylov.solve(system, islands, self.after_cycle)
            if self.contact:
                self.contact.pending.follow(system)
        if self._repeat:  # repeat indefinite iterates without second derivatives and compression
            inputs = [1, *islands.arrays, system.indefinite]
            wp.launch(self._repeat, self.coupled.worlds, inputs, device=self.coupled.device)

    def after_cycle(self) -> None:
        """Do nothing: hook that runs after every iteration of conjugate gradients."""

    @timer("step length")
    def take(self) -> None:
        """Compute the step lengths along the directions."""
        self.line_search.predict_decrease(self.search_state, self.system)
        self.measure_rotation()
        self.line_search.take(self.search_state, self.system, self.islands, self.options.rotation_cap)

    def measure_rotation(self) -> None:
        """Compute the largest squared rotation of the directions, transformed to spatial components."""
        if self.rigid_bodies:
            self.rigid_bodies.spread(self.system.direction)
        if self.planes:
            self.planes.back(self.system.direction, self.system.wanted)
        self.line_search.measure_rotation(self.iterates, self.search_state, self.system)

    @timer("edge rotation")
    def _rotate(self, state) -> None:
        """Position the nodes of rods with edge rotations, and update the frames of `state` where required."""
        self.edge_rotations.place(self.iterates, self.system, self.islands)
        if self.coupled.edges:
            self.coupled.renew(state, self.iterates.q, self.islands.iterate_action)
