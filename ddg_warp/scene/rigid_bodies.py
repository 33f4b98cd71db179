"""Rigid bodies of a scene, and the rods and shells attached to them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.geometry.mass_properties import mass_properties, principal_axes
from ddg_warp.scene.handle import BODY, BODY_JOINT, SHELL, Handle, need
from ddg_warp.scene.obstacles import Capsule, Mesh, Sphere
from ddg_warp.typing import Numbers, Vector

LEAST_MOMENT = 1e-9  # smallest principal moment over the largest one, of which float64 resolves a free rotation


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Rigid body of a scene.

    Attributes:
        mass: [kg].
        center: centre of mass at rest (3,) [m].
        moments: principal moments of inertia (3,) [kg m^2].
        axes: principal axes at rest, columns of a rotation matrix (3, 3).
        velocity: initial velocity of the centre (3,) [m/s].
        angular_velocity: initial angular velocity in space (3,) [rad/s].
        shapes: surfaces for display.
        name: "" without.
    """

    mass: float
    center: np.ndarray
    moments: np.ndarray
    axes: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    shapes: tuple[Sphere | Capsule | Mesh, ...]
    name: str


@dataclass(frozen=True, eq=False)
class BodyAttachment:
    """Nodes of a rod, or vertices of a shell, that a rigid body carries.

    Attributes:
        body: index.
        kind: "rod" or "shell"; index: of it.
        nodes: its nodes or vertices (n,).
        clamped: whether the body clamps the rod by its frame at the nodes.
    """

    body: int
    kind: str
    index: int
    nodes: np.ndarray
    clamped: bool


@dataclass(frozen=True, eq=False)
class BodyJoint:
    """Joint between two rigid bodies, or between a body and the world.

    Attributes:
        call: "ball", "hinge" or "weld".
        first, second: bodies, -1 for the world.
        point: common point at rest (3,) [m]; axis: unit vector (3,) of a hinge at rest.
        angle: of `second` relative to `first` about the axis [rad], one number or a function of time; None if free, or zero.
        torque: on `second` about the axis [N m], one number or a function of time; None without.
        spring: torsional stiffness between the angle of the bodies and `angle` [N m], None if `angle` is met exactly.
        damping: [N m s]; stops: least and largest angle [rad], None without.
        stiffness: of the separation [N/m], None for the default.
        name: "" without.
    """

    call: str
    first: int
    second: int
    point: np.ndarray
    axis: np.ndarray
    angle: float | Callable[[float], float] | None
    torque: float | Callable[[float], float] | None
    spring: float | None
    damping: float
    stops: tuple[float, float] | None
    stiffness: float | None
    name: str


