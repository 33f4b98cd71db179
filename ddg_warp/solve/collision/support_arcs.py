"""Substeps that resolve the arcs of prescribed motions in contact.

CCD moves nodes straight. A node at the distance R from an axis that rotates by an angle a moves along an arc, which is off its chord
by the sagitta R (1 - cos(a / 2)). A step, or an increment of a static load, is therefore cut into 2^k equal substeps. In each, the
surfaces that a motion moves are off their chords by less than `SEGMENT` of the activation distance and of the thickness of possible
pairs.

Motions given as functions of time are sampled at uneven times until they are resolved. Grips rotate at a constant rate; their
substeps are found on the device, world by world (`kernels.forces.prescribed_motion.grip_kernel`). Distances from an axis are
measured at rest. A surface that only rotates about its axis of symmetry (ball, capsule, drum) needs no substeps.
"""

import math
from itertools import pairwise

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from ddg_warp.errors import SolverError
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.forces.prescribed_motion import MAX_SUBSTEPS, SLACK
from ddg_warp.scene.grip import Grip
from ddg_warp.solve.collision.swept_surfaces import Swept, swept_surfaces
from ddg_warp.solve.forces.prescribed_motion import rotations_between

PART = 0.125  # of the activation distance and the thickness: allowed sagitta
TIMES = np.array([0.0, 0.13, 0.31, 0.52, 0.68, 0.87, 1.0])  # sampling times of an interval


