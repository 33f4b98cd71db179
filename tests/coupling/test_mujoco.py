"""Co-simulation with MuJoCo, and import of MJCF and URDF files."""

import sys

import numpy as np
import pytest

import ddg_warp as ddg

GRAVITY = 9.81  # m/s^2
LENGTH, EDGES, RADIUS, YOUNG, DENSITY = 0.5, 20, 5e-3, 2e7, 1000.0  # of the link and of the rod that it holds
ROD = DENSITY * np.pi * RADIUS**2 * LENGTH  # mass of the rod [kg]
HEAD = f'<mujoco><option timestep="%g" gravity="0 0 -{GRAVITY}" integrator="implicitfast"/><worldbody>'


@pytest.fixture
def mujoco():
    """Return MuJoCo, or skip."""
    return pytest.importorskip("mujoco")


def held_rod(points, **options):
    """Return a scene with a rod of the tests."""
    scene = ddg.Scene(gravity=(0, 0, -GRAVITY), **options)
    rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=ddg.Material(young=YOUNG, density=DENSITY))
    return scene, rod


def link(ratio: float) -> tuple[float, np.ndarray]:
    """Return mass and moments of inertia of a link of `ratio` times the mass of the rod."""
    return ratio * ROD, ratio * ROD * LENGTH**2 / 12.0 * np.array([1e-2, 1.0, 1.0])


def monolithic(ratio: float, damping: float, dt: float, duration: float, scheme: str) -> np.ndarray:
    """Return the end of a hinged link that carries a rod (3,), with both in one model."""
    scene, rod = held_rod(np.linspace((LENGTH, 0, 0), (2 * LENGTH, 0, 0), EDGES + 1))
    mass, inertia = link(ratio)
    body = scene.add_body(mass=mass, inertia=inertia, center=(LENGTH / 2, 0, 0))
    scene.attach(rod, [0], body)
    scene.hinge(body, point=(0, 0, 0), axis=(0, 1, 0), damping=damping)
    model = scene.build(device="cpu")
    integrator, state = ddg.Integrator(model, scheme=scheme), model.state()
    for _ in range(round(duration / dt)):
        state = integrator.step(state, dt)
    return state.points()[0]


def staggered(ratio: float, damping: float, dt: float, duration: float, iterations: int) -> np.ndarray:
    """Return the end of the link (3,), with the link in MuJoCo."""
    scene, rod = held_rod(np.linspace((LENGTH, 0, 0), (2 * LENGTH, 0, 0), EDGES + 1))
    scene.clamp_end(rod, motion=ddg.Grip(), name="hand")
    mass, (about, across, _) = link(ratio)
    xml = f"""{HEAD % dt}<body name="link"><joint axis="0 1 0" damping="{damping}"/>
        <inertial pos="{LENGTH / 2} 0 0" mass="{mass}" diaginertia="{about} {across} {across}"/></body></worldbody></mujoco>"""
    sim = ddg.coupling.MuJoCo(scene.build(device="cpu"), xml, attach={"hand": "link"}, iterations=iterations)
    for _ in sim.run(duration, dt):
        pass
    return sim.state.points()[0]


@pytest.mark.parametrize("damping", [0.0, 0.02])
@pytest.mark.parametrize(("ratio", "iterations"), [(0.2, 8), (0.5, 1), (2.2, 1)])
def test_link_converges_to_the_monolithic_solution(mujoco, ratio, iterations, damping):
    """The error of the end of the link halves with the step, to 15 %, and is below 4 mm at 2 ms after 0.2 s."""
    reference = monolithic(ratio, damping, 5e-4, 0.2, "implicit_midpoint")
    errors = [np.linalg.norm(staggered(ratio, damping, dt, 0.2, iterations) - reference) for dt in (4e-3, 2e-3)]
    assert errors[1] < 4e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)


def test_weight_of_a_cable_arrives_at_the_joint(mujoco):
    """A hinge with a spring rotates by arm times weight of a hanging cable over stiffness."""
    arm, stiffness = 0.3, 50.0
    scene, rod = held_rod(np.linspace((arm, 0, 0), (arm, 0, -LENGTH), EDGES + 1), mass_damping=5.0)
    scene.fix(rod, [0], motion=ddg.Grip(pivot=(arm, 0, 0)), name="hand")
    xml = f"""{HEAD % 1e-3}<body name="arm"><joint axis="0 1 0" stiffness="{stiffness}" damping="2"/>
        <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/><site name="tip" pos="{arm} 0 0"/></body>
        </worldbody></mujoco>"""
    sim = ddg.coupling.MuJoCo(scene.build(device="cpu"), xml, attach={"hand": "tip"})
    for _ in sim.run(3.0, 5e-3):
        pass
    assert sim.data.time == pytest.approx(3.0)
    assert sim.reactions["hand"].force == pytest.approx([0, 0, ROD * GRAVITY], abs=1e-3)
    angle = sim.data.qpos[0]
    assert angle == pytest.approx(ROD * GRAVITY * arm * np.cos(angle) / stiffness, rel=1e-3)
    assert sim.state.points()[0] == pytest.approx(sim.data.site("tip").xpos, abs=1e-12)
    again = ddg.coupling.MuJoCo(sim.model, xml, {"hand": "tip"}, data=sim.data, state=sim.state)
    again.step(5e-3)
    assert again.state.points() == pytest.approx(sim.step(5e-3).points(), abs=1e-9)
    start = sim.reset()
    assert (start.time, sim.data.time, sim.data.qpos[0]) == (0.0, 0.0, 0.0)


