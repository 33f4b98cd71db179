"""Contact in Newton's method on the coupled system; see `kernels.newton.contact_newton` and, for search and pairs, `solve.collision`.

CCD limits every proposed motion, a predictor or a step, rod by rod. Motion of supports and obstacles is included. A world whose
predictor or support motion was limited has motion pending. Its target `Iterates.proposed` then differs from its positions: all terms
but contact are evaluated there, and contact is linear about the positions. The next direction begins with the remaining motion.
"""

from functools import partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.newton.contact_newton import contact_kernels
from ddg_warp.solve.collision.ccd_bodies import number_bodies
from ddg_warp.solve.collision.contact_diagnosis import ContactDiagnosis
from ddg_warp.solve.collision.contact_model import ContactModel
from ddg_warp.solve.collision.statistics import ContactStatistics
from ddg_warp.solve.linear.contact_hessian import ContactHessian
from ddg_warp.solve.linear.sparse_system import Sums
from ddg_warp.solve.newton.pending_motion import PendingMotion
from ddg_warp.solve.newton.rod_newton import FIRST_EXACT_ITERATION
from ddg_warp.solve.newton.step_limit import StepLimit
from ddg_warp.timers import timer


class NewtonContact:
    """Contact of a `CoupledNewton`.

    Args:
        iterates: `Iterates` at rest positions; rate: inverse time over which slips count (worlds,) [1/s].
        linear: scalar type of the linear algebra; psd: see `NewtonOptions`.

    Attributes:
        search, terms: candidates; contact potential and friction of active pairs.
        `hessian`: `ContactHessian` at the last iterate.
        `limit`, `pending`: CCD limit of proposed motions, and the remainder of limited motions.
        `diagnosis`, `tally`: messages on failures, and statistics of all steps so far.
        bodies: body of each block of a world (blocks,), -1 for none; and the largest possible number of bodies.
        `rigid_bodies`: `RigidBodies` that carry nodes, None without.
        `bends`: True if the matrix has the geometric stiffness of pairs; see `kernels.collision.contact.geometric_stiffness`.
        `has_friction`: True with friction; rate: inverse time over which slips count (worlds,) [1/s].
        solutions: positions of the last step at which friction was updated, in order, for the reverse pass: `friction_iterations` -
            1 of (W N,).
    """

    def __init__(self, model, iterates, rate: wp.array, linear, psd: str):
        self.coupled = coupled = model.coupled
        host, real, worlds, device = coupled.host, coupled.real, coupled.worlds, coupled.device
        if host.frames:
            raise SceneError(
                "contact: a support on an oblique plane of symmetry does not go with it; use an axis of space"
            )
        # forces on obstacles are post-processing of states
        touch = ContactModel(coupled, linear, iterates.q, host.of_obstacles)
        self.search, self.terms, self.bodies = touch.search, touch.terms, number_bodies(host)
        self.hessian = ContactHessian(self.terms, touch.shapes)
        self.rigid_bodies = None
        self.limit, self.pending = StepLimit(model, touch, self.bodies), PendingMotion(model, linear)
        self.diagnosis, self.tally = ContactDiagnosis(model, touch), ContactStatistics(self.terms)
        self.has_friction, self.rate = host.contact_parameters.has_friction, rate
        updates = touch.law.friction_iterations - 1 if self.has_friction else 0
        self.solutions = [wp.zeros_like(iterates.q) for _ in range(updates)]
        self.bends, self._late = psd != "gauss_newton", 0 if psd == "none" else FIRST_EXACT_ITERATION
        self._curved, self._projected, self._braced = (wp.zeros(worlds, dtype=int, device=device) for _ in range(3))
        takers = device_arrays.takers(coupled.blocks, device)
        self._kept, self._dots, self._gain = (
            wp.zeros(shape, dtype=real, device=device) for shape in ((2, worlds), (worlds, takers), worlds)
        )
        self._sum = Sums(worlds, takers, real, device)
        self._kernels = contact_kernels(real, linear, device_arrays.serial(device))
        self._account, self._differ_gain, self._expect, self._refuse = self._kernels[:4]
        self._find_curved, self._again, self._keep_solution, self._brace = self._kernels[4:]

    @property
    def touching_bodies(self) -> int:
        """Number of bodies in a world."""
        return len(np.setdiff1d(self.bodies[0], [-1]))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        parts = (self.hessian, self.limit, self.pending, self._sum, self.search, self.terms, self.tally)
        return [*self._kernels, *(kernel for part in parts for kernel in part.kernels)]

    def renew(self, before: wp.array) -> None:
        """Rebuild the BVHs of the search at positions `before`, on devices where searches only refit."""
        if self.coupled.device.is_cuda:
            self.search.rebuild(before)

    def see(self, x: wp.array) -> None:
        """Update the candidates at positions x, without a motion."""
        self.search.update(x)

    @timer("friction lag")
    def lag(self, x: wp.array, again: bool = False, rate: wp.array | None = None, rotation=None) -> None:
        """Update the friction lag (normal forces, tangents) at positions x, which belong to the motion that was limited last.

        Slips restart, unless the update is made `again` within a step. At the start of a step, `rate` is the previous step's; see
        `ContactPotential.lag`. Orientations `rotation` of rigid bodies (W B,) are where slips start.
        """
        if self.has_friction:
            self.terms.lag(x, again, rate)
            if self.rigid_bodies and rotation is not None:
                self.rigid_bodies.begin_slip(rotation, self.terms.start)

    def lag_again(self, solution: wp.array, iterates, islands) -> None:
        """Update the friction lag at the iterate of converged worlds, and keep that in one of `solutions`."""
        self.coupled.sweep(self._keep_solution, [iterates.q, islands.substep_accepted, self.coupled.blocks], [solution])
        self.lag(iterates.q, again=True)
        self._launch(self._again, [islands.arrays[0]], [])

    def brace(self, dt: wp.array, islands) -> None:
        """Add inertia to the contact stiffness where the last trial reached the minimum gap, in a step of dt (worlds,) [s]."""
        if self.terms.heavy:
            self._launch(self._brace, [*islands.arrays, dt], [self._braced, self.terms.law.rate])

    @timer("CCD filter")
    def place(self, iterates, system, islands) -> None:
        """Limit the predictor by CCD, once supports are at their prescribed positions."""
        self.pending.aim(iterates)
        self.limit.begin(islands, self.pending, predictor=True)
        self._limit(iterates, system, islands)
        self.limit.mark_limited(islands)
        self.pending.end(iterates, islands)

    @timer("contact")
    def evaluate(self, iterates, islands) -> None:
        """Evaluate energies, forces and factors of contact at the limited iterate."""
        if self.has_friction:
            self.terms.evaluate(iterates.q, self.rate, iterates=(islands.energy_buffer, islands.iteration))
        else:
            self.terms.evaluate(iterates.q)

    def account(self, norms, islands) -> None:
        """Add the energy change of contact to worlds, and the rounding floor."""
        inputs = [self.terms.energy, self.terms.gap, self.diagnosis.least, self.search.counters.overflow]
        inputs += [islands.arrays[0], self._kept, norms.of_worlds[0], norms.of_worlds[1]]
        self._launch(self._account, inputs, [])

    @timer("contact")
    def assemble(self, iterates, islands) -> None:
        """Prepare the data that products and the preconditioner take from the last evaluation."""
        self._launch(self._find_curved, [islands.arrays[0], self._late], [self._curved, self._projected])
        self.hessian.linearise(iterates.q, self._curved if self.bends else None)
        self.hessian.assemble()

    @timer("CCD filter")
    def hold(self, iterates, search, system, islands) -> None:
        """Limit the trial step by CCD, and write its predicted decrease."""
        modes, blocks = self.limit.modes, self.coupled.blocks
        self.limit.begin(islands, self.pending)
        self.pending.land(iterates, system, islands, modes)
        self._limit(iterates, system, islands)
        self.pending.end(iterates, islands)
        self.coupled.sweep(self._differ_gain, [system.rhs, iterates.q, iterates.base, modes, blocks], [self._dots])
        self._sum(self._dots, self._gain)
        inputs = [modes, self.search.time, self._gain]
        self._launch(self._expect, inputs, [*islands.arrays, search.stalled, self._projected])

    def _limit(self, iterates, system, islands) -> None:
        """Limit the proposed motion by CCD, with the motion of supports."""
        bodies = self.rigid_bodies
        self.limit(iterates, bodies and partial(bodies.place, iterates, islands), bodies)
        self.pending.arrive(iterates, system, islands, self.limit.modes)

    @timer("interpenetration check")
    def finish(self, before, iterates, islands, smallest: float) -> None:
        """Refuse substeps from the coupled state `before` with interpenetration, or with energy created by rotating bodies.

        `smallest`: fraction of a step that retries reach.
        """
        if self.rigid_bodies:
            self.rigid_bodies.refuse(before, iterates, self.terms.forces, islands, smallest)
        self.search.check_crossings(before.q, iterates.q)
        inputs = [self.search.crossed, self.terms.gap, self.search.counters.overflow, *islands.arrays]
        self._launch(self._refuse, inputs, [self.tally.crossed, self.tally.least])
        self.tally(islands.arrays[0])

    def has_overflow(self, x: wp.array, spare: bool = False) -> bool:
        """Return True if lists of pairs overflowed and have grown. Reads from the device.

        With `spare`, long motions are limited instead, so that fewer candidates are needed.
        """
        grown = self.search.fit(x, self.limit.shorten if spare else None)
        grown = self.terms.fit() or grown
        if grown:
            self.tally.forget()
        return grown

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.coupled.worlds, inputs, outputs, device=self.coupled.device)
