"""Refusals of what is no model, or no state of one."""

from ddg_warp.errors import SceneError


def check_model(call: str, model) -> None:
    """Refuse what is no model, where one is asked for."""
    from ddg_warp.model.model import Model

    if not isinstance(model, Model):
        raise SceneError(f"{call}: the model is {type(model).__name__}; give what scene.build() returns")


def check_state(call: str, model, state) -> None:
    """Refuse what is no state of a model."""
    from ddg_warp.model.state import State

    if not isinstance(state, State):
        raise SceneError(f"{call}: the state is {state!r}; give one of this model, such as model.state()")
    if state.model is not model:
        raise SceneError(f"{call}: the state is of another model; give one that this model made, such as model.state()")
