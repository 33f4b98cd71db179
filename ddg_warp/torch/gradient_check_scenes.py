"""Small scenes of every kind of object, for the gradient checks of `ddg-warp gradients`."""

from collections.abc import Callable

import numpy as np

from ddg_warp.geometry import meshes
from ddg_warp.scene.drag import Granular, QuadraticDrag
from ddg_warp.scene.flow import Turbulence
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.material import Circle, Ellipse, Material, Ribbon
from ddg_warp.scene.obstacles import Box, Plane, Sphere
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.scene.scene import Scene

T = np.linspace(0.0, 1.0, 6)
CURVE = np.stack([0.3 * T, 0.05 * np.sin(3.0 * T), 0.04 * np.cos(5.0 * T)], axis=1)
RIM, ANGLES = np.linspace(0.0, 0.8, 6), np.linspace(0.0, 2.0 * np.pi, 7, endpoint=False)
SIDE = (0.3, 0.2)  # of sheets [m]


def soft(scale: float = 1.0) -> Material:
    """Return the material of all objects, with density multiplied by `scale`."""
    return Material(young=1e6, density=1000.0 * scale, viscosity=0.01)


def _rod(points=CURVE, section=None, hold: Callable | None = None, more: Callable | None = None, **options) -> Callable:
    """Return a function that adds a rod, clamped at its first edge or supported by `hold(scene, rod)`, with `more(scene, rod)`."""

    def add(scene: Scene, material: Material) -> None:
        rod = scene.add_rod(points, section=section or Ellipse(0.004, 0.003), material=material, **options)
        (hold or (lambda scene, rod: scene.clamp(rod)))(scene, rod)
        if more:
            more(scene, rod)

    return add


def _joined(rigid: bool = True, flat: bool = False, more: Callable | None = None) -> Callable:
    """Return a function that adds three rods joined at a point, the hinged ones clamped at the far ends; with `more(scene, rods)`."""

    def add(scene: Scene, material: Material) -> None:
        keep, last = np.array([1.0, not flat, 1.0]), len(CURVE) - 1
        rods = [scene.add_rod(CURVE * keep, section=Ellipse(0.004, 0.003), material=material)]
        for y, z in ((0.2, 0.1), (-0.2, 0.05)):
            points = (CURVE[-1] + np.stack([0.1 * T, y * T, z * T], axis=1)) * keep
            rods.append(scene.add_rod(points, section=Circle(0.003), material=material))
        scene.clamp(rods[0])
        scene.fix(rods[1], [last], components="xz")
        scene.join([(rods[0], last), (rods[1], 0), (rods[2], 0)], rigid=rigid)
        if not rigid:
            scene.clamp(rods[1:], edges=[-1])
        if more:
            more(scene, rods)

    return add


def _sheet(bending: str, hold: Callable | None = None, more: Callable | None = None, **options) -> Callable:
    """Return a function that adds a wavy sheet, fixed at its first vertices or supported by `hold(scene, shell, points)`."""

    def add(scene: Scene, material: Material) -> None:
        points, triangles = meshes.rectangle(3, 2, SIDE)
        points = np.array(points, float)
        if bending != "isometric":  # isometric bending needs a flat rest shape
            points[:, 2] = 0.02 * np.sin(9.0 * points[:, 0])
        shell = scene.add_shell(points, triangles, thickness=0.004, material=material, bending=bending, **options)
        first = np.flatnonzero(points[:, 0] <= 0.0 if hold or bending != "isometric" else points[:, 0] <= 0.11)
        (hold or (lambda scene, shell, first: scene.hold(shell, [*first, len(points) - 1])))(scene, shell, first)
        if more:
            more(scene, shell)

    return add


