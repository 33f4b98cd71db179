"""Derivatives by the poses of grips, from those by where their supports are."""

import numpy as np
import torch
import warp as wp


class Poses:
    """Of an engine's model, for implicit Euler: a point X that a grip holds is at pivot + R (X - pivot) + translation, a director or
    a normal d at R d."""

    def __init__(self, engine):
        self.model = model = engine.model
        real = wp.dtype_to_torch(model.types.real)
        device = str(wp.device_to_torch(model.wp_device))

        def put(values, dtype=real):
            return torch.as_tensor(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._owned, count = [], len(model.grips)
        for own in (*engine.adjoint.chains, *([engine.adjoint.net] if engine.adjoint.net else [])):
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
        moved = engine.integrator._net.motion if self.model.net is not None else None
        for index, (where, rest) in moved.normals.items() if moved else ():
            element, row, pose = where.numpy().T
            grips = np.append(moved._grips.numpy(), -1)[pose]
            shares = np.stack([grips == g for g in range(count)], 0).astype(float)
            self._normals.append(
                (index, put(element, torch.long), put(row, torch.long), put(shares), put(rest.numpy()))
            )

    def pull(self, inputs: list, poses: torch.Tensor) -> torch.Tensor:
        """Derivatives by poses (worlds, grips, 6).

        Args:
            inputs: what the reverse of the parts has found.
            poses: of the grips at the end of the step (worlds, grips, 6).
        """
        worlds, count = poses.shape[:2]
        by_shift = torch.zeros((worlds, count, 3), dtype=poses.dtype, device=poses.device)
        by_turn = torch.zeros((worlds, count, 3, 3), dtype=poses.dtype, device=poses.device)
        parts = (*self.model.groups, *([self.model.net] if self.model.net is not None else []))
        for own, places, of, arms, turned, directors in self._owned:
            part = own.supports.part
            read = inputs[next(i for i, each in enumerate(parts) if each is part)]
            held = self._held(part, read.held, places)  # (worlds, nodes, 3)
            shares = of[None] * held[:, None]  # (worlds, grips, nodes, 3)
            by_shift = by_shift + shares.sum(2)
            by_turn = by_turn + torch.einsum("wgnc,gnd->wgcd", shares, arms)
            if len(directors):
                found = wp.to_torch(own.supports.by_director, requires_grad=False)
                by_turn = by_turn + torch.einsum("gi,iwc,id->wgcd", turned, found, directors)
        for index, element, row, shares, rest in self._normals:
            found = wp.to_torch(inputs[-1].data[index], requires_grad=False)
            found = found.reshape(found.shape[0], worlds, -1)[
                row[:, None] + torch.arange(3, device=row.device), :, element[:, None]
            ]
            by_turn = by_turn + torch.einsum("gi,icw,id->wgcd", shares, found, rest)
        rotation = poses[..., 3:].detach().requires_grad_()
        with torch.enable_grad():
            zero = torch.zeros_like(rotation[..., 0])
            x, y, z = rotation.unbind(-1)
            skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*rotation.shape, 3)
            (by_rotation,) = torch.autograd.grad(torch.linalg.matrix_exp(skew), rotation, by_turn)
        return torch.cat([by_shift, by_rotation], -1)

    def _held(self, part, held: wp.array, places: torch.Tensor) -> torch.Tensor:
        """Derivatives by nodes at places, in space (worlds, nodes, 3)."""
        values, worlds = wp.to_torch(held, requires_grad=False), self.model.worlds
        if part is self.model.net:
            return values.reshape(worlds, -1, 3)[:, places]
        columns, kind = part.rods, part.kind
        own = values[: kind.dim, places // columns].reshape(kind.dim, len(places), worlds, columns)
        own = own[:, torch.arange(len(places), device=places.device), :, places % columns]  # (nodes, dim, worlds)
        result = torch.zeros((worlds, len(places), 3), dtype=values.dtype, device=values.device)
        result[..., list(part.host.axes)] = own.permute(2, 0, 1)
        return result
