"""WorldState: the states of the worlds of a batch as tensors."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.learn.engine import Engine
from ddg_warp.learn.layout import Layout


@dataclass(frozen=True)
class WorldState:
    """A state of B worlds as tensors, which lie as the device likes it; `positions` and the like are in the user's order.

    Attributes:
        values: the arrays of a `State` by the order of `Layout.fields`; of worlds whose step failed, not numbers.
        time: [s], of all worlds.
        engine: what knows their meaning; None of a state that was copied or loaded, see `Simulator.world_state`.
        codes: outcomes of the step that led here (B,), see `kernels.outcome`; 0 of good ones, and where none did.
        differentiable: bools (B,), whether a gradient goes through all steps that led here, as far as they were made for gradients.
            Gradients of the others are not numbers, unless nothing is asked of these worlds: leave them out of a loss by this mask, and
            take `torch.nan_to_num` of what is computed from worlds that failed.
    """

    values: tuple
    time: float
    engine: Engine | None
    codes: torch.Tensor
    differentiable: torch.Tensor

    @classmethod
    def begun(cls, values, time: float, engine: Engine) -> "WorldState":
        """Return a state to which no step has led."""
        codes = torch.zeros(engine.model.worlds, dtype=torch.int32, device=engine.device)
        return cls(tuple(values), time, engine, codes, codes == 0)

    @property
    def layout(self) -> Layout:
        """What the tensors of a state are.

        Raises:
            SceneError: the state was loaded, and belongs to no simulator.
        """
        if self.engine is None:
            raise SceneError(
                "the state was loaded, and belongs to no simulator yet; give it to world_state(...) of one"
            )
        return self.engine.layout

    @property
    @torch.compiler.disable
    def positions(self) -> torch.Tensor:
        """Points (B, P, 3) [m], in the order of `State.points`."""
        return self.layout.points(self.values, "x", "q")

    @property
    @torch.compiler.disable
    def velocities(self) -> torch.Tensor:
        """Their velocities (B, P, 3) [m/s]."""
        return self.layout.points(self.values, "v", "v")

    @property
    @torch.compiler.disable
    def angles(self) -> torch.Tensor:
        """Angles of edges (B, edges) [rad], zero where there is no twist."""
        return self.layout.edges(self.values)

    @property
    def failed(self) -> torch.Tensor:
        """Worlds whose last step could not be made (B,)."""
        return (self.codes != 0) & (self.codes != outcome.NO_GRADIENT)

    def outcomes(self) -> np.ndarray:
        """Names of what became of the last step of every world (B,), as of `Integrator.outcomes`; "no_gradient" where it converged and
        no gradient goes through it, though gradients were asked for. Reads from the device."""
        return outcome_names(self.codes)

    def detach(self) -> "WorldState":
        """The same without history."""
        values = tuple(value.detach() for value in self.values)
        return replace(self, values=values, differentiable=torch.ones_like(self.differentiable))

    def __getstate__(self):
        return {own.name: getattr(self, own.name) for own in fields(self)} | {"engine": None}

    def __deepcopy__(self, memo):
        return replace(self.detach(), values=tuple(value.detach().clone() for value in self.values))


torch.utils._pytree.register_pytree_node(
    WorldState,
    lambda state: ([*state.values, state.codes, state.differentiable], (state.time, state.engine)),
    lambda values, context: WorldState(tuple(values[:-2]), *context, *values[-2:]),
)


def outcome_names(codes: torch.Tensor) -> np.ndarray:
    """Names of outcomes by their codes."""
    return np.array([outcome.NAMES[code or outcome.CONVERGED] for code in codes.tolist()])
