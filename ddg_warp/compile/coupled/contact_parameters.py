"""Contact of the coupled system: collision bodies and parameters of pairs of groups."""

from dataclasses import replace

import numpy as np

from ddg_warp.compile.collision_bodies import ROD, Body, ContactParameters
from ddg_warp.compile.coupled.system import CoupledSystem
from ddg_warp.compile.laws import contact_law
from ddg_warp.errors import SceneError
from ddg_warp.scene.contact import Contact, contact_names
from ddg_warp.scene.obstacles import BALL, MESH

HALF = 0.5  # default activation distance over the smallest radius
BODY = 0.05  # largest default activation distance over the size of a rigid body

# Default contact forces that close a fraction of the activation distance. WEIGHTS: nodal weights. BENDING: fraction of EI / r^2, that
# is, bending to ten radii. STRAIN: strain of a membrane. LIMP: strain of a rod, decisive where bending stiffness is negligible.
WEIGHTS, BENDING, STRAIN, LIMP = 10.0, 0.01, 0.005, 1e-6
EARTH = 9.81  # gravity that gives the contact of rigid bodies its least stiffness, also in weightlessness [m/s^2]
BEYOND = 100.0  # largest activation distance over the size of the scene
RESOLVED = 1e-13  # least activation distance over coordinates
INERTIA = 10.0  # least contact stiffness after a step ended at the minimum gap, over nodal mass / dt^2


def contact_parameters(scene, coupled: CoupledSystem) -> ContactParameters | None:
    """Return the contact of the coupled system, None without."""
    law = scene.contact_settings
    if law is None:
        return None
    iterations = law.friction_iterations or 1 + any(body.shapes for body in scene.bodies)
    law = replace(law, friction_iterations=int(iterations))
    names, bodies, forces, sections = contact_names(scene), [], [], {}
    for rod in coupled.rods:
        batch = rod.piece.batch
        if batch.name in names:
            if batch.first not in sections:
                sections[batch.first] = _radii_and_forces(batch, law.radius.get(batch.name))
            if law.rolling and not rod.edges.size:
                raise SceneError(
                    f"contact: rolling, and rod {rod.rod} ('{batch.name}') has no twist, by which it would roll; leave rolling out, or "
                    "give the rod twist"
                )
            angles = rod.edges if law.rolling else rod.edges[:0]
            radius, elastic = (values[rod.rod - batch.first] for values in sections[batch.first])
            bodies.append(
                Body(rod.nodes, ROD, radius, batch.name, f"rod {rod.rod}", closed=batch.closed, angles=angles)
            )
            forces.append((coupled.mass[rod.nodes, 0].max(), elastic))
    for index, shell in enumerate(coupled.shells):
        if (name := shell.surface.name) in names:
            plate = shell.plate
            half = law.radius.get(name, 0.5 * float(plate.thickness.max()))
            cells = shell.nodes[shell.surface.triangles]
            bodies.append(Body(shell.nodes, MESH, half, name, f"shell {index}", cells, shell=index))
            membrane = float((plate.membrane_stiffness * np.sqrt(2.0 * plate.area)).max())
            elastic = max(BENDING * float(plate.bending_stiffness.max()) / half, STRAIN * membrane)
            forces.append((coupled.mass[shell.nodes, 0].max(), elastic))
    for index, (body, shapes) in enumerate(
        zip(scene.bodies, coupled.rigid_bodies.surfaces if scene.bodies else (), strict=True)
    ):
        for shape, nodes in zip(body.shapes, shapes, strict=False):
            radius = law.radius.get(body.name, shape.radius)
            if not radius > 0.0:
                raise SceneError(
                    f"contact: body {index} ('{body.name}') has a sharp shape; round it, as in Box(..., radius=...), or give "
                    f"contact(radius={{{body.name!r}: ...}})"
                )
            geometry = nodes, shape.kind, radius, body.name, f"body {index} ('{body.name}')", nodes[shape.cells]
            bodies.append(Body(*geometry, rigid=index))
            forces.append((body.mass, WEIGHTS * body.mass * EARTH))
    gravity, obstacles = float(np.linalg.norm(scene.gravity)), len(scene.obstacles)
    scale = [max(WEIGHTS * mass * gravity, elastic) for mass, elastic in forces]
    scale_mass = np.array([(force, mass) for force, (mass, _) in zip(scale, forces, strict=True)]).reshape(-1, 2).T
    scale_mass = np.column_stack([scale_mass, np.full((2, obstacles), np.nan)])
    for index, (obstacle, nodes, markers) in enumerate(
        zip(scene.obstacles, coupled.obstacles, coupled.markers, strict=True)
    ):
        shape, name = obstacle.shape, obstacle.name
        geometry = nodes, shape.kind, shape.radius, name, f"obstacle {index} ('{name}')", nodes[shape.cells]
        bodies.append(Body(*geometry, still=True, markers=markers))
    if [body.kind for body in bodies] == [BALL]:
        raise SceneError(
            f"contact: {bodies[0].label}, one ball alone, meets nothing; add an obstacle, a rod, a shell or a body"
        )
    result = _numbers(scene, law, bodies, *scale_mass)
    if law.rolling and not (result.has_friction and any(body.angles.size for body in bodies)):
        lacking = "no rod is in contact" if result.has_friction else "there is no friction"
        raise SceneError(f"contact: rolling, and {lacking}; leave rolling out")
    return result


