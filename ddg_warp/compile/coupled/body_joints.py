"""Elements of joints between rigid bodies: ball joints, hinges and welds."""

import numpy as np

from ddg_warp.compile.coupled.system import CoupledSet
from ddg_warp.kernels.terms import JOINTS

NO_STOP = 1e30  # angle that no hinge reaches [rad]
# Default stiffness of joints: the load WEIGHT times the mass of the heavier body [m/s^2] separates them by SEPARATION of the arm.
WEIGHT, SEPARATION = 9.81, 1e-6


def joint_sets(scene, coupled) -> list[CoupledSet]:
    """Return the elements of joints between rigid bodies."""
    bodies, sets = coupled.rigid_bodies, []
    spins = np.append(bodies.spins, bodies.world[-1:])  # -1 for the world
    for number, (joint, blocks) in enumerate(zip(scene.body_joints, bodies.anchors, strict=True)):
        k, arm = _stiffness(scene, joint)
        owner = np.array([[number], [0]])
        if joint.call == "ball":
            values = JOINTS["ball_joint"].bind(measure=1.0, stiffness=[k] * 3)
            lag, slots, term = np.zeros((0, 1)), blocks[:, None], JOINTS["ball_joint"]
        else:
            term, angular = JOINTS["hinge"], k * arm**2
            about = angular if joint.call == "weld" or joint.angle is not None else 0.0
            about = about if joint.spring is None else joint.spring
            lower, upper = joint.stops or (-NO_STOP, NO_STOP)
            values = term.bind(
                measure=1.0,
                stiffness=[k, k, k, angular, angular, about],
                damping=joint.damping,
                lower=lower,
                upper=upper,
                stop=angular if joint.stops else 0.0,
            )
            director = _normal(joint.axis)
            lag = np.concatenate([director, joint.axis, director, joint.axis, [0.0]])[:, None]
            slots = np.array([*blocks, spins[joint.first], spins[joint.second]])[:, None]
        parameters = {name: np.broadcast_to(value, 1) for name, value in values.items()}
        sets.append(CoupledSet(term, slots, lag, np.zeros((0, 1)), parameters, owner))
    return sets


def _stiffness(scene, joint) -> tuple[float, float]:
    """Return the stiffness of the separation [N/m] of a joint, and the arm [m] that makes it one of angles."""
    bodies = [scene.bodies[body] for body in (joint.first, joint.second) if body >= 0]
    gyration = [np.sqrt(body.moments.max() / body.mass) for body in bodies]
    arms = [np.linalg.norm(joint.point - body.center) for body in bodies]
    arm = max(*gyration, *arms)
    weight = WEIGHT * max(body.mass for body in bodies)
    return (weight / (SEPARATION * arm) if joint.stiffness is None else joint.stiffness), arm


def _normal(axis: np.ndarray) -> np.ndarray:
    """Return a unit vector normal to an axis."""
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return across / np.linalg.norm(across)
