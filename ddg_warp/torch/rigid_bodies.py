"""Poses and rates of rigid bodies in the tensors of a state, differentiable."""

import math

import numpy as np
import torch

from ddg_warp.errors import SceneError
from ddg_warp.kernels.elements.coupled_element import FRAME

CLOSE = (
    1e-6  # tolerated deviation of rotations from orthonormal ones, and of centres from their joints, relative to arms
)


class BodyLayout:
    """Layout of rigid bodies in the tensors of states.

    Args:
        layout: `StateLayout` of a model with rigid bodies.
    """

    def __init__(self, layout):
        model = layout.model
        self.layout, self.worlds, self.coupled = layout, model.worlds, model.coupled
        host = self._host = model.coupled.host.rigid_bodies

        def upload(values, dtype=None):
            return torch.as_tensor(np.ascontiguousarray(values), device=layout.device, dtype=dtype)

        self._real = layout.real
        self._axes, self._moments, self._arms = (upload(v, self._real) for v in (host.axes, host.moments, host.arms))
        self._origins, self._centers, self._carried, self._owner = (
            upload(v, torch.long) for v in (host.origins, host.centers, host.carried, host.owner)
        )
        self._pinned = upload(host.pinned)
        place = np.full(model.coupled.blocks, -1)
        place[host.carried] = np.arange(len(host.carried))
        center = place[host.centers]  # carried node of the centre of a pinned body
        arms = np.zeros((len(host), 3))
        arms[center >= 0] = host.arms[center[center >= 0]]
        self._center_arms = upload(arms, self._real)
        self._ghosts = list(self._find_ghosts(upload))

    def poses(self, values) -> torch.Tensor:
        """Return rotation and position of the bodies, [R | x] (B, bodies, 3, 4)."""
        position, rotation = self._blocks(values, "q")[:, self._centers], torch.nan_to_num(self._rotation(values))
        return torch.cat([self._of_good(values, rotation @ self._axes.transpose(1, 2)), position[..., None]], -1)

    def rates(self, values) -> torch.Tensor:
        """Return velocities of centres and angular velocities (B, bodies, 6)."""
        rotation, momentum = map(torch.nan_to_num, (self._rotation(values), self._momentum(values)))
        spin = torch.einsum("wbij,wbj->wbi", rotation, _turned_back(rotation, momentum) / self._moments)
        return torch.cat([self._blocks(values, "v")[:, self._centers], self._of_good(values, spin)], -1)

    def _of_good(self, values, result: torch.Tensor) -> torch.Tensor:
        """Return a result (B, ...), NaN in failed worlds, to which zero cotangents then pass nothing else."""
        failed = torch.isnan(self._momentum(values)).flatten(1).any(1)
        return torch.where(failed.view(-1, *[1] * (result.ndim - 1)), torch.nan, result)

    def momenta(self, values) -> torch.Tensor:
        """Return angular momenta (B, bodies, 3)."""
        return self._momentum(values)

    def put(self, values: list, poses: torch.Tensor | None, rates: torch.Tensor | None) -> list:
        """Return the tensors of a state with given poses (..., bodies, 3, 4) and rates (..., bodies, 6), carried nodes included.

        Raises:
            SceneError: a shape does not fit, a rotation is none, or a joint with the world holds a body elsewhere; names the body.
        """
        count, values = len(self._host), list(values)
        poses = self.poses(values) if poses is None else self._shaped("body_poses", poses, (count, 3, 4))
        rates = self.rates(values) if rates is None else self._shaped("body_rates", rates, (count, 6))
        rotation = poses[..., :3] @ self._axes
        q, v = (self._blocks(values, name).clone() for name in ("q", "v"))
        origins = torch.where(self._pinned[:, None], q[:, self._origins], poses[..., 3])
        self._check(poses.detach(), rotation.detach(), origins.detach())
        turn = rotation @ self._rotation(values).transpose(-1, -2)
        moved = torch.where(self._pinned[:, None], 0.0, rates[..., :3])
        y = torch.einsum("wjik,jk->wji", rotation[:, self._owner], self._arms)
        spin = rates[..., 3:]
        q = q.index_copy(1, self._origins, origins).index_copy(1, self._carried, origins[:, self._owner] + y)
        carried = moved[:, self._owner] + torch.linalg.cross(spin[:, self._owner], y)
        v = v.index_copy(1, self._origins, moved).index_copy(1, self._carried, carried)
        momentum = torch.einsum("wbij,wbj->wbi", rotation, self._moments * _turned_back(rotation, spin))
        new = {"q": q.reshape(-1, 3), "v": v.reshape(-1, 3), "rotation": rotation.reshape(-1, 3, 3)}
        for name, entry in (new | {"momentum": momentum.reshape(-1, 3)} | self._turn_ghosts(values, turn)).items():
            values[self.layout.index(f"net/{name}")] = entry
        return values

    def _check(self, poses: torch.Tensor, rotation: torch.Tensor, origins: torch.Tensor) -> None:
        if torch._C._are_functorch_transforms_active():
            return
        matrix = poses[..., :3]
        off = (matrix @ matrix.transpose(-1, -2) - torch.eye(3, dtype=matrix.dtype, device=matrix.device)).abs()
        wrong = (off.amax((0, 2, 3)) > CLOSE) | (torch.linalg.det(matrix).amin(0) < 0.0)
        for body in torch.nonzero(wrong).flatten().tolist()[:1]:
            raise SceneError(
                f"initial_state: body_poses: body {body} has no rotation in its first three columns; give [R | x] with R^T R = 1"
            )
        arm = torch.einsum("wbij,bj->wbi", rotation, self._center_arms)
        off = ((poses[..., 3] - origins - arm).norm(dim=-1) / self._center_arms.norm(dim=-1).clamp_min(1e-300)).amax(0)
        for body in torch.nonzero(self._pinned & (off > CLOSE)).flatten().tolist()[:1]:
            raise SceneError(
                f"initial_state: body_poses: the centre of body {body} is not where its joint with the world holds it; rotate it about "
                "the point of the joint"
            )

    def _shaped(self, name: str, values: torch.Tensor, shape: tuple) -> torch.Tensor:
        if tuple(values.shape) not in (shape, (self.worlds, *shape)):
            raise SceneError(
                f"initial_state: {name} have shape {tuple(values.shape)}; they are {shape} or {(self.worlds, *shape)}"
            )
        return values.to(device=self.layout.device, dtype=self._real).expand(self.worlds, *shape)

    def _blocks(self, values, name: str) -> torch.Tensor:
        return values[self.layout.index(f"net/{name}")].reshape(self.worlds, -1, 3)

    def _rotation(self, values) -> torch.Tensor:
        """Return orientations of principal axes (B, bodies, 3, 3)."""
        return values[self.layout.index("net/rotation")].reshape(self.worlds, -1, 3, 3)

    def _momentum(self, values) -> torch.Tensor:
        return self._blocks(values, "momentum")

    def _find_ghosts(self, upload):
        """Yield index, number of frames, bodies of ghosts (n for none), edges and directions of sets with ghosts of bodies."""
        host, coupled, bodies = self._host, self.coupled, len(self._host)
        body = np.full(coupled.blocks, bodies)
        body[host.spins] = np.arange(bodies)
        for i, part in enumerate(coupled.sets):
            measure = part.term.measure
            if measure.spins:
                slots = part.host.slots
                owners = body[slots[measure.nodes + measure.angles :]]
                edges = slots[measure.nodes] - coupled.host.nodes if measure.frames else np.zeros(0, int)
                sign = part.host.data[0] if measure.frames else np.zeros(0)
                if (owners < bodies).any():
                    arrays = upload(owners, torch.long), upload(edges, torch.long), upload(sign, self._real)
                    yield i, measure.frames, *arrays

    def _turn_ghosts(self, values, turn: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return lagged rows by name with the ghosts of bodies rotated by `turn` (B, bodies, 3, 3)."""
        identity = torch.eye(3, dtype=turn.dtype, device=turn.device).expand(self.worlds, 1, 3, 3)
        turn, result = torch.cat([turn, identity], 1), {}
        for i, frames, owners, edges, sign in self._ghosts:
            rows = values[self.layout.index(f"net/lag_{i}")].reshape(-1, self.worlds, owners.shape[1])
            ghosts = rows[:-1].reshape(-1, 2, 3, *rows.shape[1:])  # (ghosts, u and t, 3, worlds, elements)
            ghosts = torch.einsum("wgeij,gvjwe->gviwe", turn[:, owners], ghosts)
            (u, t), second = ghosts[0], ghosts[-1]
            if frames:
                frame = values[self.layout.index("net/frame")].reshape(FRAME, self.worlds, -1)[:, :, edges]
                second = (
                    frame.reshape(2, 3, *frame.shape[1:]) * torch.stack([torch.ones_like(sign), sign])[:, None, None]
                )
            twist = _reference_twist(u, second[0], t, second[1], rows[-1])
            new = torch.cat([ghosts.reshape(-1, *rows.shape[1:]), twist[None]])
            result[f"lag_{i}"] = new.reshape(new.shape[0], -1)
        return result


def _turned_back(rotation: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Return R^T v."""
    return torch.einsum("wbji,wbj->wbi", rotation, vectors)


def _reference_twist(ue, uf, te, tf, lagged) -> torch.Tensor:
    """Return the angle about tf from the transported ue to uf, as `kernels.elements.parallel_transport`; components come first."""
    b, c = torch.linalg.cross(te, tf, dim=0), (te * tf).sum(0)
    up = ue * c + torch.linalg.cross(b, ue, dim=0) + b * ((b * ue).sum(0) / (1.0 + c))
    angle = torch.atan2((torch.linalg.cross(up, uf, dim=0) * tf).sum(0), (up * uf).sum(0))
    return angle - 2.0 * math.pi * torch.round((angle - lagged) / (2.0 * math.pi)).detach()
