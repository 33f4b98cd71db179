"""What a scene says about axisymmetric shells: their meridians, and what holds and loads them."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import validate
from ddg_warp.errors import SceneError
from ddg_warp.material import Material
from ddg_warp.motion import Motion

ENDS = {"first": 0, "last": -1}


@dataclass
class AxisymmetricShell:
    """A shell of revolution; see `Meridians.add_axisymmetric_shell`."""

    points: np.ndarray  # (n, 2) radius and height [m]
    thickness: np.ndarray
    material: Material
    rest: object
    name: str


@dataclass(frozen=True)
class RingSupport:
    """What is held of nodes of a meridian; `tangent` is the direction (2,) that a rim keeps, None where it may turn."""

    shell: int
    nodes: np.ndarray
    components: str
    tangent: tuple | None = None
    clamped: bool = False
    motion: Motion | None = None


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


@dataclass
class Meridians:
    """The part of a scene that turns about the z axis: every energy, force and mass is that of the whole revolution."""

    axisymmetric_shells: list[AxisymmetricShell] = field(default_factory=list)
    ring_supports: list[RingSupport] = field(default_factory=list)
    ring_loads: list[RingLoad] = field(default_factory=list)
    ring_pressures: list[RingPressure] = field(default_factory=list)

    def add_axisymmetric_shell(
        self, points, *, thickness, material: Material, rest="shape", name: str = "shell of revolution"
    ) -> int:
        """Add a shell of revolution about the z axis, deforming as one, by its meridian in the plane of x and z.

        An end of the meridian on the axis is a pole: it stays there, and the surface stays smooth. Other ends are rims, free
        where nothing holds them.

        Args:
            points: radius and height of the nodes at rest (n, 2) [m]; only ends may have radius 0.
            thickness: one number or one an edge [m].
            material: `Material`; its density gives the mass, its viscosity the strain-rate damping.
            rest: "shape" takes metric and curvature at rest from the points, "flat" the metric alone; or two arrays (metric
                (n - 1, 2) [1], curvature (n, 2) [1/m]), along the meridian and around the axis: squared natural stretch of
                edges against the points, and natural curvature at nodes, positive where the angle of the tangent grows.
            name: shown in reports and output.

        Returns:
            Index among the axisymmetric shells.

        Raises:
            SceneError: what is given is no meridian; the message names shell and node.
        """
        try:
            points, thickness = np.array(points, float), np.array(thickness, float)
        except (TypeError, ValueError):
            raise SceneError(f"axisymmetric shell '{name}': points or thickness are no numbers") from None
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
            raise SceneError(
                f"axisymmetric shell '{name}': points have shape {points.shape}; give (n, 2), n at least 3: radius, height"
            )
        if not isinstance(material, Material):
            raise SceneError(f"axisymmetric shell '{name}': material is {material!r}; give material=Material(...)")
        _check_meridian(points, thickness, name)
        self.axisymmetric_shells.append(AxisymmetricShell(points, thickness, material, rest, name))
        return len(self.axisymmetric_shells) - 1

    def hold_ring(self, shell: int, nodes, components: str = "xz", motion: Motion | None = None) -> None:
        """Hold radius ("x") or height ("z") of nodes of a meridian; the surface may turn there (simply supported).

        `motion` moves them in the plane of x and z, by a translation and a rotation about the y axis.
        """
        self._hold_ring(RingSupport(shell, self._nodes(shell, nodes), components, motion=motion))

    def clamp_ring(
        self, shell: int, end: str, components: str = "xz", tangent=None, motion: Motion | None = None
    ) -> None:
        """Hold components and the direction of the meridian at a rim, its "first" or "last" node; a motion turns it, too.

        Args:
            tangent: direction (2,) of the meridian there, the way it runs; by default that of the points, extrapolated.
        """
        if tangent is not None:
            tangent = np.array(tangent, float)
            if tangent.shape != (2,) or not np.isfinite(tangent).all() or not tangent.any():
                raise SceneError(f"clamp_ring: tangent is {tangent!r}; give a direction (2,)")
        nodes = self._nodes(shell, self._end(shell, end))
        self._hold_ring(RingSupport(shell, nodes, components, tangent=tangent, clamped=True, motion=motion))

    def symmetry_ring(self, shell: int, end: str) -> None:
        """Put a rim on a plane of symmetry across the axis, which the meridian meets at a right angle."""
        node = self._end(shell, end)
        points = self.axisymmetric_shells[shell].points
        edge = points[1] - points[0] if node == 0 else points[-1] - points[-2]
        self.clamp_ring(shell, end, "z", tangent=(0.0, np.copysign(1.0, edge[1])))

    def add_ring_force(self, shell: int, nodes, force, amplitude: Callable[[float], float] | None = None) -> None:
        """Dead force per length of ring at rest on nodes (2,) or (n, 2): radial and axial [N/m]."""
        nodes = self._nodes(shell, nodes)
        radius = self.axisymmetric_shells[shell].points[nodes, 0]
        if not radius.all():
            raise SceneError(f"add_ring_force: shell {shell} has a pole there; use add_pole_force")
        force = _forces("add_ring_force", force, (len(nodes), 2))
        self.ring_loads.append(RingLoad(shell, nodes, 2.0 * np.pi * radius[:, None] * force, _amplitude(amplitude)))

    def add_pole_force(self, shell: int, force: float, end: str = "first", amplitude=None) -> None:
        """Dead axial force [N] on a pole."""
        node = self._end(shell, end)
        if self.axisymmetric_shells[shell].points[node, 0] != 0.0:
            raise SceneError(f"add_pole_force: the {end} node of shell {shell} is no pole; use add_ring_force")
        force = np.array([[0.0, validate.number("add_pole_force: force", force)]])
        self.ring_loads.append(RingLoad(shell, self._nodes(shell, node), force, _amplitude(amplitude)))

    def add_axisymmetric_pressure(
        self, shell: int, pressure, edges=None, *, dead: bool = False, amplitude=None
    ) -> None:
        """Pressure [Pa] on the surface of edges (all by default), towards the left of the meridian as it runs in x and z.

        It follows the surface: statics takes its exact derivative; in dynamics its forces are those on the predicted surface. With
        `dead` it keeps directions and areas of the rest shape.
        """
        self._check_axisymmetric(shell)
        count = len(self.axisymmetric_shells[shell].points) - 1
        index = np.arange(count) if edges is None else np.array(validate.indices("edges", edges), int)
        bad = index[(index < 0) | (index >= count)]
        if bad.size:
            raise SceneError(f"add_axisymmetric_pressure: edge {bad[0]} does not exist; shell {shell} has {count}")
        pressure = _forces("add_axisymmetric_pressure", pressure, index.shape)
        self.ring_pressures.append(RingPressure(shell, index, pressure, dead, _amplitude(amplitude)))

    def _hold_ring(self, support: RingSupport) -> None:
        if not support.components or set(support.components) - set("xz"):
            raise SceneError(f"ring support: components {support.components!r}; they are 'x' (radius), 'z' or both")
        motion = support.motion
        if motion is not None and not isinstance(motion, Motion):
            raise SceneError(f"ring support: motion is {motion!r}; give Motion(translation=..., angle=...)")
        if motion is not None and not motion.planar:
            raise SceneError(
                f"ring support: the motion turns about {tuple(motion.axis)}; a meridian stays in the plane of x and z, give "
                "axis=(0, 1, 0)"
            )
        self.ring_supports.append(support)

    def _end(self, shell, end: str) -> int:
        self._check_axisymmetric(shell)
        if end not in ENDS:
            raise SceneError(f"end is {end!r}; it is 'first' or 'last'")
        return ENDS[end]

    def _check_axisymmetric(self, shell) -> None:
        count = len(self.axisymmetric_shells)
        if not 0 <= validate.index("shell", shell) < count:
            raise SceneError(f"axisymmetric shell {shell} does not exist; the scene has {count} so far")

    def _nodes(self, shell, nodes) -> np.ndarray:
        self._check_axisymmetric(shell)
        count = len(self.axisymmetric_shells[shell].points)
        index = np.array(validate.indices("nodes", nodes), int)
        bad = index[(index < -count) | (index >= count)]
        if bad.size:
            raise SceneError(f"node {bad[0]} does not exist: axisymmetric shell {shell} has {count} nodes")
        return index % count


def _check_meridian(points: np.ndarray, thickness: np.ndarray, name: str) -> None:
    inner = np.zeros(len(points), bool)
    inner[1:-1] = True
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    for bad, text in (
        (~np.isfinite(points).all(1), "node {} is at a non-finite position"),
        (points[:, 0] < 0.0, "node {} has a negative radius"),
        (inner & (points[:, 0] == 0.0), "node {} is on the axis; only the ends of a meridian may be"),
        (lengths == 0.0, "edge {} has no length; remove the doubled node"),
    ):
        for node in np.flatnonzero(bad)[:1]:
            raise SceneError(f"axisymmetric shell '{name}': {text.format(node)}")
    if thickness.shape not in ((), (len(lengths),)) or not (np.isfinite(thickness) & (thickness > 0.0)).all():
        raise SceneError(
            f"axisymmetric shell '{name}': thickness is {thickness}; give one positive number or {len(lengths)} of edges"
        )


def _forces(what: str, values, shape) -> np.ndarray:
    try:
        values = np.broadcast_to(np.asarray(values, float), shape).copy()
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if not np.isfinite(values).all():
        raise SceneError(f"{what}: give finite numbers that broadcast to {shape}")
    return values


def _amplitude(amplitude):
    if amplitude is not None and not callable(amplitude):
        raise SceneError(f"amplitude is {amplitude!r}; give a function of the time, or None")
    return amplitude
