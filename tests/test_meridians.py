"""Shells of revolution in scenes: named refusals, runs, worlds, growth, and surfaces in USD."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.io.surface_of_revolution import Revolution
from ddg_warp.run.recorder import Recorder, export_usd
from ddg_warp.solve.equilibrium.statics import Equilibrium, solve

RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
ANGLE = np.linspace(0.0, 1.0, 9)
CAP = np.column_stack([np.sin(ANGLE), np.cos(ANGLE)])
TUBE = np.column_stack([np.ones(5), np.linspace(0.0, 1.0, 5)])


def scene_of(points=CAP, gravity=(0.0, 0.0, 0.0), mass_damping=0.0, **options):
    scene = ddg.Scene(gravity=gravity, analysis=ddg.Statics(1), mass_damping=mass_damping)
    scene.add_axisymmetric_shell(points, **({"thickness": 0.01, "material": RUBBER, "name": "odd"} | options))
    return scene


def moved(node, radius, height):
    points = CAP.copy()
    points[node] = radius, height
    return points


@pytest.mark.parametrize(
    ("action", "phrases"),
    [
        (lambda: scene_of(CAP[:2]), ("odd", "(n, 2)")),
        (lambda: scene_of(np.zeros((4, 3))), ("odd", "(4, 3)")),
        (lambda: scene_of("abc"), ("odd", "numbers")),
        (lambda: scene_of(moved(3, -1.0, 0.0)), ("odd", "node 3", "negative")),
        (lambda: scene_of(moved(3, 0.0, 0.0)), ("odd", "node 3", "axis")),
        (lambda: scene_of(moved(3, np.nan, 0.0)), ("odd", "node 3", "finite")),
        (lambda: scene_of(moved(3, *CAP[2])), ("odd", "edge 2", "length")),
        (lambda: scene_of(thickness=0.0), ("odd", "thickness")),
        (lambda: scene_of(thickness=np.ones(3)), ("odd", "8")),
        (lambda: scene_of(material=3), ("odd", "Material")),
        (lambda: scene_of().hold_ring(1, 0), ("shell 1", "1 so far")),
        (lambda: scene_of().hold_ring(0, 9), ("node 9", "9 nodes")),
        (lambda: scene_of().hold_ring(0, 0, "y"), ("'y'", "'xz'")),
        (lambda: scene_of().hold_ring(0, 0, motion=3), ("motion is 3", "translation")),
        (
            lambda: scene_of().hold_ring(0, 0, motion=ddg.Motion(angle=lambda t: t)),
            ("(0.0, 0.0, 1.0)", "axis=(0, 1, 0)"),
        ),
        (lambda: scene_of().clamp_ring(0, "rim"), ("rim", "'last'")),
        (lambda: scene_of().clamp_ring(0, "last", tangent=(0.0, 0.0)), ("tangent", "direction")),
        (lambda: scene_of().add_ring_force(0, 0, (1.0, 0.0)), ("pole", "add_pole_force")),
        (lambda: scene_of().add_pole_force(0, 1.0, "last"), ("no pole", "add_ring_force")),
        (lambda: scene_of().add_ring_force(0, 1, (1.0, np.inf)), ("finite",)),
        (lambda: scene_of().add_axisymmetric_pressure(0, 1.0, edges=[8]), ("edge 8", "8")),
        (lambda: scene_of().add_axisymmetric_pressure(0, 1.0, amplitude=3), ("amplitude", "function")),
        (lambda: scene_of(rest="round").build(), ("round", "'flat'")),
        (lambda: scene_of(rest=(np.ones((3, 2)), np.zeros((9, 2)))).build(), ("odd", "(8, 2)")),
        (lambda: scene_of(gravity=(1.0, 0.0, 0.0)).build(), ("gravity", "along z")),
        (lambda: Equilibrium(scene_of().build()), ("shell 0", "hold_ring")),
    ],
)
def test_refused(action, phrases):
    with pytest.raises(ddg.SceneError) as caught:
        action()
    assert not [word for word in phrases if word not in str(caught.value)], caught.value


def test_a_pole_is_not_clamped():
    with pytest.raises(ddg.SceneError, match="the first node of shell 0 is a pole"):
        scene_of().clamp_ring(0, "first")


@pytest.mark.parametrize("points", [CAP, TUBE], ids=["cap", "tube"])
def test_following_pressure_in_dynamics(device, points):
    """Pressure raised slowly with damping reaches the static solution, which differs from a dead pressure."""

    def pressed(dead=False, **options):
        scene = scene_of(points, mass_damping=60.0, **options)
        scene.clamp_ring(0, "last")
        if points is TUBE:
            scene.hold_ring(0, 0, "z", motion=ddg.Motion(translation=lambda t: (0.0, 0.0, -0.2 * min(1.0, t))))
        scene.add_axisymmetric_pressure(0, 900.0, [0, 1, 2], dead=dead, amplitude=lambda t: min(1.0, t))
        scene.add_axisymmetric_pressure(0, 400.0, [2, 3], dead=dead, amplitude=lambda t: min(1.0, t))
        return scene.build(device, "float64")

    model = pressed(material=ddg.Material(1e6, 0.3, 1000.0, viscosity=0.05))
    state, integrator = model.state(), ddg.Integrator(model, rtol=1e-10)
    for _ in range(120):
        state = integrator.step(state, 0.05)
    static, dead = (solve(pressed(d), load_steps=10).points() for d in (False, True))
    assert np.abs(static - dead).max() > 3e-4
    np.testing.assert_allclose(state.points(), static, atol=1e-9)


def test_rotated_rim_of_a_disc(device):
    """A small rim rotation makes a disc a paraboloid, w(0) = phi a / 2, with energy pi a^2 D (1 + nu) (phi / a)^2."""
    angle, radius = 1e-3, 0.5

    def disc(ramp, **options):
        scene = scene_of(np.column_stack([np.linspace(0.0, radius, 21), np.zeros(21)]), **options)
        scene.clamp_ring(0, "last", "z", motion=ddg.Motion(angle=ramp, axis=(0.0, 1.0, 0.0), pivot=(radius, 0.0, 0.0)))
        return scene.build(device, "float64")

    model = disc(lambda t: angle * t)
    static = solve(model)
    assert static.points()[0, 2] == pytest.approx(0.5 * angle * radius, rel=1e-3)
    stiffness = 1e6 * 0.01**3 / (12.0 * (1.0 - 0.3**2))
    energy = np.pi * stiffness * 1.3 * angle**2
    assert sum(model.energies(static).values()) == pytest.approx(energy, rel=1e-3)
    moved = disc(lambda t: angle * min(1.0, t), mass_damping=8.0)
    state, integrator = moved.state(), ddg.Integrator(moved, rtol=1e-10)
    for _ in range(120):
        state = integrator.step(state, 0.1)
    np.testing.assert_allclose(state.points(), static.points(), atol=1e-10)


def test_rigid_rotation_of_a_meridian(device):
    """All nodes of a clamped tube but one follow the motion about y, in statics and dynamics."""
    motion = ddg.Motion(lambda t: (0.1 * t, 0.0, 0.2 * t), lambda t: 0.8 * t, (0.0, 2.0, 0.0), (1.0, 0.0, 0.5))
    scene = scene_of(TUBE)
    scene.clamp_ring(0, "first", motion=motion)
    scene.hold_ring(0, [1, 3, 4], motion=motion)
    model = scene.build(device, "float64")
    points = np.column_stack([TUBE[:, 0], 0.0 * TUBE[:, 0], TUBE[:, 1]])
    states = [solve(model, load_steps=4), model.state()]
    integrator = ddg.Integrator(model)
    for _ in range(5):
        states[1] = integrator.step(states[1], 0.2)
    for state in states:
        fixed = np.array([0, 1, 3, 4])
        np.testing.assert_allclose(state.points()[fixed], motion.place(1.0, points)[fixed], atol=1e-12)
        (rim,) = state.coupled.data.values()
        np.testing.assert_allclose(rim.numpy()[:3, 0], motion.rotation(0.8) @ [0.0, 0.0, 1.0], atol=1e-12)
    bent = [model.energies(state)["axisymmetric_rim"] for state in states]
    assert bent[0] == pytest.approx(bent[1], rel=1e-9)


def test_following_pressure_on_many_worlds(device):
    """Stiffer worlds deform less, and each equals a single build, bit by bit."""
    scene = scene_of(TUBE)
    scene.clamp_ring(0, "last")
    scene.add_axisymmetric_pressure(0, -50.0)  # outwards: the meridian runs upwards
    factors, results = np.array([1.0, 3.0]), []
    for worlds in (factors, factors[1:]):
        model = scene.build(device, "float64", worlds=len(worlds))
        stiffness = float(model.parameters()["net/axisymmetric_stretch/stiffness"].flat[0])
        model.set_parameter(
            "axisymmetric_stretch", "stiffness", worlds * stiffness if len(worlds) > 1 else worlds[0] * stiffness
        )
        state, integrator = model.state(), ddg.Integrator(model)
        for _ in range(6):
            state = integrator.step(state, 0.01)
        results.append(state.points())
    assert results[0][0, 0, 0] > results[0][1, 0, 0] > 1.0
    (np.testing.assert_array_equal if device == "cpu" else np.testing.assert_allclose)(results[0][1], results[1])


def test_worlds_and_growth(device):
    """Worlds grow by separate rest strains: a tube with rest a_tt / 2 equal to (g R)^2 / 2 and free ends has radius g R."""
    scene = scene_of(TUBE)
    scene.hold_ring(0, 0, "z")
    model = scene.build(device, "float64", worlds=2)
    growth = np.array([1.05, 1.1])
    model.set_parameter("axisymmetric_stretch", "rest_22", 0.5 * growth**2)
    points = Equilibrium(model).load(model.state(), 1).points()
    np.testing.assert_allclose(points[:, :, 0], np.repeat(growth[:, None], 5, 1), atol=1e-9)
    np.testing.assert_allclose(points[:, :, 2], [TUBE[:, 1]] * 2, atol=1e-9)


def test_shell_of_revolution_with_rods_and_shells(device):
    """Points are ordered as rods, meridians, vertices; the shell of revolution deforms as in a separate scene."""
    single = scene_of()
    single.clamp_ring(0, "last")
    single.add_pole_force(0, -1.0)
    both = scene_of()
    both.clamp_ring(0, "last")
    both.add_pole_force(0, -1.0)
    triangle = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    both.hold(both.add_shell(triangle, [[0, 1, 2]], thickness=0.1, material=RUBBER), [0, 1, 2])
    rod = both.add_rod(triangle + 2.0, section=ddg.Circle(0.01), material=RUBBER)
    both.clamp(rod, [0])
    points = [
        Equilibrium(m).load(m.state(), 1).points() for m in (scene.build(device, "float64") for scene in (single, both))
    ]
    np.testing.assert_allclose(points[1], np.concatenate([triangle + 2.0, points[0], triangle]), atol=1e-9)


def test_surface_of_revolution_in_usd(device, tmp_path):
    """A cap revolved with N sides has one triangle a side at the pole, two elsewhere; its area tends to 2 pi (1 - cos 1)."""
    from pxr import Usd, UsdGeom

    model = scene_of().build(device)
    with Recorder(model, tmp_path, usd=False) as recorder:
        recorder.record(model.state())
    export_usd(tmp_path / "trajectory.h5", tmp_path / "cap.usdc", revolve=64)
    stage = Usd.Stage.Open(str(tmp_path / "cap.usdc"))
    (mesh,) = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    triangles = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    corners = np.array(mesh.GetPointsAttr().Get(0.0))[triangles]
    normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(triangles) == 64 * (1 + 2 * 7)
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(2.0 * np.pi * (1.0 - np.cos(1.0)), rel=5e-3)
    assert (np.sum(normals * corners.mean(1), 1) > 0.0).all()  # to the left of the meridian, which is outwards here
    turned = Revolution(model.curves, model.state().points(), 64)
    np.testing.assert_allclose(np.linalg.norm(turned.points(model.state().points()), axis=1), 1.0, rtol=1e-12)