def test_obstacles_follow_geoms(mujoco):
    """A ball on a vertical slide comes to rest on a rod, and the contact force is its weight."""
    scene, rod = held_rod(np.linspace((-0.1, 0, 0), (0.1, 0, 0), 21), mass_damping=10.0)
    scene.clamp(rod, edges=[0, -1])
    scene.contact()
    xml = f"""{HEAD % 1e-3}<body name="ball" pos="0 0 0.026"><joint type="slide" axis="0 0 1" damping="1"/>
        <geom name="shell" type="sphere" size="0.02" mass="0.02"/></body></worldbody></mujoco>"""
    attach = ddg.coupling.add_obstacles(scene, xml)
    assert list(attach.values()) == ["ball"]
    sim = ddg.coupling.MuJoCo(scene.build(device="cpu"), xml, attach)
    for _ in sim.run(1.0, 2e-3):
        pass
    assert sim.reactions["shell"].force[2] == pytest.approx(-0.02 * GRAVITY, rel=1e-2)
    assert sim.data.body("ball").xpos[2] == pytest.approx(0.026, abs=2e-3)


def test_pose_of_a_grip_counts_turns():
    """Rotation vectors of a continuous rotation are continuous, and its pose keeps the pivot at the position."""
    grip, pose, axis = ddg.Grip(pivot=(1.0, 0.0, 0.0)), np.zeros(6), np.array([2.0, -1.0, 2.0]) / 3.0
    for angle in np.linspace(0.0, 20.0, 60):
        pose = grip.at((1.5, 0.0, angle), np.append(np.cos(angle / 2), np.sin(angle / 2) * axis), near=pose)
        assert pose == pytest.approx([0.5, 0.0, angle, *(angle * axis)], abs=1e-12)
    assert grip.at((1, 0, 0)) == pytest.approx(np.zeros(6))
    assert grip.at(np.zeros((4, 3))).shape == (4, 6)


def test_refusals_of_the_coupling(mujoco):
    scene, rod = held_rod(np.linspace((0, 0, 0), (LENGTH, 0, 0), 4))
    grip = ddg.Grip()
    scene.clamp(rod, motion=grip, name="hand")
    model, xml = scene.build(device="cpu"), HEAD % 1e-3 + '<body name="a"><geom size="1"/></body></worldbody></mujoco>'
    for attach, message in (
        ({}, "attach is"),
        ({"band": "a"}, r"no grip holds a support named 'band'; did you mean 'hand'\?"),
        ({"hand": "aa"}, r"named 'aa'; did you mean 'a'\?"),
        ({ddg.Grip(): "a"}, "holds nothing of the model"),
        ({grip: "a", "hand": "a"}, "attached twice"),
    ):
        with pytest.raises(ddg.SceneError, match=message):
            ddg.coupling.MuJoCo(model, xml, attach)
    with pytest.raises(ddg.SceneError, match="2 worlds"):
        ddg.coupling.MuJoCo(scene.build(device="cpu", worlds=2), xml, {grip: "a"})
    with pytest.raises(ddg.SceneError, match="MuJoCo refuses the model"):
        ddg.coupling.MuJoCo(model, "missing.xml", {grip: "a"})
    with pytest.raises(ddg.SceneError, match="no multiple of MuJoCo's time step"):
        ddg.coupling.MuJoCo(model, xml, {grip: "a"}).step(1.5e-3)


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install 'ddg-warp\[mujoco\]'"):
        ddg.coupling.add_bodies(ddg.Scene(), "arm.xml")


PENDULUM = f"""<mujoco><option timestep="%g" gravity="0 0 -{GRAVITY}" integrator="RK4"><flag contact="disable"/></option><worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0" damping="%g"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.4"/>
    <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" stiffness="0.5" springref="20"/>
    <geom type="box" pos="0.1 0 0.02" size="0.1 0.02 0.03" mass="0.2"/>
    <body name="cap" pos="0.2 0 0"><geom type="sphere" size="0.03" mass="0.1"/></body></body></body></worldbody>
    <actuator><motor name="drive" joint="elbow" gear="0.5" ctrlrange="-1 1" ctrllimited="true"/>
    <position name="servo" joint="shoulder" kp="2" kv="0.05"/><velocity name="brake" joint="elbow" kv="0.01" gear="0.5"/>
    </actuator></mujoco>"""