def _radii_and_forces(batch, radius: float | None) -> tuple[list[float], list[float]]:
    """Return the contact radius of every rod of a batch [m], and its elastic default force [N].

    Args:
        radius: of all rods, None for the largest of each section.

    Raises:
        SceneError: the section has no positive radius.
    """
    section_radius = batch.section.radius
    if radius is None and (section_radius is None or not np.all(np.asarray(section_radius) > 0.0)):
        raise SceneError(
            f"contact: rod {batch.first} ('{batch.name}') needs a contact radius, and its section has {section_radius}; give "
            f"Stiffness(radius=...), positive, or contact(radius={{{batch.name!r}: ...}})"
        )
    radii = _largest(batch, "radius") if radius is None else np.full(batch.rods, radius)
    bending = np.maximum(_largest(batch, "EI1"), _largest(batch, "EI2"))
    elastic = np.maximum(BENDING * bending / radii**2, LIMP * _largest(batch, "EA"))
    return radii.tolist(), elastic.tolist()


def _largest(batch, name: str) -> np.ndarray:
    """Return the largest value of a section property along every rod of a batch (R,)."""
    return np.broadcast_to(np.atleast_2d(np.asarray(getattr(batch.section, name), float)).max(1), batch.rods)


def _numbers(scene, law: Contact, bodies: list[Body], scale: np.ndarray, mass: np.ndarray) -> ContactParameters:
    """Return the contact parameters of pairs of groups.

    Args:
        scale: force of every body that closes a fraction of the activation distance [N]; mass: heaviest nodal mass [kg].
    """
    names, group = np.unique([body.name for body in bodies], return_inverse=True)
    count, moving = len(names), np.array([not body.still for body in bodies])
    reach = min(_reach(scene, body) for body in bodies if not body.still)
    within = np.full((count, count), reach if law.range is None else law.range)
    rough = np.full((count, count, 3), law.friction)
    force, inertia = (_of_both(values, group, moving) for values in (scale, INERTIA * mass))
    stiffness = np.full((count, count), np.nan if law.stiffness is None else law.stiffness)
    ignored, roots, index = [], {}, {name: i for i, name in enumerate(names.tolist())}
    for between in scene.betweens:
        g, h = (index[name] for name in between.names)
        for table, value in ((rough, between.friction), (stiffness, between.stiffness), (within, between.range)):
            if value is not None:
                table[g, h] = table[h, g] = value
        if between.ignore:
            ignored.append((g, h))
        if between.root_length is not None:
            roots.setdefault(g, (between.root_length, []))[1].append(h)
    _refuse_ranges(scene, within, names)
    explicit = bool(np.isfinite(stiffness).any())
    inertia = np.where(np.isnan(stiffness), inertia, 0.0)
    stiffness = np.where(np.isnan(stiffness), force / within, stiffness)
    density, min_separation_fraction = contact_law(law, stiffness, within, explicit)
    multipliers = _by_direction(rough)
    return ContactParameters(
        law,
        density,
        min_separation_fraction,
        bodies,
        names.tolist(),
        group,
        *multipliers,
        stiffness,
        within,
        inertia,
        ignored,
        roots,
    )


def _reach(scene, body: Body) -> float:
    """Return the default activation distance of a collision body [m]: half of the radius, less for a thick rigid body."""
    if body.rigid < 0:
        return HALF * body.radius
    rigid = scene.bodies[body.rigid]
    points = np.concatenate([shape.points for shape in rigid.shapes]) - rigid.center
    return min(HALF * body.radius, BODY * float(np.linalg.norm(points, axis=1).max() + body.radius))


def _refuse_ranges(scene, within: np.ndarray, names) -> None:
    """Refuse activation distances (groups, groups) beyond the scene size or below the resolution of coordinates."""
    points = [o.points.reshape(-1, 3) for o in (*scene.batches, *scene.shells)]
    points += [s.points + sign * s.radius for body in scene.bodies for s in body.shapes for sign in (-1, 1)]
    points = np.concatenate(points)
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
    """Return geometric means (groups, groups) of the largest values of moving bodies in two groups.

    An obstacle takes the value of the other group. Two obstacles have zero.
    """
    largest = np.full(int(group.max()) + 1, np.nan)
    for g in np.unique(group[moving]):
        largest[g] = values[moving & (group == g)].max()
    largest = np.where(np.isnan(largest)[:, None], largest[None], largest[:, None])
    return np.nan_to_num(np.sqrt(largest * largest.T))


def _by_direction(friction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest nonzero coefficient of forwards, backwards and across (..., 3), and multiples of it.

    So sticking contacts creep by less than the velocity of the law in every direction.
    """
    least = np.where(friction > 0.0, friction, np.inf).min(-1)
    none = np.isinf(least)
    return np.where(none, 0.0, least), np.where(none[..., None], 1.0, friction / least[..., None])
