"""Arguments of the coupling with MuJoCo; see `effects`."""

from functools import cache

import mujoco
import numpy as np
from effects import CALLS, DEVICE, RUBBER, Call, Change, line

import ddg_warp as ddg

XML = """<mujoco><option timestep="0.01"/><worldbody><body name="arm"><joint name="root" axis="0 1 0"/><geom size="0.1" mass="0.1"/>
    <body name="hand" pos="0.5 0 0"><joint name="wrist" axis="0 1 0"/><geom name="ball" size="0.1" mass="0.1"/></body></body>
    </worldbody><actuator><motor name="motor" joint="wrist"/></actuator></mujoco>"""


@cache
def model(length: float = 1.0):
    """Return a model of two rods, each with a grip."""
    scene = ddg.Scene()
    for name, y in (("left", 0.0), ("right", 0.5)):
        rod = scene.add_rod(length * line() + (0.0, y, 0.0), section=ddg.Circle(0.02), material=RUBBER)
        scene.clamp(rod, motion=ddg.Grip(), name=name)
    return scene.build(DEVICE, "float64")


def moved() -> mujoco.MjData:
    """Return data with a rotating hand."""
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(XML))
    data.qpos[:], data.qvel[1] = 0.3, 1.0
    return data


def steered(data) -> None:
    """Set the control of the wrist."""
    data.ctrl[:] = 1.0


def observe_coupling(model=None, mj_model=XML, attach=None, dt=0.01, controls=None, **options) -> list:
    """Observe two steps."""
    made = BUILT if model is None else model
    sim = ddg.coupling.MuJoCo(made, mj_model, {"left": "hand"} if attach is None else attach, **options)
    for _ in range(2):
        sim.step(dt, controls)
    return [sim.data.qpos.copy(), sim.state.points(), sim.state.time, sim.integrator.statistics()["newton_iterations"]]


BUILT = model()
POSES = np.zeros((2, 6)) + 0.01
CALLS["MuJoCo"] = Call(ddg.coupling.MuJoCo, observe_coupling, {}, {
    "model": model(1.1), "mj_model": XML.replace("0.1", "0.2"), "attach": {"right": "arm"}, "data": moved(),
    "state": BUILT.state(velocities=np.ones((BUILT.points_count, 3))), "control": steered, "iterations": 5})  # fmt: skip
CALLS["MuJoCo.step"] = Call(ddg.coupling.MuJoCo.step, observe_coupling, {}, {
    "dt": 0.02, "controls": ddg.Controls(poses=POSES)})  # fmt: skip


def observe_run(**named) -> list:
    """Observe a short run."""
    sim = ddg.coupling.MuJoCo(BUILT, XML, {"left": "hand"})
    return [[state.time, state.points()] for state in sim.run(**named)]


CALLS["MuJoCo.run"] = Call(ddg.coupling.MuJoCo.run, observe_run, {"duration": 0.02, "dt": 0.01}, {
    "duration": 0.03, "dt": 0.02, "controls": ddg.Controls(poses=POSES)})  # fmt: skip


def observe_bodies(**named) -> list:
    """Observe the rigid bodies and joints of a scene."""
    scene = ddg.Scene()
    added = ddg.coupling.add_bodies(scene, **named)
    bodies = [[body.mass, body.center, body.velocity, body.angular_velocity] for body in scene.bodies]
    return [list(added.bodies), bodies, [joint.torque and joint.torque(0.0) for joint in scene.body_joints]]


CALLS["add_bodies"] = Call(ddg.coupling.add_bodies, observe_bodies, {"mj_model": XML}, {
    "mj_model": XML.replace("0.1", "0.2"), "data": moved(), "ctrl": {"motor": 2.0}}, ("scene",))  # fmt: skip


def observe_obstacles(**named) -> list:
    """Observe the obstacles of a scene."""
    scene = ddg.Scene()
    attach = ddg.coupling.add_obstacles(scene, **named)
    shapes = [[obstacle.name, obstacle.shape.points, obstacle.shape.radius] for obstacle in scene.obstacles]
    return [list(attach.values()), shapes]


CALLS["add_obstacles"] = Call(ddg.coupling.add_obstacles, observe_obstacles, {"mj_model": XML}, {
    "mj_model": XML.replace("0.1", "0.2"), "bodies": Change(["hand"]), "data": moved()}, ("scene",))  # fmt: skip
