"""Prescribed motion of supports on a device."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.compile.boundary_conditions import pose_starts
from ddg_warp.errors import SolverError
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.forces import prescribed_motion as motion
from ddg_warp.kernels.forces.prescribed_motion import COUNTED, HALF
from ddg_warp.model.state import State


def poses(model, t0: float, t1: float, start: float = 0.0, part: float = 1.0) -> np.ndarray:
    """Return poses of all motions between t0 and t1 (rows, 21), over a fraction `part` of a step; see `Motion.pose`.

    Raises:
        SolverError: a motion is not finite, or leaves the plane of a planar scene; names the function and the time.
    """
    rows = np.concatenate([motion.pose(t0, t1, start, part) for motion in model.motions])
    if model.scene.dimension == 2 and rows[:, 19].any():
        raise SolverError(
            f"a motion's translation has a y component at t = {t1:g}: {tuple(rows[np.argmax(np.abs(rows[:, 19])), 18:].tolist())}; "
            "a scene of dimension 2 stays in the plane of x and z, give 0",
            outcome=argument_checks.PRESCRIBED,
        )
    return rows


def jump_between(model, t0: float, t1: float) -> str:
    """Return the message on a step or increment with a jump of a motion; empty without."""
    for moved in model.motions:
        time = moved.jump(t0, t1)
        if time is not None:
            return (
                f"a motion of its supports jumps at t = {time:g}, which no step can follow: make it continuous, such as a ramp over a "
                "few steps"
            )
    return ""


def counts_revolutions(poses: np.ndarray) -> bool:
    """Return True if a rotation vector of poses (..., 6) exceeds the range of orientations."""
    return bool((np.square(poses[..., 3:]).sum(-1) > COUNTED**2).any())


def rotations_between(begin: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the shorter rotation vectors (..., 3) of grips between poses (..., 6); see `Grip`.

    Raises:
        SolverError: rotation vectors differ by more than half a revolution, so the sense is ambiguous.
    """
    from scipy.spatial.transform import Rotation

    first, last = (np.array(poses[..., 3:]).reshape(-1, 3) for poses in (begin, ends))
    counted = np.linalg.norm(last - first, axis=-1)
    long = np.flatnonzero((np.linalg.norm(last, axis=-1) > COUNTED) & (counted > COUNTED))
    if long.size:
        grips, turns = begin.shape[-2], counted[long[0]] / (2.0 * np.pi)
        world = f" of world {long[0] // grips}" if len(first) > grips else ""
        raise SolverError(
            f"turned_too_far: poses of grip {long[0] % grips}{world} differ by {turns:.3g} turns, from the rotation vector "
            f"{np.round(first[long[0]], 6).tolist()} to {np.round(last[long[0]], 6).tolist()}, and a grip takes the shorter rotation, "
            f"half a turn at most; go in {int(np.ceil(2.0 * turns))} steps or more, or give the shorter rotation vector",
            outcome=outcome.NAMES[outcome.ROTATED_TOO_FAR],
        )
    turn = (Rotation.from_rotvec(last) * Rotation.from_rotvec(first).inv()).as_rotvec()
    half = np.linalg.norm(turn, axis=-1) > np.pi - 2.0 * HALF
    turn[half & (((last - first) * turn).sum(-1) < 0.0)] *= -1.0
    return turn.reshape(begin.shape[:-1] + (3,))


def poses_between(state: State, ends: np.ndarray, start: float, end: float) -> Callable:
    """Return poses of grips (worlds, grips, 6) as a function of the load parameter, from the state to `ends`.

    Raises:
        SolverError: as `rotations_between`.
    """
    from scipy.spatial.transform import Rotation

    begin = state.poses().reshape(state.model.worlds, -1, 6)
    ends = np.array(np.broadcast_to(ends, begin.shape))
    first, turn = Rotation.from_rotvec(begin[..., 3:].reshape(-1, 3)), rotations_between(begin, ends).reshape(-1, 3)

    def poses(load_factor: float) -> np.ndarray:
        if load_factor == end:
            return ends
        s = (load_factor - start) / (end - start)
        rotation = (Rotation.from_rotvec(s * turn) * first).as_rotvec().reshape(*begin.shape[:2], 3)
        return np.concatenate([begin[..., :3] + s * (ends - begin)[..., :3], rotation], axis=-1)

    return poses


