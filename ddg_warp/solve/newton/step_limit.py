"""CCD step fractions of the coupled system: limits of every proposed motion, a predictor or an update."""

import math
from collections.abc import Callable

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.contact_newton import SINGLE_FRACTION, limit_kernels
from ddg_warp.solve.collision.ccd_bodies import number_units

FAR = 16.0  # margins that a node moves, from which on a world has a single step fraction: candidates of longer motions are too many
# Where candidates still do not fit, motions are limited to LONGEST margins, then to a fraction SHORTER until they do.
LONGEST, SHORTER = 4096.0, 0.25
ARC_ROUNDS = 2  # most searches along straight motions to the arcs of limited rigid bodies


class StepLimit:
    """CCD limit of proposed motions, by one fraction for each CCD body or each world.

    Args:
        `touch`: `ContactModel`, whose search limits motions; bodies: see `ccd_bodies.number_bodies`.

    Attributes:
        modes: (worlds,) whether a world moves, and by how many fractions; see `kernels.newton.contact_newton`.
        min_separation_fraction: fraction of the gap that every pair keeps; see `ContactModel`.
        farthest: [m] largest motion of nodes in worlds with a single step fraction, while candidates do not fit.
    """

    def __init__(self, model, touch, bodies: tuple[np.ndarray, int]):
        self.coupled, self.search = model.coupled, touch.search
        self.min_separation_fraction = touch.min_separation_fraction
        real, device = self.coupled.real, self.coupled.device
        ccd_body, self._num_ccd_bodies = number_units(*bodies, self.coupled.host, model.motions)
        self._ccd_body = wp.array(ccd_body, dtype=int, device=device)
        self._start = wp.zeros(self.coupled.worlds * self.coupled.blocks, dtype=self.coupled.vector, device=device)
        self.modes = wp.zeros(self.coupled.worlds, dtype=int, device=device)
        self._longest, self.farthest = wp.zeros(self.coupled.worlds, dtype=real, device=device), math.inf
        self._fractions = wp.zeros_like(self._longest)
        self.kernels = limit_kernels(real, device_arrays.serial(device))
        self._find_modes, self._find_predicted, self._stay, self._near, self._less = self.kernels[:5]
        self._find_short, self._combine = self.kernels[5:]

    def begin(self, islands, pending, predictor: bool = False) -> None:
        """Find the worlds with a proposed motion: of an update, or the predictor of a step; reset `PendingMotion.going`."""
        kernel = self._find_predicted if predictor else self._find_modes
        self._launch(kernel, [islands.arrays[0]], [self.modes, self._longest, pending.going])

    def __call__(self, iterates, place: Callable[[], None] | None = None, rigid_bodies=None) -> None:
        """Limit the proposed motion from `base` to `q`; `proposed` keeps the proposed end.

        Args:
            `place`: moves carried nodes of rigid bodies to q. A limited body ends on its arc, next to the straight motions that have
                been searched. Its straight motions to there are then limited again, up to `ARC_ROUNDS` times.
            rigid_bodies: `RigidBodies`, whose rotations are bounded, or None.
        """
        q, blocks, far = iterates.q, self.coupled.blocks, FAR * self.search.margin
        inputs = [q, iterates.base, self._ccd_body, self.coupled.host.nodes, far, blocks]
        self.coupled.sweep(self._stay, inputs, [self._start, self.modes, iterates.proposed, self._longest])
        if place:
            bodies = self._ccd_body, self._num_ccd_bodies
            rigid_bodies.bound_rotations(self._start, q, *bodies, self.modes)
            place()
        shorter = [self.modes, self._longest, self.farthest]
        if self.farthest < math.inf:
            self.coupled.sweep(self._near, [self._start, self._ccd_body, *shorter, blocks], [q])
        self.search.filter(
            self._start, q, self._ccd_body, self.modes, self._num_ccd_bodies, self.min_separation_fraction
        )
        if self.farthest < math.inf:
            self._launch(self._less, shorter, [self.search.time])
        if place:
            rigid_bodies.note_fractions(self.search.time)
            self._follow_arcs(q, place)

    def _follow_arcs(self, q: wp.array, place: Callable[[], None]) -> None:
        """Move the limited bodies to the arcs, and limit the straight motions to there."""
        for _ in range(ARC_ROUNDS):
            place()
            wp.copy(self._fractions, self.search.time)
            self.search.filter(
                self._start, q, self._ccd_body, self.modes, self._num_ccd_bodies, self.min_separation_fraction
            )
            self._launch(self._combine, [self._fractions], [self.search.time])
        place()

    def mark_limited(self, islands) -> None:
        """Mark worlds with a limited predictor: their motion is pending."""
        self._launch(self._find_short, [self.modes, self.search.time], [islands.arrays[0]])

    def fraction(self, before: np.ndarray, after: np.ndarray) -> float:
        """Return the CCD step fraction of a motion (3 W N,) that all worlds have in common. Not in a capture."""

        def blocks(values):
            return wp.array(values.reshape(-1, 3), dtype=self.coupled.vector, device=self.coupled.device)

        base, move = blocks(before), after - before
        self.modes.fill_(SINGLE_FRACTION)
        longest = float(np.abs(move).max())
        self.search.fit(base)
        while True:
            fraction = min(1.0, self.farthest / longest) if longest > 0.0 else 1.0
            q = blocks(before + fraction * move)
            self.search.filter(base, q, self._ccd_body, self.modes, self._num_ccd_bodies, self.min_separation_fraction)
            if not self.search.fit(base, lambda: self._shorten(longest)):  # else the filter moved nothing
                return fraction * float(self.search.time.numpy().min())

    def shorten(self) -> bool:
        """Limit the motions tried last to less from now on; return False if they are short already."""
        return self._shorten(float(self._longest.numpy().max()))

    def _shorten(self, longest: float) -> bool:
        """Limit motions to less than `longest` [m] from now on; return False if that is short already."""
        longest, least = min(self.farthest, longest), FAR * self.search.margin
        if longest <= least:
            return False
        self.farthest = max(least, min(longest * SHORTER, LONGEST * self.search.margin))
        return True

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.coupled.worlds, inputs, outputs, device=self.coupled.device)
