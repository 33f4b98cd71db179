"""What joins a scene's rods and adds surfaces to them: shells, joints, attachments, and what holds and loads shells."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import validate
from ddg_warp.errors import SceneError
from ddg_warp.material import Material
from ddg_warp.meridians import Meridians
from ddg_warp.motion import Motion


@dataclass
class Shell:
    """A triangle mesh with thickness and material; see `Scene.add_shell`."""

    points: np.ndarray  # (P, 3) [m]
    triangles: np.ndarray  # (T, 3)
    thickness: np.ndarray
    material: Material
    bending: str
    membrane: str
    rest: object
    name: str


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
    motion: Motion | None = None


@dataclass(frozen=True)
class ShellLoad:
    """Dead forces (V, 3) [N] on vertices of a shell, times amplitude(t) if given."""

    shell: int
    vertices: np.ndarray
    force: np.ndarray
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
    """Nodes of a rod that are vertices of a shell."""

    rod: int
    nodes: np.ndarray
    shell: int
    vertices: np.ndarray


@dataclass
class Structures(Meridians):
    """The part of a scene that is a net: whatever is not a rod of its own."""

    shells: list[Shell] = field(default_factory=list)
    shell_supports: list[ShellSupport] = field(default_factory=list)
    shell_loads: list[ShellLoad] = field(default_factory=list)
    pressures: list[Pressure] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)

    def add_shell(
        self,
        points,
        triangles,
        *,
        thickness,
        material: Material,
        bending: str = "midedge_dof",
        membrane: str = "flat",
        rest="shape",
        name: str = "shell",
    ) -> int:
        """Add a triangle mesh as a thin shell.

        Args:
            points: vertices at rest (P, 3) [m].
            triangles: corners (T, 3), neighbours oriented alike; normals follow the right hand.
            thickness: one number or one a triangle [m].
            material: `Material`; its density gives the mass, its viscosity the strain-rate damping.
            bending: "midedge_dof", "midedge_boundary", "midedge", "hinge" or "isometric"; see `ddg_warp.shells`.
            membrane: "flat" (constant strain triangles) or "curved" (their sides have the length of the arcs over them, by the
                normals of bending "midedge_dof"): thin shells that bend far do not lock. For statics, where an iteration costs
                about twice the time; dynamics refuses it.
            rest: "shape" takes metric and curvature at rest from the points, "flat" the metric alone; or two arrays
                (abar (T, 3) [m^2], bbar (T, 3) [m]), first and second fundamental form in the basis of the first two edges.
            name: shown in reports and output.

        Returns:
            Index of the shell.

        Raises:
            SceneError: what is given is no surface; the message names shell and triangle.
        """
        try:
            points, triangles = np.array(points, float), np.array(triangles)
        except (TypeError, ValueError):
            raise SceneError(f"shell '{name}': points or triangles are no arrays of numbers") from None
        if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
            raise SceneError(
                f"shell '{name}': points have shape {points.shape}, triangles {triangles.shape}; give (P, 3) and (T, 3)"
            )
        if not np.issubdtype(triangles.dtype, np.integer):
            raise SceneError(f"shell '{name}': triangles are {triangles.dtype}; give whole numbers")
        if not isinstance(material, Material):
            raise SceneError(f"shell '{name}': material is {material!r}; give material=Material(...)")
        self.shells.append(
            Shell(points, triangles, np.asarray(thickness, float), material, bending, membrane, rest, name)
        )
        return len(self.shells) - 1

    def hold(self, shell: int, vertices, components: str = "xyz", motion: Motion | None = None) -> None:
        """Hold components of vertices of a shell, which `motion` moves; the surface may turn there (simply supported)."""
        self._hold(shell, vertices, components, motion=motion)

    def clamp_boundary(self, shell: int, vertices, components: str = "xyz", motion: Motion | None = None) -> None:
        """Hold components of vertices, and the surface's normal at the mesh edges between them, inside the surface, too.

        `motion` moves the components and turns the normals as one body, however many times; it moves no other components, so
        that with "yz" a clamp that turns can slide along x.
        """
        self._hold(shell, vertices, components, edges="clamp", motion=motion)

    def symmetry(self, shell: int, vertices, axis: str) -> None:
        """Put vertices on a symmetry plane across an axis of space, "x", "y" or "z", which the surface meets at a right angle."""
        if axis not in ("x", "y", "z"):
            raise SceneError(f"symmetry: axis is {axis!r}; it is 'x', 'y' or 'z'")
        self._hold(shell, vertices, axis, edges="symmetry", normal=tuple(np.eye(3)["xyz".index(axis)]))

    def add_vertex_force(self, shell: int, vertices, force, amplitude: Callable[[float], float] | None = None) -> None:
        """Dead force [N] on each of some vertices, (3,) or (V, 3). In statics it grows with the load parameter."""
        vertices = self._vertices(shell, vertices)
        try:
            force = np.broadcast_to(np.asarray(force, float), (len(vertices), 3)).copy()
        except (TypeError, ValueError):
            force = np.full(1, np.nan)
        if not np.isfinite(force).all():
            raise SceneError(f"add_vertex_force: give finite forces, (3,) or one for each of {len(vertices)} vertices")
        self.shell_loads.append(ShellLoad(shell, vertices, force, _amplitude(amplitude)))

    def add_edge_force(self, shell: int, path, force, amplitude: Callable[[float], float] | None = None) -> None:
        """Dead force per length (3,) [N/m] along a path of vertices, shared out by half the length to either side at rest."""
        path = self._vertices(shell, path)
        force = np.array(validate.vector("add_edge_force: force", force))
        lengths = np.linalg.norm(np.diff(self.shells[shell].points[path], axis=0), axis=1)
        if not lengths.size or not lengths.all():
            raise SceneError("add_edge_force: the path has no length; give two different vertices at least, in order")
        share = 0.5 * (np.concatenate([[0.0], lengths]) + np.concatenate([lengths, [0.0]]))
        self.shell_loads.append(ShellLoad(shell, path, share[:, None] * force, _amplitude(amplitude)))

    def add_pressure(
        self, shell: int, pressure, triangles=None, *, dead: bool = False, amplitude: Callable | None = None
    ) -> None:
        """Pressure [Pa] on triangles (all by default) along their normals.

        It follows the surface: it has no potential where the boundary moves. Statics takes its exact, unsymmetric derivative; in
        dynamics its forces are those on the predicted surface. With `dead` it keeps directions and areas of the rest shape.
        """
        self._check_shell(shell)
        count = len(self.shells[shell].triangles)
        index = np.arange(count) if triangles is None else np.array(validate.indices("triangles", triangles), int)
        bad = index[(index < 0) | (index >= count)]
        if bad.size:
            raise SceneError(f"add_pressure: triangle {bad[0]} does not exist; shell {shell} has {count}")
        try:
            pressure = np.broadcast_to(np.asarray(pressure, float), index.shape).copy()
        except (TypeError, ValueError):
            pressure = np.full(1, np.nan)
        if not np.isfinite(pressure).all():
            raise SceneError(f"add_pressure: give one finite number, or one for each of {len(index)} triangles")
        self.pressures.append(Pressure(shell, index, pressure, dead, _amplitude(amplitude)))

    def join(self, members: Iterable[tuple[int, int]], rigid: bool = True) -> None:
        """Join rods at nodes, (rod, node) each: at the same point at rest.

        A rigid joint turns with its own rotation and bends every edge that meets there against it, by half a cell each, so that
        two collinear rods joined rigidly are one rod. A hinged joint shares the position alone.
        """
        pairs = []
        for member in members:
            rod, node = validate.indices("join: member", member)
            self._rods(rod)
            pairs.append((rod, node))
        if len(set(pairs)) < 2:
            raise SceneError(f"join: {pairs}; a joint has two different members at least, (rod, node) each")
        self.joints.append(Joint(tuple(pairs), bool(rigid)))

    def attach(self, rod: int, nodes, shell: int, vertices) -> None:
        """Make nodes of a rod and vertices of a shell one: a stiffener, a line, a rim. They are at the same points at rest."""
        self._rods(rod)
        nodes = np.array(validate.indices("attach: nodes", nodes), int)
        vertices = self._vertices(shell, vertices)
        if len(nodes) != len(vertices):
            raise SceneError(f"attach: {len(nodes)} nodes of rod {rod} and {len(vertices)} vertices; give as many")
        self.attachments.append(Attachment(rod, nodes, shell, vertices))

    def _hold(self, shell, vertices, components, **options) -> None:
        if not components or set(components) - set("xyz"):
            raise SceneError(f"hold: components {components!r}; they are letters of 'xyz', one at least")
        motion = options.get("motion")
        if motion is not None and not isinstance(motion, Motion):
            raise SceneError(f"motion is {motion!r}; give Motion(translation=..., angle=...)")
        self.shell_supports.append(ShellSupport(shell, self._vertices(shell, vertices), components, **options))

    def _check_shell(self, shell) -> None:
        if not 0 <= validate.index("shell", shell) < len(self.shells):
            raise SceneError(f"shell {shell} does not exist; the scene has {len(self.shells)} shells so far")

    def _vertices(self, shell, vertices) -> np.ndarray:
        self._check_shell(shell)
        count = len(self.shells[shell].points)
        index = np.array(validate.indices("vertices", vertices), int)
        bad = index[(index < 0) | (index >= count)]
        if bad.size:
            raise SceneError(f"vertex {bad[0]} does not exist: shell {shell} has {count} vertices")
        return index


def _amplitude(amplitude):
    if amplitude is not None and not callable(amplitude):
        raise SceneError(f"amplitude is {amplitude!r}; give a function of the time, or None")
    return amplitude
