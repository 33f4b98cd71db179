"""Rigid bodies of the coupled system on the host: dof blocks, carried nodes, masses and moments of inertia.

A body has a node at its centre of mass and a rotation block. Nodes that it carries have no dofs, x = c + R X. Their masses belong to
the body, so that a body with its carried masses moves as one.

A body that a joint pins to the world rotates about the point of the joint, with its moments of inertia there. Its centre of mass is
then a carried node, on which the weight acts.

Alternative: a stiff joint, as between bodies. Its point has an error, and by the midpoint rule the centre leaves its circle, which
lengthens periods (pendulum of 1 rad at 190 steps a period: 1.7e-4 instead of 1.0e-4).
"""

from dataclasses import dataclass

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.geometry.mass_properties import point_inertia, principal_axes


@dataclass
class RigidBodyArrays:
    """Rigid bodies (B) and carried nodes (C), in the order of bodies.

    Attributes:
        origins, spins: dof blocks of the points about which bodies rotate, and of rotations (B,).
        centers: dof blocks of centres of mass (B,), carried nodes of pinned bodies, else `origins`.
        pinned: mask of pinned bodies (B,).
        carried: dof blocks of carried nodes (C,).
        owner: body of each carried node (C,); starts: first carried node of each body (B + 1,).
        arms: X of carried nodes in principal axes (C, 3) [m].
        moments: principal moments of inertia (B, 3) [kg m^2]; axes: principal axes at rest, columns (B, 3, 3).
        velocity, angular_velocity: initial velocity of the centre and angular velocity in space (B, 3).
        anchors: points of joints between bodies, as the first and as the second body carries them (J, 2).
        surfaces: dof blocks of the points of each shape of each body in contact.
        world: fixed dof blocks of the joints with the world: points, then a rotation; empty without joints.
    """

    origins: np.ndarray
    spins: np.ndarray
    centers: np.ndarray
    pinned: np.ndarray
    carried: np.ndarray
    owner: np.ndarray
    starts: np.ndarray
    arms: np.ndarray
    moments: np.ndarray
    axes: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    anchors: np.ndarray
    surfaces: list[list[np.ndarray]]
    world: np.ndarray

    def __len__(self) -> int:
        return len(self.origins)

    def lengths(self, mass: np.ndarray) -> np.ndarray:
        """Return the length of each body that relates moments to forces (B,) [m], for masses of dof blocks.

        It is the radius of gyration, or the longest arm.
        """
        result = np.sqrt(self.moments.max(1) / mass[self.origins, 0])
        np.maximum.at(result, self.owner, np.linalg.norm(self.arms, axis=1))
        return result


def carried_nodes(
    scene, coupled, centers: np.ndarray, anchors: np.ndarray, surfaces: list[list[np.ndarray]], first_spin: int
) -> RigidBodyArrays:
    """Return the rigid bodies of a scene, with dof blocks of centres (B,), anchors (J, 2) and the shapes of each body.

    Rotations have blocks from `first_spin` on.

    Raises:
        SceneError: two bodies carry one node.
    """
    rods = {rod.rod: rod for rod in coupled.rods}
    owners, labels = {}, {}
    for link in scene.body_attachments:
        nodes = (rods[link.index] if link.kind == "rod" else coupled.shells[link.index]).nodes[link.nodes]
        for number, block in zip(link.nodes.tolist(), nodes.tolist(), strict=True):
            label = f"{'node' if link.kind == 'rod' else 'vertex'} {number} of {link.kind} {link.index}"
            if owners.setdefault(block, link.body) != link.body:
                raise SceneError(
                    f"attach: body {link.body} cannot carry {label}, which body {owners[block]} carries "
                    f"as {labels[block]}; join the bodies instead"
                )
            labels.setdefault(block, label)
    origins = centers.copy()
    for joint, (block, _) in zip(reversed(scene.body_joints), anchors[::-1].tolist(), strict=True):
        if joint.first < 0:
            origins[joint.second] = block  # of the first joint with the world
    pinned = origins != centers
    world = []
    for joint, blocks in zip(scene.body_joints, anchors.tolist(), strict=True):
        for body, block in zip((joint.first, joint.second), blocks, strict=True):
            if body < 0:
                world.append(block)
            else:
                owners[block] = body
    for body, shapes in enumerate(surfaces):
        owners |= dict.fromkeys(np.concatenate([np.zeros(0, int), *shapes]).tolist(), body)
        if pinned[body]:
            owners[centers[body]] = body
    world += [first_spin + len(scene.bodies)] * bool(scene.body_joints)
    carried, owner = np.array(list(owners), int), np.array(list(owners.values()), int)
    order = np.argsort(owner, kind="stable")
    carried, owner = carried[order], owner[order]
    bodies = scene.bodies
    vectors = {name: np.array([getattr(body, name) for body in bodies]) for name in ("velocity", "angular_velocity")}
    result = RigidBodyArrays(
        origins=origins,
        centers=centers,
        pinned=pinned,
        spins=first_spin + np.arange(len(bodies)),
        carried=carried,
        owner=owner,
        starts=np.searchsorted(owner, np.arange(len(bodies) + 1)),
        arms=np.zeros((len(carried), 3)),
        moments=np.array([body.moments for body in bodies]),
        axes=np.array([body.axes for body in bodies]),
        **vectors,
        anchors=anchors,
        surfaces=surfaces,
        world=np.array(world, int),
    )
    welded = [joint.second for joint in scene.body_joints if joint.call == "weld" and joint.first < 0]
    coupled.fixed[np.append(result.world, result.spins[welded])] = True
    return result


def take_masses(scene, coupled) -> None:
    """Add the masses of carried nodes to the bodies, and fix the carried nodes, as these have no dofs.

    Raises:
        SceneError: a support fixes a carried node.
    """
    bodies = coupled.rigid_bodies
    for block in bodies.carried[coupled.fixed[bodies.carried].any(1)][:1]:
        body = bodies.owner[bodies.carried == block][0]
        raise SceneError(
            f"attach: a support fixes {coupled.name(block)}, which body {body} carries; support the rod elsewhere, or leave one out"
        )
    for index, body in enumerate(scene.bodies):
        nodes = bodies.carried[bodies.owner == index]
        mass, points = coupled.mass[nodes, 0], coupled.rest[nodes]
        total = body.mass + mass.sum()
        center = (body.mass * body.center + mass @ points) / total
        origin = coupled.rest[bodies.origins[index]] if bodies.pinned[index] else center
        tensor = body.axes * body.moments @ body.axes.T
        for m, x in ((body.mass, body.center), *zip(mass, points, strict=True)):
            tensor = tensor + point_inertia(m, x - origin)
        if bodies.pinned[index] or mass.any():
            bodies.moments[index], bodies.axes[index] = principal_axes(tensor)
        bodies.velocity[index] += np.cross(body.angular_velocity, center - body.center)
        coupled.mass[nodes] = 0.0
        coupled.rest[bodies.centers[index]] = center
        coupled.mass[bodies.origins[index]] = total
        if bodies.pinned[index]:
            bodies.velocity[index] = 0.0
            coupled.add_load(bodies.centers[[index]], total * np.array(scene.gravity, float))
        points = coupled.rest[nodes]
        bodies.arms[bodies.owner == index] = (points - origin) @ bodies.axes[index]
    coupled.fixed[bodies.carried] = True