def test_double_pendulum_agrees_with_mujoco(mujoco):
    """Positions after 1 s agree with fine steps of MuJoCo, to second order in the step, with motor, servos, damping and spring."""

    def drive(t):
        return 1.5 * np.sin(8.0 * t)

    fine = mujoco.MjModel.from_xml_string(PENDULUM % (1e-4, 0.01))
    data = mujoco.MjData(fine)
    for _ in range(10000):
        data.ctrl[:] = drive(data.time + 5e-5)  # middle of the step
        mujoco.mj_step(fine, data)
    mujoco.mj_kinematics(fine, data)
    errors = []
    for dt in (4e-3, 2e-3):
        scene = ddg.Scene(gravity=(0, 0, -GRAVITY))
        added = ddg.coupling.add_bodies(
            scene, PENDULUM % (1e-3, 0.01), ctrl=dict.fromkeys(("drive", "servo", "brake"), drive)
        )
        assert list(added.joints) == ["shoulder", "elbow"]
        assert added.bodies["cap"] == added.bodies["lower"]
        model = scene.build(device="cpu")
        integrator, state = ddg.Integrator(model, scheme="implicit_midpoint"), model.state()
        for _ in range(round(1.0 / dt)):
            state = integrator.step(state, dt)
        errors.append(np.abs(state.body(added.bodies["upper"]).position - data.body("upper").xipos).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] > 3.0


def test_unsupported_joints_and_actuators_are_listed_at_once(mujoco):
    xml = f"""{HEAD % 1e-3}<body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1"/>
        <body name="arm"><joint name="spring" axis="0 1 0" stiffness="1" armature="0.1"/>
        <geom name="tube" type="cylinder" size="0.1 0.2"/></body></body></worldbody>
        <actuator><position name="servo" joint="rail"/><general name="lag" joint="spring" dyntype="filter"/></actuator></mujoco>"""
    with pytest.raises(ddg.SceneError) as refused:
        ddg.coupling.add_bodies(ddg.Scene(), xml)
    for text in ("rail is a slide", "spring has armature", "servo is no motor", "lag is no motor"):
        assert text in str(refused.value)
    assert "tube" not in str(refused.value)


def test_urdf(mujoco, tmp_path):
    """Bodies of a URDF file: a fixed link belongs to the body of its parent, and stops are the limits."""
    link = """<link name="%s"><inertial><origin xyz="0.1 0 0"/><mass value="%g"/>
        <inertia ixx="1e-3" iyy="2e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    text = f"""<robot name="arm"><mujoco><compiler fusestatic="false"/></mujoco>
        <link name="base"/>{link % ("upper", 0.4)}{link % ("hand", 0.1)}
        <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="2" effort="1" velocity="1"/><dynamics damping="0.3"/></joint>
        <joint name="wrist" type="fixed"><parent link="upper"/><child link="hand"/><origin xyz="0.2 0 0"/></joint></robot>"""
    (tmp_path / "arm.urdf").write_text(text)
    scene = ddg.Scene()
    added = ddg.coupling.add_bodies(scene, tmp_path / "arm.urdf")
    body, joint = scene.bodies[added.bodies["hand"]], scene.body_joints[added.joints["shoulder"]]
    assert body.mass == pytest.approx(0.5)
    assert body.center == pytest.approx([(0.4 * 0.1 + 0.1 * 0.3) / 0.5, 0, 0])
    assert sorted(body.moments)[1:] == pytest.approx([4e-3 + 0.08 * 0.04] * 2)
    assert (joint.damping, *joint.stops) == pytest.approx((0.3, -1.0, 2.0))


def test_free_bodies_balls_and_constraints(mujoco):
    """A free body that moves, with a ball on it, keeps its velocity; constraints become joints."""
    xml = """<mujoco><option gravity="0 0 0"/><worldbody><geom type="plane" size="1 1 1"/>
        <body name="hull" pos="0 0 1"><freejoint/><geom type="ellipsoid" size="0.1 0.2 0.3" mass="1"/>
        <body name="mast" pos="0 0 0.4"><joint name="foot" type="ball"/><geom type="cylinder" size="0.02 0.1" mass="0.1"/></body></body>
        <body name="buoy" pos="0.5 0 1"><freejoint/><geom size="0.1" mass="1"/></body>
        <body name="float" pos="-0.5 0 1"><freejoint/><geom size="0.1" mass="1"/></body></worldbody>
        <equality><connect name="line" body1="hull" body2="buoy" anchor="0.25 0 0"/>
        <weld name="bar" body1="hull" body2="float"/></equality></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    for start in (0, model.nv - 12, model.nv - 6):  # dofs of the free joints
        data.qvel[start : start + 3] = 0.1, 0.0, 0.2
    mujoco.mj_forward(model, data)
    scene = ddg.Scene(gravity=(0, 0, 0))
    added = ddg.coupling.add_bodies(scene, model, data=data)
    assert {name: scene.body_joints[handle].call for name, handle in added.joints.items()} == {
        "foot": "ball",
        "line": "ball",
        "bar": "weld",
    }
    built = scene.build(device="cpu")
    integrator, state = ddg.Integrator(built), built.state()
    for _ in range(10):
        state = integrator.step(state, 0.01)
    for name in ("hull", "mast", "buoy", "float"):
        expected = data.body(name).xipos + 0.1 * np.array([0.1, 0.0, 0.2])
        assert state.body(added.bodies[name]).position == pytest.approx(expected, abs=1e-9)
