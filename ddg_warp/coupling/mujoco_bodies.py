"""Rigid bodies, joints and motors of MJCF and URDF files in a scene, by MuJoCo's compiler."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.coupling.mujoco_model import WORLD, compiled, mujoco_module, name_of, start_data
from ddg_warp.coupling.mujoco_shapes import collides, shape_of, unsupported
from ddg_warp.errors import SceneError
from ddg_warp.geometry.mass_properties import point_inertia
from ddg_warp.scene.handle import Handle


@dataclass(frozen=True)
class MuJoCoBodies:
    """Handles of bodies and joints that `add_bodies` added, by MuJoCo's names.

    Attributes:
        bodies: rigid bodies; bodies that MuJoCo welds together have one handle.
        joints: hinges and balls, and constraints `connect` and `weld`.
    """

    bodies: dict[str, Handle]
    joints: dict[str, Handle]


def add_bodies(scene, mj_model, *, data=None, ctrl: Mapping[str, float | Callable] | None = None) -> MuJoCoBodies:
    """Add the moving bodies of a MuJoCo model to a scene, with joints and motors; return their handles.

    Masses, inertias and initial velocities are MuJoCo's. Bodies without a joint are merged with their parent. Hinges keep springs,
    damping and limits, the latter as stiff stops. Position and velocity servos become springs and damping of their hinges. Constraints
    `connect` and `weld` become balls and welds. Geoms that collide become shapes; ellipsoids and cylinders become inscribed meshes, and
    meshes are not made convex. Geoms of the world are left out, see `add_obstacles`; gravity is that of the scene.

    Args:
        scene: to which the bodies are added.
        mj_model: `MjModel`, or path or text of an MJCF or URDF file.
        data: `MjData` of the configuration at rest, with velocities; the initial one by default.
        ctrl: control of motors and servos by name, numbers or functions of time [s]; zero by default. The torque is the control,
            clipped to its range, times gain and gear, plus a bias that is linear in the position and rate of the hinge.

    Raises:
        SceneError: the model has features that rigid bodies lack; the message lists all of them. Examples are slides, several joints of
            a body, springs of balls, armature or friction of joints, actuators other than motors and servos of hinges, and tendons.
        MissingPackageError: the package mujoco is missing.
    """
    call = "add_bodies"
    mj_model = compiled(call, mj_model)
    data = start_data(call, mj_model, data)
    ctrl = {} if ctrl is None else dict(ctrl)
    actuators = [name_of(mj_model, "actuator", i) for i in range(mj_model.nu)]
    for name in ctrl:
        if name not in actuators:
            raise SceneError(f"{call}: ctrl: no actuator is named {name!r}{argument_checks.meant(name, actuators)}")
    refused = [*_refused_joints(mj_model), *_refused_actuators(mj_model), *_refused_others(mj_model, data)]
    if refused:
        raise SceneError(f"{call}: rigid bodies have no counterpart of: {'; '.join(refused)}")
    handles = {WORLD: None}
    for root in range(1, mj_model.nbody):
        if mj_model.body_weldid[root] == root:
            handles[root] = _add_body(scene, mj_model, data, root)
    handles = {body: handles[mj_model.body_weldid[body]] for body in range(mj_model.nbody)}
    joints = {}
    for joint in range(mj_model.njnt):
        body = mj_model.jnt_bodyid[joint]
        added = _add_joint(scene, mj_model, data, joint, handles[mj_model.body_parentid[body]], handles[body], ctrl)
        if added is not None:
            joints[added.name] = added
    for equality in range(mj_model.neq):
        added = _add_equality(scene, mj_model, data, equality, handles)
        joints[added.name] = added
    bodies = {name_of(mj_model, "body", body): handle for body, handle in handles.items() if handle is not None}
    return MuJoCoBodies(bodies, joints)


def _add_body(scene, mj_model, data, root: int) -> Handle:
    """Add a rigid body: a body of MuJoCo, and all that are welded to it."""
    mujoco = mujoco_module()
    bodies = np.flatnonzero(mj_model.body_weldid == root)
    masses, centers = mj_model.body_mass[bodies], data.xipos[bodies]
    mass = masses.sum()
    center, inertia = masses @ centers / mass, np.zeros((3, 3))
    for body, part_mass, arm in zip(bodies, masses, centers - center, strict=True):
        axes = data.ximat[body].reshape(3, 3)
        inertia += axes * mj_model.body_inertia[body] @ axes.T + point_inertia(part_mass, arm)
    rates = np.zeros(6)
    mujoco.mj_objectVelocity(mj_model, data, mujoco.mjtObj.mjOBJ_BODY, root, rates, 0)
    spin = rates[:3]
    geoms = [g for g in range(mj_model.ngeom) if mj_model.geom_bodyid[g] in bodies and collides(mj_model, g)]
    return scene.add_body(
        [shape_of(mj_model, data, geom) for geom in geoms],
        mass=mass,
        inertia=inertia,
        center=center,
        velocity=rates[3:] + np.cross(spin, center - data.xipos[root]),
        angular_velocity=spin,
        name=name_of(mj_model, "body", root),
    )


def _add_joint(scene, mj_model, data, joint: int, parent: Handle | None, child: Handle, ctrl: dict) -> Handle | None:
    """Add a hinge or ball; return None for a free joint."""
    mujoco = mujoco_module()
    kind, name = mujoco.mjtJoint(mj_model.jnt_type[joint]), name_of(mj_model, "joint", joint)
    pair = (child,) if parent is None else (parent, child)
    point = data.xanchor[joint].copy()
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return None
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        return scene.ball(*pair, point=point, name=name)
    stops, start = None, data.qpos[mj_model.jnt_qposadr[joint]]
    if mj_model.jnt_limited[joint]:
        stops = tuple(mj_model.jnt_range[joint] - start)
    actuators = np.flatnonzero(mj_model.actuator_trnid[:, 0] == joint)
    _, by_angle, by_rate = _bias(mj_model, actuators)
    stiffness = mj_model.jnt_stiffness[joint]
    spring = float(stiffness - by_angle.sum())
    relaxed = float(stiffness * mj_model.qpos_spring[mj_model.jnt_qposadr[joint]] / spring - start) if spring else None
    return scene.hinge(
        *pair,
        point=point,
        axis=data.xaxis[joint].copy(),
        angle=relaxed,
        torque=_torque(mj_model, actuators, ctrl),
        spring=spring or None,
        damping=float(mj_model.dof_damping[mj_model.jnt_dofadr[joint]] - by_rate.sum()),
        stops=stops,
        name=name,
    )


@dataclass(frozen=True)
class _Torque:
    """Torque of motors and servos at zero angle and rate [N m], a function of time.

    Attributes:
        motors: control (number or function of time), least and largest control, and factor, of each actuator.
        constant: [N m].
    """

    motors: tuple
    constant: float

    def __call__(self, t: float) -> float:
        controls = ((ctrl(t) if callable(ctrl) else ctrl, *row) for ctrl, *row in self.motors)
        return self.constant + float(
            sum(factor * min(max(value, least), most) for value, least, most, factor in controls)
        )


def _torque(mj_model, actuators, ctrl: dict) -> _Torque | None:
    """Return the torque of actuators of one joint; None without any."""
    motors = []
    for actuator in actuators:
        value = ctrl.get(name_of(mj_model, "actuator", actuator), 0.0)
        limited = mj_model.actuator_ctrllimited[actuator]
        limits = mj_model.actuator_ctrlrange[actuator] if limited else (-np.inf, np.inf)
        factor = mj_model.actuator_gear[actuator, 0] * mj_model.actuator_gainprm[actuator, 0]
        motors.append((value, *map(float, limits), float(factor)))
    return _Torque(tuple(motors), float(_bias(mj_model, actuators)[0].sum())) if motors else None


def _bias(mj_model, actuators) -> np.ndarray:
    """Return the constant torque of actuators, and its derivatives by the joint's angle and rate (3, actuators) [N m, s].

    The force is bias_0 + bias_1 l + bias_2 dl/dt with l = gear angle, and the torque gear times that.
    """
    gear = mj_model.actuator_gear[actuators, 0]
    affine = mj_model.actuator_biastype[actuators] == mujoco_module().mjtBias.mjBIAS_AFFINE
    return np.where(affine, mj_model.actuator_biasprm[actuators, :3].T, 0.0) * [gear, gear**2, gear**2]


def _add_equality(scene, mj_model, data, equality: int, handles: dict) -> Handle:
    """Add a constraint `connect` as a ball, or `weld` as a weld."""
    mujoco = mujoco_module()
    bodies = [mj_model.eq_obj1id[equality], mj_model.eq_obj2id[equality]]
    pair = [handle for body in bodies if (handle := handles[body]) is not None]
    name = name_of(mj_model, "equality", equality)
    connect = mj_model.eq_type[equality] == mujoco.mjtEq.mjEQ_CONNECT
    body = bodies[0] if connect else bodies[1]
    point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ mj_model.eq_data[equality, :3]
    return (scene.ball if connect else scene.weld)(*pair, point=point, name=name)


def _refused_joints(mj_model):
    """Yield the joints of MuJoCo without a counterpart, with the reason."""
    kinds = mujoco_module().mjtJoint
    for body in range(1, mj_model.nbody):
        if mj_model.body_jntnum[body] > 1:
            yield f"{name_of(mj_model, 'body', body)} has {mj_model.body_jntnum[body]} joints, one at most"
    for joint in range(mj_model.njnt):
        name, kind = name_of(mj_model, "joint", joint), kinds(mj_model.jnt_type[joint])
        first = mj_model.jnt_dofadr[joint]
        dofs = slice(first, first + {kinds.mjJNT_FREE: 6, kinds.mjJNT_BALL: 3}.get(kind, 1))
        reasons = {
            "is a slide": kind == kinds.mjJNT_SLIDE,
            "has a stiffness and is no hinge": kind != kinds.mjJNT_HINGE and mj_model.jnt_stiffness[joint],
            "has a nonlinear stiffness": np.any(getattr(mj_model, "jnt_stiffnesspoly", [[0]] * mj_model.njnt)[joint]),
            "has nonlinear damping": np.any(getattr(mj_model, "dof_dampingpoly", [[0]] * mj_model.nv)[dofs]),
            "has armature": mj_model.dof_armature[dofs].any(),
            "has friction": mj_model.dof_frictionloss[dofs].any(),
            "has damping and is no hinge": kind != kinds.mjJNT_HINGE and mj_model.dof_damping[dofs].any(),
            "has limits and is no hinge": kind != kinds.mjJNT_HINGE and mj_model.jnt_limited[joint],
        }
        yield from (f"{name} {reason}" for reason, applies in reasons.items() if applies)


def _refused_actuators(mj_model):
    """Yield the actuators that are neither motors nor servos of hinges."""
    mujoco = mujoco_module()
    for actuator in range(mj_model.nu):
        joint = mj_model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        hinge = joint and mj_model.jnt_type[mj_model.actuator_trnid[actuator, 0]] == mujoco.mjtJoint.mjJNT_HINGE
        plain = (
            mj_model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
            and mujoco.mjtBias(mj_model.actuator_biastype[actuator])
            in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
            and (_bias(mj_model, [actuator])[1:] <= 0.0).all()
            and mj_model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
        )
        if not (hinge and plain) or mj_model.actuator_forcelimited[actuator]:
            yield f"actuator {name_of(mj_model, 'actuator', actuator)} is no motor or servo of a hinge"


def _refused_others(mj_model, data):
    """Yield geoms, bodies and constraints of a MuJoCo model without a counterpart."""
    mujoco = mujoco_module()
    for geom in range(mj_model.ngeom):
        if mj_model.body_weldid[mj_model.geom_bodyid[geom]] != WORLD and collides(mj_model, geom):
            reason = unsupported(mj_model, geom)
            if reason:
                yield reason
    for body in range(1, mj_model.nbody):
        if mj_model.body_gravcomp[body]:
            yield f"{name_of(mj_model, 'body', body)} has gravity compensation"
        if mj_model.body_mocapid[body] >= 0:
            yield f"{name_of(mj_model, 'body', body)} is a mocap body"
    bodily = mujoco.mjtObj.mjOBJ_BODY
    for equality in range(mj_model.neq):
        name = name_of(mj_model, "equality", equality)
        supported = mujoco.mjtEq(mj_model.eq_type[equality]) in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
        if not supported or mj_model.eq_objtype[equality] != bodily or not mj_model.eq_active0[equality]:
            yield f"{name} is no active connect or weld of bodies"
        rows = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) & (data.efc_id == equality)
        if supported and np.abs(data.efc_pos[rows]).max(initial=0.0) > 1e-6:
            yield f"{name} does not hold at the start"
    counts = {"tendons": mj_model.ntendon, "flexes": mj_model.nflex, "plugins": mj_model.nplugin}
    counts["fluid forces"] = mj_model.opt.density or mj_model.opt.viscosity
    yield from (name for name, count in counts.items() if count)
