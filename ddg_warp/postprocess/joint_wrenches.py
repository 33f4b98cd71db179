"""Forces and moments that joints of rigid bodies transmit, of equilibria and of steps."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, overload

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.kernels.terms import BODY_JOINTS
from ddg_warp.model.rigid_bodies import BodyState, body_states
from ddg_warp.scene.handle import BODY_JOINT, named
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.equilibrium.tangent_part import TangentBlock
from ddg_warp.solve.stepping.wrenches import Reaction
from ddg_warp.typing import Floats

if TYPE_CHECKING:
    from ddg_warp.model.model import Model
    from ddg_warp.model.state import State
    from ddg_warp.scene.scene import Scene

SECOND_POINT, SECOND_ROTATION = 1, 3  # blocks of a joint's elements: point and rotation of the second body


class JointWrenches(list[Reaction]):
    """Wrenches of all joints, by position, by handle or by name, in the order in which joints were added."""

    def __init__(self, wrenches: Iterable[Reaction], scene: "Scene"):
        super().__init__(wrenches)
        self._names = [joint.name for joint in scene.body_joints]

    @overload
    def __getitem__(self, item: int | str) -> Reaction: ...

    @overload
    def __getitem__(self, item: slice) -> list[Reaction]: ...

    def __getitem__(self, item: int | str | slice) -> Reaction | list[Reaction]:
        """Return the wrench of a position, handle or name; of a slice a list.

        Raises:
            SceneError: no joint has the name, several have it, or the handle is of something else.
        """
        return super().__getitem__(item if isinstance(item, slice) else int(named(BODY_JOINT, item, self._names)))


def of_equilibrium(model: "Model", state: "State", factor: float) -> JointWrenches:
    """Return the wrenches of joints in an equilibrium at a load parameter."""
    tangent = Tangent(model).parts[-1]
    resultant = tangent.loads(factor, tangent.dofs(state)) - tangent.gradient(state)
    blocks = resultant.reshape(model.worlds, -1, 3)
    rigid = model.coupled.host.rigid_bodies
    weight = factor * pinned_masses(model) * np.array(model.scene.gravity)
    return joint_wrenches(model, state, blocks[:, rigid.origins] - weight, blocks[:, rigid.spins], tangent)


def pinned_masses(model: "Model") -> Floats:
    """Return the masses of bodies that rotate about a pin, zero for others (bodies, 1) [kg]."""
    host = model.coupled.host
    return np.where(host.rigid_bodies.pinned, host.mass[host.rigid_bodies.origins, 0], 0.0)[:, None]


def joint_wrenches(
    model: "Model", state: "State", force: Floats, moment: Floats, tangent: TangentBlock | None = None
) -> JointWrenches:
    """Return the force on the second body of every joint, and the moment about the point of the joint.

    Args:
        force, moment: sum of all forces on every body except its pin's, inertia included (worlds, bodies, 3). The pin of a body
            that is joined to the world balances it.
        tangent: of the coupled system, if there is one already.
    """
    scene, worlds = model.scene, model.worlds
    rigid, count = model.coupled.host.rigid_bodies, len(scene.body_joints)
    tangent = tangent or Tangent(model).parts[-1]
    forces, moments = np.zeros((worlds, count, 3)), np.zeros((worlds, count, 3))
    for index, part in enumerate(model.coupled.sets):
        if part.term.name in BODY_JOINTS:
            joints = part.host.owner[0]
            gradient = tangent.forces(state, index).reshape(-1, worlds, part.elements, 3)
            forces[:, joints] = -gradient[SECOND_POINT]
            if part.term.name == "hinge":
                moments[:, joints] = -gradient[SECOND_ROTATION]
    q = state.coupled.q.numpy().astype(float).reshape(worlds, -1, 3)
    bodies = body_states(state) if any(joint.damping for joint in scene.body_joints) else None
    pinned: set[int] = set()
    for number, joint in enumerate(scene.body_joints):
        if joint.damping:
            moments[:, number] -= _damping(bodies, joint)
        if joint.first < 0 and joint.second not in pinned:
            pinned.add(joint.second)
            forces[:, number] -= force[:, joint.second]
            if joint.call == "weld":
                moments[:, number] -= moment[:, joint.second]
    points = q[:, rigid.anchors[:, 1]]
    values = zip(*(array.swapaxes(0, 1) for array in (forces, moments, points)), strict=True)
    return JointWrenches((Reaction(*(v[0] if worlds == 1 else v for v in each)) for each in values), scene)


def _damping(bodies: BodyState, joint) -> Floats:
    """Return the damping torque of a hinge, opposite to the hinge's rate, with the sign of the first body (worlds, 3) [N m]."""
    first, second = (0.0 if body < 0 else bodies.angular_velocity[:, body] for body in (joint.first, joint.second))
    axis = bodies.rotation[:, joint.second] @ joint.axis
    return joint.damping * np.sum((second - first) * axis, axis=1, keepdims=True) * axis


def require_joints(call: str, model: "Model") -> None:
    """Refuse a model without joints of rigid bodies."""
    if not model.scene.body_joints:
        raise SceneError(f"{call}: the scene has no joint of rigid bodies; add one by scene.hinge, ball or weld")
