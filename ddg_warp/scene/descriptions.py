"""What a scene is told, entry by entry: analyses, rods and shells, and what holds, loads and joins them."""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.geometry.surface import Surface
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.material import Material, Stiffness
from ddg_warp.scene.motion import Motion
from ddg_warp.scene.path import Displacement, Stop

RUN = 2**16  # nodes


@arguments.called
@dataclass(frozen=True)
class Dynamics:
    """Advance in time: step dt [s] to duration [s] by `scheme` (`implicit_euler` or `implicit_midpoint`).

    In each step forces balance to `rtol` of the load of a rod or shell: its weight and what else it is given; in contact all but a part
    `outliers` of them; see `Integrator`.
    `precision` ("float64", "mixed" or "float32") is that of models that are built without one; by default what suits the device.
    """

    dt: float = 0.01
    duration: float = 1.0
    scheme: str = "implicit_euler"
    rtol: float = 1e-6
    precision: str | None = None
    outliers: float = 0.0

    def __post_init__(self):
        arguments.positive("Dynamics: dt", self.dt, "s")
        arguments.positive("Dynamics: duration", self.duration, "s")
        arguments.positive("Dynamics: rtol", self.rtol)
        arguments.part("Dynamics: outliers", self.outliers)
        arguments.choice("Dynamics: scheme", self.scheme, ("implicit_euler", "implicit_midpoint"))
        if self.precision is not None:
            arguments.choice("Dynamics: precision", self.precision, ("float64", "mixed", "float32"))


@arguments.called
@dataclass(frozen=True)
class Statics:
    """Find the equilibrium: loads and motions grow with the load parameter from 0 to 1 in `load_steps` increments."""

    load_steps: int = 1

    def __post_init__(self):
        arguments.count("Statics: load_steps", self.load_steps)


@arguments.called
@dataclass(frozen=True)
class Trace:
    """Follow the path of equilibria from load parameter 0 by arc length, through limit points.

    Attributes:
        watch: displacements to record by name (`Displacement`).
        stop: where to end.
        step, max_step, load_scale: see `ddg_warp.solve.continuation.ContinuationOptions`.
    """

    watch: dict[str, Displacement] = field(default_factory=dict)
    stop: Stop = field(default_factory=Stop)
    step: float = 0.02
    max_step: float = 0.1
    load_scale: float = 1.0

    def __post_init__(self):
        for name in ("step", "max_step", "load_scale"):
            arguments.positive(f"Trace: {name}", getattr(self, name))
        if not isinstance(self.stop, Stop):
            raise SceneError(f"Trace: stop is {self.stop!r}; give Stop(...)")
        if not isinstance(self.watch, dict) or not all(isinstance(w, Displacement) for w in self.watch.values()):
            raise SceneError(
                f"Trace: watch is {arguments.shown(self.watch)}; give displacements by name, {{'tip': Displacement.of(row, axis)}}"
            )


@dataclass(frozen=True, init=False)
class Law:
    """A constitutive law for a term of rods, instead of the quadratic one.

    Attributes:
        density: a `ddg_warp.kernels.densities.Density`, of the package or one's own.
        values: of its parameters by family: a number, or an array that broadcasts to (rods, edges), or a list with one for each
            strain. At vertices stiffnesses are those of both half edges in series, and what else there is the mean over them (see
            `ddg_warp.compile.half_cells`). What is not given comes from the rod: stiffnesses of its section, strains at rest,
            viscosity.
    """

    density: object
    values: dict

    def __init__(self, density, **values):
        for name, given in values.items():
            for number in given if isinstance(given, list | tuple) else [given]:
                found = arguments.array(
                    f"Law: {name}", number, "give a number, an array, or a list with one for each strain"
                )
                arguments.sized(f"Law: {name}", found)
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "values", deepcopy(values))


