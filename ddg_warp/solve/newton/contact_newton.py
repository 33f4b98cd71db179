"""Contact in Newton's method on the coupled system; see `kernels.newton.contact_newton` and, for search and pairs, `solve.collision`.

CCD limits every proposed motion, a predictor or a step, rod by rod. Motion of supports and obstacles is included. A world whose
predictor or support motion was limited has motion pending. Its target `Iterates.proposed` then differs from its positions: all terms
but contact are evaluated there, and contact is linear about the positions. The next direction begins with the remaining motion.
"""

import math

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.newton import contact_newton as kernels
from ddg_warp.scene.obstacles import Obstacle
from ddg_warp.solve.collision.ccd_bodies import number_bodies, number_units
from ddg_warp.solve.collision.contact_model import ContactModel
from ddg_warp.solve.collision.statistics import ContactStatistics
from ddg_warp.solve.linear.contact_hessian import ContactHessian
from ddg_warp.solve.linear.sparse_system import Sums
from ddg_warp.solve.newton.rod_newton import FIRST_EXACT_ITERATION
from ddg_warp.timers import timer

FAR = 16.0  # margins that a node moves, from which on a world has a single step fraction: candidates of longer motions are too many
# Where candidates still do not fit, motions are limited to LONGEST margins, then to a fraction SHORTER until they do.
LONGEST, SHORTER = 4096.0, 0.25
STIFFER = 100.0  # suggested stiffness factor where the minimum gap was reached: enough in five of five cases of cloth, 10 in four
# fractions of a failed step at which motions are tested: short against the first gap, then against the step
LOOKS = (*(2.0**-k for k in range(12, 3, -1)), *(k / 8 for k in range(1, 9)))
LEAST = 1e-3  # of the activation distance: gap that counts as minimum gap reached for a barrier
ROUNDING = 16.0  # ulps within which supports count as arrived