def _rotated_sheet(scene: Scene, material: Material) -> None:
    """Add a sheet along a diagonal, with a skew symmetry plane across it."""
    points, triangles = meshes.rectangle(3, 2, SIDE)
    points = np.array(points, float)
    along, across = np.array([0.8, 0.6, 0.0]), np.array([-0.6, 0.8, 0.0])
    first = np.flatnonzero(points[:, 0] <= 0.0)
    points = points[:, :1] * along + points[:, 1:2] * across
    shell = scene.add_shell(points, triangles, thickness=0.004, material=material)
    scene.symmetry(shell, first, tuple(along))
    scene.hold(shell, [0])
    scene.hold(shell, [len(points) - 1], components="z")


def _stiffened(scene: Scene, material: Material) -> None:
    points, triangles = meshes.rectangle(3, 2, SIDE)
    shell = scene.add_shell(points, triangles, thickness=0.004, material=material)
    points = np.asarray(points)
    scene.hold(shell, [0, 4, 8])
    row = np.flatnonzero(points[:, 1] == 0.0)
    rod = scene.add_rod(points[row], section=Circle(0.003), material=material)
    scene.attach(rod, range(len(row)), shell, row)


def _dome(scene: Scene, material: Material) -> None:
    points = np.column_stack([0.3 * np.sin(RIM), 0.3 * np.cos(RIM)])
    shell = scene.add_axisymmetric_shell(points, thickness=0.004, material=material)
    scene.clamp_ring(shell, "last")


def _magnetised(magnetisation, field, dipoles: bool = False) -> Callable:
    def magnetise(scene: Scene, rod: int) -> None:
        scene.magnetize(rod, magnetisation)
        scene.magnetic_field(field, gradient=np.diag([1e-2, 1e-2, -2e-2]))
        if dipoles:
            scene.add_dipoles()

    return magnetise


EDDIES = Turbulence((0.5, 0.2, 1.0), 0.5, 0.2, modes=16)


def _drag(scene: Scene, rods) -> None:
    scene.drag(rods, tangential=0.1, normal=0.2, rotational=1e-6, nodes=0.01)


def _sand(scene: Scene, rods) -> None:
    scene.drag(rods, Granular(lateral=0.3, friction=0.1, leading=0.05, speed=0.05))


def _wind(scene: Scene, rods, flow=(0.5, 0.2, 1.0)) -> None:
    scene.flow = flow
    scene.drag(rods, QuadraticDrag(300.0, tangential=0.1))


def _some_drag(scene: Scene, rods) -> None:
    """Add viscous drag to one rod, granular drag to another, and a mass to the third."""
    _drag(scene, rods[0])
    _sand(scene, rods[1])
    scene.add_mass(rods[2], -1, 0.002)


def _add_contact(scene: Scene, law: str, **options) -> None:
    """Add contact with friction, with a large activation distance."""
    scene.contact(law=law, range=0.02, stiffness=5.0, friction=0.3, velocity=0.5, **options)


def _crossing(scene: Scene, material: Material, motion: Grip | None = None, **options) -> None:
    """Add two crossing rods, one clamped, with two friction iterations a step."""
    rods = [scene.add_rod(CURVE, section=Circle(0.004), material=material, name="lower")]
    points = CURVE[3] + np.stack([0.1 * T - 0.05, 0.3 * T - 0.15, 0.014 + 0.03 * (T - 0.5) ** 2], axis=1)
    rods.append(scene.add_rod(points, section=Circle(0.003), material=material, name="upper"))
    scene.clamp(rods[0], edges=[0, -1], motion=motion)
    _add_contact(scene, "barrier", friction_iterations=2, **options)


def _on_ball(scene: Scene, material: Material) -> None:
    """Add a rod on a ball that a grip moves."""
    scene.add_rod(CURVE, section=Circle(0.004), material=material)
    scene.add_obstacle(Sphere((0.18, 0.05, -0.352), 0.3), motion=Grip(pivot=(0.1, 0.0, -0.2)))
    _add_contact(scene, "penalty")