class Motion:
    """Prescribed motion of nodes and twist angles of a rod group or of the coupled system.

    Poses at both ends of a step come from the host, poses of grips from the states. The device interpolates per island.

    Args:
        part: `RodGroup` or `CoupledModel`.

    Attributes:
        pose: see `kernels.forces.prescribed_motion`; with grips per world, `stride` rows apart.
        rows: number of poses of an interval.
        levels: log2 of the number of intervals of every world (worlds,).
    """

    def __init__(self, model, part, midpoint: bool = False):
        host, real = part.host, model.types.real
        self.model, self.part = model, part
        starts = pose_starts(model.motions)
        self.rows, self.levels, self._grip, self._of_arcs = int(starts[-1]), np.zeros(model.worlds, int), None, []
        if model.grips:
            grips = np.full(self.rows, -1)
            places = [i for i, moved in enumerate(model.motions) if moved in model.grips]
            grips[starts[places]] = np.arange(len(places))
            self._grips = self._list(grips).flatten()
            self._grip = motion.grip_kernel(real, False)
            makes = [(wp.types.vector(3, real), 2), *[(real, 2)] * 2, (int, 2), (real, 2), (wp.int64, 1)]
            self._of_arcs = [wp.zeros((1,) * ndim, dtype=dtype, device=model.wp_device) for dtype, ndim in makes]
        self._make_room(0)
        if model.grips:
            self._hand(0.0, 0.0)
        self._timed = len(model.grips) < len(model.motions)
        self._nodes, self._angles = motion.support_kernels(part.dim, real, midpoint)
        places, angles = host.moving[:, 0], host.turning[:, 0]
        self.nodes = self._list(host.index(places), host.moving[:, 1:])
        self.rest = self._vectors(host.points(places))
        edges = angles - host.nodes
        self.angles = self._list(host.index(angles), edges, host.edge_ends(angles), host.turning[:, 1])
        self.directors = self._vectors(host.frame[:3].reshape(3, -1)[:, edges].T)

    def _make_room(self, level: int) -> None:
        """Allocate the poses of 2^level intervals, and of all coarser levels."""
        real, device, count = self.model.types.real, self.model.wp_device, (2 ** (level + 1) - 1) * self.rows
        self._shared = wp.zeros((count, motion.POSE), dtype=real, device=device)
        self._host = wp.zeros_like(self._shared, device="cpu")
        self._rows = self._host.numpy()
        self.pose, self.stride = self._shared, 0
        if self._grip:
            self.pose = wp.zeros((self.model.worlds * count, motion.POSE), dtype=real, device=device)
            self.stride = count

    def _list(self, *columns: np.ndarray) -> wp.array:
        return wp.array(np.column_stack(columns).astype(np.int32), dtype=int, device=self.model.wp_device)

    def _vectors(self, values: np.ndarray) -> wp.array:
        vector = wp.types.vector(3, self.model.types.real)
        return wp.array(np.ascontiguousarray(values), dtype=vector, device=self.model.wp_device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._nodes, *([self._angles] if len(self.angles) else []), *([self._grip] if self._grip else [])]

    def go_by(self, source: "Motion") -> None:
        """Read the poses of another `Motion` of the same model."""
        self.pose, self.stride, self._timed, self._grip = source.pose, source.stride, False, None

    def resolve_grips(self, of_arcs: list) -> None:
        """Compute substeps in the kernel of grips by arrays of `Arcs`; the last ones are islands and tally."""
        if self._grip:
            self._grip, self._of_arcs = motion.grip_kernel(self.model.types.real, True), of_arcs

    def upload(self, t0: float, t1: float) -> None:
        """Upload poses between t0 and t1 of motions in time."""
        if self._timed:
            self._hand(t0, t1)

    def divide(self, levels: np.ndarray, t0: float, t1: float) -> bool:
        """Upload poses of 2^level intervals of a step per world (worlds,), after `upload`; return True if arrays grew."""
        self.levels, most = levels, int(levels.max())
        grown = self._shared.shape[0] < (2 ** (most + 1) - 1) * self.rows
        if grown:
            self._make_room(most)
        for level in np.unique(levels[levels > 0]).tolist():
            count = 2**level
            times = t0 + (t1 - t0) * np.arange(count + 1) / count
            times[-1] = t1
            for k, (start, end) in enumerate(pairwise(times.tolist())):
                first = (count - 1 + k) * self.rows
                self._rows[first : first + self.rows] = poses(self.model, start, end, k / count, 1.0 / count)
        if most:
            self._hand(t0, t1)
        return grown

    def _hand(self, t0: float, t1: float) -> None:
        self._rows[: self.rows] = poses(self.model, t0, t1)
        # from unpinned memory, so that the next rows may overwrite it at once
        wp.copy(self._shared, self._host)

    def follow(self, before: State, after: State) -> None:
        """Write poses of every world over a step between two states, with grips; capturable."""
        if self._grip:
            of_arcs = self._of_arcs
            inputs = [
                self._grips,
                len(self.model.grips),
                self._shared,
                before.grips.pose,
                after.grips.pose,
                *of_arcs[:3],
            ]
            self._launch(self._grip, self._shared, inputs, [self.pose, *of_arcs[3:]])

    def apply(self, islands, x: wp.array, *directed: wp.array) -> None:
        """Move fixed nodes and angles to the end of the substep of each island: see `place` and `direct`."""
        self.place(islands, x)
        self.direct(islands, x, *directed)

    def place(self, islands, x: wp.array) -> None:
        """Move fixed nodes x."""
        inputs = [self.nodes, self.rest, self.pose, self.stride, self.rows, *islands.arrays, self.part.world_columns]
        self._launch(self._nodes, self.nodes, inputs, [x])

    def direct(self, islands, x: wp.array, frame: wp.array, theta: wp.array) -> None:
        """Set fixed angles theta, from lagged frames to the tangents of edges in x."""
        if len(self.angles):
            inputs = [self.angles, self.directors, self.pose, self.stride, self.rows]
            inputs += [*islands.arrays, self.part.world_columns, x, frame]
            self._launch(self._angles, self.angles, inputs, [theta])

    def put(self, state: State, t0: float, t1: float, *arrays: wp.array) -> None:
        """Apply the motion between t0 and t1 to arrays of a state."""
        self.upload(t0, t1)
        self.follow(state, state)
        islands = Islands(self.part.columns, self.model.types.real, self.model.wp_device)
        islands.substep_fraction.fill_(1.0)
        self.apply(islands, *arrays)

    def _launch(self, kernel, where: wp.array, inputs: list, outputs: list) -> None:
        dim = (len(where), self.model.worlds)
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)
