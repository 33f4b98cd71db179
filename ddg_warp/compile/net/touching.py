"""What of a net may touch what, and by which numbers."""

import numpy as np

from ddg_warp.compile.bodies import ROD, Body, Touching
from ddg_warp.compile.net.net import Net
from ddg_warp.errors import SceneError
from ddg_warp.scene.contact import Contact, touching_names
from ddg_warp.scene.obstacles import MESH

HALF = 0.5  # of the smallest radius, the range of contact by default
# Of forces that close the gap by some part of the range, by default: weights of a node; the share of EI / r^2, bending to ten radii;
# the strain of what a node carries of a membrane; and that of a rod, which counts where its bending stiffness is next to none.
WEIGHTS, BENDING, STRAIN, LIMP = 10.0, 0.01, 0.005, 1e-6
BEYOND = 100.0  # range of contact over the size of the scene, at most
RESOLVED = 1e-13  # range of contact over the coordinates of the scene, at least
INERTIA = 10.0  # of the mass of a node over the square of the step, the least stiffness of a step that had no room


def touching(scene, net: Net) -> Touching | None:
    """Contact of a scene's net, None without."""
    law = scene.touching
    if law is None:
        return None
    names, bodies, forces = touching_names(scene), [], []
    for rod in net.rods:
        batch = rod.piece.batch
        if batch.name in names:
            row = rod.rod - batch.first
            radius = law.radius.get(batch.name)
            if radius is None:
                radius = _radius(batch, row, rod.rod)
            if law.rolling and not rod.edges.size:
                raise SceneError(
                    f"contact: rolling, and rod {rod.rod} ('{batch.name}') has no twist, by which it would roll; leave rolling out, or "
                    "give the rod twist"
                )
            angles = rod.edges if law.rolling else rod.edges[:0]
            bodies.append(
                Body(rod.nodes, ROD, radius, batch.name, f"rod {rod.rod}", closed=batch.closed, angles=angles)
            )
            bending = max(float(np.max(_of_rod(batch, name, row))) for name in ("EI1", "EI2"))
            elastic = max(BENDING * bending / radius**2, LIMP * float(np.max(_of_rod(batch, "EA", row))))
            forces.append((net.mass[rod.nodes, 0].max(), elastic))
    for index, shell in enumerate(net.shells):
        if (name := shell.surface.name) in names:
            plate = shell.plate
            half = law.radius.get(name, 0.5 * float(plate.thickness.max()))
            cells = shell.nodes[shell.surface.triangles]
            bodies.append(Body(shell.nodes, MESH, half, name, f"shell {index}", cells, shell=index))
            membrane = float((plate.membrane_stiffness * np.sqrt(2.0 * plate.area)).max())
            elastic = max(BENDING * float(plate.bending_stiffness.max()) / half, STRAIN * membrane)
            forces.append((net.mass[shell.nodes, 0].max(), elastic))
    gravity, obstacles = float(np.linalg.norm(scene.gravity)), len(scene.obstacles)
    scale = [max(WEIGHTS * mass * gravity, elastic) for mass, elastic in forces]
    own = np.array([(force, mass) for force, (mass, _) in zip(scale, forces, strict=True)]).reshape(-1, 2).T
    own = np.column_stack([own, np.full((2, obstacles), np.nan)])
    for index, (obstacle, nodes, markers) in enumerate(zip(scene.obstacles, net.obstacles, net.markers, strict=True)):
        shape, name = obstacle.shape, obstacle.name
        given = nodes, shape.kind, shape.radius, name, f"obstacle {index} ('{name}')", nodes[shape.cells]
        bodies.append(Body(*given, still=True, markers=markers))
    found = _numbers(scene, law, bodies, *own)
    if law.rolling and not (found.rubs and any(body.angles.size for body in bodies)):
        lacking = "no rod touches anything" if found.rubs else "there is no friction"
        raise SceneError(f"contact: rolling, and {lacking}; leave rolling out")
    return found