@dataclass(kw_only=True, repr=False, eq=False)
class RigidBodies:
    """Rigid bodies of a `Scene`."""

    bodies: list[RigidBody] = field(default_factory=list, init=False)
    body_attachments: list[BodyAttachment] = field(default_factory=list, init=False)
    body_joints: list[BodyJoint] = field(default_factory=list, init=False)

    def add_body(
        self,
        shapes: Sphere | Capsule | Mesh | Iterable[Sphere | Capsule | Mesh] | None = None,
        *,
        density: float | None = None,
        mass: float | None = None,
        inertia: Numbers | None = None,
        center: Vector | None = None,
        velocity: Vector = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        name: str = "body",
    ) -> Handle:
        """Add a rigid body of uniform density within shapes, or of given mass and inertia; return its handle.

        Args:
            shapes: `Sphere`, `Capsule`, `Box` or closed `Mesh`, or several that do not overlap, where they are at rest.
            density: of the shapes [kg/m^3]; or give `mass`.
            mass: [kg]; scales the inertia of the shapes, if `inertia` is not given.
            inertia: about the centre [kg m^2]: moments about x, y and z (3,), or the tensor (3, 3).
            center: centre of mass at rest (3,) [m], with `inertia`; by default of the shapes.
            velocity: initial velocity of the centre (3,) [m/s].
            angular_velocity: initial angular velocity (3,) [rad/s].
            name: name for queries; bodies of one name have common contact parameters.

        Attach rods and shells with `attach`. With `contact` the shapes collide with rods, shells, obstacles and other bodies. They
        do not collide with the rods and shells that the body carries, nor with bodies that a joint connects to it. Friction acts on
        the surfaces, and so rolls bodies.

        Raises:
            SceneError: a shape without volume, an inertia that no body has, or a missing quantity; the message names it.
        """
        shapes = () if shapes is None else tuple(shapes) if isinstance(shapes, Iterable) else (shapes,)
        for shape in shapes:
            if not isinstance(shape, Sphere | Capsule | Mesh):
                raise SceneError(
                    f"add_body: {argument_checks.shown(shape)} is no body; give Sphere, Capsule, Box or a closed Mesh"
                )
        if (density is None) == (mass is None):
            raise SceneError("add_body: give either density or mass")
        if not shapes and (density is not None or inertia is None or center is None):
            raise SceneError("add_body: without shapes, give mass, inertia and center")
        if (inertia is None and center is not None) or (density is not None and inertia is not None):
            raise SceneError(
                "add_body: center and inertia belong to a mass; leave them to the shapes, or give mass and inertia"
            )
        if inertia is None:
            density = 1.0 if density is None else argument_checks.positive("add_body: density", density, "kg/m^3")
            total, middle, tensor = mass_properties(shapes, density)
            factor = 1.0 if mass is None else argument_checks.positive("add_body: mass", mass, "kg") / total
            mass, tensor = factor * total, factor * tensor
        else:
            mass, tensor = argument_checks.positive("add_body: mass", mass, "kg"), _tensor(inertia)
            middle = (
                mass_properties(shapes, 1.0)[1]
                if center is None
                else argument_checks.vector("add_body: center", center)
            )
        moments, axes = _principal(tensor)
        vectors = {"velocity": velocity, "angular_velocity": angular_velocity}
        rates = (np.array(argument_checks.vector(f"add_body: {key}", value)) for key, value in vectors.items())
        name = argument_checks.text("add_body: name", name)
        self.bodies.append(RigidBody(mass, np.array(middle), moments, axes, *rates, shapes, name))
        return Handle(len(self.bodies) - 1, BODY, name)

    def ball(
        self, first: int, second: int | None = None, *, point: Vector, stiffness: float | None = None, name: str = ""
    ) -> Handle:
        """Join two bodies at a point, or a body to the world there, about which they rotate freely; return the handle.

        Args:
            first, second: bodies; without `second` the world.
            point: common point at rest (3,) [m].
            stiffness: of the separation of the points that the bodies carry [N/m]. By default a thousandth of the arm under a
                thousand times the weight of the heavier body at 9.81 m/s^2.
            name: of the joint.

        Raises:
            SceneError: a body does not exist, or both are one.
        """
        return self._add_joint("ball", first, second, point, (0.0, 0.0, 1.0), stiffness=stiffness, name=name)

    def hinge(
        self,
        first: int,
        second: int | None = None,
        *,
        point: Vector,
        axis: Vector,
        angle: float | Callable[[float], float] | None = None,
        torque: float | Callable[[float], float] | None = None,
        spring: float | None = None,
        damping: float = 0.0,
        stops: tuple[float, float] | None = None,
        stiffness: float | None = None,
        name: str = "",
    ) -> Handle:
        """Join two bodies by a hinge, or a body to the world, driven by an angle, or by a torque; return the handle.

        The angle is that of `second` relative to `first` about the axis, zero at rest; without `second` that of the body relative to
        the world. It counts revolutions, as long as it changes by less than half of one a step.

        Args:
            first, second: bodies; without `second` the world.
            point: common point at rest (3,) [m].
            axis: direction at rest (3,).
            angle: driven angle, one number or a function of time [rad]; `Controls.angles` replaces it step by step.
            torque: on `second` about the axis, and the opposite one on `first`: one number, or a function of time [N m].
            spring: torsional stiffness [N m]. `angle`, zero by default, is then that of the relaxed spring. A torque, damping and stops
                may act, too: a servo motor.
            damping: torque against the angular rate [N m s].
            stops: least and largest angle [rad].
            stiffness: of the separation [N/m], see `ball`; angles have this times the square of the arm.
            name: of the joint.

        Raises:
            SceneError: a body does not exist, both are one, or the angle has a torque or stops, but no spring.
        """
        if spring is not None:
            spring = argument_checks.number("hinge: spring", spring, "zero or more [N m]", lambda v: v >= 0.0)
        elif angle is not None and (torque is not None or damping or stops is not None):
            raise SceneError(
                "hinge: a driven angle leaves nothing to a torque, damping or stops; leave these out, or give a spring"
            )
        argument_checks.number("hinge: damping", damping, "zero or more [N m s]", lambda v: v >= 0.0)
        if stops is not None:
            lower, upper = argument_checks.broadcast("hinge: stops", stops, (2,))
            if not lower <= 0.0 <= upper or lower == upper:
                raise SceneError(
                    f"hinge: stops are ({lower:g}, {upper:g}) rad; give the least and the largest, with 0 between them"
                )
            stops = float(lower), float(upper)
        for label, value in (("angle", angle), ("torque", torque)):
            if callable(value):
                argument_checks.value_at(f"hinge: {label}", value, 0.0, error=SceneError)
            elif value is not None:
                argument_checks.number(f"hinge: {label}", value)
        options = {"angle": angle, "torque": torque, "spring": spring, "damping": float(damping), "stops": stops}
        return self._add_joint("hinge", first, second, point, axis, stiffness=stiffness, name=name, **options)

    def weld(
        self,
        first: int,
        second: int | None = None,
        *,
        point: Vector | None = None,
        stiffness: float | None = None,
        name: str = "",
    ) -> Handle:
        """Join two bodies rigidly, or a body to the world, up to the stiffness; return the handle.

        Args:
            first, second: bodies; without `second` the world.
            point: where forces are transmitted (3,) [m]; by default the mean of the centres, or the centre of `first`.
            stiffness: of the separation [N/m], see `ball`; angles have this times the square of the arm.
            name: of the joint.

        Raises:
            SceneError: a body does not exist, or both are one.
        """
        if point is None:
            numbers = [self._body("weld", body) for body in (first, second) if body is not None]
            point = np.mean([self.bodies[number].center for number in numbers], axis=0)
        return self._add_joint("weld", first, second, point, (0.0, 0.0, 1.0), stiffness=stiffness, name=name)

    def _add_joint(self, call, first, second, point, axis, *, stiffness, name, **drive) -> Handle:
        first, second = self._body(call, first), -1 if second is None else self._body(call, second)
        if first == second:
            raise SceneError(f"{call}: body {first} is joined to itself; give two bodies, or one and the world")
        if second < 0:
            first, second = second, first
        point = np.array(argument_checks.vector(f"{call}: point", point))
        axis = argument_checks.direction(f"{call}: axis", axis)
        if stiffness is not None:
            stiffness = argument_checks.positive(f"{call}: stiffness", stiffness, "N/m")
        name = name and argument_checks.text(f"{call}: name", name)
        free = {"angle": None, "torque": None, "spring": None, "damping": 0.0, "stops": None}
        self.body_joints.append(
            BodyJoint(call, first, second, point, axis, **(free | drive), stiffness=stiffness, name=name)
        )
        return Handle(len(self.body_joints) - 1, BODY_JOINT, name)

    def _attach_to_body(self, item, nodes, body, frame: bool) -> None:
        """Let a body carry nodes of a rod or vertices of a shell; see `attach`."""
        body = self._body("attach", body)
        frame = argument_checks.flag("attach: frame", frame)
        if isinstance(item, Handle) and item.kind == SHELL:
            self.body_attachments.append(BodyAttachment(body, "shell", int(item), self._vertices(item, nodes), False))
            return
        (rod,), nodes = self._on_rods("attach", argument_checks.index("attach: rod", item), "node", nodes)
        self.body_attachments.append(BodyAttachment(body, "rod", int(rod), np.array(nodes), frame))

    def _body(self, call: str, body) -> int:
        """Return the index of a rigid body; refuse anything else."""
        need(BODY, body)
        index = argument_checks.index(f"{call}: body", body)
        if not 0 <= index < len(self.bodies):
            raise SceneError(f"{call}: body {index} does not exist; the scene has {len(self.bodies)} bodies so far")
        return index


