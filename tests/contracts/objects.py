"""Small examples of every kind of object: how to add, support and load each, and its features."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes

RECTANGLE = ddg.Rectangle(0.04, 0.02)
X, Y, Z = np.eye(3)


def rubber(viscosity: float = 0.0) -> ddg.Material:
    return ddg.Material(young=1e7, poisson=0.35, density=1000.0, viscosity=viscosity)


@dataclass
class Added:
    """Indices and operations of an added object.

    Attributes:
        rods, shells, rings: indices.
        hold: (scene, motion) -> None: supports that leave no rigid-body mode and only move by `motion`.
        load: (scene, size, amplitude) -> None: a force of magnitude `size` along -z, away from the supports.
    """

    hold: Callable
    load: Callable
    rods: list[int] = field(default_factory=list)
    shells: list[int] = field(default_factory=list)
    rings: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Object:
    """Kind of object; `turns`: supports may rotate rigidly about `axis`."""

    add: Callable
    dimension: int = 3
    axis: tuple = (0.0, 0.0, 1.0)
    turns: bool = True

    def scene(self, viscosity: float = 0.0, motion=None, held: bool = True, **options) -> tuple[ddg.Scene, Added]:
        """Return a scene with this object alone, supported if `held`."""
        scene = ddg.Scene(**({"dimension": self.dimension} | options))
        added = self.add(scene, rubber(viscosity))
        if held:
            added.hold(scene, motion)
        return scene, added


def arc(n: int = 8, lift: float = 0.0) -> np.ndarray:
    """Return an arc of a circle in the plane of x and z, or rising out of it."""
    s = np.linspace(0.0, 0.5, n + 1)
    return np.stack([np.sin(s), lift * s, 1.0 - np.cos(s)], -1)


def line(start, end, n: int) -> np.ndarray:
    return np.linspace(np.asarray(start, float), np.asarray(end, float), n + 1)


def _force_on_rod(rod: int, node: int):
    return lambda scene, size, amplitude=None: scene.add_force(rod, node, (0.0, 0.0, -size), amplitude)


def _rod(points=None, clamp: str = "edge", **options):
    def add(scene, material) -> Added:
        settings = {"section": RECTANGLE} | options
        rod = scene.add_rod(arc(lift=0.3) if points is None else points, material=material, **settings)

        def hold(scene, motion=None):
            if clamp == "edge":
                scene.clamp(rod, edges=[0], motion=motion)
            elif clamp == "end":
                scene.clamp_end(rod, motion=motion)
            else:
                scene.fix(rod, [0], motion=motion)

        return Added(hold, _force_on_rod(rod, -1), rods=[rod])

    return add


def _magnetised(scene, material) -> Added:
    """Add a rod with tangential magnetisation, in a field normal to the plane of other loads, zero at the start."""
    added = _rod()(scene, material)
    scene.magnetize(added.rods, 2e4)
    scene.magnetic_field(lambda t: (0.0, 2e-3 * t**4, 0.0))
    return added


def _ring(scene, material) -> Added:
    angle = 2.0 * np.pi * np.arange(12) / 12
    points = 0.3 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    rod = scene.add_rod(points, section=RECTANGLE, material=material, closed=True)
    return Added(
        lambda scene, motion=None: scene.clamp(rod, edges=[0], motion=motion), _force_on_rod(rod, 6), rods=[rod]
    )


def _joined(rigid: bool, **options):
    def add(scene, material) -> Added:
        settings = {"section": RECTANGLE, "material": material} | options
        first = scene.add_rod(line(0.0 * X, 0.5 * X, 4), **settings)
        second = scene.add_rod(line(0.5 * X, X, 4), **settings)
        scene.join([(first, -1), (second, 0)], rigid=rigid)

        def hold(scene, motion=None):
            scene.clamp(first, edges=[0], motion=motion)
            if not rigid:  # a hinge alone leaves the second rod a mechanism
                scene.clamp(second, edges=[-1], motion=motion)

        return Added(hold, _force_on_rod(second, 1), rods=[first, second])

    return add


def _sheet(bending: str, membrane: str = "flat"):
    def add(scene, material) -> Added:
        points, triangles = meshes.rectangle(4, 3, (0.8, 0.5), "alternating")
        shell = scene.add_shell(
            points, triangles, thickness=0.01, material=material, bending=bending, membrane=membrane
        )
        return _added_sheet(scene, shell, points)

    return add


def _added_sheet(scene, shell: int, points: np.ndarray) -> Added:
    low = points[:, 0].min()
    column = np.unique(points[:, 0])[1]
    clamped = np.flatnonzero(points[:, 0] <= low + 1e-9)
    inside = np.flatnonzero(np.abs(points[:, 0] - column) < 1e-9)
    tip = np.flatnonzero(points[:, 0] >= points[:, 0].max() - 1e-9)

    def hold(scene, motion=None):
        if scene.shells[shell].bending == "isometric":  # no boundary normals to clamp: fix two columns of vertices
            scene.hold(shell, np.concatenate([clamped, inside]), motion=motion)
        else:
            scene.clamp_boundary(shell, clamped, motion=motion)

    def load(scene, size, amplitude=None):
        scene.add_vertex_force(shell, tip, (0.0, 0.0, -size / len(tip)), amplitude)

    return Added(hold, load, shells=[shell])


def _stiffened(scene, material) -> Added:
    points, triangles = meshes.rectangle(4, 3, (0.8, 0.5), "alternating")
    shell = scene.add_shell(points, triangles, thickness=0.01, material=material)
    added = _added_sheet(scene, shell, points)
    edge = np.flatnonzero(points[:, 1] <= points[:, 1].min() + 1e-9)
    edge = edge[np.argsort(points[edge, 0])]
    rod = scene.add_rod(points[edge], section=ddg.Rectangle(0.02, 0.01), material=material, director=Z)
    scene.attach(rod, range(len(edge)), shell, edge)  # coupled, so that supports of the sheet fix the rod's twist
    return Added(added.hold, added.load, rods=[rod], shells=[shell])


def _dome(scene, material) -> Added:
    angle = np.linspace(0.0, 0.8, 9)
    points = np.column_stack([np.sin(angle), np.cos(angle)])
    shell = scene.add_axisymmetric_shell(points, thickness=0.02, material=material)
    return Added(
        lambda scene, motion=None: scene.clamp_ring(shell, "last", motion=motion),
        lambda scene, size, amplitude=None: scene.add_pole_force(shell, -size, amplitude=amplitude),
        rings=[shell],
    )


def _with_a_body(scene, material) -> Added:
    """Add a rod with a box on the last node."""
    added = _rod(line(0.0 * X, X, 6), section=ddg.Circle(0.02))(scene, material)
    box = scene.add_body(ddg.Box(1.05 * X, (0.05, 0.018, 0.018), radius=2e-3), density=1000.0, name="box")
    scene.attach(added.rods[0], [-1], box)
    return Added(added.hold, _force_on_rod(added.rods[0], 4), rods=added.rods)


def _mixed(*adders):
    def add(scene, material) -> Added:
        added = [adder(scene, material) for adder in adders]

        def hold(scene, motion=None):
            for item in added:
                item.hold(scene, motion)

        def load(scene, size, amplitude=None):
            for item in added:
                item.load(scene, size, amplitude)

        several = {name: [i for item in added for i in getattr(item, name)] for name in ("rods", "shells", "rings")}
        return Added(hold, load, **several)

    return add


RANGE = 1e-3  # activation distance of contact [m]


def _between_balls(adder, point: tuple, thick: float, friction=0.2):
    """Return an adder with a ball above and one below a point of the object, slightly beyond the activation distance."""

    def add(scene, material) -> Added:
        added = adder(scene, material)
        offset = 0.05 + thick + 1.02 * RANGE
        for side in (-1.0, 1.0):
            scene.add_obstacle(ddg.Sphere(tuple(np.array(point) + [0.0, 0.0, side * offset]), 0.05), name="ball")
        scene.contact(range=RANGE)
        for item in (*scene.batches, *scene.shells):
            scene.contact_between(item.name, "ball", friction=friction)
        return added

    return add


def add_floor(scene, gap: float, motion=None, **options) -> float:
    """Add a floor below all objects, which ignore each other; return its height [m]."""
    heights = [batch.points[..., 2].min() - np.max(batch.section.radius) for batch in scene.batches]
    heights += [shell.points[:, 2].min() - 0.5 * np.max(shell.thickness) for shell in scene.shells]
    heights += [shape.points[:, 2].min() - shape.radius for body in scene.bodies for shape in body.shapes]
    height = min(heights, default=0.0) - gap
    scene.add_obstacle(ddg.Plane((0.0, 0.0, height)), motion=motion, name="floor")
    scene.contact(range=RANGE, friction=0.2, **options)
    ignore_pairs_of_objects(scene)
    return height


def ignore_pairs_of_objects(scene) -> None:
    """Ignore contact between all rods and shells."""
    names = sorted({item.name for item in (*scene.batches, *scene.shells, *scene.bodies)})
    for i, one in enumerate(names):
        for two in names[i:]:
            scene.contact_between(one, two, ignore=True)


UP = (0.0, 1.0, 0.0)  # axis of rotations within the plane of x and z
HANGING = line(0.0 * X, -0.5 * Z, 6)

OBJECTS = {
    "rod": Object(_rod()),
    "rod clamped at its end": Object(_rod(clamp="end")),
    "planar rod": Object(_rod(arc()), dimension=2, axis=UP),
    "rod without twist": Object(_rod(line(0.0 * X, X, 8), twist=False, section=ddg.Circle(0.02)), axis=UP),
    "rod without bending": Object(_rod(HANGING, clamp="node", bend=False), turns=False),
    "closed rod": Object(_ring),
    "rods joined rigidly": Object(_joined(True)),
    "rods joined by a hinge": Object(_joined(False)),
    "planar rods joined rigidly": Object(_joined(True), dimension=2, axis=UP),
    "rod on a shell": Object(_stiffened),
    **{
        f"shell, {bending}": Object(_sheet(bending))
        for bending in ("midedge_dof", "midedge_boundary", "midedge", "hinge", "isometric")
    },
    "shell, curved membrane": Object(_sheet("midedge_dof", "curved")),
    "shell of revolution": Object(_dome, axis=UP, turns=False),
    "rods alone and joined": Object(_mixed(_rod(), _ring, _joined(True))),
    "rods and shells": Object(_mixed(_rod(), _joined(False), _stiffened, _sheet("hinge"))),
    "shells of both kinds": Object(_mixed(_sheet("midedge_dof"), _dome), axis=UP, turns=False),
    "rods by the turning angle": Object(_mixed(_rod(curvature="angle"), _joined(True, curvature="angle"))),
    "rod with a body": Object(_with_a_body, axis=UP),
    "magnetised rod": Object(_magnetised, turns=False),
    "rod in contact": Object(
        _between_balls(_rod(line(0.0 * X, X, 8), section=ddg.Circle(0.02)), X, 0.02, (0.2, 0.3, 0.4)), axis=UP
    ),
    "rods in contact, joined": Object(
        _between_balls(_joined(True, section=ddg.Circle(0.02)), (0.875, 0.0, 0.0), 0.02), axis=UP
    ),
    "shell in contact": Object(_between_balls(_sheet("midedge_dof"), (0.8, 0.25, 0.0), 0.005)),
}