class NewtonContact:
    """Contact of a `CoupledNewton`.

    Args:
        iterates: `Iterates` at rest positions; rate: inverse time over which slips count (worlds,) [1/s].
        linear: scalar type of the linear algebra; psd: see `NewtonOptions`.

    Attributes:
        search, terms: candidates; contact potential and friction of active pairs.
        hessian: `ContactHessian` at the last iterate.
        bodies: body of each block of a world (blocks,), -1 for none; and the largest possible number of bodies.
        `bends`: True if the matrix has the geometric stiffness of pairs; see `kernels.collision.contact.geometric_stiffness`.
        `has_friction`: True with friction; rate: inverse time over which slips count (worlds,) [1/s].
        solutions: positions of the last step at which friction was updated, in order, for the reverse pass: `lags` - 1 of (W N,).
        farthest: [m] largest motion of nodes in worlds with a single step fraction, while candidates do not fit; see `has_overflow`.
        crossed: (1,) interpenetrating pairs refused in all steps so far; least: (1,) smallest gap [m].
    """

    def __init__(self, model, iterates, rate: wp.array, linear, psd: str):
        self.coupled, self._scene = model.coupled, model.scene
        self._moves, self._eps = bool(model.motions), model.types.eps
        coupled, host, real, device = model.coupled, model.coupled.host, model.coupled.real, model.coupled.device
        if host.frames:
            raise SceneError(
                "contact: a support on an oblique plane of symmetry does not go with it; use an axis of space"
            )
        # forces on obstacles are post-processing of states
        self.touch = ContactModel(coupled, linear, iterates.q, host.of_obstacles)
        self.search, self.terms = self.touch.search, self.touch.terms
        self.hessian = ContactHessian(self.terms, self.touch.shapes)
        self.has_friction, self.rate = host.touching.has_friction, rate
        worlds, updates = coupled.worlds, self.touch.law.friction_iterations - 1 if self.has_friction else 0

        def make(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        self._modes, self._curved, self._projected = (make(worlds, int) for _ in range(3))
        self.bends, self._late = psd != "gauss_newton", 0 if psd == "none" else FIRST_EXACT_ITERATION
        self._kept, self._gain = make((2, worlds), real), make(worlds, real)
        self.solutions, self._move = [wp.zeros_like(iterates.q) for _ in range(updates)], wp.zeros_like(iterates.q)
        self._way, self._pushed = (make(len(iterates.q), wp.types.vector(3, linear)) for _ in range(2))
        self._going = make(1, int)
        self._longest, self.farthest = make(worlds, real), math.inf
        self._braced = make(worlds, int)
        self.crossed, self.least = make(1, wp.int64), wp.full(1, math.inf, dtype=real, device=device)
        self.tally = ContactStatistics(self.terms)
        self._counts = self.crossed, self.least, self.search.searches, *self.tally.arrays
        self.bodies = number_bodies(host)
        unit, self._units = number_units(*self.bodies, host, model.motions)
        self._unit = wp.array(unit, dtype=int, device=device)
        support_blocks = np.concatenate([host.moving[:, 0], host.turning[:, 0]])
        self._nodes = wp.array(support_blocks.astype(np.int32), dtype=int, device=device)
        self._aims = make((max(1, len(support_blocks)), worlds), coupled.vector)
        built = kernels.world_kernels(real)
        (
            self._account,
            self._find_modes,
            self._find_predicted,
            self._depart,
            self._expect,
            self._refuse,
            self._find_curved,
            self._again,
            self._find_short,
            self._less,
            self._brace,
        ) = built
        self._kernels = list(built)
        built = kernels.block_kernels(real, linear, device_arrays.serial(device))
        (
            self._differ_gain,
            self._lessen,
            self._aim,
            self._push,
            self._land,
            self._arrive,
            self._stay,
            self._near,
            self._part,
            self._find_way,
            self._add,
            self._keep_solution,
        ) = built
        self._kernels += built
        self._dots = make((worlds, device_arrays.takers(coupled.blocks, device)), real)
        self._sum = Sums(worlds, self._dots.shape[1], real, device)
        self._least = LEAST * float(host.touching.range.min()) if self.touch.keep else -math.inf
        self._stiffest = float(host.touching.stiffness.max())

    @property
    def touching_bodies(self) -> int:
        """Number of bodies in a world."""
        return len(np.setdiff1d(self.bodies[0], [-1]))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        loaded = [*self._kernels, *self.hessian.kernels]
        return [*loaded, *self._sum.kernels, *self.search.kernels, *self.terms.kernels, *self.tally.kernels]

    def renew(self, before: wp.array) -> None:
        """Rebuild the BVHs of the search at positions `before`, on devices where searches only refit."""
        if self.coupled.device.is_cuda:
            self.search.rebuild(before)

    def see(self, x: wp.array) -> None:
        """Update the candidates at positions x, without a motion."""
        self.search.update(x)

    @timer("friction lag")
    def lag(self, x: wp.array, again: bool = False, rate: wp.array | None = None) -> None:
        """Update the friction lag (normal forces, tangents) at positions x, which belong to the motion that was limited last.

        Slips restart, unless the update is made `again` within a step. At the start of a step, `rate` is the previous step's; see
        `ContactPotential.lag`.
        """
        if self.has_friction:
            self.terms.lag(x, again, rate)

    def rest(self, iterates, islands) -> None:
        """Clear all pending motion: the target is the iterate itself."""
        wp.copy(iterates.proposed, iterates.q)
        islands.support_motion_pending.zero_()
        self._going.zero_()

    def lag_again(self, solution: wp.array, iterates, islands) -> None:
        """Update the friction lag at the iterate of converged worlds, and keep that in one of `solutions`."""
        self._sweep(self._keep_solution, [iterates.q, islands.substep_accepted, self.coupled.blocks], [solution])
        self.lag(iterates.q, again=True)
        self._launch(self._again, self.coupled.worlds, [islands.arrays[0]], [])

    def brace(self, dt: wp.array, islands) -> None:
        """Add inertia to the contact stiffness where the last trial reached the minimum gap, in a step of dt (worlds,) [s]."""
        if self.terms.heavy:
            outputs = [self._braced, self.terms.law.rate]
            self._launch(self._brace, self.coupled.worlds, [*islands.arrays, dt], outputs)

    @timer("CCD filter")
    def place(self, iterates, system, islands) -> None:
        """Limit the predictor by CCD, once supports are at their prescribed positions."""
        flags = islands.arrays[0]
        if len(self._nodes):
            inputs = [self._nodes, self.coupled.blocks, iterates.q]
            self._launch(self._aim, (len(self._nodes), self.coupled.worlds), inputs, [self._aims])
        self._launch(self._find_predicted, self.coupled.worlds, [flags], [self._modes, self._longest])
        self._cut(iterates, system, islands)
        self._launch(self._find_short, self.coupled.worlds, [self._modes, self.search.time], [flags])
        self._let_go(iterates, islands)

    @timer("contact")
    def evaluate(self, iterates, islands) -> None:
        """Evaluate energies, forces and factors of contact at the limited iterate."""
        if self.has_friction:
            self.terms.evaluate(iterates.q, self.rate, iterates=(islands.energy_buffer, islands.iteration))
        else:
            self.terms.evaluate(iterates.q)

    def account(self, norms, islands) -> None:
        """Add the energy change of contact to worlds, and the rounding floor."""
        inputs = [self.terms.energy, self.terms.gap, self._least, self.search.overflow]
        inputs += [islands.arrays[0], self._kept, norms.of_worlds[0], norms.of_worlds[1]]
        self._launch(self._account, self.coupled.worlds, inputs, [])

    @timer("contact")
    def assemble(self, iterates, islands) -> None:
        """Prepare the data that products and the preconditioner take from the last evaluation."""
        outputs = [self._curved, self._projected]
        self._launch(self._find_curved, self.coupled.worlds, [islands.arrays[0], self._late], outputs)
        self.hessian.linearise(iterates.q, self._curved if self.bends else None)
        self.hessian.assemble()

    def approach(self, iterates, system) -> None:
        """Subtract the resistance of contact against the remaining motion from the residual."""
        wp.capture_if(self._going, lambda: self._approach(iterates, system))

    def _approach(self, iterates, system) -> None:
        blocks, fixed, wanted = self.coupled.blocks, system.masks.fixed, system.wanted
        self._sweep(self._find_way, [iterates.q, iterates.proposed, wanted, blocks], [self._way])
        if len(self._nodes):
            inputs = [self._nodes, self._aims, iterates.q, fixed, wanted, blocks]
            self._launch(self._push, (len(self._nodes), self.coupled.worlds), inputs, [self._way])
        self._pushed.zero_()
        self.terms.product(self._way, self._pushed)
        self._sweep(self._lessen, [self._pushed, fixed, wanted, blocks], [system.rhs])

    def follow(self, system) -> None:
        """Add the remaining motion to the directions."""
        inputs, outputs = [self._way, system.wanted, self.coupled.blocks], [system.direction]
        wp.capture_if(self._going, lambda: self._sweep(self._add, inputs, outputs))

    @timer("CCD filter")
    def hold(self, iterates, search, system, islands) -> None:
        """Limit the trial step by CCD, and write its predicted decrease."""
        worlds, blocks, flags = self.coupled.worlds, self.coupled.blocks, islands.arrays[0]
        self._launch(self._find_modes, worlds, [flags], [self._modes, self._longest])
        self._launch(self._depart, worlds, [self._modes], [flags])
        if len(self._nodes):
            inputs = [self._nodes, self._aims, system.masks.fixed, self._modes, *islands.arrays, blocks]
            self._launch(self._land, (len(self._nodes), worlds), inputs, [iterates.q])
        self._cut(iterates, system, islands)
        self._let_go(iterates, islands)
        self._sweep(self._differ_gain, [system.rhs, iterates.q, iterates.base, self._modes, blocks], [self._dots])
        self._sum(self._dots, self._gain)
        inputs = [self._modes, self.search.time, self._gain]
        self._launch(self._expect, worlds, inputs, [*islands.arrays, search.stalled, self._projected])

    def _cut(self, iterates, system, islands) -> None:
        """Limit the proposed motion by CCD; `ahead` keeps the proposed target."""
        q, blocks, far = iterates.q, self.coupled.blocks, FAR * self.search.margin
        inputs = [q, iterates.base, self._unit, self.coupled.host.nodes, far, blocks]
        self._sweep(self._stay, inputs, [self._move, self._modes, iterates.proposed, self._longest])
        shorter = [self._modes, self._longest, self.farthest]
        if self.farthest < math.inf:
            self._sweep(self._near, [self._move, self._unit, *shorter, blocks], [q])
        self.search.filter(self._move, q, self._unit, self._modes, self._units, self.touch.keep)
        if self.farthest < math.inf:
            self._launch(self._less, self.coupled.worlds, shorter, [self.search.time])
        if len(self._nodes):
            inputs = [self._nodes, self._aims, system.masks.fixed, self._modes, ROUNDING * self._eps, blocks, q]
            self._launch(self._arrive, (len(self._nodes), self.coupled.worlds), inputs, [islands.arrays[0]])

    def share(self, before: np.ndarray, after: np.ndarray) -> float:
        """Return the CCD step fraction of a motion (3 W N,) that all worlds have in common. Not in a capture."""
        base = wp.array(before.reshape(-1, 3), dtype=self.coupled.vector, device=self.coupled.device)
        self._modes.fill_(kernels.SINGLE_FRACTION)
        move = after - before
        longest = float(np.abs(move).max())
        self.search.fit(base)
        while True:
            fraction = min(1.0, self.farthest / longest) if longest > 0.0 else 1.0
            q = wp.array(
                (before + fraction * move).reshape(-1, 3), dtype=self.coupled.vector, device=self.coupled.device
            )
            self.search.filter(base, q, self._unit, self._modes, self._units, self.touch.keep)
            if not self.search.fit(base, lambda: self._shorten(longest)):  # else the filter moved nothing
                return fraction * float(self.search.time.numpy().min())

    def _let_go(self, iterates, islands) -> None:
        """Reset the target to the iterate in worlds without pending motion."""
        self._going.zero_()
        inputs = [iterates.q, islands.arrays[0], self.coupled.blocks]
        self._sweep(self._part, inputs, [iterates.proposed, self._going])

    @timer("interpenetration check")
    def finish(self, before: wp.array, iterates, islands) -> None:
        """Refuse substeps with interpenetration."""
        self.search.check_crossings(before, iterates.q)
        inputs = [self.search.crossed, self.terms.gap, self.search.overflow, *islands.arrays]
        self._launch(self._refuse, self.coupled.worlds, inputs, [self.crossed, self.least])
        self.tally(islands.arrays[0])

    def statistics(self) -> dict:
        """Return the statistics of all steps so far, by name.

        Counts of searches, refused interpenetrations and present candidates. Smallest gap [m], infinite beyond the activation
        distance. Entries of `ContactStatistics.statistics`.
        """
        least = self.least.numpy()[0]
        return {
            "searches": int(self.search.searches.numpy()[0]),
            "refused_crossings": int(self.crossed.numpy()[0]),
            "smallest_gap": float(least) if least < least.dtype.type(self.search.reach) else math.inf,
            "candidates": sum(int(pairs.count.numpy()[0]) for pairs in self.search.lists),
        } | self.tally.statistics()

    def go_on(self, previous: "NewtonContact") -> None:
        """Continue the counts of a previous object."""
        for count, previous_count in zip(self._counts, previous._counts, strict=True):
            wp.copy(count, previous_count)

    def check(self, x: wp.array) -> None:
        """Refuse start positions with overlaps, or with gaps too small for a barrier. Reads from the device.

        Raises:
            SceneError: names the pair and by how much.
        """
        gap, pair = self.touch.closest(x)
        least = self._least if self.touch.keep else -self.touch.search.reach
        if gap <= least:
            meet = f"overlap by {-gap:.3g} m" if gap < 0.0 else "have no gap"
            if gap > 0.0:
                meet = f"are {gap:.3g} m apart, too close for a barrier, which needs {least:.3g} m,"
            raise SceneError(
                f"contact: {pair} {meet} at the start; separate them, as model.resolve_overlaps(state) does, give "
                "them a smaller radius, or exclude the pair by contact_between(..., ignore=True)"
            )

    def closest_pair(self, x: wp.array, reason: int) -> str:
        """Return a message on the closest pair at positions x, a likely cause of the failed `reason`, with a remedy.

        Empty where no pair is within range. Reads from the device.
        """
        gap, pair = self.touch.closest(x)
        if gap >= self.search.reach:
            return ""
        return f"the smallest gap, {gap:.3g} m, is between {pair}; {self._widen(gap) if reason == outcome.MINIMUM_GAP else ''}"

    def blocked(self, tangent, state, start: float, end: float) -> str:
        """Return the remedy for two fixed objects that motions drive into each other from `start` to `end`.

        Empty where there are none. Tests the fractions `LOOKS` of the interval, from a state at its start. Reads from the device.
        """
        for fraction in LOOKS if self._moves else ():
            moved_state = state.copy()
            tangent.move_supports(moved_state, start, start + fraction * (end - start))
            if remedy := self._driven(moved_state.coupled.q):
                return remedy
        return ""

    def _driven(self, x: wp.array) -> str:
        """Return the remedy for two overlapping fixed objects at positions x, at least one of them moved; else empty."""
        gap, pair, nodes = self.touch.closest_nodes(x)
        host, scene = self.coupled.host, self._scene
        if gap > max(self._least, 0.0) or not all(host.fixed[pair_nodes].all() for pair_nodes in nodes):
            return ""
        supports = [*scene.supports, *scene.shell_supports, *scene.ring_supports, *scene.obstacles]
        moved = {
            f"obstacle '{support.name}'" if isinstance(support, Obstacle) else f"support {number} ({support.call})"
            for number, (support, support_dofs) in enumerate(zip(supports, host.held, strict=True))
            if support.motion is not None
            and any(np.isin(pair_nodes, support_dofs.places).any() for pair_nodes in nodes)
        }
        if not moved:
            return ""
        return (
            f"{pair} are both fixed, and the motion of {' and of '.join(sorted(moved))} drives them into each other: change "
            "that motion, free one of them, or exclude the pair by contact_between(..., ignore=True), "
        )

    def _widen(self, gap: float) -> str:
        """Return remedies for a minimum gap reached, the best first; `gap` [m] is the smallest before the step."""
        if gap < self._least:
            return "separate them, as model.resolve_overlaps(state) does, "
        if self.terms.heavy:
            return f"give their contact a larger stiffness, such as {STIFFER * self._stiffest:.3g} N/m, or a larger range, "
        return (
            f"give their contact a larger stiffness, {STIFFER:g} times as much, or none for an automatic one, or a "
            "larger range, "
        )

    def _shorten(self, longest: float) -> bool:
        """Limit motions to less than `longest` [m] from now on; return False if that is short already."""
        longest, least = min(self.farthest, longest), FAR * self.search.margin
        if longest <= least:
            return False
        self.farthest = max(least, min(longest * SHORTER, LONGEST * self.search.margin))
        return True

    def has_overflow(self, x: wp.array, spare: bool = False) -> bool:
        """Return True if lists of pairs overflowed and have grown. Reads from the device.

        With `spare`, long motions are limited instead, so that fewer candidates are needed.
        """

        def shorten() -> bool:
            return self._shorten(float(self._longest.numpy().max()))

        grown = self.search.fit(x, shorten if spare else None)
        grown = self.terms.fit() or grown
        if grown:
            self.tally.forget()
        return grown

    def _sweep(self, kernel, inputs: list, outputs: list) -> None:
        coupled = self.coupled
        device_arrays.sweep(kernel, coupled.blocks, inputs, outputs, coupled.device, worlds=coupled.worlds)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device)
