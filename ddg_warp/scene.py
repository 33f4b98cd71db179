"""The description of a simulation: rods, supports, loads. NumPy only; nothing here knows a device."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import validate
from ddg_warp.errors import SceneError
from ddg_warp.integrate.path import Displacement, Stop
from ddg_warp.material import Material, Stiffness
from ddg_warp.motion import Motion
from ddg_warp.structures import Structures


@dataclass(frozen=True)
class Dynamics:
    """Advance in time: step dt [s] to duration [s] by `scheme` (`implicit_euler` or `implicit_midpoint`)."""

    dt: float = 0.01
    duration: float = 1.0
    scheme: str = "implicit_euler"


@dataclass(frozen=True)
class Statics:
    """Find the equilibrium: loads and motions grow with the load parameter from 0 to 1 in `load_steps` increments."""

    load_steps: int = 1


@dataclass(frozen=True)
class Trace:
    """Follow the path of equilibria from load parameter 0 by arc length, through limit points.

    Attributes:
        watch: displacements to record by name (`Displacement`).
        stop: where to end.
        step, max_step, load_scale: see `ddg_warp.integrate.continuation.ContinuationOptions`.
    """

    watch: dict[str, Displacement] = field(default_factory=dict)
    stop: Stop = field(default_factory=Stop)
    step: float = 0.02
    max_step: float = 0.1
    load_scale: float = 1.0


@dataclass
class RodBatch:
    """Rods of one `add_rods` call: same node count and closedness; section, shape and rest shape may differ."""

    points: np.ndarray  # (R, n, 3) [m]
    section: Stiffness
    closed: bool
    natural: object
    director: np.ndarray | None  # (3,), (R, 3) or (R, edges, 3)
    twist: bool
    bend: bool
    name: str
    first: int  # index of its first rod

    @property
    def rods(self) -> int:
        return self.points.shape[0]

    @property
    def nodes(self) -> int:
        return self.points.shape[1]

    @property
    def edges(self) -> int:
        return self.nodes if self.closed else self.nodes - 1


@dataclass(frozen=True)
class Support:
    """Dofs held on some rods: nodes (with components), edge angles, or an end frame (`end` is "first" or "last").

    `tangent` and `director` (rods, 3) are those of the end at rest, extrapolated from the rod where they are None.
    """

    rods: np.ndarray
    nodes: tuple[int, ...] = ()
    components: str = "xyz"
    edges: tuple[int, ...] = ()
    end: str = ""
    motion: Motion | None = None
    tangent: np.ndarray | None = None
    director: np.ndarray | None = None


@dataclass(frozen=True)
class Load:
    """A dead force on a node [N], or on an edge a twisting moment or a couple [N m]; times amplitude(t) if given."""

    rods: np.ndarray
    node: int = 0
    force: tuple = (0.0, 0.0, 0.0)
    edge: int | None = None
    moment: float = 0.0
    couple: tuple = (0.0, 0.0, 0.0)
    amplitude: Callable[[float], float] | None = None


@dataclass
class Scene(Structures):
    """Rods and shells with supports and loads, ready to be built for a device.

    Args:
        gravity: acceleration (3,) [m/s^2].
        dimension: 3, or 2 for a scene that stays in the plane of x and z (y of every point is then ignored).
        analysis: `Dynamics`, `Statics` or `Trace`: what `ddg-warp run` does with the scene.
        mass_damping: mass-proportional damping alpha [1/s].
        initial: makes the first state of a run from the model; the rest state by default.
        callbacks: functions of the state, called between steps.
    """

    gravity: tuple = (0.0, 0.0, -9.81)
    dimension: int = 3
    analysis: Dynamics | Statics | Trace = field(default_factory=Dynamics)
    mass_damping: float = 0.0
    initial: Callable | None = None
    batches: list[RodBatch] = field(default_factory=list)
    supports: list[Support] = field(default_factory=list)
    loads: list[Load] = field(default_factory=list)
    masses: list[tuple[np.ndarray, int, float]] = field(default_factory=list)
    callbacks: list[Callable] = field(default_factory=list)

    @property
    def rod_count(self) -> int:
        """Number of rods added so far."""
        return sum(batch.rods for batch in self.batches)

    def add_rod(self, points, *, director=None, **options) -> int:
        """Add one rod with points (n, 3); options as in `add_rods`, without R: a director (3,) or (edges, 3). Returns its index."""
        if np.ndim(director) == 2 and len(director) > 1:
            director = [director]
        return self.add_rods([points], director=director, **options)[0]

    def add_rods(
        self,
        points,
        *,
        section,
        material: Material | None = None,
        closed: bool = False,
        natural="shape",
        director=None,
        twist: bool = True,
        bend: bool = True,
        name: str = "rod",
    ) -> range:
        """Add rods of equal node count.

        Args:
            points: nodes at rest (R, n, 3) [m]; their distances are the rest lengths.
            section: `Circle`, `Ellipse`, `Rectangle` (with a material) or `Stiffness`.
            material: `Material`; not needed with `Stiffness`.
            closed: whether the last node is joined to the first.
            natural: "shape" takes curvature and twist at rest from the points and directors; "straight" sets both to zero; or
                three arrays (curvature 1, curvature 2, twist) [1/m] that broadcast to (R, vertices), of vertices between edges.
                With tangent t and first director d1: curvature 1 > 0 bends the rod towards d1, curvature 2 > 0 towards the
                second director t x d1, twist > 0 turns both right-handed about t on the way from the first node to the last
                (tools/results/natural_curvature.png). In dimension 2 one array, positive from x towards z.
            director: first director of the first edge (3,) or (R, 3), carried along without twist, or of all edges
                (R, edges, 3); made perpendicular to the tangents. By default one is chosen.
            twist: False leaves twist out: 3 dofs a node, for isotropic rods that are straight at rest.
            bend: False leaves bending and twist out: a chain of springs.
            name: shown in reports and output.

        Returns:
            Indices of the rods.

        Raises:
            SceneError: what is given cannot be a rod; the message names rod and node.
        """
        try:
            points = np.array(points, float)
            director = None if director is None else np.asarray(director, float)
        except (TypeError, ValueError):
            raise SceneError(
                f"rods '{name}': points or director are no arrays of numbers; points are (rods, nodes, 3)"
            ) from None
        if points.ndim == 2:
            points = points[None]
        if points.ndim != 3 or points.shape[2] != 3:
            raise SceneError(f"rods '{name}': points have shape {points.shape}; give (rods, nodes, 3)")
        stiffness = getattr(section, "stiffness", None)
        if stiffness is None:
            raise SceneError(f"rods '{name}': section {section!r} is none; use Circle, Ellipse, Rectangle or Stiffness")
        if not isinstance(material, Material) and not isinstance(section, Stiffness):
            raise SceneError(f"rods '{name}': a {type(section).__name__} needs a material; give material=Material(...)")
        planar = self.dimension == 2
        batch = RodBatch(
            points,
            stiffness(material),
            closed,
            natural,
            director,
            twist and bend and not planar,
            bend,
            name,
            self.rod_count,
        )
        self.batches.append(batch)
        return range(batch.first, batch.first + batch.rods)

    def clamp(self, rods, edges: Iterable[int] = (0,), motion: Motion | None = None) -> None:
        """Hold edges: both nodes and the angle. The continuum clamp then lies at the middle of the edge.

        Negative indices count from the last edge. `motion` moves them; without it they stay where they are at rest.
        """
        edges = validate.indices("clamp: edges", edges)
        nodes = tuple(dict.fromkeys(n for e in edges for n in ((e, e + 1) if e >= 0 else (e - 1, e))))
        self._support(rods, nodes=nodes, edges=edges, motion=motion)

    def clamp_end(
        self,
        rods,
        end: str = "first",
        motion: Motion | None = None,
        components: str = "xyz",
        tangent=None,
        director=None,
    ) -> None:
        """Hold position and frame exactly at an end node: the tangent is prescribed there and the end cell is half a cell.

        Args:
            rods: one rod or several.
            end: "first" or "last".
            motion: moves and turns the end; it stays as it is at rest without.
            components: of the position that are held; the others are free, so that a clamped end can slide along an axis of space.
            tangent: of the rod at the end at rest, (3,) or (rods, 3), pointing from the first node to the last; a rod whose natural
                shape is that of its points is free of stress with it. By default extrapolated from the two edges at the end.
            director: first material director at the end at rest, (3,) or (rods, 3), made perpendicular to the tangent; by default
                extrapolated likewise, so that a rod whose directors turn along it goes on turning up to its end.

        Raises:
            SceneError: the end, the tangent or the director is none; the message says which.
        """
        if end not in ("first", "last"):
            raise SceneError(f"clamp_end: end is {end!r}; it is 'first' or 'last'")
        index = self._rods(rods)
        tangent = None if tangent is None else validate.directions("clamp_end: tangent", tangent, index)
        director = None if director is None else validate.directions("clamp_end: director", director, index)
        if tangent is not None and self.dimension == 2 and tangent[:, 1].any():
            raise SceneError(
                f"clamp_end: tangent {tangent[0]} leaves the plane of x and z that a scene of dimension 2 stays in"
            )
        for batch in self._batches(index) if director is not None else ():
            if not batch.twist:
                raise SceneError(
                    f"clamp_end: rod {batch.first} ('{batch.name}') has no twist, and so no director; leave director out"
                )
        self._support(rods, components=components, end=end, motion=motion, tangent=tangent, director=director)

    def fix(self, rods, nodes: Iterable[int], components: str = "xyz", motion: Motion | None = None) -> None:
        """Hold components of nodes (a hinge)."""
        self._support(rods, nodes=validate.indices("fix: nodes", nodes), components=components, motion=motion)

    def fix_twist(self, rods, edges: Iterable[int], motion: Motion | None = None) -> None:
        """Hold the angle of edges."""
        self._support(rods, edges=validate.indices("fix_twist: edges", edges), motion=motion)

    def add_force(self, rods, node: int, force, amplitude: Callable[[float], float] | None = None) -> None:
        """Dead force [N] on a node, times amplitude(t). In statics it grows with the load parameter if amplitude is None."""
        force = validate.vector(f"add_force: force on node {node}", force)
        self._load(rods, amplitude, node=validate.index("add_force: node", node), force=force)

    def add_twisting_moment(self, rods, edge: int, moment: float, amplitude=None) -> None:
        """Moment [N m] about the tangent of an edge, conjugate to its angle."""
        for batch in self._batches(self._rods(rods)):
            if not batch.twist:
                raise SceneError(
                    f"add_twisting_moment: rod {batch.first} ('{batch.name}') has no twist; add it with twist=True, in dimension 3"
                )
        moment = validate.number(f"add_twisting_moment: moment on edge {edge}", moment)
        self._load(rods, amplitude, edge=validate.index("add_twisting_moment: edge", edge), moment=moment)

    def add_couple(self, rods, edge: int, couple, amplitude=None) -> None:
        """Couple (3,) [N m] on an edge, its axis fixed in space: a pair of forces across the edge and a moment about it.

        Outside the plane it has no potential (Ziegler, Principles of Structural Stability, 1968). Statics takes it as it is; in
        dynamics its forces are those on the predicted edge and stay as they are within a step.
        """
        couple = validate.vector(f"add_couple: couple on edge {edge}", couple)
        self._load(rods, amplitude, edge=validate.index("add_couple: edge", edge), couple=couple)

    def add_mass(self, rods, node: int, mass: float) -> None:
        """Point mass [kg] on a node."""
        if not 0.0 < mass < np.inf:
            raise SceneError(f"add_mass: {mass} kg at node {node}; a point mass is positive and finite")
        self.masses.append((self._rods(rods), validate.index("add_mass: node", node), float(mass)))

    def build(self, device=None, precision: str | None = None, worlds: int = 1, allow_rounding: bool = False):
        """Freeze the scene into a `Model` on a device.

        Args:
            device: Warp device, such as "cpu" or "cuda:0"; by default CUDA if there is one.
            precision: "float64" (default on the CPU), "mixed" (default on CUDA) or "float32".
            worlds: independent copies.
            allow_rounding: step and solve in "float32" also where its rounding decides what comes out; counted as `lost_in_rounding`.

        Raises:
            SceneError: see `ddg_warp.validate`.
        """
        from ddg_warp.model import Model

        validate.check_scene(self)
        worlds = validate.index("worlds", worlds)
        return Model(self, device=device, precision=precision, worlds=worlds, allow_rounding=allow_rounding)

    def _rods(self, rods) -> np.ndarray:
        index = np.array(validate.indices("rods", rods), int)
        bad = index[(index < 0) | (index >= self.rod_count)]
        if bad.size:
            raise SceneError(f"rod {bad[0]} does not exist; the scene has {self.rod_count} rods so far")
        return index

    def _support(self, rods, *, motion, components: str = "xyz", **held) -> None:
        if not components or set(components) - set("xyz"):
            raise SceneError(f"fix: components {components!r}; they are letters of 'xyz', one at least")
        if motion is not None and not isinstance(motion, Motion):
            raise SceneError(f"motion is {motion!r}; give Motion(translation=..., angle=...)")
        if motion is not None and self.dimension == 2 and not motion.planar:
            raise SceneError(
                f"the motion turns about {tuple(motion.axis)}; a scene of dimension 2 stays in the plane of x and z, give "
                "axis=(0, 1, 0)"
            )
        self.supports.append(Support(self._rods(rods), components=components, motion=motion, **held))

    def _load(self, rods, amplitude, **load) -> None:
        if amplitude is not None and not callable(amplitude):
            raise SceneError(f"amplitude is {amplitude!r}; give a function of the time, or None")
        self.loads.append(Load(self._rods(rods), amplitude=amplitude, **load))

    def _batches(self, rods: np.ndarray) -> list[RodBatch]:
        """The batches that some rods belong to."""
        starts = [batch.first for batch in self.batches]
        return [self.batches[i] for i in np.unique(np.searchsorted(starts, rods, side="right") - 1)]
