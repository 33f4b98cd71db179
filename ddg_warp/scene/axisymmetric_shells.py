"""Axisymmetric shells of a scene, described by meridians, with supports and loads."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.scene import validate
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.handle import AXISYMMETRIC, RING_SUPPORT, Handle, need
from ddg_warp.scene.material import Material
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.typing import Amplitude, End, Numbers, Selection

ENDS = {"first": 0, "last": -1}


@dataclass
class AxisymmetricShell:
    """Shell of revolution; see `Meridians.add_axisymmetric_shell`."""

    points: np.ndarray  # (n, 2) radius and height [m]
    thickness: np.ndarray
    material: Material
    rest: object
    name: str


@dataclass(frozen=True)
class RingSupport:
    """Support of nodes of a meridian; `tangent` is the fixed direction (2,) of a rim, None if free to rotate."""

    shell: int
    nodes: np.ndarray
    components: str
    tangent: tuple | None = None
    clamped: bool = False
    motion: Motion | Grip | None = None
    call: str = "hold_ring"  # method of the scene, for messages
    name: str = ""


@dataclass(frozen=True)
class RingLoad:
    """Dead forces (n, 2) along radius and height [N], summed around the ring, times amplitude(t) if given."""

    shell: int
    nodes: np.ndarray
    force: np.ndarray
    amplitude: Callable[[float], float] | None = None


@dataclass(frozen=True)
class RingPressure:
    """Pressure [Pa] on the surface of edges of a meridian; see `Meridians.add_axisymmetric_pressure`."""

    shell: int
    edges: np.ndarray
    pressure: np.ndarray
    dead: bool = False
    amplitude: Callable[[float], float] | None = None


@argument_checks.called
@dataclass(kw_only=True, repr=False, eq=False)
class Meridians:
    """Axisymmetric shells of a scene, with energies, forces and masses of the whole revolution about the z axis."""

    axisymmetric_shells: list[AxisymmetricShell] = field(default_factory=list, init=False)
    ring_supports: list[RingSupport] = field(default_factory=list, init=False)
    ring_loads: list[RingLoad] = field(default_factory=list, init=False)
    ring_pressures: list[RingPressure] = field(default_factory=list, init=False)

    def add_axisymmetric_shell(
        self,
        points: Numbers,
        *,
        thickness: Numbers,
        material: Material,
        rest: Literal["shape"] | tuple[Numbers, Numbers] = "shape",
        name: str = "shell of revolution",
    ) -> Handle:
        """Add a shell of revolution about the z axis with axisymmetric deformation, by its meridian in the plane of x and z.

        An end of the meridian on the axis is a pole, which stays on the axis with a smooth surface. Other ends are rims, free by
        default.

        Args:
            points: radius and height of the nodes at rest (n, 2) [m]; only ends may have radius 0.
            thickness: one number or one an edge [m].
            material: `Material`; its density gives the mass, its viscosity the strain-rate damping.
            rest: "shape" takes metric and curvature at rest from the points, "flat" the metric alone. Or two arrays (metric
                (n - 1, 2) [1], curvature (n, 2) [1/m]), along the meridian and around the axis. The metric is the squared natural
                stretch of edges against the points; natural curvature at nodes is positive where the angle of the tangent grows.
            name: shown in reports and output.

        Returns:
            Handle among the axisymmetric shells.

        Raises:
            SceneError: no valid meridian; the message names shell and node.
        """
        label = f"axisymmetric shell '{argument_checks.text('add_axisymmetric_shell: name', name)}'"
        points = argument_checks.array(f"{label}: points", points, "give (n, 2), radius and height").copy()
        thickness = argument_checks.array(f"{label}: thickness", thickness, "give one number, or one an edge").copy()
        for part, values in (("points", points), ("thickness", thickness)):
            argument_checks.sized(f"{label}: {part}", values)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
            raise SceneError(
                f"axisymmetric shell '{name}': points have shape {points.shape}; give (n, 2), n at least 3: radius, height"
            )
        if not isinstance(material, Material):
            raise SceneError(f"axisymmetric shell '{name}': material is {material!r}; give material=Material(...)")
        if np.any(np.abs(material.poisson) >= 1.0):
            raise SceneError(f"axisymmetric shell '{name}': Poisson's ratio {material.poisson}; it is between -1 and 1")
        _check_meridian(points, thickness, name)
        points.setflags(write=False)
        thickness.setflags(write=False)
        self.axisymmetric_shells.append(AxisymmetricShell(points, thickness, deepcopy(material), deepcopy(rest), name))
        return Handle(len(self.axisymmetric_shells) - 1, AXISYMMETRIC, name)

    def hold_ring(
        self, shell: int, nodes: Selection, components: str = "xz", motion: Motion | Grip | None = None, name: str = ""
    ) -> Handle:
        """Fix radius ("x") or height ("z") of nodes of a meridian, free to rotate (simply supported).

        `motion` moves the nodes in the plane of x and z, by a translation, which may differ between nodes, and a rotation about the y
        axis. `name` is the support's in `Model.reactions`.
        """
        return self._hold_ring(RingSupport(shell, self._nodes(shell, nodes), components, motion=motion, name=name))

    def clamp_ring(
        self,
        shell: int,
        end: End,
        components: str = "xz",
        tangent: Numbers | None = None,
        motion: Motion | Grip | None = None,
        name: str = "",
    ) -> Handle:
        """Clamp a rim, the "first" or "last" node: fix components and the direction of the meridian, which a motion rotates.

        Args:
            tangent: direction (2,) of the meridian at the rim, from first to last; by default extrapolated from the points.
        """
        if tangent is not None:
            tangent = argument_checks.broadcast("clamp_ring: tangent (2,)", tangent, (2,), own=1)
            if not tangent.any():
                raise SceneError(f"clamp_ring: tangent is {tangent!r}; give a direction (2,), not zero")
        node = self._end(shell, end)
        if self.axisymmetric_shells[shell].points[node, 0] == 0.0:
            raise SceneError(
                f"clamp_ring: the {end} node of shell {shell} is a pole, which has its direction; use hold_ring"
            )
        nodes = self._nodes(shell, node)
        options = {"tangent": tangent, "clamped": True, "motion": motion, "call": "clamp_ring", "name": name}
        return self._hold_ring(RingSupport(shell, nodes, components, **options))

    def symmetry_ring(self, shell: int, end: End, name: str = "") -> Handle:
        """Add a symmetry plane normal to the axis at a rim, orthogonal to the meridian."""
        node = self._end(shell, end)
        points = self.axisymmetric_shells[shell].points
        edge = points[1] - points[0] if node == 0 else points[-1] - points[-2]
        return self.clamp_ring(shell, end, "z", tangent=(0.0, np.copysign(1.0, edge[1])), name=name)

    def add_ring_force(
        self, shell: int, nodes: Selection, force: Numbers, amplitude: Amplitude | None = None
    ) -> Handle:
        """Add a dead force per length of ring at rest on nodes (2,) or (n, 2): radial and axial [N/m]."""
        nodes = argument_checks.once("add_ring_force: nodes", self._nodes(shell, nodes))
        radius = self.axisymmetric_shells[shell].points[nodes, 0]
        if not radius.all():
            raise SceneError(f"add_ring_force: shell {shell} has a pole there; use add_pole_force")
        force = argument_checks.broadcast("add_ring_force: force", force, (len(nodes), 2), own=1)
        amplitude = argument_checks.amplitude("add_ring_force", amplitude)
        self.ring_loads.append(RingLoad(shell, nodes, 2.0 * np.pi * radius[:, None] * force, amplitude))
        return Handle(len(self.ring_loads) - 1, "ring load")

    def add_pole_force(
        self, shell: int, force: float, end: End = "first", amplitude: Amplitude | None = None
    ) -> Handle:
        """Add a dead axial force [N] on a pole."""
        node = self._end(shell, end)
        if self.axisymmetric_shells[shell].points[node, 0] != 0.0:
            raise SceneError(f"add_pole_force: the {end} node of shell {shell} is no pole; use add_ring_force")
        force = np.array([[0.0, argument_checks.number("add_pole_force: force", force)]])
        amplitude = argument_checks.amplitude("add_pole_force", amplitude)
        self.ring_loads.append(RingLoad(shell, self._nodes(shell, node), force, amplitude))
        return Handle(len(self.ring_loads) - 1, "ring load")

    def add_axisymmetric_pressure(
        self,
        shell: int,
        pressure: Numbers,
        edges: Selection | None = None,
        *,
        dead: bool = False,
        amplitude: Amplitude | None = None,
    ) -> Handle:
        """Add pressure [Pa] on edges (all by default), towards the left of the meridian in the plane of x and z.

        Pressure is a follower load: statics uses its exact load stiffness; in dynamics its forces are time-lagged, evaluated on the
        predicted surface. With `dead` it keeps directions and areas of the rest shape.
        """
        self._check_axisymmetric(shell)
        count = len(self.axisymmetric_shells[shell].points) - 1
        call = "add_axisymmetric_pressure"
        index = slice(None) if edges is None else edges
        index = argument_checks.once(f"{call}: edges", argument_checks.indices(f"{call}: edges", index, count))
        missing = index[(index < 0) | (index >= count)]
        if missing.size:
            raise SceneError(f"{call}: edge {missing[0]} does not exist; shell {shell} has {count}")
        pressure = argument_checks.broadcast(f"{call}: pressure", pressure, index.shape)
        dead, amplitude = argument_checks.flag(f"{call}: dead", dead), argument_checks.amplitude(call, amplitude)
        self.ring_pressures.append(RingPressure(shell, index, pressure, dead, amplitude))
        return Handle(len(self.ring_pressures) - 1, "ring pressure")

    def _hold_ring(self, support: RingSupport) -> Handle:
        if support.name:
            argument_checks.text(f"{support.call}: name", support.name)
        argument_checks.components(support.call, support.components, "xz")
        motion = support.motion
        validate.check_motion(support.call, motion, planar=True)
        if motion is not None and motion.count not in (None, len(support.nodes)):
            raise SceneError(
                f"{support.call}: the motion has {motion.count} displacements of {len(support.nodes)} nodes; give one for each"
            )
        self.ring_supports.append(support)
        return Handle(len(self.ring_supports) - 1, RING_SUPPORT, support.name)

    def _end(self, shell, end: str) -> int:
        self._check_axisymmetric(shell)
        return ENDS[argument_checks.choice("end", end, tuple(ENDS))]

    def _check_axisymmetric(self, shell) -> None:
        need(AXISYMMETRIC, shell)
        count = len(self.axisymmetric_shells)
        if not 0 <= argument_checks.index("shell", shell) < count:
            raise SceneError(f"axisymmetric shell {shell} does not exist; the scene has {count} so far")

    def _nodes(self, shell, nodes) -> np.ndarray:
        self._check_axisymmetric(shell)
        count = len(self.axisymmetric_shells[shell].points)
        index = argument_checks.indices("nodes", nodes, count)
        missing = index[(index < -count) | (index >= count)]
        if missing.size:
            raise SceneError(f"node {missing[0]} does not exist: axisymmetric shell {shell} has {count} nodes")
        return index % count


def _check_meridian(points: np.ndarray, thickness: np.ndarray, name: str) -> None:
    inner = np.zeros(len(points), bool)
    inner[1:-1] = True
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    for faulty, text in (
        (~np.isfinite(points).all(1), "node {} is at a non-finite position"),
        (points[:, 0] < 0.0, "node {} has a negative radius"),
        (inner & (points[:, 0] == 0.0), "node {} is on the axis; only the ends of a meridian may be"),
        (
            lengths <= validate.DOUBLED * lengths.max(),
            "edge {} has no length, two nodes lie at one point; remove one of them",
        ),
    ):
        for node in np.flatnonzero(faulty)[:1]:
            raise SceneError(f"axisymmetric shell '{name}': {text.format(node)}")
    if thickness.shape not in ((), (len(lengths),)) or not (np.isfinite(thickness) & (thickness > 0.0)).all():
        raise SceneError(
            f"axisymmetric shell '{name}': thickness is {thickness}; give one positive number or {len(lengths)} of edges"
        )