def _tensor(inertia) -> np.ndarray:
    """Return an inertia tensor (3, 3) from moments about x, y and z, or a tensor; refuse anything else."""
    values = argument_checks.array("add_body: inertia", inertia, "give moments (3,) or a tensor (3, 3) [kg m^2]")
    values = np.diag(values) if values.shape == (3,) else values
    symmetric = values.shape == (3, 3) and np.abs(values - values.T).max() <= 1e-9 * np.abs(values).max()
    if not (np.isfinite(values).all() and symmetric):
        raise SceneError(
            f"add_body: inertia has shape {np.shape(inertia)} or is not symmetric; give moments (3,) or a symmetric tensor (3, 3)"
        )
    return 0.5 * (values + values.T)


def _principal(tensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return principal moments (3,) and axes, columns of a rotation (3, 3); axes of a diagonal tensor stay x, y and z."""
    if np.array_equal(tensor, np.diag(np.diag(tensor))):
        moments, axes = np.diag(tensor).copy(), np.eye(3)
    else:
        moments, axes = principal_axes(tensor)
    largest = moments.max()
    if not moments.min() > LEAST_MOMENT * largest or moments.sum() < 2.0 * largest * (1.0 - 1e-6):
        raise SceneError(
            f"add_body: principal moments of inertia {moments} kg m^2; they are positive, and none exceeds the sum of the others"
        )
    return moments, axes
