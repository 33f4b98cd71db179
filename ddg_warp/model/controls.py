"""Controls: what a time step, or a search for an equilibrium, is given beside its state, world by world."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError


@arguments.called
@dataclass(frozen=True, eq=False)
class Controls:
    """What acts during one step, constant over it: `integrator.step(state, dt, controls)`. What is not given is as the scene has it.

    Every field is one array for all worlds, or has an axis of worlds in front. What the scene has as functions of time, motions and
    loads, stays as it is, the same for all worlds; these loads add to it. They belong to the step alone: what is asked of a state
    afterwards (reactions, spectra, energy of gravity) knows the loads of the scene.

    `statics.solve(model, controls=...)` takes them, too: the load parameter scales loads, gravity and the field as it does those of
    the scene, and poses are those at its end.

    Attributes:
        poses: of every `Grip` at the end of the step (grips, 6) or (worlds, grips, 6): translation [m] and rotation vector [rad],
            relative to rest, in the order of `model.grips`. Grips rest where they are without.
        forces: on points (P, 3) or (worlds, P, 3) [N], in the order of `State.points`; on rows of one node, which joined
            rods have, their sum; of a shell of revolution on the whole ring.
        moments: about the tangents of edges (edges,) or (worlds, edges) [N m], in the order of `State.angles`.
        gravity: (3,) or (worlds, 3) [m/s^2], instead of the scene's.
        field: (3,) or (worlds, 3) [T], a uniform magnetic field on top of the scene's.
    """

    poses: Any = None
    forces: Any = None
    moments: Any = None
    gravity: Any = None
    field: Any = None

    def checked(self, model) -> dict[str, np.ndarray]:
        """What is given, by name, each as an array with an axis of worlds (1 or worlds, ...).

        Raises:
            SceneError: a shape does not fit, a value is not finite, or the model has nothing that it could act on.
        """
        known = shapes(model)
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        found = {
            name: _numbers(name, values, known[name], model.worlds)
            for name, values in given.items()
            if values is not None
        }
        _refuse_missing(model, found)
        _refuse_out_of_plane(model, found)
        return found


def checked(controls: Controls | None, model, call: str = "step") -> dict[str, np.ndarray]:
    """What controls give, see `Controls.checked`; nothing without."""
    if controls is None:
        return {}
    if not isinstance(controls, Controls):
        raise SceneError(
            f"{call}: controls are {arguments.shown(controls)}; give "
            "Controls(poses=..., forces=..., moments=..., gravity=..., field=...)"
        )
    return controls.checked(model)


def _numbers(name: str, values, shape: tuple, worlds: int) -> np.ndarray:
    """The one place where arrays of others become ours."""
    values = arguments.array(f"Controls: {name}", values)
    if values.shape not in (shape, (worlds, *shape)):
        raise SceneError(
            f"Controls: {name} have shape {values.shape}; they are {shape}, or {(worlds, *shape)} for each of the worlds"
        )
    if not np.isfinite(values).all():
        *world, place = np.argwhere(~np.isfinite(values))[0][: values.ndim - len(shape) + 1]
        where = f" in world {world[0]}" if world else ""
        raise SceneError(f"Controls: {name}: entry {place}{where} is not finite; give finite numbers")
    return values if values.ndim > len(shape) else values[None]


def shapes(model) -> dict[str, tuple]:
    """Of what a model's worlds are given each, by name."""
    points, edges, grips = model.points_count, model.order.edges_count, len(model.grips)
    return {"forces": (points, 3), "moments": (edges,), "gravity": (3,), "field": (3,), "poses": (grips, 6)}


def require_acting(model, names) -> None:
    """Refuse what would act on nothing.

    Raises:
        SceneError: poses are among the names, and there is no grip; or a magnetic field, and nothing is magnetised or the scene has no
            field that it adds to.
    """
    if "field" in names and not model.magnetic:
        raise SceneError(
            "Controls: a magnetic field acts on nothing; magnetise rods by scene.magnetize, and add scene.magnetic_field((0, 0, 0)) to "
            "which it adds"
        )
    if "poses" in names and not model.grips:
        raise SceneError(
            "Controls: poses of no grip; hold something by Grip(...), as in scene.clamp(rod, motion=Grip())"
        )


def _refuse_missing(model, found: dict[str, np.ndarray]) -> None:
    """Refuse what would act on nothing, and moments about edges without an angle."""
    require_acting(model, found)
    if "moments" in found:
        bad = np.flatnonzero(found["moments"].any(0) & ~model.order.twisted)
        if bad.size:
            edge, rod = model.order.edge(bad[0])
            raise SceneError(
                f"Controls: moments: edge {edge} of rod {rod} ('{model.curves.names[rod]}') has no twist; give 0, or add the rod with "
                "twist=True, in dimension 3"
            )


def _refuse_out_of_plane(model, found: dict[str, np.ndarray]) -> None:
    """Refuse what leaves the plane of x and z that planar scenes, and meridians of shells of revolution, stay in."""
    scene = model.scene
    planar = scene.dimension == 2
    flat, grips = np.full(model.points_count, planar), np.full(len(model.grips), planar)
    along = [0, 1] if scene.axisymmetric_shells else [1] if planar else []
    for support in scene.ring_supports:
        if support.motion in model.grips:
            grips[model.grips.index(support.motion)] = True
    flat[model.order.meridian_rows] = True
    text = "stays in the plane of x and z"
    if "poses" in found:
        poses = np.abs(found["poses"]).max(0)
        for grip in np.flatnonzero(grips & poses[:, [1, 3, 5]].any(1))[:1]:
            raise SceneError(
                f"Controls: poses: what grip {grip} holds {text}; give 0 for its translation along y and its rotation about x and z"
            )
    if "forces" in found:
        for point in np.flatnonzero(flat & found["forces"][..., 1].any(0))[:1]:
            raise SceneError(f"Controls: forces: point {point} {text}; give 0 along y")
    if "field" in found and planar and found["field"][:, 1].any():
        raise SceneError(f"Controls: field {tuple(found['field'][0].tolist())}: the scene {text}; give 0 along y")
    if "gravity" in found and found["gravity"][:, along].any():
        what = (
            "shells of revolution are about z; give 0 along x and y"
            if along == [0, 1]
            else f"the scene {text}; give 0 along y"
        )
        raise SceneError(f"Controls: gravity {tuple(found['gravity'][0].tolist())}: {what}")