def _fixed_on_ball(**friction) -> Callable:
    """Return a function that clamps a rod and supports the far end by a ball on a grip."""

    def hold(scene: Scene, rod: int) -> None:
        scene.clamp(rod)
        scene.add_obstacle(Sphere((0.18, 0.05, -0.352), 0.3), motion=Grip(pivot=(0.1, 0.0, -0.2)))
        scene.contact(range=0.02, stiffness=5.0, **friction)

    return hold


def _on_box(scene: Scene, material: Material) -> None:
    """Add a rod on a rigid box on a plane, with friction."""
    scene.add_rod(CURVE, section=Circle(0.004), material=material)
    scene.add_body(
        Box((0.18, 0.05, -0.085), (0.05, 0.04, 0.03), radius=0.004), density=300.0, angular_velocity=(1.0, 2.0, 3.0)
    )
    scene.add_obstacle(Plane((0.0, 0.0, -0.135), (-0.03, 0.0, 1.0)))
    scene.contact(law="barrier", range=0.02, stiffness=5.0, friction=0.3, velocity=0.5, friction_iterations=1)


def _over_plane(scene: Scene, shell: int) -> None:
    scene.add_obstacle(Plane((0.0, 0.0, -0.01), (-0.03, 0.0, 1.0)))
    _add_contact(scene, "barrier")


def _with_bodies(scene: Scene, rod: int) -> None:
    """Add a body clamped to the end of a rod, one hinged to it with a motor, and one that hangs from the world by a spring."""
    first, second = CURVE[-1] + (0.02, 0.01, 0.0), CURVE[-1] + (0.05, 0.03, 0.02)
    bodies = [
        scene.add_body(mass=0.02, inertia=(2e-5, 3e-5, 4e-5), center=first, angular_velocity=(3.0, 4.0, 5.0)),
        scene.add_body(mass=0.01, inertia=(1e-5, 2e-5, 1e-5), center=second, angular_velocity=(1.0, -2.0, 3.0)),
        scene.add_body(mass=0.03, inertia=(2e-5, 1e-5, 3e-5), center=(0.0, 0.3, -0.05)),
    ]
    scene.attach(rod, -1, bodies[0])
    scene.hinge(
        *bodies[:2], point=0.5 * (first + second), axis=(0.0, 1.0, 0.0), torque=1e-3, damping=1e-5, stiffness=200.0
    )
    scene.hinge(bodies[2], point=(0.0, 0.3, 0.0), axis=(1.0, 0.0, 0.0), angle=0.1, spring=1e-3, stiffness=200.0)


def _timed(t: float) -> tuple:
    return (0.0, 2e-2 * t, 1e-2)


SWING = Motion(
    translation=lambda t: (0.05 * np.sin(9.0 * t), 0.1 * t, 0.0), angle=lambda t: 4.0 * t, axis=(0.3, 1.0, 0.2)
)

