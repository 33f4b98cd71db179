"""What a scene says about contact: what may touch, by which law, and obstacles."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.motion import Motion
from ddg_warp.scene.obstacles import Capsule, Mesh, Obstacle, Plane, Sphere

LAWS = ("barrier", "penalty")
FRICTION_LAWS = ("logistic", "polynomial")
WAYS = ("forwards", "backwards", "across")
ONE = "; contact_between of rods and an obstacle takes one forwards, one backwards and one across"


@dataclass(frozen=True)
class Contact:
    """Contact of a scene; attributes as the arguments of `Scene.contact`."""

    law: str = "barrier"
    range: float | None = None
    stiffness: float | None = None
    friction: float = 0.0
    friction_law: str = "logistic"
    velocity: float = 1e-3
    lags: int = 1
    rolling: bool = False
    apart: float | None = None
    radius: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    objects: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Between:
    """What is different between objects of two names; None where it is not. Friction is a number, or forwards, backwards and across."""

    names: tuple[str, str]
    ignore: bool
    friction: float | tuple[float, float, float] | None
    stiffness: float | None
    range: float | None


@arguments.called
@dataclass(kw_only=True, repr=False, eq=False)
class Contacts:
    """The part of a scene that is about contact."""

    touching: Contact | None = field(default=None, init=False)
    betweens: list[Between] = field(default_factory=list, init=False)
    obstacles: list[Obstacle] = field(default_factory=list, init=False)

    def contact(
        self,
        *,
        law: str = "barrier",
        range: float | None = None,
        stiffness: float | None = None,
        friction: float = 0.0,
        friction_law: str = "logistic",
        velocity: float = 1e-3,
        lags: int = 1,
        rolling: bool = False,
        apart: float | None = None,
        radius: Mapping[str, float] | None = None,
        objects=None,
    ) -> None:
        """Let rods, shells and obstacles touch: nothing passes through anything.

        Rods are rows of capsules, as thick as the `radius` of their section: of one that is no circle that of the circle of its area,
        of `Stiffness` the one it was given, where it changes along the rod the largest. Shells and meshes have a thickness. Two
        surfaces push each other where the gap between them is below `range`. By "barrier" the force grows without bound as the gap
        closes, and nothing overlaps; by "penalty" it grows with the overlap, and the lines and surfaces in the middle never cross.
        See `kernels.densities.contact` and `friction`.

        Args:
            law: "barrier" or "penalty".
            range: gap below which surfaces push each other [m]; by default half of the smallest radius of a rod or half thickness of
                a shell.
            stiffness: of the law [N/m]; by default of every object what lets ten weights of a node, bending as tight as ten radii, or
                half a percent of strain in a shell's membrane close the gap by some part of the range, and between two the geometric
                mean. A step that has no room by that, in halves either, is tried again with at least ten times the mass of a node over
                the square of its length, so that shorter steps stop what longer ones do. A stiffness that is given stays as it is.
            friction: Coulomb's coefficient; `contact_between` takes one for each direction, too.
            friction_law: "logistic" or "polynomial": how friction grows with the speed.
            velocity: the speed nu from which on all of the friction acts, nearly [m/s]: what sticks creeps by less.
            lags: how often in a step friction takes the normal forces and directions anew.
            rolling: whether friction acts on the surfaces of rods, of the capsules that they are here, and turns them about their axes,
                so that they roll. Else it acts between their middle lines, and takes the angular momentum of what rubs: all that two
                free parallel rods have that meet and slide across each other, which keep 0.95 of it if they roll. Friction along rods
                turns none about its axis, and takes it either way. Piles of 12 and 40 rods take 35 and 50 % longer so.
            apart: edges of a rod with less than this between them along it are no pair [m]; by default pi times its radius.
            radius: by name of objects, instead of those of their sections, or half thicknesses [m].
            objects: names of the rods and shells that touch; by default all. Obstacles always do.

        Raises:
            SceneError: an argument that is none of these, or contact was described before.
        """
        if self.touching is not None:
            raise SceneError("contact: this scene has contact already; use contact_between for what differs")
        call = "contact: "
        range = None if range is None else arguments.positive(f"{call}range", range, "m")
        stiffness = None if stiffness is None else arguments.positive(f"{call}stiffness", stiffness, "N/m")
        if apart is not None:
            apart = arguments.number(f"{call}apart", apart, "an arc length, zero or more [m]", lambda v: v >= 0.0)
        if radius is not None and not isinstance(radius, Mapping):
            raise SceneError(
                f"{call}radius is {arguments.shown(radius)}; give a dictionary from names of objects to radii [m]"
            )
        for name, value in (radius or {}).items():
            arguments.text(f"{call}a name in radius", name)
            arguments.positive(f"{call}radius of {name!r}", value, "m")
        self.touching = Contact(
            arguments.choice(f"{call}law", law, LAWS),
            range,
            stiffness,
            _friction(f"{call}friction", friction, ONE),
            arguments.choice(f"{call}friction_law", friction_law, FRICTION_LAWS),
            arguments.positive(f"{call}velocity", velocity, "m/s"),
            arguments.count(f"{call}lags", lags),
            arguments.flag(f"{call}rolling", rolling),
            apart,
            MappingProxyType(dict(radius or {})),
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
    ) -> None:
        """What is different between objects of two names, or among those of one; the last call counts.

        Args:
            one, other: names as given to `add_rods`, `add_shell` and `add_obstacle`.
            ignore: whether they pass through each other; nothing else is given then.
            friction: as of `contact`; or, of rods on an obstacle, three coefficients: of a rod that slides forwards, towards its last
                node, backwards, and across itself (snakes, worms, bristles). Between these directions it is as
                `kernels.contact.pair_friction` says.
            stiffness, range: as of `contact`.

        Raises:
            SceneError: an argument that is none of these; at `build`, three coefficients between what is no rod and an obstacle.
        """
        for which, name in (("one", one), ("other", other)):
            arguments.text(f"contact_between: {which}", name)
        call = f"contact_between {one!r} and {other!r}: "
        stiffness = None if stiffness is None else arguments.positive(f"{call}stiffness", stiffness, "N/m")
        range = None if range is None else arguments.positive(f"{call}range", range, "m")
        if np.iterable(friction) and not isinstance(friction, str):
            friction = arguments.vector(f"{call}friction forwards, backwards and across", friction)
            for way, value in zip(WAYS, friction, strict=True):
                _friction(f"{call}friction {way}", value)
        elif friction is not None:
            friction = _friction(f"{call}friction", friction)
        ignore = arguments.flag(f"{call}ignore", ignore)
        given = [
            name
            for name, value in (("friction", friction), ("stiffness", stiffness), ("range", range))
            if value is not None
        ]
        if ignore and given:
            raise SceneError(f"{call}what passes through each other has no {given[0]}; give ignore or {given[0]}")
        if not (ignore or given):
            raise SceneError(f"{call}nothing is different; give ignore=True, friction, stiffness or range")
        self.betweens.append(Between((one, other), ignore, friction, stiffness, range))

    def add_obstacle(
        self, shape: Plane | Sphere | Capsule | Mesh, *, motion: Motion | Grip | None = None, name: str = "obstacle"
    ) -> int:
        """Add a body that rods and shells of a scene with `contact` touch, and that nothing bends.

        Args:
            shape: `Plane`, `Sphere`, `Capsule`, `Box` or `Mesh`, where it is at the start.
            motion: moves it as a whole, and friction goes with its surface, also of a ball or drum that spins about itself; of a mesh
                it may give every vertex a displacement of its own. It stays still without. Steps in which it sweeps arcs are taken
                in substeps that resolve these, see `ddg_warp.solve.net.arcs`.
            name: by which `contact_between` and output know it.

        Returns:
            Index of the obstacle.

        Raises:
            SceneError: no such shape, or a motion that does not fit.
        """
        arguments.text("add_obstacle: name", name)
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
        return len(self.obstacles) - 1


def check_contact(scene) -> None:
    """Refuse contact that is about nothing, or of names that nothing has.

    Raises:
        SceneError: the first thing found wrong.
    """
    if scene.touching is None:
        if scene.obstacles:
            raise SceneError(f"obstacle 0 ('{scene.obstacles[0].name}') touches nothing; add scene.contact()")
        if scene.betweens:
            raise SceneError("contact_between: this scene has no contact; add scene.contact()")
        return
    if scene.dimension == 2:
        raise SceneError("contact: a scene with contact has dimension 3; leave dimension=2 to scenes without")
    if scene.axisymmetric_shells:
        raise SceneError(
            f"contact: shell of revolution 0 ('{scene.axisymmetric_shells[0].name}') can not touch anything"
        )
    if not any(np.any(between.friction) for between in (scene.touching, *scene.betweens) if between.friction):
        for name in ("friction_law", "velocity", "lags"):
            if getattr(scene.touching, name) != getattr(Contact, name):
                raise SceneError(
                    f"contact: {name} is of friction, and there is none; give friction, or leave {name} out"
                )
    bodies = {batch.name for batch in scene.batches} | {shell.name for shell in scene.shells}
    moving, obstacles = touching_names(scene), {obstacle.name for obstacle in scene.obstacles}
    names = moving | obstacles
    asked = [("objects", name, bodies) for name in scene.touching.objects or ()]
    asked += [("radius", name, moving) for name in scene.touching.radius]
    asked += [("contact_between", name, names) for between in scene.betweens for name in between.names]
    for what, name, known in asked:
        if name not in known:
            raise SceneError(f"contact: {what} names {name!r}; what can touch is {', '.join(map(repr, sorted(known)))}")
    for between in scene.betweens:
        if not moving & set(between.names):
            raise SceneError(
                "contact_between {!r} and {!r}: obstacles never touch each other; leave it out".format(*between.names)
            )
        if isinstance(between.friction, tuple):
            _check_directed(scene, between, obstacles)


def _check_directed(scene, between: Between, obstacles: set[str]) -> None:
    """Refuse friction by direction of anything but rods on an obstacle."""
    rods, shells = {batch.name for batch in scene.batches}, {shell.name for shell in scene.shells}
    rods, obstacles = rods - shells - obstacles, obstacles - rods - shells
    one, other = between.names
    if not ((one in rods and other in obstacles) or (other in rods and one in obstacles)):
        raise SceneError(
            f"contact_between {one!r} and {other!r}: friction forwards, backwards and across is of rods on an obstacle, and names of "
            "their own; give one coefficient"
        )


def touching_names(scene) -> set[str]:
    """Names of the rods and shells that touch."""
    if scene.touching is None:
        return set()
    if scene.touching.objects is not None:
        return set(scene.touching.objects)
    return {batch.name for batch in scene.batches} | {shell.name for shell in scene.shells}


def _names(what: str, values) -> tuple[str, ...]:
    """Names without repetition, from one or several."""
    names = [values] if isinstance(values, str) else list(values) if np.iterable(values) else []
    if not names or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{what} is {arguments.shown(values)}; give a name or a list of names of rods and shells")
    return tuple(dict.fromkeys(names))


def _friction(what: str, value: float, more: str = "") -> float:
    return arguments.number(what, value, f"a coefficient, zero or more{more}", lambda v: v >= 0.0 and np.isfinite(v))
