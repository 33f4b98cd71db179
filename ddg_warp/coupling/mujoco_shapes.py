"""Shapes of MuJoCo's geoms, and obstacles that follow MuJoCo's bodies."""

from collections.abc import Iterable

import numpy as np

from ddg_warp.coupling.mujoco_model import WORLD, body_of, compiled, mujoco_module, name_of, start_data
from ddg_warp.errors import SceneError
from ddg_warp.geometry import meshes
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.obstacles import Box, Capsule, Mesh, Plane, Sphere

SIDES = 32  # of the prism that stands for a cylinder


def collides(mj_model, geom: int) -> bool:
    """Return True if a geom collides in MuJoCo."""
    return bool(mj_model.geom_contype[geom] or mj_model.geom_conaffinity[geom])


def unsupported(mj_model, geom: int) -> str:
    """Return the reason why a geom has no shape; empty if it has one."""
    mujoco = mujoco_module()
    kind = mujoco.mjtGeom(mj_model.geom_type[geom])
    kinds = mujoco.mjtGeom
    supported = {kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_BOX, kinds.mjGEOM_MESH}
    supported |= {kinds.mjGEOM_ELLIPSOID, kinds.mjGEOM_CYLINDER}
    if kind in supported or (kind == kinds.mjGEOM_PLANE and mj_model.geom_bodyid[geom] == WORLD):
        return ""
    return f"{name_of(mj_model, 'geom', geom)} is a {kind.name.removeprefix('mjGEOM_').lower()}"


def shape_of(mj_model, data, geom: int) -> Plane | Sphere | Capsule | Mesh:
    """Return the shape of a geom at the pose in the data; ellipsoids and cylinders become inscribed meshes."""
    kinds = mujoco_module().mjtGeom
    kind, size = kinds(mj_model.geom_type[geom]), mj_model.geom_size[geom]
    center, rotation = data.geom_xpos[geom].copy(), data.geom_xmat[geom].reshape(3, 3).copy()
    if kind == kinds.mjGEOM_PLANE:
        return Plane(tuple(center), tuple(rotation[:, 2]))
    if kind == kinds.mjGEOM_SPHERE:
        return Sphere(tuple(center), float(size[0]))
    if kind == kinds.mjGEOM_CAPSULE:
        axis = size[1] * rotation[:, 2]
        return Capsule(tuple(center - axis), tuple(center + axis), float(size[0]))
    if kind == kinds.mjGEOM_BOX:
        return Box(center, size, rotation)
    if kind == kinds.mjGEOM_MESH:
        mesh = mj_model.geom_dataid[geom]
        vertices, faces = mj_model.mesh_vertadr[mesh], mj_model.mesh_faceadr[mesh]
        points = mj_model.mesh_vert[vertices : vertices + mj_model.mesh_vertnum[mesh]].astype(float)
        cells = mj_model.mesh_face[faces : faces + mj_model.mesh_facenum[mesh]].astype(int)
    elif kind == kinds.mjGEOM_ELLIPSOID:
        points, cells = meshes.sphere(2)
        points = size * points
    else:
        points, cells = _prism(size[0], size[1])
    return Mesh(center + points @ rotation.T, cells)


def _prism(radius: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of a closed prism about z, inscribed in a cylinder of half length `half`."""
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=1)
    up = np.array([0.0, 0.0, half])
    points = np.concatenate([ring - up, ring + up, [-up, up]])
    low = np.arange(SIDES)
    following = (low + 1) % SIDES
    high, above, below = low + SIDES, following + SIDES, np.full(SIDES, 2 * SIDES)
    sides = ([low, following, above], [low, above, high], [below, following, low], [below + 1, high, above])
    return points, np.concatenate([np.stack(corners, axis=1) for corners in sides])


def add_obstacles(scene, mj_model, bodies: Iterable[str] | str | None = None, *, data=None) -> dict[Grip, str]:
    """Add the geoms of MuJoCo's bodies as obstacles with grips; return entries of `MuJoCo(attach=...)`.

    Geoms that do not collide in MuJoCo are left out. Geoms of the world stay at rest.

    Args:
        scene: of rods and shells, with `contact`.
        mj_model: `MjModel`, or path or text of an MJCF or URDF file.
        bodies: names of bodies, or of sites and geoms that they carry; "world" for fixed geoms. All by default.
        data: `MjData` of the configuration at rest; the initial one by default.

    Returns:
        For each moving body its `Grip` and its name.

    Raises:
        SceneError: a name is unknown, or a shape is not supported (height fields, planes that move, signed distances).
        MissingPackageError: the package mujoco is missing.
    """
    call = "add_obstacles"
    mj_model = compiled(call, mj_model)
    data = start_data(call, mj_model, data)
    names = [bodies] if isinstance(bodies, str) else bodies
    chosen = range(mj_model.nbody) if names is None else [body_of(call, mj_model, name) for name in names]
    geoms = [g for g in range(mj_model.ngeom) if mj_model.geom_bodyid[g] in chosen and collides(mj_model, g)]
    refused = [reason for geom in geoms if (reason := unsupported(mj_model, geom))]
    if refused:
        raise SceneError(f"{call}: no shapes for {'; '.join(refused)}; leave them out by contype=0 and conaffinity=0")
    grips: dict[int, Grip] = {}
    for geom in geoms:
        body = int(mj_model.geom_bodyid[geom])
        motion = None
        if mj_model.body_weldid[body] != WORLD or mj_model.body_mocapid[body] >= 0:
            motion = grips.setdefault(body, Grip(pivot=tuple(data.xpos[body])))
        scene.add_obstacle(shape_of(mj_model, data, geom), motion=motion, name=name_of(mj_model, "geom", geom))
    return {grip: name_of(mj_model, "body", body) for body, grip in grips.items()}