# name -> dimension of the scene, and the function that adds the object
OBJECTS: dict[str, tuple[int, Callable]] = {
    "rod": (3, _rod()),
    "rod clamped at its end": (3, _rod(section=Circle(0.004), hold=lambda s, r: s.clamp_end(r))),
    "rod without twist": (
        3,
        _rod(section=Circle(0.004), natural="straight", twist=False, hold=lambda s, r: s.fix(r, [0, -1])),
    ),
    "planar rod": (2, _rod(CURVE * [1.0, 0.0, 1.0], Circle(0.004))),
    "rod by the turning angle": (3, _rod(curvature="angle")),
    "closed rod": (
        3,
        _rod(0.1 * np.stack([np.cos(ANGLES), np.sin(ANGLES), 0.2 * np.sin(2.0 * ANGLES)], axis=1), closed=True),
    ),
    "ribbon": (3, _rod(section=Ribbon(0.01, 0.002))),
    "rods joined rigidly": (3, _joined()),
    "rods joined by a hinge": (3, _joined(rigid=False)),
    "planar rods joined rigidly": (2, _joined(flat=True)),
    **{
        f"shell, {name}": (3, _sheet(name))
        for name in ("midedge_dof", "midedge_boundary", "midedge", "hinge", "isometric")
    },
    "shell, curved membrane": (3, _sheet("midedge_dof", membrane="curved")),
    "shell on an oblique plane": (3, _rotated_sheet),
    "rod on a shell": (3, _stiffened),
    "shell of revolution": (3, _dome),
    "magnetised rod": (3, _rod(more=_magnetised(2e4, (0.0, 1e-2, 1e-2)))),
    "rod magnetised across": (3, _rod(more=_magnetised((1e4, 2e4, 1e4), _timed))),
    "magnetised rod without twist": (
        3,
        _rod(
            section=Circle(0.004),
            natural="straight",
            twist=False,
            hold=lambda s, r: s.fix(r, [0, -1]),
            more=_magnetised(2e4, _timed),
        ),
    ),
    "rod of dipoles": (3, _rod(more=_magnetised(2e5, (0.0, 1e-2, 1e-2), dipoles=True))),
    "rod with drag": (3, _rod(more=_drag)),
    "rod in sand": (3, _rod(more=_sand)),
    "rod in wind": (3, _rod(section=Circle(0.004), more=_wind)),
    "joined rods in wind": (3, _joined(more=_wind)),
    "shell in turbulence": (3, _sheet("midedge_dof", more=lambda scene, shell: _wind(scene, None, EDDIES))),
    "shell in wind": (3, _sheet("midedge_dof", more=lambda scene, shell: _wind(scene, None))),
    "joined rods with drag": (3, _joined(more=_some_drag)),
    "rod in a motion": (3, _rod(hold=lambda s, r: s.clamp(r, motion=SWING))),
    "gripped rod": (3, _rod(hold=lambda s, r: s.clamp(r, motion=Grip(pivot=(0.1, 0.0, 0.0))))),
    "gripped shell": (3, _sheet("midedge_dof", lambda s, k, first: s.hold(k, first, motion=Grip()))),
    "shell clamped by a grip": (
        3,
        _sheet("midedge_dof", lambda s, k, first: s.clamp_boundary(k, first, motion=Grip())),
    ),
    "shell clamped in a motion": (
        3,
        _sheet("midedge_dof", lambda s, k, first: s.clamp_boundary(k, first, motion=SWING)),
    ),
    "rod with bodies": (3, _rod(more=_with_bodies)),
    "rods in contact": (3, _crossing),
    "gripped rod that rolls another": (3, lambda s, m: _crossing(s, m, Grip(), rolling=True)),
    "rod on a gripped ball": (3, _on_ball),
    "held rod on a gripped ball": (3, _rod(section=Circle(0.004), hold=_fixed_on_ball())),
    "held rod that rubs a gripped ball": (
        3,
        _rod(section=Circle(0.004), hold=_fixed_on_ball(friction=0.3, velocity=0.01)),
    ),
    "held rod that rolls on a gripped ball": (
        3,
        _rod(section=Circle(0.004), hold=_fixed_on_ball(friction=0.3, velocity=0.01, rolling=True)),
    ),
    "rod on a rigid box": (3, _on_box),
    "shell on a plane": (3, _sheet("midedge_dof", more=_over_plane)),
    "rod under a couple": (3, _rod(more=lambda s, r: s.add_couple(r, -1, (1e-4, 2e-4, -1e-4)))),
    "shell under pressure": (3, _sheet("midedge_dof", more=lambda s, k: s.add_pressure(k, 5.0))),
}


def scene_of(name: str, gravity=(0.5, 0.0, -9.81), mass_damping: float = 0.7, density: float = 1.0) -> Scene:
    """Return the scene of an object; `density` is a factor.

    Args:
        gravity, mass_damping: as of `Scene`.
    """
    dimension, add = OBJECTS[name]
    if add is _dome:  # gravity acts along the axis of revolution
        gravity = (0.0, 0.0, gravity[2])
    scene = Scene(gravity=tuple(gravity), mass_damping=mass_damping, dimension=dimension)
    add(scene, soft(density))
    return scene