def laws_of(what: str, section, material, laws) -> dict[str, Law]:
    """Laws by term: those that a section brings, and those given.

    Raises:
        SceneError: something else is given.
    """
    brought = section.laws(material) if hasattr(section, "laws") else {}
    if laws is not None and not isinstance(laws, Mapping):
        raise SceneError(f"{what}: laws = {laws!r}; give a dictionary from terms to Law(density, ...)")
    for term, law in (laws or {}).items():
        if not isinstance(law, Law) or not hasattr(law.density, "parameters"):
            raise SceneError(f"{what}: the law of {term!r} is {law!r}; give Law(density, ...)")
    return {**brought, **(laws or {})}


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
    laws: Mapping[str, Law] = field(default_factory=dict)  # by term
    curvature: str = "tangent"  # or "angle"
    sized: bool = True  # whether all stiffnesses and masses follow from the size of its section

    @property
    def by_angle(self) -> bool:
        """Whether curvature is the turning angle over the length."""
        return self.curvature == "angle"

    @property
    def rods(self) -> int:
        return self.points.shape[0]

    @property
    def nodes(self) -> int:
        return self.points.shape[1]

    @property
    def edges(self) -> int:
        return self.nodes if self.closed else self.nodes - 1

    def runs(self, rows: np.ndarray) -> list[np.ndarray]:
        """Rows of its rods in runs so short that what is computed of them stays in the processor's cache."""
        return np.array_split(rows, -(-len(rows) * self.nodes // RUN))


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
    motion: Motion | Grip | None = None
    tangent: np.ndarray | None = None
    director: np.ndarray | None = None
    call: str = "fix"  # what users know it by


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
class Shell:
    """A triangle mesh with thickness and material; see `Scene.add_shell`."""

    surface: Surface
    thickness: np.ndarray
    material: Material
    bending: str
    membrane: str
    rest: object
    name: str

    @property
    def points(self) -> np.ndarray:
        """Vertices at rest (P, 3) [m]."""
        return self.surface.points

    @property
    def triangles(self) -> np.ndarray:
        """Corners (T, 3)."""
        return self.surface.triangles


@dataclass(frozen=True)
class ShellSupport:
    """What is held of a shell: components of vertices, and what the surface does at the mesh edges between them.

    `edges` is "" (free to turn), "clamp" (the normal is held) or "symmetry" (mirrored across the plane with normal `normal`).
    """

    shell: int
    vertices: np.ndarray
    components: str
    edges: str = ""
    normal: tuple = (0.0, 0.0, 0.0)
    motion: Motion | Grip | None = None
    call: str = "hold"  # what users know it by


@dataclass(frozen=True)
class ShellLoad:
    """Dead forces (V, 3) [N] on vertices of a shell, times amplitude(t) if given."""

    shell: int
    vertices: np.ndarray
    force: np.ndarray
    amplitude: Callable[[float], float] | None = None


@dataclass(frozen=True)
class EdgeCouple:
    """A couple per length (E,) [N] about boundary edges (E,) of a shell, times amplitude(t) if given."""

    shell: int
    edges: np.ndarray
    couple: np.ndarray
    amplitude: Callable[[float], float] | None = None


@dataclass(frozen=True)
class Pressure:
    """Pressure [Pa] along the normals of triangles, which follow the surface unless `dead`; times amplitude(t) if given."""

    shell: int
    triangles: np.ndarray
    pressure: np.ndarray
    dead: bool = False
    amplitude: Callable[[float], float] | None = None


@dataclass(frozen=True)
class Joint:
    """Rods joined at nodes, (rod, node) each: hinged (positions alone) or rigid (their frames turn together)."""

    members: tuple[tuple[int, int], ...]
    rigid: bool


@dataclass(frozen=True)
class Attachment:
    """Nodes of a rod that are vertices of a shell; whether edges between them that lie on mesh edges turn with the shell."""

    rod: int
    nodes: np.ndarray
    shell: int
    vertices: np.ndarray
    glued: bool
