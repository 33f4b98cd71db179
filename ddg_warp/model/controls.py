"""Controls: loads, poses of grips, gravity and field of one time step or static solve, per world."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ddg_warp import argument_checks, host_arrays
from ddg_warp.errors import SceneError
from ddg_warp.typing import Floats, Numbers

if TYPE_CHECKING:
    from ddg_warp.model.model import Model


@argument_checks.called
@dataclass(frozen=True, eq=False)
class Controls:
    """Control inputs of one step, constant over it: `integrator.step(state, dt, controls)`.

    Every input is one array for all worlds, or has an axis of worlds in front. Inputs left out are as in the scene. Motions and loads
    that the scene gives as functions of time stay, the same in all worlds; control loads add to them. Controls belong to the step
    alone: later queries of a state (reactions, spectra, energy of gravity) know only the loads and fields of the scene.

    `statics.solve(model, controls=...)` takes them, too. The load parameter then scales loads, gravity and the field like the loads
    of the scene. Poses are reached at its end, and fields on a straight path from the fields of the scene at its start.

    Attributes:
        poses: pose of every `Grip` at the end of the step (grips, 6) or (worlds, grips, 6), in the order of `model.grips`: translation
            [m] and rotation vector [rad] relative to rest. Without, grips stay where they are.
        forces: on points (P, 3) or (worlds, P, 3) [N], in the order of `State.points`. Rows of one node (joined rods) add up. A shell
            of revolution takes the force on the whole ring.
        moments: about the tangents of edges (edges,) or (worlds, edges) [N m], in the order of `State.angles`.
        gravity: (3,) or (worlds, 3) [m/s^2], instead of the scene's.
        field: (3,) or (worlds, 3) [T], a uniform magnetic field on top of the scene's.
        fields: values that replace the fields of the scene, by name; see `Scene.prescribe`. One number, one number an element, or both
            with an axis of worlds in front; (worlds,) is one number a world.
        angles: of hinges (hinges,) or (worlds, hinges) [rad], in the order of `Scene.hinge` calls, instead of the scene's; hinges
            without a driven angle ignore theirs, which is zero.
        torques: of hinges (hinges,) or (worlds, hinges) [N m], added to the scene's.
        wrenches: force at the centre of mass [N] and moment [N m] on every rigid body (bodies, 6) or (worlds, bodies, 6), in space.
    """

    poses: Numbers | None = None
    forces: Numbers | None = None
    moments: Numbers | None = None
    gravity: Numbers | None = None
    field: Numbers | None = None
    fields: Mapping[str, Numbers] | None = None
    angles: Numbers | None = None
    torques: Numbers | None = None
    wrenches: Numbers | None = None

    def checked(self, model: "Model") -> dict[str, Floats]:
        """Return the given inputs by name, each with an axis of worlds (1 or worlds, ...); "fields" is a dict.

        Raises:
            SceneError: a shape does not fit, a value is not finite, or the model has nothing that it could act on.
        """
        inputs = {name: values for name, values in vars(self).items() if values is not None}
        prescribed = inputs.pop("fields", None)
        expected = shapes(model) if inputs else {}
        result = {name: _numbers(name, values, expected[name], model.worlds) for name, values in inputs.items()}
        if inputs:
            _refuse_missing(model, result)
            _refuse_out_of_plane(model, result)
        if prescribed is not None:
            result["fields"] = _checked_fields(model, prescribed)
        return result


TimedControls: TypeAlias = Controls | Callable[[float], Controls] | None


def _checked_fields(model, values) -> dict[str, np.ndarray]:
    """Return values of fields by name, as of `FieldElements.given`."""
    if not isinstance(values, Mapping):
        raise SceneError(
            f"Controls: fields are {argument_checks.shown(values)}; give values by name, as {{'muscle': ...}}"
        )
    return {name: named_field(model, name).given(each) for name, each in values.items()}


def named_field(model, name: str):
    """Return the field of a name, `FieldElements`.

    Raises:
        SceneError: the model has no such field.
    """
    if name not in model.fields.items:
        listed = ", ".join(map(repr, model.fields.items)) or "none; add one by scene.prescribe(name, parameter)"
        raise SceneError(f"Controls: fields: there is no field {name!r}; the model has {listed}")
    return model.fields.items[name]


def controls_at(controls: "TimedControls", t: float) -> Controls | None:
    """Return the controls of a step that ends at t [s], from controls or a function of time."""
    return controls(t) if callable(controls) else controls


def checked(controls: Controls | None, model, call: str = "step") -> dict[str, np.ndarray]:
    """Return the arrays of `Controls.checked` by name; {} without controls."""
    if controls is None:
        return {}
    if not isinstance(controls, Controls):
        raise SceneError(
            f"{call}: controls are {argument_checks.shown(controls)}; give "
            "Controls(poses=..., forces=..., moments=..., gravity=..., field=..., fields=..., angles=..., torques=..., wrenches=...)"
        )
    return controls.checked(model)


def _numbers(name: str, values, shape: tuple, worlds: int) -> np.ndarray:
    """Return the values of a field as a checked float array with an axis of worlds."""
    values = argument_checks.array(f"Controls: {name}", values)
    if values.shape not in (shape, (worlds, *shape)):
        raise SceneError(
            f"Controls: {name} have shape {values.shape}; they are {shape}, or {(worlds, *shape)} for each of the worlds"
        )
    if not host_arrays.all_finite(values):
        *world, entry = np.argwhere(~np.isfinite(values))[0][: values.ndim - len(shape) + 1]
        where = f" in world {world[0]}" if world else ""
        raise SceneError(f"Controls: {name}: entry {entry}{where} is not finite; give finite numbers")
    return values if values.ndim > len(shape) else values[None]


def shapes(model) -> dict[str, tuple]:
    """Return the shape of every field of `Controls` for one world, by name."""
    points, edges, grips = model.points_count, model.order.edges_count, len(model.grips)
    hinges, bodies = len(model.drives.joints), len(model.scene.bodies)
    of_bodies = {"angles": (hinges,), "torques": (hinges,), "wrenches": (bodies, 6)}
    return of_bodies | {"forces": (points, 3), "moments": (edges,), "gravity": (3,), "field": (3,), "poses": (grips, 6)}


DRIVES = "angles", "torques"  # controls of hinges


def require_acting(model, names) -> None:
    """Refuse poses without grips, and a field without magnetised rods.

    Raises:
        SceneError: `names` has poses, and there is no grip; or a field, and no rod is magnetised or the scene has no field.
    """
    if "field" in names and not model.magnetic:
        raise SceneError(
            "Controls: a magnetic field acts on nothing; magnetise rods by scene.magnetize, and add scene.magnetic_field((0, 0, 0)) to "
            "which it adds"
        )
    pinned = [joint.second for joint in model.scene.body_joints if joint.first < 0]
    if "gravity" in names and pinned:
        raise SceneError(
            f"Controls: gravity: body {pinned[0]} is joined to the world, and its weight is that of the scene's gravity; leave gravity "
            "out"
        )
    if "poses" in names and not model.grips:
        raise SceneError(
            "Controls: poses of no grip; hold something by Grip(...), as in scene.clamp(rod, motion=Grip())"
        )


def _refuse_missing(model, inputs: dict[str, np.ndarray]) -> None:
    """Refuse controls that act on nothing, and moments about edges without a twist angle."""
    require_acting(model, inputs)
    for name in DRIVES:
        if name in inputs and not model.drives.joints:
            raise SceneError(f"Controls: {name} of no hinge; add one by scene.hinge(...)")
    if "angles" in inputs:
        for hinge in np.flatnonzero(~model.drives.driven & inputs["angles"].any(0))[:1]:
            raise SceneError(
                f"Controls: angles: hinge {hinge} has no driven angle; give 0, or add it by scene.hinge(..., angle=0.0), or a spring"
            )
    if "wrenches" in inputs and not model.scene.bodies:
        raise SceneError("Controls: wrenches of no rigid body; add one by scene.add_body(...)")
    if "moments" in inputs:
        untwisted = np.flatnonzero(inputs["moments"].any(0) & ~model.order.twisted)
        if untwisted.size:
            edge, rod = model.order.edge(untwisted[0])
            raise SceneError(
                f"Controls: moments: edge {edge} of rod {rod} ('{model.curves.names[rod]}') has no twist; give 0, or add the rod with "
                "twist=True, in dimension 3"
            )


def _refuse_out_of_plane(model, inputs: dict[str, np.ndarray]) -> None:
    """Refuse controls that leave the x-z plane of planar scenes and of meridians."""
    scene = model.scene
    planar = scene.dimension == 2
    if not planar and not scene.axisymmetric_shells:
        return
    flat, grips = np.full(model.points_count, planar), np.full(len(model.grips), planar)
    along = [0, 1] if scene.axisymmetric_shells else [1] if planar else []
    for support in scene.ring_supports:
        if support.motion in model.grips:
            grips[model.grips.index(support.motion)] = True
    flat[model.order.meridian_rows] = True
    text = "stays in the plane of x and z"
    if "poses" in inputs:
        poses = np.abs(inputs["poses"]).max(0)
        for grip in np.flatnonzero(grips & poses[:, [1, 3, 5]].any(1))[:1]:
            raise SceneError(
                f"Controls: poses: what grip {grip} holds {text}; give 0 for its translation along y and its rotation about x and z"
            )
    if "forces" in inputs:
        for point in np.flatnonzero(flat & inputs["forces"][..., 1].any(0))[:1]:
            raise SceneError(f"Controls: forces: point {point} {text}; give 0 along y")
    if "field" in inputs and planar and inputs["field"][:, 1].any():
        raise SceneError(f"Controls: field {tuple(inputs['field'][0].tolist())}: the scene {text}; give 0 along y")
    if "gravity" in inputs and inputs["gravity"][:, along].any():
        reason = (
            "shells of revolution are about z; give 0 along x and y"
            if along == [0, 1]
            else f"the scene {text}; give 0 along y"
        )
        raise SceneError(f"Controls: gravity {tuple(inputs['gravity'][0].tolist())}: {reason}")
