"""Messages on contact: overlaps at the start, closest pairs of failed steps, and motions that drive supports together."""

import math

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.scene.descriptions import supports_of
from ddg_warp.scene.obstacles import Obstacle

STIFFER = 100.0  # suggested stiffness factor where the minimum gap was reached: enough in five of five cases of cloth, 10 in four
# fractions of a failed step at which motions are tested: short against the first gap, then against the step
LOOKS = (*(2.0**-k for k in range(12, 3, -1)), *(k / 8 for k in range(1, 9)))
LEAST = 1e-3  # of the activation distance: gap that counts as minimum gap reached for a barrier


class ContactDiagnosis:
    """Likely causes of failures in contact, with remedies. Reads from the device.

    Args:
        `touch`: `ContactModel` of the model.

    Attributes:
        least: gap that counts as minimum gap reached [m]; minus infinity for a penalty.
    """

    def __init__(self, model, touch):
        self.coupled, self._scene, self._moves, self.touch = model.coupled, model.scene, bool(model.motions), touch
        contact_parameters = model.coupled.host.contact_parameters
        self.least = LEAST * float(contact_parameters.range.min()) if touch.min_separation_fraction else -math.inf
        self._stiffest = float(contact_parameters.stiffness.max())

    def check(self, x: wp.array) -> None:
        """Refuse start positions with overlaps, or with gaps too small for a barrier.

        Raises:
            SceneError: names the pair and by how much.
        """
        gap, pair = self.touch.closest(x)
        least = self.least if self.touch.min_separation_fraction else -self.touch.search.search_distance
        if gap <= least:
            meet = f"overlap by {-gap:.3g} m" if gap < 0.0 else "have no gap"
            if gap > 0.0:
                meet = f"are {gap:.3g} m apart, too close for a barrier, which needs {least:.3g} m,"
            raise SceneError(
                f"contact: {pair} {meet} at the start; separate them, as model.resolve_overlaps(state) does, give "
                "them a smaller radius, or exclude the pair by contact_between(..., ignore=True), or the roots of rods by root_length"
            )

    def closest_pair(self, x: wp.array, reason: int) -> str:
        """Return a message on the closest pair at positions x, a likely cause of the failed `reason`, with a remedy.

        Empty where no pair is within range.
        """
        gap, pair = self.touch.closest(x)
        if gap >= self.touch.search.search_distance:
            return ""
        return f"the smallest gap, {gap:.3g} m, is between {pair}; {self._widen(gap) if reason == outcome.MINIMUM_GAP else ''}"

    def blocked(self, tangent, state, start: float, end: float) -> str:
        """Return the remedy for two fixed objects that motions drive into each other from `start` to `end`.

        Empty where there are none. Tests the fractions `LOOKS` of the interval, from a state at its start.
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
        if gap > max(self.least, 0.0) or not all(host.fixed[pair_nodes].all() for pair_nodes in nodes):
            return ""
        supports = supports_of(scene)
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
        if gap < self.least:
            return "separate them, as model.resolve_overlaps(state) does, "
        if self.touch.terms.heavy:
            return f"give their contact a larger stiffness, such as {STIFFER * self._stiffest:.3g} N/m, or a larger range, "
        return (
            f"give their contact a larger stiffness, {STIFFER:g} times as much, or none for an automatic one, or a "
            "larger range, "
        )
