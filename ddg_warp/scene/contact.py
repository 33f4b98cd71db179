"""Contact of a scene: colliding objects, contact potential, friction and obstacles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.handle import OBSTACLE, Handle
from ddg_warp.scene.law import Law, is_law
from ddg_warp.scene.obstacles import Capsule, Mesh, Obstacle, Plane, Sphere
from ddg_warp.scene.prescribed_motion import Motion

LAWS = ("barrier", "penalty")
FRICTION_LAWS = ("logistic", "polynomial")
DIRECTIONS = ("forwards", "backwards", "across")
ONE = "; contact_between of rods and an obstacle takes one forwards, one backwards and one across"


@dataclass(frozen=True)
class Contact:
    """Contact settings of a scene; attributes are the arguments of `Scene.contact`."""

    law: str | Law = "barrier"
    range: float | None = None
    stiffness: float | None = None
    friction: float = 0.0
    friction_law: str = "logistic"
    velocity: float = 1e-3
    friction_iterations: int | None = None
    rolling: bool = False
    exclusion_length: float | None = None
    radius: Mapping[str, float] = field(default_factory=dict)
    objects: tuple[str, ...] | None = None

    @property
    def name(self) -> str:
        """Name of the law."""
        return self.law if isinstance(self.law, str) else self.law.density.name


@dataclass(frozen=True)
class Between:
    """Contact settings between objects of two names; None means as in `Contact`.

    Friction is one coefficient, or three: forwards, backwards and across. The root length is of rods of the first name.
    """

    names: tuple[str, str]
    ignore: bool
    friction: float | tuple[float, float, float] | None
    stiffness: float | None
    range: float | None
    root_length: float | None = None


@argument_checks.called
@dataclass(kw_only=True, repr=False, eq=False)
class Contacts:
    """Contact and obstacles of a scene."""

    contact_settings: Contact | None = field(default=None, init=False)
    betweens: list[Between] = field(default_factory=list, init=False)
    obstacles: list[Obstacle] = field(default_factory=list, init=False)

    def contact(
        self,
        *,
        law: Literal["barrier", "penalty"] | Law = "barrier",
        range: float | None = None,
        stiffness: float | None = None,
        friction: float = 0.0,
        friction_law: str = "logistic",
        velocity: float = 1e-3,
        friction_iterations: int | None = None,
        rolling: bool = False,
        exclusion_length: float | None = None,
        radius: Mapping[str, float] | None = None,
        objects: str | Sequence[str] | None = None,
    ) -> None:
        """Enable contact of rods, shells and obstacles without interpenetration.

        Rods are rows of capsules with the radius of the circle of equal area, or the `radius` of a `Stiffness`; of a varying radius
        the largest counts. Shells and meshes have a thickness. Contact acts where
        the gap between two surfaces is below the activation distance `range`. With "barrier" the force grows without bound as the gap
        closes, and surfaces never overlap. With "penalty" it grows with the overlap, and centrelines and midsurfaces never cross.
        See `kernels.densities.contact` and `friction`.

        Measured: piles of 12 and 40 rods take 35 and 50 % longer with `rolling`.

        Args:
            law: contact potential, "barrier" or "penalty"; or a `Law` with one strain, the gap [m]. Its parameters "stiffness"
                and "range" are the arguments below, the others one number each. It is repulsive, convex, and zero from the range on.
                Surfaces never overlap if its energy is infinite at zero gap.
            range: activation distance: gap below which contact acts [m]. By default half of the smallest radius of a rod or half
                thickness of a shell. For a rigid body at most a twentieth of the size.
            stiffness: of the contact potential [N/m]; between two objects the geometric mean. By default ten weights of a
                node, bending to ten radii, or half a percent of membrane strain close the gap by a fraction of `range`. A step that
                reaches the minimum gap, in substeps too, is retried with at least ten node masses over the square of its length,
                so that shorter steps succeed. A given stiffness is kept.
            friction: Coulomb coefficient; `contact_between` accepts one for each direction, too.
            friction_law: "logistic" or "polynomial" growth of friction with slip velocity.
            velocity: stick threshold nu [m/s], the slip velocity of nearly full friction; sticking contacts creep at less.
            friction_iterations: friction lag: number of updates of normal forces and tangents in a step. By default 1, and 2 with
                rigid bodies, whose impacts begin and end in a step.
            rolling: whether friction acts on the surface of rods, with its torque on the twist angle, so that rods roll. Otherwise it
                acts between centrelines and loses angular momentum. Two free parallel rods that collide and slide across each
                other lose all of it, but keep 0.95 with rolling. Friction along rods exerts no torque about the
                axis, and loses angular momentum in both cases.
            exclusion_length: collision exclusion distance: arc length below which edges of one rod form no pair [m]; by default pi
                radii.
            radius: by name of objects, instead of radii of sections or half thicknesses [m].
            objects: names of the rods and shells with contact; by default all. Obstacles always have contact.

        Raises:
            SceneError: an invalid argument, or a second call.
        """
        if self.contact_settings is not None:
            raise SceneError("contact: this scene has contact already; use contact_between for exceptions")
        call = "contact: "
        range = None if range is None else argument_checks.positive(f"{call}range", range, "m")
        stiffness = None if stiffness is None else argument_checks.positive(f"{call}stiffness", stiffness, "N/m")
        if exclusion_length is not None:
            exclusion_length = argument_checks.number(
                f"{call}exclusion_length", exclusion_length, "an arc length, zero or more [m]", lambda v: v >= 0.0
            )
        if radius is not None and not isinstance(radius, Mapping):
            raise SceneError(
                f"{call}radius is {argument_checks.shown(radius)}; give a dictionary from names of objects to radii [m]"
            )
        for name, value in (radius or {}).items():
            argument_checks.text(f"{call}a name in radius", name)
            argument_checks.positive(f"{call}radius of {name!r}", value, "m")
        self.contact_settings = Contact(
            law if is_law(law) else argument_checks.choice(f"{call}law", law, LAWS),
            range,
            stiffness,
            _friction(f"{call}friction", friction, ONE),
            argument_checks.choice(f"{call}friction_law", friction_law, FRICTION_LAWS),
            argument_checks.positive(f"{call}velocity", velocity, "m/s"),
            None
            if friction_iterations is None
            else argument_checks.count(f"{call}friction_iterations", friction_iterations),
            argument_checks.flag(f"{call}rolling", rolling),
            exclusion_length,
            dict(radius or {}),
            None if objects is None else _names(f"{call}objects", objects),
        )

    def contact_between(
        self,
        one: str,
        other: str,
        *,
        ignore: bool = False,
        friction: float | tuple[float, float, float] | None = None,
        stiffness: float | None = None,
        range: float | None = None,
        root_length: float | None = None,
    ) -> None:
        """Override contact settings between objects of two names, or among objects of one; the last call counts.

        Args:
            one, other: names as given to `add_rods`, `add_shell` and `add_obstacle`.
            ignore: whether the objects pass through each other; excludes all other arguments.
            friction: as of `contact`. For rods on an obstacle also three coefficients of anisotropic friction: sliding forwards
                (towards the last node), backwards, and across (snakes, worms, bristles). `kernels.collision.friction.potential`
                interpolates between these directions.
            stiffness, range: as of `contact`.
            root_length: arc length [m] from the first node of rods named `one`, within which they have no contact with `other`, the
                surface that they grow from. Edges that start and nodes that lie within are left out, and have contact with all else.

        Raises:
            SceneError: an invalid argument. At `build`, three coefficients between other objects than rods and an obstacle, or a root
                length of other objects than rods, or two of the same rods.
        """
        for argument, name in (("one", one), ("other", other)):
            argument_checks.text(f"contact_between: {argument}", name)
        call = f"contact_between {one!r} and {other!r}: "
        stiffness = None if stiffness is None else argument_checks.positive(f"{call}stiffness", stiffness, "N/m")
        range = None if range is None else argument_checks.positive(f"{call}range", range, "m")
        if root_length is not None:
            root_length = argument_checks.positive(f"{call}root_length", root_length, "m")
        if np.iterable(friction) and not isinstance(friction, str):
            friction = argument_checks.vector(f"{call}friction forwards, backwards and across", friction)
            for direction, value in zip(DIRECTIONS, friction, strict=True):
                _friction(f"{call}friction {direction}", value)
        elif friction is not None:
            friction = _friction(f"{call}friction", friction)
        ignore = argument_checks.flag(f"{call}ignore", ignore)
        overrides = [
            name
            for name, value in (
                ("friction", friction),
                ("stiffness", stiffness),
                ("range", range),
                ("root_length", root_length),
            )
            if value is not None
        ]
        if ignore and overrides:
            raise SceneError(f"{call}ignored pairs have no {overrides[0]}; give ignore or {overrides[0]}")
        if not (ignore or overrides):
            raise SceneError(f"{call}no exception; give ignore=True, friction, stiffness, range or root_length")
        self.betweens.append(Between((one, other), ignore, friction, stiffness, range, root_length))

    def add_obstacle(
        self, shape: Plane | Sphere | Capsule | Mesh, *, motion: Motion | Grip | None = None, name: str = "obstacle"
    ) -> Handle:
        """Add a kinematic rigid collider to a scene with `contact`.

        Args:
            shape: `Plane`, `Sphere`, `Capsule`, `Box` or `Mesh` in the initial position.
            motion: rigid motion of the obstacle; friction follows its surface, also of a spinning ball or drum. For a mesh it may
                give a displacement for each vertex. Fixed by default. Steps along arcs are divided into substeps that resolve
                the arcs, see `ddg_warp.solve.collision.support_arcs`.
            name: of the obstacle in `contact_between` and output.

        Returns:
            Handle of the obstacle.

        Raises:
            SceneError: an invalid shape, or a motion that does not fit.
        """
        argument_checks.text("add_obstacle: name", name)
        if not isinstance(shape, Plane | Sphere | Capsule | Mesh):
            raise SceneError(f"add_obstacle '{name}': shape is {shape!r}; give Plane, Sphere, Capsule, Box or Mesh")
        if motion is not None and not isinstance(motion, Motion | Grip):
            raise SceneError(
                f"add_obstacle '{name}': motion is {motion!r}; give Motion(translation=..., angle=...) or Grip(pivot=...)"
            )
        count = getattr(motion, "count", None)
        if count is not None and (not isinstance(shape, Mesh) or count != len(shape.points)):
            raise SceneError(
                f"add_obstacle '{name}': the motion has {count} displacements, the shape {len(shape.points)} points; "
                "of a Mesh give one for each vertex, of other shapes one for all"
            )
        self.obstacles.append(Obstacle(shape, motion, name))
        return Handle(len(self.obstacles) - 1, OBSTACLE, name)


def check_contact(scene) -> None:
    """Refuse contact settings without effect, or with unknown names.

    Raises:
        SceneError: the first error.
    """
    if scene.contact_settings is None:
        if scene.obstacles:
            raise SceneError(f"obstacle 0 ('{scene.obstacles[0].name}') has no contact; add scene.contact()")
        if scene.betweens:
            raise SceneError("contact_between: this scene has no contact; add scene.contact()")
        return
    if scene.dimension == 2:
        raise SceneError("contact: a scene with contact has dimension 3; leave dimension=2 to scenes without")
    if scene.axisymmetric_shells:
        raise SceneError(f"contact: shell of revolution 0 ('{scene.axisymmetric_shells[0].name}') has no contact")
    if not any(np.any(between.friction) for between in (scene.contact_settings, *scene.betweens) if between.friction):
        for name in ("friction_law", "velocity", "friction_iterations"):
            if getattr(scene.contact_settings, name) != getattr(Contact, name):
                raise SceneError(
                    f"contact: {name} is of friction, and there is none; give friction, or leave {name} out"
                )
    bodies = {batch.name for batch in scene.batches} | {shell.name for shell in scene.shells}
    bodies |= {body.name for body in scene.bodies if body.shapes}
    moving, obstacles = contact_names(scene), {obstacle.name for obstacle in scene.obstacles}
    names = moving | obstacles
    named = [("objects", name, bodies) for name in scene.contact_settings.objects or ()]
    named += [("radius", name, moving) for name in scene.contact_settings.radius]
    named += [("contact_between", name, names) for between in scene.betweens for name in between.names]
    for label, name, valid in named:
        if name not in valid:
            raise SceneError(
                f"contact: {label} names {name!r}; objects with contact are {', '.join(map(repr, sorted(valid)))}"
            )
    for between in scene.betweens:
        if not moving & set(between.names):
            raise SceneError(
                "contact_between {!r} and {!r}: there is no contact between obstacles; leave it out".format(
                    *between.names
                )
            )
        if isinstance(between.friction, tuple):
            _check_directed(scene, between, obstacles)
    _check_roots(scene)


def _check_directed(scene, between: Between, obstacles: set[str]) -> None:
    """Refuse anisotropic friction of any pair but rods on an obstacle."""
    rods, shells = {batch.name for batch in scene.batches}, {shell.name for shell in scene.shells}
    rods, obstacles = rods - shells - obstacles, obstacles - rods - shells
    a, b = between.names
    if not ((a in rods and b in obstacles) or (b in rods and a in obstacles)):
        raise SceneError(
            f"contact_between {a!r} and {b!r}: friction forwards, backwards and across is of rods on an obstacle, and names of "
            "their own; give one coefficient"
        )


def _check_roots(scene) -> None:
    """Refuse roots of other objects than rods, and two root lengths of the same rods."""
    rods, lengths = {batch.name for batch in scene.batches}, {}
    for between in scene.betweens:
        if between.root_length is None:
            continue
        one, partner = between.names
        call = f"contact_between {one!r} and {partner!r}: root_length"
        if one not in rods:
            raise SceneError(f"{call} is of rods, and {one!r} are none; name rods first")
        if lengths.setdefault(one, between.root_length) != between.root_length:
            raise SceneError(f"{call} is {between.root_length}, and {lengths[one]} for another object; give one length")


def contact_names(scene) -> set[str]:
    """Return the names of rods, shells and rigid bodies with contact."""
    if scene.contact_settings is None:
        return set()
    if scene.contact_settings.objects is not None:
        return set(scene.contact_settings.objects)
    return {item.name for item in (*scene.batches, *scene.shells)} | {body.name for body in scene.bodies if body.shapes}


def _names(label: str, values) -> tuple[str, ...]:
    """Return names without repetition, from one or several."""
    names = [values] if isinstance(values, str) else list(values) if np.iterable(values) else []
    if not names or not all(isinstance(name, str) for name in names):
        raise SceneError(
            f"{label} is {argument_checks.shown(values)}; give a name or a list of names of rods and shells"
        )
    return tuple(dict.fromkeys(names))


def _friction(label: str, value: float, more: str = "") -> float:
    return argument_checks.number(
        label, value, f"a coefficient, zero or more{more}", lambda v: v >= 0.0 and np.isfinite(v)
    )
