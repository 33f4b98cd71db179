"""Motion of supports on a device."""

from collections.abc import Callable

import numpy as np
import warp as wp

from ddg_warp import arguments
from ddg_warp.compile.conditions import pose_starts
from ddg_warp.errors import SolverError
from ddg_warp.kernels import motion
from ddg_warp.kernels.islands import Islands
from ddg_warp.model.state import State


def poses(model, t0: float, t1: float) -> np.ndarray:
    """Poses of all motions of a model between t0 and t1 (rows, 21).

    Raises:
        SolverError: a motion has no finite value, or leaves the plane of a planar scene; names the function and the time.
    """
    rows = np.concatenate([motion.pose(t0, t1) for motion in model.motions])
    if model.scene.dimension == 2 and rows[:, 19].any():
        raise SolverError(
            f"a motion's translation has a part along y at t = {t1:g}: {tuple(rows[np.argmax(np.abs(rows[:, 19])), 18:].tolist())}; "
            "a scene of dimension 2 stays in the plane of x and z, give 0",
            outcome=arguments.PRESCRIBED,
        )
    return rows


def jump_between(model, t0: float, t1: float) -> str:
    """What to tell of a step or an increment that failed because a motion jumps in it; empty where none does."""
    for moved in model.motions:
        at = moved.jump(t0, t1)
        if at is not None:
            return (
                f"a motion of its supports jumps at t = {at:g}, which no step can follow: make it continuous, such as a ramp over a "
                "few steps"
            )
    return ""


def poses_between(state: State, ends: np.ndarray, start: float, end: float) -> Callable:
    """Poses of grips (worlds, grips, 6) by load parameter, from those of a state at `start` to `ends` at `end`: see `Grip`."""
    from scipy.spatial.transform import Rotation

    begin = state.poses().reshape(state.model.worlds, -1, 6)
    ends = np.array(np.broadcast_to(ends, begin.shape))
    first, last = (Rotation.from_rotvec(poses[..., 3:].reshape(-1, 3)) for poses in (begin, ends))
    turn = (last * first.inv()).as_rotvec()

    def poses(at: float) -> np.ndarray:
        if at == end:
            return ends
        s = (at - start) / (end - start)
        rotation = (Rotation.from_rotvec(s * turn) * first).as_rotvec().reshape(*begin.shape[:2], 3)
        return np.concatenate([begin[..., :3] + s * (ends - begin)[..., :3], rotation], axis=-1)

    return poses


class Motion:
    """Motion of the held nodes and angles of a group of rods or of a net.

    Poses at both ends of a step come from the host, those of grips from the states there; where supports are in between is found on the
    device, island by island.

    Args:
        part: `Group` or `DeviceNet`.

    Attributes:
        pose: see `kernels.motion`; with grips, of every world, `stride` rows apart.
    """

    def __init__(self, model, part, midpoint: bool = False):
        host, real = part.host, model.types.real
        self.model, self.part = model, part
        starts = pose_starts(model.motions)
        self._shared = wp.zeros((starts[-1], motion.POSE), dtype=real, device=model.wp_device)
        self._host = wp.zeros_like(self._shared, device="cpu")
        self._rows = self._host.numpy()
        self.pose, self.stride, self._grip = self._shared, 0, None
        if model.grips:
            grips = np.full(starts[-1], -1)
            places = [i for i, moved in enumerate(model.motions) if moved in model.grips]
            grips[starts[places]] = np.arange(len(places))
            self.stride, self._grips = len(grips), self._list(grips).flatten()
            self.pose = wp.zeros((model.worlds * len(grips), motion.POSE), dtype=real, device=model.wp_device)
            self._grip = motion.grip_kernel(real)
            self._hand(0.0, 0.0)
        self._timed = len(model.grips) < len(model.motions)
        self._nodes, self._angles = motion.support_kernels(part.dim, real, midpoint)
        places, angles = host.moving[:, 0], host.turning[:, 0]
        self.nodes = self._list(host.index(places), host.moving[:, 1:])
        self.rest = self._vectors(host.points(places))
        edges = angles - host.nodes
        self.angles = self._list(host.index(angles), edges, host.edge_ends(angles), host.turning[:, 1])
        self.directors = self._vectors(host.frame[:3].reshape(3, -1)[:, edges].T)

    def _list(self, *columns: np.ndarray) -> wp.array:
        return wp.array(np.column_stack(columns).astype(np.int32), dtype=int, device=self.model.wp_device)

    def _vectors(self, values: np.ndarray) -> wp.array:
        vector = wp.types.vector(3, self.model.types.real)
        return wp.array(np.ascontiguousarray(values), dtype=vector, device=self.model.wp_device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._nodes, *([self._angles] if len(self.angles) else []), *([self._grip] if self._grip else [])]

    def go_by(self, other: "Motion") -> None:
        """Have the poses that another part of the same model is handed."""
        self.pose, self.stride, self._timed, self._grip = other.pose, other.stride, False, None

    def upload(self, t0: float, t1: float) -> None:
        """Poses between t0 and t1 of motions that are functions of time."""
        if self._timed:
            self._hand(t0, t1)

    def _hand(self, t0: float, t1: float) -> None:
        self._rows[:] = poses(self.model, t0, t1)
        wp.copy(
            self._shared, self._host
        )  # from memory that is not pinned, so that the next rows may take its place at once

    def follow(self, before: State, after: State) -> None:
        """Poses of every world over the step from one state to another, where there are grips; launches alone."""
        if self._grip:
            inputs = [self._grips, len(self.model.grips), self._shared, before.grips.pose, after.grips.pose]
            self._launch(self._grip, self._grips, inputs, [self.pose])

    def apply(self, islands, x: wp.array, *directed: wp.array) -> None:
        """Put what is held where the part of the step that an island tries has it: see `place` and `direct`."""
        self.place(islands, x)
        self.direct(islands, x, *directed)

    def place(self, islands, x: wp.array) -> None:
        """Put nodes x."""
        inputs = [self.nodes, self.rest, self.pose, self.stride, *islands.arrays, self.part.world_columns]
        self._launch(self._nodes, self.nodes, inputs, [x])

    def direct(self, islands, x: wp.array, frame: wp.array, theta: wp.array) -> None:
        """Put angles theta, from lagged frames to the tangents that edges have in x."""
        if len(self.angles):
            inputs = [self.angles, self.directors, self.pose, self.stride]
            inputs += [*islands.arrays, self.part.world_columns, x, frame]
            self._launch(self._angles, self.angles, inputs, [theta])

    def put(self, state: State, t0: float, t1: float, *arrays: wp.array) -> None:
        """Put what `apply` puts, arrays of a state that belong to t0, where it is at t1."""
        self.upload(t0, t1)
        self.follow(state, state)
        islands = Islands(self.part.columns, self.model.types.real, self.model.wp_device)
        islands.portion.fill_(1.0)
        self.apply(islands, *arrays)

    def _launch(self, kernel, where: wp.array, inputs: list, outputs: list) -> None:
        dim = (len(where), self.model.worlds)
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)
