"""Reverse of rigid bodies in steps and equilibria of the coupled system; see `ddg_warp.kernels.adjoint.rigid_bodies`."""

from dataclasses import replace

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp.errors import SceneError
from ddg_warp.kernels.adjoint import rigid_bodies as kernels
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.rigid_bodies import motion
from ddg_warp.model.coupled_model import CoupledState

# Most solves after the first with moments of controls. Each reduces the error by about half the rotation [rad] that these cause in a
# step.
CORRECTIONS = 16
EXACT, CHANGED = 1e-9, 1e-6  # relative change after which no more follow, and largest one by the last
ADDED = "predicted", "momentum", "moments", "rate"  # gradients that kernels add to


class RigidBodyAdjoint:
    """Reverse of the rigid bodies of a `CoupledModel` in steps by implicit Euler and in equilibria.

    Args:
        bodies: `RigidBodies` of the exact matrix.
        assembly: `CoupledAssembly`.
        by_damping: gradient by the mass-proportional damping (W N,), added to.
        steps: True for steps.

    Attributes:
        gradients: gradients by the inputs of the bodies, a struct of kernels.
    """

    def __init__(self, model, bodies, assembly, by_damping: wp.array, steps: bool):
        coupled, real = model.coupled, model.types.real
        self.coupled, self.bodies, self.tables, self._assembly = coupled, bodies, coupled.bodies, assembly
        self._steps = steps
        count, blocks = coupled.worlds * len(self.tables), coupled.worlds * coupled.blocks

        def make(size, dtype=coupled.vector):
            return wp.zeros(size, dtype=dtype, device=coupled.device)

        self._islands = Islands(coupled.worlds, real, coupled.device)
        self._turned, self._by_turn, self._rhs, self._last, self._q, self._v, self._slip = (
            make(blocks) for _ in range(7)
        )
        self._worlds, self._more = [make(coupled.worlds, int) for _ in range(2)], make(1, int)
        self._lag = coupled.lagged()[1]
        self.gradients = gradients = kernels.gradients_type(real)()
        for name in ("predicted", "momentum", "moments", "force", "moment"):
            setattr(gradients, name, make(count))
        gradients.rate, gradients.damping = make(count, real), by_damping
        self._predict, self._turn = motion.predict_kernel(real, False), motion.turn_kernel(real)
        self._spread = motion.spread_kernel(real, real)
        self._end, self._flight = kernels.end_kernel(real), kernels.flight_kernel(real)
        self._condense, _, self._correct, self._settle, self._go_on, self._pull = kernels.solve_kernels(
            real, bodies.linear
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        around = [self._predict, self._turn, self._spread, self._end, self._flight]
        corrections = [self._correct, self._settle, self._go_on]
        return [*around, self._condense, *corrections, self._pull, *self.coupled.carries]

    def begin(self, kept, solved: CoupledState, rate: float, coefficient: float) -> CoupledState:
        """Move bodies and carried nodes to the solution of a step; return it with the ghosts of its solve.

        Args:
            kept: `CoupledSavedStep`; solved: its solution.
            rate: inverse step [1/s], zero for an equilibrium; coefficient: that of inertia [1/s^2].
        """
        before, islands, tables, struct = kept.before, self._islands, self.tables, self.bodies.bodies
        if not rate:
            wp.copy(self.bodies.predicted, solved.rotation)
            solved = replace(solved, q=wp.clone(solved.q))
            self.bodies.place(solved, islands)
            return solved
        islands.inverse_step.fill_(rate)
        islands.inertia_coefficient.fill_(coefficient)
        wp.copy(struct.virial, kept.virial)
        struct.moment.zero_()
        if kept.moment is not None:
            wp.copy(struct.moment, kept.moment)
        inputs = [before.rotation, before.momentum, tables.moments, len(tables), islands.arrays[1]]
        self._launch(self._predict, inputs, [self.bodies.predicted, struct.inertia])
        self.bodies.place(solved, islands)
        lag = [
            turned if part.term.measure.spins else rows
            for part, turned, rows in zip(self.coupled.sets, self._lag, solved.lag, strict=True)
        ]
        solved = replace(solved, lag=lag)
        self._find_turn(before)
        self.coupled.turn_ghosts(before, solved, self._turned, self.coupled.every)
        self._find_turn(before)
        for name in ADDED:
            getattr(self.gradients, name).zero_()
        return solved

    def _find_turn(self, before: CoupledState) -> None:
        """Write the rotation vectors of the flight."""
        wp.copy(self._turned, before.q)
        inputs = [before.rotation, self.bodies.predicted, self.tables.spins, self.coupled.blocks]
        self._launch(self._turn, inputs, [self._turned])

    def begin_slip(self, before: CoupledState) -> wp.array:
        """Return the start of slip (W N,). Its blocks of rotations have the rotation vectors from P to R_n."""
        wp.copy(self._slip, before.q)
        self.bodies.begin_slip(before.rotation, self._slip)
        return self._slip

    def end(
        self,
        before: CoupledState,
        solved: CoupledState,
        after: CoupledState,
        cotangent: CoupledState,
        by_solution,
        step,
    ) -> CoupledState:
        """Return the cotangent of the end of a step, moved from carried nodes to bodies; add to the gradient by the solution.

        Args:
            step: inverse step of worlds and mass-proportional damping, arrays.
        """
        tables = self.tables
        wp.copy(self._q, cotangent.q)
        if self._steps:
            wp.copy(self._v, cotangent.v)
        inputs = [cotangent.rotation, cotangent.momentum, after.rotation, after.momentum, before.momentum]
        inputs += [self.bodies.predicted, solved.q, tables.moments, tables.arms, tables.starts, tables.carried]
        inputs += [tables.origins, tables.spins, self.coupled.blocks, *step]
        self._launch(self._end, inputs, [self._q, self._v, by_solution, self.gradients])
        return replace(cotangent, q=self._q, v=self._v)

    def condense(self, grad_q: wp.array) -> wp.array:
        """Return the gradient by the solution with carried nodes condensed, in memory of its own."""
        wp.copy(self._rhs, grad_q)
        self._launch(self._condense, [self.bodies.bodies, self.coupled.blocks], [self._rhs])
        return self._rhs

    def spread(self, w: wp.array) -> None:
        """Write the entries of carried nodes to a solution of the adjoint system."""
        tables, count = self.tables, len(self.tables.host.carried)
        inputs = [self.bodies.bodies.derivative, tables.owner, tables.carried, tables.origins, tables.spins]
        inputs += [self.coupled.blocks]
        wp.launch(self._spread, (self.coupled.worlds, count), inputs, [w], device=self.coupled.device)

    def skew(self, tangent, load_factor: float) -> sparse.csc_matrix | None:
        """Return the matrix of moments of controls in an equilibrium, which have no potential; None without moments.

        The derivative of T^T M at w = 0 is [M] / 2.
        """
        blocks = tangent.carried.bodies
        moment = load_factor * tangent.given.reshape(-1, 3)[blocks]
        if not moment.any():
            return None
        row, column = np.indices((3, 3)).reshape(2, -1)
        values = 0.5 * np.cross(moment[:, None], np.eye(3)).reshape(-1, 9)  # of -[M]
        places = (3 * blocks[:, None] + row).ravel(), (3 * blocks[:, None] + column).ravel()
        return sparse.csc_matrix((values.ravel(), places), shape=(tangent.size, tangent.size))

    def solve(self, system, grad_q: wp.array, solved: CoupledState, w: wp.array) -> None:
        """Correct a solution w of the adjoint system for moments of controls, which have no potential.

        Marks worlds in `failed` of the `ExactSystem` where the corrections do not converge.
        """
        (marks, left), more = self._worlds, self._more
        compared = [self.tables.spins, self._last, w, self.coupled.blocks]

        def correct() -> None:
            more.zero_()
            wp.copy(self._last, w)
            rhs = self.condense(grad_q)
            self._launch(self._correct, [self.bodies.bodies, solved.q, w, self.coupled.blocks], [rhs])
            system.solve_again(rhs, w)
            self._launch(self._settle, [*compared, EXACT], [marks])
            wp.launch(self._go_on, len(marks), [marks], [left, more], device=self.coupled.device)

        left.fill_(CORRECTIONS)
        more.fill_(1)
        wp.capture_while(more, correct)
        self._launch(self._settle, [*compared, CHANGED], [system.failed])

    def pull(self, solved: CoupledState, w: wp.array, grad_q: wp.array, step) -> None:
        """Add the gradients through the residual; move the gradients by carried nodes to the origins."""
        inputs = [self.bodies.bodies, self.bodies.predicted, self.tables.moments, solved.q, w, self.coupled.blocks]
        self._launch(self._pull, [*inputs, *step], [grad_q, self.gradients])

    def depart(self, before: CoupledState, solved: CoupledState, by_frame, own_rows, by_data, start, step) -> None:
        """Reverse free flight.

        Writes the gradients by orientations and angular momenta of the start.

        Args:
            by_frame, own_rows: gradients by frames, added to, and by own lagged rows, overwritten.
            by_data: gradients by constant data, added to.
            start: gradients by the start. Its dof blocks have the gradients by rotation vectors from P to R_n, which are zeroed.
        """
        tables = self.tables
        self._by_turn.zero_()
        self._assembly.unturn(solved, before, self._turned, own_rows, self._by_turn, by_frame, by_data)
        inputs = [before.rotation, before.momentum, tables.moments, self.bodies.predicted, self._by_turn]
        inputs += [start.q, tables.spins, self.coupled.blocks, *step, self.gradients]
        self._launch(self._flight, inputs, [start.rotation, start.momentum])

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.coupled.worlds, len(self.tables)), inputs, outputs, device=self.coupled.device)


def refuse(model, scheme: str | None) -> None:
    """Refuse gradients through rigid bodies by scheme and scene.

    Raises:
        SceneError: names the scheme, or the objects.
    """
    if not model.scene.bodies:
        return
    host, first = model.coupled.host, f"body 0 ('{model.scene.bodies[0].name}')"
    contact = host.contact_parameters
    for refused, reason in (
        (scheme is None and contact, "in equilibria with contact; take steps by 'implicit_euler'"),
        (scheme == "implicit_midpoint", "by the implicit midpoint rule; use 'implicit_euler'"),
        (scheme and host.followers, "in a scene with follower loads; leave them out"),
        (
            contact is not None and contact.has_friction and contact.law.friction_iterations > 1,
            "with several friction iterations a step; set friction_iterations=1",
        ),
    ):
        if refused:
            raise SceneError(f"no gradient goes through {first}, which is rigid, {reason}")
