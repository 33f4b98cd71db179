"""Entries of a scene: analyses, rods, shells, supports, loads, joints and attachments."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.geometry.surface import Surface
from ddg_warp.scene.equilibrium_path import Displacement, StopCriterion, watched_displacements
from ddg_warp.scene.frame_motion import FrameMotion
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.law import Law
from ddg_warp.scene.material import Material, Stiffness
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.typing import Precision, Scheme

RUN = 2**16  # nodes


@argument_checks.called
@dataclass(frozen=True)
class Dynamics:
    """Time integration with steps dt [s] to duration [s] by `scheme` (`implicit_euler` or `implicit_midpoint`).

    Each step converges to residuals of `rtol` of the load of a rod or shell, its weight and other loads. In contact a fraction
    `unconverged_fraction` of bodies may exceed the tolerance; see `Integrator`. A larger rtol saves iterations. Hanging sheets of 1 m
    by 1e-2 take a quarter to a half of the time of 1e-6. Their nodes are off by up to 1e-4 m in 20 steps, with the multilevel
    preconditioner by 5.5e-6 m (`tools/results/sheets_levels_gpu.csv`).

    `error` [m] instead of `rtol` lets `simulate` choose the step, a repeated half of dt, and rtol. It requests the largest error of a
    node at the end of the run, over the exact motion of the discretised scene. Pilot runs estimate it; see `run.step_choice`. States
    are recorded every dt, which must resolve the motion.
    `precision` ("float64", "mixed" or "float32") is the default of `Scene.build`; None selects by device.
    """

    dt: float = 0.01
    duration: float = 1.0
    scheme: Scheme = "implicit_euler"
    rtol: float = 1e-6
    precision: Precision | None = None
    unconverged_fraction: float = 0.0
    error: float | None = None

    def __post_init__(self):
        argument_checks.positive("Dynamics: dt", self.dt, "s")
        argument_checks.positive("Dynamics: duration", self.duration, "s")
        argument_checks.positive("Dynamics: rtol", self.rtol)
        argument_checks.part("Dynamics: unconverged_fraction", self.unconverged_fraction)
        argument_checks.choice("Dynamics: scheme", self.scheme, ("implicit_euler", "implicit_midpoint"))
        if self.precision is not None:
            argument_checks.choice("Dynamics: precision", self.precision, ("float64", "mixed", "float32"))
        if self.error is not None:
            argument_checks.positive("Dynamics: error", self.error, "m")
            if self.rtol != Dynamics.rtol:
                raise SceneError(f"Dynamics: rtol = {self.rtol!r} is chosen from the error; leave out rtol or error")
            if self.unconverged_fraction:
                raise SceneError(
                    "Dynamics: unconverged_fraction leaves residuals that error cannot estimate; leave out one of them"
                )


@argument_checks.called
@dataclass(frozen=True)
class Statics:
    """Equilibrium by load stepping: loads and motions grow with the load parameter from 0 to 1 in `load_steps` increments."""

    load_steps: int = 1

    def __post_init__(self):
        argument_checks.count("Statics: load_steps", self.load_steps)


@argument_checks.called
@dataclass(frozen=True)
class PathAnalysis:
    """Arc-length continuation of equilibria from load parameter 0, through limit points.

    Attributes:
        watch: displacements to record by name, each a `Displacement`, or (rod, node) for all of its components as "name.x" and so on.
        stop: termination criteria.
        step, max_step, load_scale: see `ddg_warp.solve.equilibrium.continuation.ContinuationOptions`.
    """

    watch: dict[str, Displacement | tuple[int | str, int]] = field(default_factory=dict)
    stop: StopCriterion = field(default_factory=StopCriterion)
    step: float = 0.02
    max_step: float = 0.1
    load_scale: float = 1.0

    def __post_init__(self):
        for name in ("step", "max_step", "load_scale"):
            argument_checks.positive(f"PathAnalysis: {name}", getattr(self, name))
        if not isinstance(self.stop, StopCriterion):
            raise SceneError(f"PathAnalysis: stop is {self.stop!r}; give StopCriterion(...)")
        watched_displacements("PathAnalysis", self.watch, planar=False)


@dataclass
class RodBatch:
    """Rods of one `add_rods` call with equal node count and closedness; section, shape and rest shape may differ."""

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
    sized: bool = True  # whether all stiffnesses and masses follow from the size of the section

    @property
    def by_angle(self) -> bool:
        """True if curvature is the turning angle over the length."""
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
        """Return rows of rods in runs short enough for the processor's cache."""
        return np.array_split(rows, -(-len(rows) * self.nodes // RUN))


@dataclass(frozen=True)
class Support:
    """Fixed dofs of some rods: node components, twist angles of edges, or an end frame (`end` is "first" or "last").

    `tangent` and `director` (rods, 3) give the end frame at rest; None extrapolates them from the rod.
    """

    rods: np.ndarray
    nodes: tuple[int, ...] = ()
    components: str = "xyz"
    edges: tuple[int, ...] = ()
    end: str = ""
    motion: Motion | Grip | FrameMotion | None = None
    tangent: np.ndarray | None = None
    director: np.ndarray | None = None
    call: str = "fix"  # method of the scene, for messages
    name: str = ""


@dataclass(frozen=True)
class Load:
    """Dead force on a node [N], or twisting moment or couple on an edge [N m], times amplitude(t) if given."""

    rods: np.ndarray
    node: int = 0
    force: tuple = (0.0, 0.0, 0.0)
    edge: int | None = None
    moment: float = 0.0
    couple: tuple = (0.0, 0.0, 0.0)
    amplitude: Callable[[float], float] | None = None


@dataclass
class Shell:
    """Triangle mesh with thickness and material; see `Scene.add_shell`."""

    surface: Surface
    thickness: np.ndarray
    material: Material
    bending: str
    membrane: str
    rest: object
    name: str
    laws: Mapping[str, Law] = field(default_factory=dict)  # by term
    uv: np.ndarray | None = None

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
    """Support of a shell: fixed components of vertices, and a condition at mesh edges between these vertices.

    `edges` is "" (free to rotate), "clamp" (fixed normal) or "symmetry" (mirrored across the plane with normal `normal`).
    """

    shell: int
    vertices: np.ndarray
    components: str
    edges: str = ""
    normal: tuple = (0.0, 0.0, 0.0)
    motion: Motion | Grip | None = None
    call: str = "hold"  # method of the scene, for messages
    name: str = ""


@dataclass(frozen=True)
class ShellLoad:
    """Dead forces (V, 3) [N] on vertices of a shell, times amplitude(t) if given."""

    shell: int
    vertices: np.ndarray
    force: np.ndarray
    amplitude: Callable[[float], float] | None = None


@dataclass(frozen=True)
class EdgeCouple:
    """Couple per length (E,) [N] about boundary edges (E,) of a shell, times amplitude(t) if given."""

    shell: int
    edges: np.ndarray
    couple: np.ndarray
    amplitude: Callable[[float], float] | None = None


@dataclass(frozen=True)
class Pressure:
    """Pressure [Pa] along the normals of triangles, a follower load unless `dead`, times amplitude(t) if given."""

    shell: int
    triangles: np.ndarray
    pressure: np.ndarray
    dead: bool = False
    amplitude: Callable[[float], float] | None = None


@dataclass(frozen=True)
class Joint:
    """Joint of rods at nodes, (rod, node) each: hinged (common position) or rigid (common position and rotation)."""

    members: tuple[tuple[int, int], ...]
    rigid: bool
    laws: Mapping[str, Law] = field(default_factory=dict)  # by term


@dataclass(frozen=True)
class Attachment:
    """Nodes of a rod merged with vertices of a shell; `glued` edges on mesh edges rotate with the shell."""

    rod: int
    nodes: np.ndarray
    shell: int
    vertices: np.ndarray
    glued: bool


def supports_of(scene) -> list:
    """Return all supports of a scene, of rods, shells and rings, then obstacles, as ordered in `Reactions`."""
    return [*scene.supports, *scene.shell_supports, *scene.ring_supports, *scene.obstacles]