class Arcs:
    """Substeps of time steps and static increments of a model with contact.

    Attributes:
        moved: `Swept` of every motion that moves surfaces.
        of_grips: device data of every grip. Node positions relative to its pivot (grips, P), allowed sagitta and largest rotation of
            a substep (worlds, grips).
    """

    def __init__(self, model):
        self.model, self._version, self._allowed, self._largest = model, None, [], []
        self.moved = swept_surfaces(model)
        motions = [swept.motion for swept in self.moved]
        self._of_grip = [motions.index(grip) if grip in motions else -1 for grip in model.grips]
        real, device, grips = model.types.real, model.wp_device, len(model.grips)
        arms = np.zeros((grips, max([1, *(len(swept.points) for swept in self.moved)]), 3))
        for grip_arms, i in zip(arms, self._of_grip, strict=True):
            if i >= 0:
                grip_arms[: len(self.moved[i].points)] = self.moved[i].arms
        numbers = (wp.zeros((model.worlds, grips), dtype=real, device=device) for _ in range(2))
        self.of_grips = [wp.array(arms, dtype=wp.types.vector(3, real), device=device), *numbers]
        self._renew()

    def outdate(self) -> None:
        """Have the contact parameters read from the device before the next step."""
        self._version = None

    def _renew(self) -> None:
        """Update the contact parameters if one has changed."""
        if self._version == self.model.version:
            return
        self._version = self.model.version
        self._allowed = [self._room(swept) for swept in self.moved]
        self._largest = [_largest_rotations(*each) for each in zip(self.moved, self._allowed, strict=True)]
        if self._of_grip:
            allowed, most = np.full((2, self.model.worlds, len(self._of_grip)), np.inf)
            for g, i in enumerate(self._of_grip):
                if i >= 0:
                    allowed[:, g], most[:, g] = self._allowed[i], self.moved[i].most
            for array, values in zip(self.of_grips[1:], (allowed, most), strict=True):
                array.assign(values)

    def _room(self, swept: Swept) -> np.ndarray:
        """Return the allowed sagitta of surfaces in every world (worlds,) [m], infinite if nothing can meet them."""
        coupled, contact, worlds = self.model.coupled, self.model.coupled.host.contact_parameters, self.model.worlds
        count = len(contact.names)
        within = coupled.contact_parameters["range"].numpy().reshape(worlds, count, count)
        radii = coupled.contact_parameters["radius"].numpy().reshape(worlds, -1)
        least = np.stack([radii[:, contact.group == g].min(1) for g in range(count)], 1)
        first, second = contact.meeting
        meets = np.isin(first, swept.groups) | np.isin(second, swept.groups)
        first, second = first[meets], second[meets]
        thickness = least[:, first] + least[:, second]
        return PART * np.minimum(within[:, first, second], thickness).min(1, initial=np.inf)

    def levels(self, t0: float, t1: float, load_steps: int = 0) -> np.ndarray:
        """Return log2 of the number of substeps that resolve functions of time from t0 to t1, of every world (worlds,).

        Args:
            t0, t1: start and end time of a step.
            load_steps: number of static load increments, one of which this is.

        Raises:
            SolverError: more than `MAX_SUBSTEPS` would be needed; names the object, its rotation, and a step that is short enough.
        """
        self._renew()
        result = np.zeros(self.model.worlds, int)
        for swept, allowed, largest in zip(self.moved, self._allowed, self._largest, strict=True):
            if largest is not None:
                result = np.maximum(result, _levels_of(swept, allowed, largest, t0, t1, load_steps))
        return result

    def increments(self, state, ends: np.ndarray | None, start: float, end: float, load_steps: int) -> int:
        """Return the number of increments of a static load that resolves `load_steps` from `start` to `end`.

        Args:
            state: at the start; ends: poses of grips at the end (worlds, grips, 6), None without motion.

        Raises:
            SolverError: as of `levels`.
        """
        if start == end or not self.moved:
            return load_steps
        load_factors = np.linspace(start, end, load_steps + 1).tolist()
        substeps = 2 ** max(int(self.levels(*each, load_steps).max()) for each in pairwise(load_factors))
        if ends is None:
            return load_steps * substeps
        begin = state.poses().reshape(self.model.worlds, -1, 6)
        turns = rotations_between(begin, np.broadcast_to(ends, begin.shape))
        for w, g in np.argwhere(turns.any(-1)):
            if (i := self._of_grip[g]) < 0:
                continue
            angle = float(np.linalg.norm(turns[w, g]))
            axis = Rotation.from_rotvec(begin[w, g, 3:]).inv().apply(turns[w, g] / angle)
            needed = SLACK * angle / load_steps / largest_rotation(self.moved[i], self._allowed[i][w], axis)
            if needed > MAX_SUBSTEPS:
                raise _refusal(
                    self.moved[i], angle, f"load_steps = {math.ceil(load_steps * needed / MAX_SUBSTEPS)} or more"
                )
            substeps = max(substeps, 2 ** max(0, math.ceil(math.log2(needed))))
        return load_steps * substeps

    def failure(self, world: int) -> str:
        """Return the remedy for a failed world with a grip that rotated too far."""
        self._renew()
        turns = [(largest_rotation(self.moved[i], self._allowed[i][world]), i) for i in self._of_grip if i >= 0]
        turn, i = min(turns)
        return (
            f"{self.moved[i].label} rotates farther in a step than {MAX_SUBSTEPS} substeps resolve; rotate its grip by at most "
            f"{_rounded_down(MAX_SUBSTEPS * turn):g} rad in a step, or give contact a larger range"
        )


def largest_rotation(swept: Swept, allowed: float, axis: np.ndarray | None = None) -> float:
    """Return the largest rotation of a substep about an axis at rest (default: any) for an allowed sagitta [m]."""
    far = np.linalg.norm(swept.arms if axis is None else np.cross(axis, swept.arms), axis=-1).max()
    if 2.0 * far <= allowed:
        return swept.most
    return min(swept.most, 4.0 * math.asin(math.sqrt(0.5 * min(1.0, allowed / far))))


def _largest_rotations(swept: Swept, allowed: np.ndarray) -> np.ndarray | None:
    """Return the largest rotation of a substep (worlds,) of a function of time; None for grips, or if nothing can meet the surface."""
    if isinstance(swept.motion, Grip) or not np.isfinite(allowed).any():
        return None
    if swept.motion.by_rod:  # chords of nodes are sufficient
        return np.full(len(allowed), np.inf)
    return np.array([largest_rotation(swept, each, swept.motion.unit) for each in allowed])