def _radius(batch, row: int, rod: int) -> float:
    """Largest radius of one rod of a batch [m], by which it touches.

    Raises:
        SceneError: its section has none.
    """
    radius = batch.section.radius
    if radius is None or not np.all(np.asarray(radius) > 0.0):
        raise SceneError(
            f"contact: rod {rod} ('{batch.name}') touches by a radius, and that of its section is {radius}; give "
            f"Stiffness(radius=...), positive, or contact(radius={{{batch.name!r}: ...}})"
        )
    return float(np.max(_of_rod(batch, "radius", row)))


def _of_rod(batch, name: str, row: int) -> np.ndarray:
    """Values of the section of one rod of a batch."""
    values = np.asarray(getattr(batch.section, name), float)
    return values[row] if values.ndim == 2 and len(values) > 1 else values


def _numbers(scene, law: Contact, bodies: list[Body], scale: np.ndarray, mass: np.ndarray) -> Touching:
    """Numbers by pairs of groups.

    Args:
        scale: of every body the force [N] that closes the gap by some part of the range; mass: of its heaviest node [kg].
    """
    names, group = np.unique([body.name for body in bodies], return_inverse=True)
    count, moving = len(names), np.array([not body.still for body in bodies])
    radius = min(body.radius for body in bodies if not body.still)
    within = np.full((count, count), HALF * radius if law.range is None else law.range)
    rough = np.full((count, count, 3), law.friction)
    force, inertia = (_of_both(own, group, moving) for own in (scale, INERTIA * mass))
    stiffness = np.full((count, count), np.nan if law.stiffness is None else law.stiffness)
    ignored, place = [], {name: i for i, name in enumerate(names.tolist())}
    for between in scene.betweens:
        g, h = (place[name] for name in between.names)
        for table, value in ((rough, between.friction), (stiffness, between.stiffness), (within, between.range)):
            if value is not None:
                table[g, h] = table[h, g] = value
        if between.ignore:
            ignored.append((g, h))
    _refuse_ranges(scene, within, names)
    inertia = np.where(np.isnan(stiffness), inertia, 0.0)
    stiffness = np.where(np.isnan(stiffness), force / within, stiffness)
    return Touching(law, bodies, names.tolist(), group, *_by_way(rough), stiffness, within, inertia, ignored)


def _refuse_ranges(scene, within: np.ndarray, names) -> None:
    """Refuse a range (groups, groups) far beyond what touches, or one that coordinates do not resolve."""
    points = np.concatenate([o.points.reshape(-1, 3) for o in (*scene.batches, *scene.shells)])
    size, far = np.ptp(points, axis=0).max(), np.abs(points).max()
    for g, h in np.argwhere((within > BEYOND * size) | (within < RESOLVED * far))[:1]:
        wrong = (
            f"far beyond the size of the scene, {size:.3g} m"
            if within[g, h] > size
            else f"lost in positions of {far:.3g} m"
        )
        raise SceneError(
            f"contact: the range between {str(names[g])!r} and {str(names[h])!r} is {within[g, h]:.3g} m, {wrong}; it is by "
            "default half of the smallest radius or half thickness: give range=..., of about that size"
        )


def _of_both(values: np.ndarray, group: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Geometric means (groups, groups) of the largest values of what moves in two groups, of obstacles that of what they touch.

    Two obstacles, which never touch, have zero.
    """
    own = np.full(int(group.max()) + 1, np.nan)
    for g in np.unique(group[moving]):
        own[g] = values[moving & (group == g)].max()
    own = np.where(np.isnan(own)[:, None], own[None], own[:, None])
    return np.nan_to_num(np.sqrt(own * own.T))


def _by_way(friction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of coefficients forwards, backwards and across (..., 3) the smallest but zero, and multiples of it.

    So what sticks creeps by less than the velocity of the law, whichever way it is pulled.
    """
    least = np.where(friction > 0.0, friction, np.inf).min(-1)
    none = np.isinf(least)
    return np.where(none, 0.0, least), np.where(none[..., None], 1.0, friction / least[..., None])
