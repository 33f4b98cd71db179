"""What is prescribed from outside: motion of supports, and loads that change."""

import numpy as np
import warp as wp

from ddg_warp import arguments
from ddg_warp.compile.chains import pose_starts
from ddg_warp.errors import SolverError
from ddg_warp.kernels import motion, step


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


class PrescribedMotion:
    """Motion of the held dofs of a group that have one."""

    def __init__(self, model, group, midpoint: bool = False):
        self.model, self.group = model, group
        nodes, angles = step.motion_kernels(group.kind, model.types.real, midpoint)
        self.kernels = [nodes, angles] if group.moving.edges.shape[0] else [nodes]
        rows = pose_starts(model.motions)[-1]
        self.pose = wp.zeros((rows, motion.POSE), dtype=model.types.real, device=model.wp_device)

    def upload(self, t0: float, t1: float) -> None:
        """Poses of all motions between t0 and t1."""
        self.pose.assign(poses(self.model, t0, t1))

    def apply(self, islands, x: wp.array, frame: wp.array, theta: wp.array) -> None:
        """Put held nodes and angles where the part of the step that a rod tries ends."""
        nodes, *angles = self.kernels
        held, group, device = self.group.moving, self.group, self.model.wp_device
        wp.launch(
            nodes,
            held.nodes.shape[0],
            [held.nodes, held.node_rest, self.pose, *islands.arrays],
            [x],
            device=device,
        )
        for kernel in angles:
            wp.launch(
                kernel,
                held.edges.shape[0],
                [held.edges, held.edge_rest, self.pose, group.count, *islands.arrays, x, frame],
                [theta],
                device=device,
            )


class TimedLoads:
    """Loads of a group that change from step to step, and couples, which change with the edge they act on."""

    def __init__(self, model, group, midpoint: bool):
        real, device, host = model.types.real, model.wp_device, group.host
        self.group, self.device, self.midpoint = group, device, midpoint
        self.kernels = step.load_kernels(group.kind, real)
        timed = host.timed_loads
        self._load_of = np.concatenate([np.full(len(load.k), i) for i, load in enumerate(timed)])
        rows = np.concatenate([np.column_stack([load.k, load.columns]) for load in timed])
        touched = np.unique(np.concatenate([rows, rows + [1, 0]]), axis=0)
        touched = touched[touched[:, 0] < group.nodes]
        base = np.zeros((len(touched), 4))
        base[:, : group.kind.dim] = host.load[touched[:, 0], touched[:, 1]]
        base[:, 3] = host.load_angle[touched[:, 0], touched[:, 1]]

        def worlds(values, shift=0):
            return np.concatenate([values + shift * world * group.rods for world in range(model.worlds)])

        self.where = wp.array(worlds(rows, np.array([0, 1])).astype(np.int32), dtype=int, device=device)
        self.touched = wp.array(worlds(touched, np.array([0, 1])).astype(np.int32), dtype=int, device=device)
        self.base = wp.array(worlds(base), dtype=real, device=device)
        self.values = wp.zeros((self.where.shape[0], 7), dtype=real, device=device)

    def upload(self, t0: float, t1: float) -> None:
        """Values at the time that the scheme balances forces at."""
        at = 0.5 * (t0 + t1) if self.midpoint else t1
        table = np.zeros((len(self.group.host.timed_loads), 7))
        for row, load in zip(table, self.group.host.timed_loads, strict=True):
            row[: self.group.kind.dim] = load.force
            row[3] = load.moment
            row[4:] = load.couple
            row *= load.at(at, 1.0)
        self.values.assign(np.tile(table[self._load_of], (self.group.worlds, 1)))

    def apply(self, x: wp.array, load: wp.array, load_angle: wp.array) -> None:
        """Write constant loads plus these, on edges of nodes x, where such loads were before."""
        reset, add = self.kernels
        out = [load, load_angle]
        wp.launch(reset, self.touched.shape[0], [self.touched, self.base], out, device=self.device)
        wp.launch(add, self.where.shape[0], [self.where, self.values, x], out, device=self.device)
