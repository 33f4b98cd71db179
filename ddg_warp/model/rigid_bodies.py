"""Rigid bodies of the coupled system on a device: constant arrays, and their initial state."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp.kernels.rigid_bodies import motion
from ddg_warp.typing import Floats


class RigidBodyTables:
    """Constant arrays of the rigid bodies of a `CoupledModel`.

    Attributes:
        `host`: `RigidBodyArrays`.
        `origins`, `spins`, `carried`, `owner`, `starts`, `arms`: see there.
        `centers`: see there; center: carried node that is the centre of mass (B,), -1 for the origin.
        moments: principal moments of inertia (W B,).
    """

    def __init__(self, host, coupled):
        self.host, self.coupled, device = host, coupled, coupled.device

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        for name in ("origins", "spins", "carried", "owner", "starts"):
            setattr(self, name, put(getattr(host, name)))
        place = np.full(coupled.blocks, -1)
        place[host.carried] = np.arange(len(host.carried))
        self.center, self.centers = put(place[host.centers]), put(host.centers)
        self.matrix = wp.types.matrix((3, 3), coupled.real)
        self.arms = wp.array(host.arms.reshape(-1, 3), dtype=coupled.vector, device=device)
        self.moments = wp.array(np.tile(host.moments, (coupled.worlds, 1)), dtype=coupled.vector, device=device)
        self._carry = motion.carry_kernel(coupled.real)

    def __len__(self) -> int:
        return len(self.host)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._carry]

    def start(self, state) -> None:
        """Set the initial poses and rates in a state at rest."""
        host, worlds = self.host, self.coupled.worlds
        spins = np.einsum("bji,bj->bi", host.axes, host.angular_velocity)
        momentum = np.einsum("bij,bj->bi", host.axes, host.moments * spins)
        state.rotation.assign(np.tile(host.axes, (worlds, 1, 1)))
        state.momentum.assign(np.tile(momentum, (worlds, 1)))
        v = state.v.numpy().reshape(worlds, -1, 3)
        v[:, host.origins] = host.velocity
        state.v.assign(v.reshape(-1, 3))
        self.carry(state)

    def carry(self, state) -> None:
        """Move carried nodes of a state to the poses of the bodies, with the velocities there; capturable."""
        inputs = [state.rotation, state.momentum, self.moments, self.arms, self.owner, self.carried, self.origins]
        wp.launch(
            self._carry,
            (self.coupled.worlds, len(self.host.carried)),
            [*inputs, self.coupled.blocks],
            [state.q, state.v],
            device=self.coupled.device,
        )


@dataclass(frozen=True)
class BodyState:
    """Pose and rates of a rigid body; with several worlds, arrays begin with the worlds.

    Attributes:
        position: centre of mass (3,) [m].
        rotation: from the orientation at rest to that of the state, a matrix (3, 3).
        velocity: of the centre of mass (3,) [m/s].
        angular_velocity: in space (3,) [rad/s].
    """

    position: Floats
    rotation: Floats
    velocity: Floats
    angular_velocity: Floats


def body_states(state, chosen=slice(None)) -> BodyState:
    """Return poses and rates of rigid bodies in a `State`, arrays (worlds, bodies, ...), of all or chosen ones."""
    model, host = state.model, state.model.coupled.host.rigid_bodies
    rotation, momentum = (values[:, chosen] for values in _rotations_and_momenta(state))
    blocks = (array.numpy().astype(float).reshape(model.worlds, -1, 3) for array in (state.coupled.q, state.coupled.v))
    position, velocity = (values[:, host.centers[chosen]] for values in blocks)
    rates = np.einsum("wbji,wbj->wbi", rotation, momentum) / host.moments[chosen]
    to_rest = host.axes[chosen].transpose(0, 2, 1)
    return BodyState(position, rotation @ to_rest, velocity, np.einsum("wbij,wbj->wbi", rotation, rates))


def body_rates(state) -> wp.array:
    """Return the velocities of dof blocks of a `State` (W N,), with angular velocities at rotations of rigid bodies."""
    v, host = state.coupled.v, state.model.coupled.host.rigid_bodies
    values = v.numpy().reshape(state.model.worlds, -1, 3)
    values[:, host.spins] = body_states(state).angular_velocity
    return wp.array(values.reshape(-1, 3), dtype=v.dtype, device=v.device)


def _rotations_and_momenta(state) -> tuple[np.ndarray, np.ndarray]:
    """Return orientations (worlds, bodies, 3, 3) and angular momenta (worlds, bodies, 3) [kg m^2/s] of a `State`."""
    arrays = (array.numpy().astype(float) for array in (state.coupled.rotation, state.coupled.momentum))
    return tuple(values.reshape(state.model.worlds, -1, *values.shape[1:]) for values in arrays)


def body_state(state, index: int) -> BodyState:
    """Return pose and rates of a rigid body in a `State`."""
    values = vars(body_states(state, [index])).values()
    return BodyState(*(value[0, 0] if state.model.worlds == 1 else value[:, 0] for value in values))


def body_energies(state) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotational kinetic energy of rigid bodies, and the potential of gravity that masses of dofs lack (worlds,) [J].

    The weight of a pinned body acts at its centre, while its mass counts at the pin.
    """
    model, host = state.model, state.model.coupled.host.rigid_bodies
    rotation, momentum = _rotations_and_momenta(state)
    kinetic = 0.5 * (np.einsum("wbji,wbj->wbi", rotation, momentum) ** 2 / host.moments).sum((1, 2))
    q = state.coupled.q.numpy().astype(float).reshape(model.worlds, -1, 3)
    weight = model.coupled.host.mass[host.origins] * np.array(model.scene.gravity, float)
    return kinetic, -((q[:, host.centers] - q[:, host.origins]) * weight).sum((1, 2))
