"""What is prescribed from outside: motion of supports, and loads that change."""

from types import SimpleNamespace

import numpy as np
import warp as wp

from ddg_warp import arguments, arrays
from ddg_warp.compile.conditions import pose_starts
from ddg_warp.errors import SolverError
from ddg_warp.kernels import drag, element, motion, step
from ddg_warp.kernels.islands import Islands
from ddg_warp.scene.drag import flow_at


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


class ChainDrag:
    """Drag on a group of rods, against a fluid that flows."""

    def __init__(self, model, group, midpoint: bool = False):
        self.model, self.group, self.midpoint = model, group, midpoint
        self._resist, self._settle = drag.chain_kernels(group.kind, model.types.real)
        vector = wp.types.vector(group.kind.dim, model.types.real)
        self.flow = wp.array(self._flow(0.0), dtype=vector, device=model.wp_device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._resist, *([self._settle] if self.midpoint else [])]

    def upload(self, t0: float, t1: float) -> None:
        """The flow at the time that the scheme balances forces at."""
        if callable(self.model.scene.flow):
            self.flow.assign(self._flow(0.5 * (t0 + t1) if self.midpoint else t1))

    def _flow(self, t: float) -> np.ndarray:
        return flow_at(self.model.scene, t)[None, [0, 2] if self.group.kind.dim == 2 else [0, 1, 2]]

    def resist(self, before, newton, islands) -> None:
        """Write inertia and drag of a solve from the state `before`, once its iterate is predicted."""
        group = self.group
        self._launch(
            self._resist,
            [before.x, before.v, before.theta, newton.x if self.midpoint else before.x, newton.x, group.drag, self.flow]
            + [group.mass, group.rotary, group.count, *islands.arrays],
            [newton.mass, newton.rotary, newton.target_angle],
        )

    def at(self, data, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Inertia and drag (node, column) of a group's state at t, with the resistance over a second, and the flow (dim,)."""
        group, real, device = self.group, self.model.types.real, self.model.wp_device
        islands = Islands(group.columns, real, device)
        islands.coefficient.fill_(1.0)
        islands.rate.fill_(1.0)
        solve = SimpleNamespace(x=data.x)
        solve.mass = arrays.allocate((group.nodes, group.columns), element.inertia_type(group.kind, real), device)
        solve.rotary, solve.target_angle = wp.zeros_like(data.theta), wp.clone(data.theta)
        self.upload(t, t)
        self.resist(data, solve, islands)
        return arrays.download(solve.mass), self.flow.numpy()[0].astype(float)

    def settle(self, after, newton, islands) -> None:
        """Rates of what has no inertia in the state `after`."""
        group = self.group
        if self.midpoint:
            self._launch(
                self._settle,
                [newton.x, newton.theta, group.mass, group.rotary, group.count, *islands.arrays]
                + [after.x, after.theta],
                [after.v, after.omega],
            )

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.group.node_threads, inputs, outputs, device=self.model.wp_device)
