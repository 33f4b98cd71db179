"""Gradients with respect to grip poses, from gradients by support positions."""

import numpy as np
import torch
import warp as wp

from ddg_warp.torch.rotations import halfway, matrix, partway, quaternion
from ddg_warp.torch.state_layout import view


def by_last_poses(first: torch.Tensor, last: torch.Tensor, fraction: float, cotangent: torch.Tensor) -> torch.Tensor:
    """Return the gradient by the `last` poses of a straight path (worlds, grips, 6), given that by poses on the path.

    The path is that of `ddg_warp.solve.forces.prescribed_motion.poses_between`.

    Args:
        first: poses at the start of the path.
        fraction: position on the path, in [0, 1], of the poses with gradient `cotangent`.
        cotangent: gradient by the poses at that position.
    """
    with torch.enable_grad():
        last = last.detach().requires_grad_()
        (start, rotation), (end, last_rotation) = first.split(3, -1), last.split(3, -1)
        poses = torch.cat([start + fraction * (end - start), partway(rotation, last_rotation, fraction)], -1)
        return torch.autograd.grad((poses * cotangent).sum(), last)[0]


class Poses:
    """Gradients by the grip poses of an `Adjoint` or `EquilibriumAdjoint`.

    A gripped point X is at pivot + R (X - pivot) + translation, a director or normal d at R d.
    In the midpoint rule a point is at the mean of its end positions, and a vector is rotated halfway.

    Attributes:
        by_end: gradient by poses at the end of the last step or equilibrium pulled (worlds, grips, 6).
    """

    def __init__(self, adjoint, midpoint: bool = False):
        self.model, self._midpoint = adjoint.model, midpoint
        model = self.model
        real = wp.dtype_to_torch(model.types.real)
        device = str(wp.device_to_torch(model.wp_device))

        def put(values, dtype=real):
            return torch.as_tensor(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._owned, count = [], len(model.grips)
        for subsystem in adjoint.parts:
            if not subsystem.supports:
                continue
            motion, host = subsystem.supports.motion, subsystem.supports.part.host
            grip_of = np.append(motion._grips.numpy(), -1)  # grip of a row of poses; -1 for none
            poses, nodes = host.moving[:, 1:], host.moving[:, 0]
            rest, pivots = host.points(nodes), np.array([grip.pivot for grip in model.grips])
            grips = np.where(poses >= 0, grip_of[np.maximum(poses, -1)], -1)  # (nodes, 3)
            weights = np.stack([(grips == g) for g in range(count)], 0).astype(float)  # (grips, nodes, 3)
            arms = rest[None] - pivots[:, None]
            turned = np.stack([grip_of[host.turning[:, 1]] == g for g in range(count)], 0).astype(float)
            directors = host.frame[:3].reshape(3, -1)[:, host.turning[:, 0] - host.nodes].T
            self._owned.append(
                (subsystem, put(nodes, torch.long), put(weights), put(arms), put(turned), put(directors))
            )
        self._normals = []  # element sets with gripped normals: index, elements, rows of data, weights of grips, rest normals
        moved = adjoint.coupled.supports if adjoint.coupled else None
        for index, (where, rest) in moved.motion.normals.items() if moved else ():
            element, row, pose = where.numpy().T
            grips = np.append(moved.motion._grips.numpy(), -1)[pose]
            grip_weights = np.stack([grips == g for g in range(count)], 0).astype(float)
            self._normals.append(
                (index, put(element, torch.long), put(row, torch.long), put(grip_weights), put(rest.numpy()))
            )

    def pull_step(self, by_start_state, inputs: list, ends: tuple, cotangent, posed: bool) -> None:
        """Write the gradient by poses at the start of a step to `by_start_state`, and store that at the end.

        Args:
            by_start_state: gradient by the state before the step.
            inputs: gradients of the subsystems.
            ends: states at both ends.
            cotangent: gradient by the state at the end.
            posed: True if poses were controls of the step; else poses at the end equal the start.
        """
        before, after, by_end = (self._of(state) for state in (*ends, cotangent))
        by_start, by_pose = self.vjp(inputs, before, after)
        self.by_end = by_end + by_pose
        by_start = by_start if posed else by_start + self.by_end
        view(by_start_state.grips.pose).copy_(by_start.reshape(-1, 6).T)

    def pull_equilibrium(self, inputs: list, state, cotangent) -> None:
        """Store the gradient by the poses of an equilibrium; `cotangent` is that by its state."""
        poses = self._of(state)
        self.by_end = self._of(cotangent) + self.vjp(inputs, poses, poses)[1]

    def _of(self, state) -> torch.Tensor:
        """Return the poses of a state (worlds, grips, 6)."""
        return view(state.grips.pose).T.reshape(self.model.worlds, -1, 6)

    def vjp(self, inputs: list, before: torch.Tensor, after: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the gradients by grip poses at the start and at the end of a step (worlds, grips, 6).

        Args:
            inputs: gradients of the subsystems.
            before, after: poses at both ends.
        """
        worlds, count = after.shape[:2]
        by_shift = torch.zeros((worlds, count, 3), dtype=after.dtype, device=after.device)
        by_turn, by_turned, by_end = (by_shift.new_zeros((worlds, count, 3, 3)) for _ in range(3))
        parts = (*self.model.groups, *([self.model.coupled] if self.model.coupled is not None else []))
        for entry, nodes, weights, arms, turned, directors in self._owned:
            part = entry.supports.part
            read = inputs[next(i for i, each in enumerate(parts) if each is part)]
            by_fixed = self._held(part, read.held, nodes)  # (worlds, nodes, 3)
            by_gripped = weights[None] * by_fixed[:, None]  # (worlds, grips, nodes, 3)
            by_shift = by_shift + by_gripped.sum(2)
            by_turn = by_turn + torch.einsum("wgnc,gnd->wgcd", by_gripped, arms)
            if len(directors):
                gradients = view(entry.supports.by_director)
                by_turned = by_turned + torch.einsum("gi,iwc,id->wgcd", turned, gradients, directors)
        if self._normals:
            by_turned = by_turned + self._by_normals(inputs[-1].data, worlds)
            by_end = self._by_normals(inputs[-1].end_data, worlds)
        share = 0.5 if self._midpoint else 1.0
        ends = [poses[..., 3:].detach().requires_grad_() for poses in (before, after)]
        with torch.enable_grad():
            start, end = (matrix(quaternion(rotation)) for rotation in ends)
            solved = matrix(halfway(*map(quaternion, ends))) if self._midpoint else end
            total = (end * (share * by_turn + by_end)).sum() + (solved * by_turned).sum()
            if self._midpoint:
                total = total + (start * (share * by_turn)).sum()
            gradients = torch.autograd.grad(total, ends, allow_unused=True)
        by_start, by_rotation = (
            torch.zeros_like(r) if entry is None else entry for entry, r in zip(gradients, ends, strict=True)
        )
        shift = (1.0 - share) * by_shift, share * by_shift
        return torch.cat([shift[0], by_start], -1), torch.cat([shift[1], by_rotation], -1)

    def _by_normals(self, data: list, worlds: int) -> torch.Tensor:
        """Return the gradient by rotations (worlds, grips, 3, 3), from that by normals of element sets that grips rotate."""
        total = 0.0
        for index, element, row, weights, rest in self._normals:
            by_data = view(data[index])
            by_data = by_data.reshape(by_data.shape[0], worlds, -1)
            by_data = by_data[row[:, None] + torch.arange(3, device=row.device), :, element[:, None]]
            total = total + torch.einsum("gi,icw,id->wgcd", weights, by_data, rest)
        return total

    def _held(self, part, by_fixed: wp.array, nodes: torch.Tensor) -> torch.Tensor:
        """Return the gradient by nodes at given indices, in space (worlds, nodes, 3)."""
        values, worlds = view(by_fixed), self.model.worlds
        if part is self.model.coupled:
            return values.reshape(worlds, -1, 3)[:, nodes]
        columns, kind = part.rods, part.kind
        by_node = values[: kind.dim, nodes // columns].reshape(kind.dim, len(nodes), worlds, columns)
        by_node = by_node[:, torch.arange(len(nodes), device=nodes.device), :, nodes % columns]  # (nodes, dim, worlds)
        result = torch.zeros((worlds, len(nodes), 3), dtype=values.dtype, device=values.device)
        result[..., list(part.host.axes)] = by_node.permute(2, 0, 1)
        return result