def _levels_of(
    swept: Swept, allowed: np.ndarray, largest: np.ndarray, t0: float, t1: float, load_steps: int
) -> np.ndarray:
    """Return log2 of the number of substeps (worlds,) that resolve a function of time."""
    result, coarse, level = np.zeros(len(allowed), int), np.ones(len(allowed), bool), 0
    while True:
        off, turn = _chords(swept, t0, t1, level)
        coarse &= (off > allowed) | (SLACK * turn > largest)
        if not coarse.any():
            return result
        if 2**level == MAX_SUBSTEPS:
            excess = float(np.maximum(turn / largest, np.sqrt(off / allowed)).max())
            remedy = f"dt = {_rounded_down(abs(t1 - t0) / excess):g} s or less"
            if load_steps:
                remedy = f"load_steps = {math.ceil(load_steps * excess)} or more"
            jump_time = swept.motion.jump(t0, t1)
            if jump_time is not None:
                remedy = f"a motion that does not jump, as this one at t = {jump_time:g}, such as a ramp over the step"
            raise _refusal(swept, _chords(swept, t0, t1, 0)[1], remedy)
        level += 1
        result[coarse] = level


def _refusal(swept: Swept, turn: float, remedy: str) -> SolverError:
    move = f"rotates by {turn / (2.0 * math.pi):.3g} turns" if turn else "moves along arcs"
    return SolverError(
        f"turned_too_far: {swept.label} {move} in a step, farther than {MAX_SUBSTEPS} substeps resolve; take {remedy}, "
        "or give contact a "
        "larger range",
        outcome=outcome.NAMES[outcome.ROTATED_TOO_FAR],
    )


def _rounded_down(value: float) -> float:
    """Return a positive number with two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / unit) * unit


def _chords(swept: Swept, t0: float, t1: float, level: int) -> tuple[float, float]:
    """Return the largest sagitta of nodes [m] and the largest rotation [rad] in 2^level intervals from t0 to t1.

    A motion that only rotates has a sagitta of 0: the rotation is sufficient.
    """
    motion, count = swept.motion, 2**level
    times = (t0 + (t1 - t0) * (np.arange(count)[:, None] + TIMES) / count).ravel().tolist()
    if motion.by_rod:
        path = np.stack([motion.place(t, swept.points, swept.rows) for t in times])
        return _sagitta(path.reshape(count, len(TIMES), -1, 3), alone=True), 0.0
    angles = np.array([motion.angle(t) for t in times] if motion.turns else [0.0] * len(times), float)
    # the angle alone counts revolutions between two samples
    turn = float(np.ptp(angles.reshape(count, -1), axis=-1).max())
    if not motion.shifts:
        return 0.0, turn
    shifts = np.array([motion.translation(t) for t in times], float).reshape(len(times), -1, 3)
    if motion.count is not None:
        shifts = shifts[:, swept.rows]
    positions = shifts + _rotated(motion.unit, angles, swept.arms) if turn else shifts
    # a rigid body moves along its chords as a whole
    return _sagitta(positions.reshape(count, len(TIMES), -1, 3), alone=motion.count is not None), turn


def _sagitta(path: np.ndarray, alone: bool) -> float:
    """Return the largest distance [m] of paths (intervals, times, P, 3) from their chords, for points `alone` or as a rigid body."""
    path = path - path[:, :1]
    chord = path[:, -1:]
    along, square = (path * chord).sum(-1, keepdims=True), (chord * chord).sum(-1, keepdims=True)
    if not alone:
        along, square = along.sum(-2, keepdims=True), square.sum(-2, keepdims=True)
    weight = np.clip(along / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
    return float(np.sqrt(np.square(path - weight * chord).sum(-1).max()))


def _rotated(axis: np.ndarray, angles: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return arms (P, 3) rotated about an axis by angles (n,): (n, P, 3)."""
    along = np.outer(arms @ axis, axis)
    cos, sin = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    return along + cos * (arms - along) + sin * np.cross(axis, arms)
