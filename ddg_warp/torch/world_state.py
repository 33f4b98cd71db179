"""WorldState: the states of the worlds of a batch as tensors."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.torch.compiler import graph_break
from ddg_warp.torch.engine import Engine
from ddg_warp.torch.state_layout import StateLayout


@dataclass(frozen=True, repr=False)
class WorldState:
    """State of B worlds as tensors in storage layout; properties such as `positions` are in user order.

    Attributes:
        values: arrays of a `State`, ordered as `StateLayout.fields`; NaN in failed worlds.
        time: [s], of all worlds.
        engine: engine with the layout; None for a copied or loaded state, see `Simulator.world_state`.
        codes: outcomes of the step to this state (B,), see `kernels.core.outcome`; 0 if good, or without a step.
        differentiable: bools (B,), True if a gradient goes through all steps to this state, as far as made for gradients. Gradients
            of other worlds are NaN, unless their cotangent is zero: mask them in a loss, and apply `torch.nan_to_num` to
            values computed from failed worlds.
    """

    values: tuple[torch.Tensor, ...]
    time: float
    engine: Engine | None
    codes: torch.Tensor
    differentiable: torch.Tensor

    @classmethod
    def begun(cls, values: Iterable[torch.Tensor], time: float, engine: Engine) -> "WorldState":
        """Return a state without a step before."""
        codes = torch.zeros(engine.model.worlds, dtype=torch.int32, device=engine.device)
        return cls(tuple(values), time, engine, codes, codes == 0)

    @property
    def layout(self) -> StateLayout:
        """Layout of the tensors of the state.

        Raises:
            SceneError: the state was loaded, and is not bound to a simulator.
        """
        if self.engine is None:
            raise SceneError(
                "the state was loaded, and belongs to no simulator yet; give it to world_state(...) of one"
            )
        return self.engine.layout

    @property
    @graph_break
    def positions(self) -> torch.Tensor:
        """Points (B, P, 3) [m], in the order of `State.points`."""
        return self.layout.points(self.values, "x", "q")

    @property
    @graph_break
    def velocities(self) -> torch.Tensor:
        """Velocities of points (B, P, 3) [m/s]."""
        return self.layout.points(self.values, "v", "v")

    @property
    @graph_break
    def angles(self) -> torch.Tensor:
        """Twist angles of edges (B, edges) [rad], zero without twist."""
        return self.layout.edges(self.values)

    @property
    @graph_break
    def body_poses(self) -> torch.Tensor:
        """Rotation and position of rigid bodies, [R | x], (B, bodies, 3, 4) [m], as of `State.body_poses`."""
        return self.layout.bodies.poses(self.values)

    @property
    @graph_break
    def body_rates(self) -> torch.Tensor:
        """Velocity of the centre [m/s] and angular velocity [rad/s] of rigid bodies (B, bodies, 6), at the inertia of the model."""
        return self.layout.bodies.rates(self.values)

    @property
    @graph_break
    def body_momenta(self) -> torch.Tensor:
        """Angular momenta of rigid bodies (B, bodies, 3) [kg m^2/s], about the centre or the point of a joint with the world."""
        return self.layout.bodies.momenta(self.values)

    @property
    def failed(self) -> torch.Tensor:
        """Mask of worlds that failed in the last step (B,)."""
        return (self.codes != 0) & (self.codes != outcome.NO_GRADIENT)

    def outcomes(self) -> np.ndarray:
        """Return outcome names of the last step of every world (B,), as `Integrator.outcomes`. Reads from the device.

        "no_gradient" marks worlds that converged but have no gradient, though gradients were requested.
        """
        return outcome_names(self.codes)

    def detach(self) -> "WorldState":
        """Return the state without gradient history."""
        values = tuple(value.detach() for value in self.values)
        return replace(self, values=values, differentiable=torch.ones_like(self.differentiable))

    def __repr__(self) -> str:
        number = argument_checks.number_of
        if self.engine is None:
            return f"<WorldState at t = {self.time:g} s: {number(len(self.codes), 'world')}, of no simulator yet>"
        size = f"{number(len(self.codes), 'world')} of {number(self.engine.model.points_count, 'point')}"
        return f"<WorldState at t = {self.time:g} s: {size} on {self.engine.device}>"

    def to(self, *arguments, **options) -> "WorldState":
        """Return the state itself, on the device and with the dtype of the model; see `torch.Tensor.to`.

        Raises:
            SceneError: another device or dtype is given; the message has the calls that copy the state.
        """
        require_same("a state", self.layout.model, arguments, options, "give it to simulator.world_state(state) there")
        return self

    def __getstate__(self):
        return {attribute.name: getattr(self, attribute.name) for attribute in fields(self)} | {"engine": None}

    def __deepcopy__(self, memo):
        return replace(self.detach(), values=tuple(value.detach().clone() for value in self.values))


torch.utils._pytree.register_pytree_node(
    WorldState,
    lambda state: ([*state.values, state.codes, state.differentiable], (state.time, state.engine)),
    lambda values, context: WorldState(tuple(values[:-2]), *context, *values[-2:]),
)


def require_same(name: str, model, arguments: tuple, options: dict, remedy: str) -> None:
    """Refuse arguments of `torch.Tensor.to` with another device or dtype than a model has."""
    device, dtype, *_ = torch._C._nn._parse_to(*arguments, **options)
    current = torch.device(str(wp.device_to_torch(model.wp_device)))
    if device is not None and (device.type, device.index or 0) != (current.type, current.index or 0):
        raise SceneError(
            f"{name} lives on {current}, as its model: make another by Simulator(model.to({str(device)!r}), dt), and {remedy}"
        )
    real = wp.dtype_to_torch(model.types.real)
    if dtype not in (None, real):
        raise SceneError(
            f"{name} is of {real} in the precision {model.precision!r}; convert tensors, such as state.positions.to({dtype})"
        )


def outcome_names(codes: torch.Tensor) -> np.ndarray:
    """Return outcome names by code."""
    return np.array([outcome.NAMES[code or outcome.CONVERGED] for code in codes.tolist()])
