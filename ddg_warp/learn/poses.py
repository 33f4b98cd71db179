"""Derivatives by the poses of grips, from those by where their supports are."""

import numpy as np
import torch
import warp as wp

from ddg_warp.learn.layout import view
from ddg_warp.learn.rotations import halfway, matrix, partway, quaternion


def by_last_poses(first: torch.Tensor, last: torch.Tensor, share: float, given: torch.Tensor) -> torch.Tensor:
    """Derivatives by the `last` poses of a straight way (worlds, grips, 6), from those `given` by poses on it.

    Such a way is that of `ddg_warp.solve.motion.poses_between`.

    Args:
        first: poses where it begins; share: the part of the way to where derivatives are given.
    """
    with torch.enable_grad():
        last = last.detach().requires_grad_()
        (start, turn), (end, last_turn) = first.split(3, -1), last.split(3, -1)
        poses = torch.cat([start + share * (end - start), partway(turn, last_turn, share)], -1)
        return torch.autograd.grad((poses * given).sum(), last)[0]


class Poses:
    """Of the supports of an `Adjoint` or an `EquilibriumAdjoint`.

    A point X that a grip holds is at pivot + R (X - pivot) + translation, a director or a normal d at R d.
    By the midpoint rule a point is at the mean of where it is at both ends of the step, and a vector is turned halfway.

    Attributes:
        by_end: derivatives by poses at the end of the last step or equilibrium that was pulled (worlds, grips, 6).
    """

    def __init__(self, adjoint, midpoint: bool = False):
        self.model, self._midpoint = adjoint.model, midpoint
        model = self.model
        real = wp.dtype_to_torch(model.types.real)
        device = str(wp.device_to_torch(model.wp_device))

        def put(values, dtype=real):
            return torch.as_tensor(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._owned, count = [], len(model.grips)
        for own in adjoint.parts:
            if not own.supports:
                continue
            motion, host = own.supports.motion, own.supports.part.host
            grip_of = np.append(motion._grips.numpy(), -1)  # of a row of poses; -1 of none
            poses, places = host.moving[:, 1:], host.moving[:, 0]
            rest, pivots = host.points(places), np.array([grip.pivot for grip in model.grips])
            grips = np.where(poses >= 0, grip_of[np.maximum(poses, -1)], -1)  # (nodes, 3)
            of = np.stack([(grips == g) for g in range(count)], 0).astype(float)  # (grips, nodes, 3)
            arms = rest[None] - pivots[:, None]
            turned = np.stack([grip_of[host.turning[:, 1]] == g for g in range(count)], 0).astype(float)
            directors = host.frame[:3].reshape(3, -1)[:, host.turning[:, 0] - host.nodes].T
            self._owned.append((own, put(places, torch.long), put(of), put(arms), put(turned), put(directors)))
        self._normals = []  # of sets with normals that grips turn: index, their elements and rows of data, shares of grips, rest
        moved = adjoint.net.supports if adjoint.net else None
        for index, (where, rest) in moved.motion.normals.items() if moved else ():
            element, row, pose = where.numpy().T
            grips = np.append(moved.motion._grips.numpy(), -1)[pose]
            shares = np.stack([grips == g for g in range(count)], 0).astype(float)
            self._normals.append(
                (index, put(element, torch.long), put(row, torch.long), put(shares), put(rest.numpy()))
            )

    def pull_step(self, found, inputs: list, ends: tuple, given, posed: bool) -> None:
        """Put derivatives by poses at the start of a step into those by the state there, `found`, and keep those at the end.

        Args:
            inputs: what the reverse of the parts has found.
            ends: states at both ends; given: derivatives by that at the end.
            posed: whether the step was given poses; else they are those of the start.
        """
        before, after, by_end = (self._of(state) for state in (*ends, given))
        by_start, own = self.pull(inputs, before, after)
        self.by_end = by_end + own
        by_start = by_start if posed else by_start + self.by_end
        view(found.grips.pose).copy_(by_start.reshape(-1, 6).T)

    def pull_equilibrium(self, inputs: list, state, given) -> None:
        """Keep derivatives by the poses of an equilibrium, of which `given` are those by its state."""
        poses = self._of(state)
        self.by_end = self._of(given) + self.pull(inputs, poses, poses)[1]

    def _of(self, state) -> torch.Tensor:
        """Poses of a state (worlds, grips, 6)."""
        return view(state.grips.pose).T.reshape(self.model.worlds, -1, 6)

    def pull(self, inputs: list, before: torch.Tensor, after: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Derivatives by the poses of the grips at the start and at the end of a step (worlds, grips, 6).

        Args:
            inputs: what the reverse of the parts has found.
            before, after: these poses.
        """
        worlds, count = after.shape[:2]
        by_shift = torch.zeros((worlds, count, 3), dtype=after.dtype, device=after.device)
        by_turn, by_turned, by_end = (by_shift.new_zeros((worlds, count, 3, 3)) for _ in range(3))
        parts = (*self.model.groups, *([self.model.net] if self.model.net is not None else []))
        for own, places, of, arms, turned, directors in self._owned:
            part = own.supports.part
            read = inputs[next(i for i, each in enumerate(parts) if each is part)]
            held = self._held(part, read.held, places)  # (worlds, nodes, 3)
            shares = of[None] * held[:, None]  # (worlds, grips, nodes, 3)
            by_shift = by_shift + shares.sum(2)
            by_turn = by_turn + torch.einsum("wgnc,gnd->wgcd", shares, arms)
            if len(directors):
                found = view(own.supports.by_director)
                by_turned = by_turned + torch.einsum("gi,iwc,id->wgcd", turned, found, directors)
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
            found = torch.autograd.grad(total, ends, allow_unused=True)
        by_start, by_rotation = (
            torch.zeros_like(r) if own is None else own for own, r in zip(found, ends, strict=True)
        )
        shift = (1.0 - share) * by_shift, share * by_shift
        return torch.cat([shift[0], by_start], -1), torch.cat([shift[1], by_rotation], -1)

    def _by_normals(self, data: list, worlds: int) -> torch.Tensor:
        """Derivatives by rotations (worlds, grips, 3, 3), from those by the data of element sets with normals that grips turn."""
        total = 0.0
        for index, element, row, shares, rest in self._normals:
            found = view(data[index])
            found = found.reshape(found.shape[0], worlds, -1)
            found = found[row[:, None] + torch.arange(3, device=row.device), :, element[:, None]]
            total = total + torch.einsum("gi,icw,id->wgcd", shares, found, rest)
        return total

    def _held(self, part, held: wp.array, places: torch.Tensor) -> torch.Tensor:
        """Derivatives by nodes at places, in space (worlds, nodes, 3)."""
        values, worlds = view(held), self.model.worlds
        if part is self.model.net:
            return values.reshape(worlds, -1, 3)[:, places]
        columns, kind = part.rods, part.kind
        own = values[: kind.dim, places // columns].reshape(kind.dim, len(places), worlds, columns)
        own = own[:, torch.arange(len(places), device=places.device), :, places % columns]  # (nodes, dim, worlds)
        result = torch.zeros((worlds, len(places), 3), dtype=values.dtype, device=values.device)
        result[..., list(part.host.axes)] = own.permute(2, 0, 1)
        return result
