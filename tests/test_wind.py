"""Wind: flows of position and time, quadratic drag of rods and shells, turbulence and gusts, against closed forms."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes

RHO, CN, CT = 1.2, 1.17, 0.02
CLOTH = ddg.Material(young=1e6, poisson=0.3, density=300.0)
SCHEMES = ("implicit_euler", "implicit_midpoint")
LAWS = {"quadratic": {"law": ddg.QuadraticDrag(RHO, CN, CT)}, "linear": {"normal": 0.7, "tangential": 0.1}}


def plate(device, angle: float = 0.0, law: str = "quadratic", worlds: int = 1, young: float = 1e6, **options):
    """Return the model of a plate of 0.6 m x 0.4 m across x, rotated by an angle about y towards it."""
    scene = ddg.Scene(**({"gravity": (0.0, 0.0, 0.0)} | options))
    points, triangles = meshes.rectangle(3, 2, (0.6, 0.4), "alternating")
    along = np.array([np.sin(angle), 0.0, np.cos(angle)])
    points = points[:, :1] * along + points[:, 1:2] * [0.0, 1.0, 0.0]
    shell = scene.add_shell(points, triangles, thickness=1e-3, material=CLOTH, bending="hinge")
    scene.drag(shells=shell, **LAWS[law])
    return scene.build(device, "float64", worlds=worlds)


def plate_force(law: str, angle: float, w) -> np.ndarray:
    """Return the force on the plate in the relative flow w: normal and along, each by itself, times the area 0.24 m^2.

    Quadratic: rho / 2 C_n |w_n| w_n, and rho / 2 C_t |w_t| w_t on both sides.
    """
    normal = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    across = normal * (w @ normal)
    along = w - across
    if law == "linear":
        return 0.24 * (0.7 * across + 0.1 * along)
    size = np.linalg.norm
    return 0.24 * 0.5 * RHO * (CN * size(across) * across + 2.0 * CT * size(along) * along)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("angle", [0.0, 0.4, 0.5 * np.pi], ids=["across", "at an angle", "along"])
def test_flat_plate(device, law, angle):
    """Force and power of a plate that moves at another velocity in every world."""
    u, velocity = np.array([5.0, 1.0, 0.0]), np.array([[0.0, 0.0, 0.0], [8.0, 0.5, -1.0]])
    model = plate(device, angle, law, worlds=2, flow=tuple(u))
    drag = model.drag(model.state(velocities=np.repeat(velocity[:, None], model.points_count, 1)))
    for world in range(2):
        expected = plate_force(law, angle, u - velocity[world])
        np.testing.assert_allclose(drag.force[world].sum(0), expected, rtol=1e-12, atol=1e-13)
        assert drag.power[world] == pytest.approx(expected @ velocity[world], rel=1e-12, abs=1e-13)


@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
def test_rod_in_a_shear_flow(device, joined):
    """A vertical rod of 2 m in u = 3 z, by the trapezoidal rule of edges of h = 0.1 m.

    Quadratic: the integral of rho / 2 C_n d (3 z)^2 is 12 rho C_n d, by the rule times 1 + h^2 / 8. Linear: that of c 3 z is 6 c.
    """
    z = np.linspace(0.0, 2.0, 21)
    quadratic = {"law": ddg.QuadraticDrag(RHO, CN, CT)}, 12.0 * RHO * CN * 0.02 * (1.0 + 0.1**2 / 8.0)
    for law, exact in (quadratic, ({"normal": 0.7, "tangential": 0.1}, 4.2)):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), flow=lambda points, t: points[..., 2:] * [3.0, 0.0, 0.0])
        parts = (z[:11], z[10:]) if joined else (z,)
        options = {"section": ddg.Circle(0.01), "material": ddg.Material(young=1e9, density=1e3)}
        rods = [scene.add_rod(part[:, None] * [0.0, 0.0, 1.0], **options) for part in parts]
        if joined:
            scene.join([(rods[0], -1), (rods[1], 0)])
        scene.drag(**law)
        model = scene.build(device, "float64", worlds=2)
        force = model.drag(model.state()).force
        np.testing.assert_allclose(force[0], force[1])
        assert force[0, :, 0].sum() == pytest.approx(exact, rel=1e-12)
        assert np.abs(force[..., 1:]).max() < 1e-14


@pytest.mark.parametrize("scheme", SCHEMES)
def test_terminal_velocity_of_a_falling_sheet(device, scheme):
    """A level sheet falls at v tanh(g t / v), v = (2 g sigma / (rho C_n))^1/2 with 0.3 kg/m^2; orders of error in time."""
    g, t = 9.81, 0.6
    terminal = np.sqrt(2.0 * g * 0.3 / (RHO * CN))

    def speed(steps: int) -> float:
        model = plate(device, 0.5 * np.pi, gravity=(0.0, 0.0, -g))
        integrator, state = ddg.Integrator(model, scheme), model.state()
        for _ in range(steps):
            state = integrator.step(state, t / steps)
        return -state.velocities()[:, 2].mean()

    errors = [speed(steps) - terminal * np.tanh(g * t / terminal) for steps in (10, 20, 40)]
    np.testing.assert_allclose(np.diff(np.log2(np.abs(errors))), -1.0 - (scheme == SCHEMES[1]), atol=0.15)
    model = plate(device, 0.5 * np.pi, gravity=(0.0, 0.0, -g))
    integrator, state = ddg.Integrator(model, scheme), model.state()
    for _ in range(20):
        state = integrator.step(state, 0.5)
    assert -state.velocities()[:, 2].mean() == pytest.approx(terminal, rel=1e-3)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_strong_wind_on_light_cloth(device, scheme):
    """A loose sheet of 0.3 kg/m^2 in 200 m/s by long steps: no vertex outruns the wind, and the sheet comes to its velocity."""
    model = plate(device, 0.3, flow=(200.0, 0.0, 0.0))
    integrator, state = ddg.Integrator(model, scheme), model.state()
    for _ in range(20):
        state = integrator.step(state, 0.02)
        assert np.linalg.norm(state.velocities().mean(0) - [100.0, 0.0, 0.0]) < 101.0
    assert integrator.statistics()["outcomes"] == {"converged": 20}


def test_energy_account_of_quadratic_drag(device):
    """Sheet in still air, midpoint rule: the energy changes by made - dissipated, and dissipated is the integral of the power."""
    model = plate(device, 0.4)
    velocities = np.cross((0.0, 9.0, 3.0), model.state().points()) + (4.0, 0.0, 1.0)
    state, integrator = model.state(velocities=velocities), ddg.Integrator(model, "implicit_midpoint", rtol=1e-11)
    before, power = sum(model.energies(state).values()), [model.drag(state).power]
    for _ in range(20):
        state = integrator.step(state, 2e-3)
        power.append(model.drag(state).power)
    change, account = sum(model.energies(state).values()) - before, integrator.statistics()["energy"]
    assert change < -0.02 * before
    assert change == pytest.approx(account["made"] - account["dissipated"], abs=1e-9 * before)
    assert account["dissipated"] == pytest.approx(-2e-3 * np.sum(np.array(power[1:]) + power[:-1]) / 2.0, rel=0.01)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_uniform_flow_as_a_field(device, scheme):
    """A field with one value moves rods and shells, bit for bit, as the uniform flow does."""
    results = []
    for flow in ((3.0, 1.0, 2.0), lambda points, t: np.broadcast_to([3.0, 1.0, 2.0], points.shape)):
        scene = ddg.Scene(flow=flow)
        points, triangles = meshes.rectangle(2, 2, (0.2, 0.2), "alternating")
        scene.add_shell(points, triangles, thickness=1e-3, material=CLOTH, bending="hinge")
        s = np.linspace(0.0, 1.0, 6)[:, None]
        for count in (6, 5):
            scene.add_rod(s[:count] * [1.0, 0.2, 0.1], section=ddg.Circle(0.01), material=CLOTH)
        scene.drag(law=ddg.QuadraticDrag(RHO))
        model = scene.build(device, "float64")
        integrator, state = ddg.Integrator(model, scheme), model.state()
        for _ in range(3):
            state = integrator.step(state, 0.01)
        results.append(state.points())
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_fields_on_the_device(device, scheme):
    """Rods of two lengths and a sheet, in two worlds, move in fields as in the same function on the host."""
    turbulence = ddg.Turbulence((5.0, 1.0, 0.0), 0.3, 0.4, seed=2, modes=64)
    grid = ddg.FlowGrid(
        np.random.default_rng(1).normal(size=(3, 2, 3, 1, 3)), (-0.2, -0.2, 0.0), (1.0, 0.5, 0.0), (0.0, 0.015, 0.1)
    )
    field = turbulence + grid + ddg.Gust((2.0, 0.0, 0.0), duration=0.1)
    results = []
    for flow in (field, lambda points, t: 1.0 * field(points, t)):
        scene = ddg.Scene(flow=flow)
        points, triangles = meshes.rectangle(2, 2, (0.2, 0.2), "alternating")
        scene.add_shell(points, triangles, thickness=1e-3, material=CLOTH, bending="hinge")
        s = np.linspace(0.0, 1.0, 6)[:, None]
        for count in (6, 5):
            scene.add_rod(s[:count] * [1.0, 0.2, 0.1], section=ddg.Circle(0.01), material=CLOTH)
        scene.drag(law=ddg.QuadraticDrag(RHO))
        model = scene.build(device, "float64", worlds=2)
        velocities = np.zeros((2, model.points_count, 3))
        velocities[1, :, 0] = 1.0
        integrator, state = ddg.Integrator(model, scheme), model.state(velocities=velocities)
        for _ in range(3):
            state = integrator.step(state, 0.01)
        results.append((state.points(), model.drag(state).force))
    for device_values, host_values in zip(*results, strict=True):
        np.testing.assert_allclose(device_values, host_values, rtol=0.0, atol=1e-10)


def test_flow_is_evaluated_where_nodes_start(device):
    """A massless rod in u = x drifts by x -> x (1 + h) each step of Euler's rule; by the midpoint rule with the mean velocity."""
    for scheme, factor in zip(SCHEMES, (1.1, 1.1), strict=True):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), flow=lambda points, t: points * [1.0, 0.0, 0.0])
        points = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
        scene.add_rod(points, section=ddg.Stiffness(EA=1.0, radius=0.01), bend=False)
        scene.drag(normal=1.0, tangential=1.0)
        model = scene.build(device, "float64")
        state = ddg.Integrator(model, scheme).step(model.state(), 0.1)
        np.testing.assert_allclose(state.points()[:, 0], factor, rtol=1e-9)


def test_grid(device, tmp_path):
    """A grid is exact for trilinear fields, linear in time, and constant beyond; files return it."""
    axes = [np.linspace(*ends) for ends in ((-1.0, 2.0, 4), (0.0, 1.0, 3), (0.0, 5.0, 2))]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    field = np.stack([x * y + z, 2.0 - y * z * x, x], -1)
    grid = ddg.FlowGrid([field, 3.0 * field], (-1.0, 0.0, 0.0), (2.0, 1.0, 5.0), times=[1.0, 3.0])
    points = np.random.default_rng(0).uniform((-1.0, 0.0, 0.0), (2.0, 1.0, 5.0), (2, 7, 3))
    x, y, z = np.moveaxis(points, -1, 0)
    exact = np.stack([x * y + z, 2.0 - y * z * x, x], -1)
    for t, factor in ((0.0, 1.0), (1.5, 1.5), (3.0, 3.0), (9.0, 3.0)):
        np.testing.assert_allclose(grid(points, t), factor * exact, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(grid(np.array([[9.0, -9.0, 2.5]]), 0.0), [[2.5, 2.0, 2.0]])
    for name in ("flow.npz", "flow.h5"):
        if name.endswith(".h5"):
            pytest.importorskip("h5py")
        grid.save(tmp_path / name)
        np.testing.assert_array_equal(ddg.FlowGrid.load(tmp_path / name)(points, 1.5), grid(points, 1.5))


@pytest.mark.parametrize("spectrum", ["von_karman", "kraichnan"])
def test_turbulence(spectrum):
    """Mean, standard deviation, divergence, longitudinal correlation and Taylor's hypothesis, over a volume and seeds.

    Kraichnan's spectrum has f(r) = exp(-pi r^2 / (4 L^2)). The integral of f is L.
    """
    mean, intensity, length, samples = np.array([8.0, 0.0, 0.0]), 0.15, 2.0, 1500
    points = np.random.default_rng(1).uniform(0.0, 500.0, (samples, 3))
    flows = [ddg.Turbulence(mean, intensity, length, seed, spectrum=spectrum) for seed in range(4)]
    u = np.concatenate([flow(points, 1.0) for flow in flows])
    np.testing.assert_allclose(u.mean(0), mean, atol=0.06)
    np.testing.assert_allclose(u.std(0), 1.2, rtol=0.06)
    assert np.sum((u - mean) ** 2) / len(u) == pytest.approx(3.0 * 1.2**2, rel=0.02)
    h, flow = 1e-4, flows[0]
    gradient = [(flow(points + h * axis, 0.0) - flow(points - h * axis, 0.0)) / (2.0 * h) for axis in np.eye(3)]
    divergence = sum(gradient[axis][:, axis] for axis in range(3))
    assert np.abs(divergence).max() < 1e-5 * np.abs(gradient).max()
    r = np.linspace(0.0, 4.0 * length, 17)
    f = np.zeros(len(r))
    for axis in range(3):  # along each axis: isotropy
        for flow in flows[:2]:
            component = flow(points, 0.0)[:, axis] - mean[axis]
            along = [flow(points + distance * np.eye(3)[axis], 0.0)[:, axis] - mean[axis] for distance in r]
            f += np.array(along) @ component / samples / 1.2**2 / 6.0
    assert np.sum(0.5 * (f[1:] + f[:-1]) * np.diff(r)) == pytest.approx(length, rel=0.15)
    if spectrum == "kraichnan":
        np.testing.assert_allclose(f, np.exp(-np.pi * r**2 / (4.0 * length**2)), atol=0.08)
    flow = flows[0]
    moved = flow(points + 0.1 * mean, 0.1) - flow(points, 0.0)  # decorrelates at the rate 0.6 / s
    assert np.sqrt(np.mean(moved**2)) == pytest.approx(1.2 * 0.6 * 0.1, rel=0.1)
    np.testing.assert_array_equal(
        flow(points[:9], 2.0), ddg.Turbulence(mean, intensity, length, 0, spectrum=spectrum)(points[:9], 2.0)
    )


def test_gust_on_turbulence():
    """A gust of 4 s begins at 2 s, peaks in the middle, ends after its duration, and adds to a field."""
    gust = ddg.Gust((6.0, 0.0, 0.0), start=2.0, duration=4.0)
    np.testing.assert_allclose(
        [gust(t)[0] for t in (0.0, 2.0, 3.0, 4.0, 5.0, 6.0, 9.0)], [0, 0, 3, 6, 3, 0, 0], atol=1e-12
    )
    turbulence, points = ddg.Turbulence((8.0, 0.0, 0.0), 0.1, 2.0), np.zeros((4, 3))
    flow = turbulence + gust + (0.0, 1.0, 0.0)
    np.testing.assert_allclose(flow(points, 4.0), turbulence(points, 4.0) + [6.0, 1.0, 0.0])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_wrench_of_a_fixed_plate(device, scheme):
    """The support of a plate that is fixed everywhere takes the drag of a step, in every world and precision."""
    for precision in ("float64", "mixed"):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), flow=(5.0, 1.0, 2.0))
        points, triangles = meshes.rectangle(3, 2, (0.6, 0.4), "alternating")
        shell = scene.add_shell(points, triangles, thickness=1e-3, material=CLOTH, bending="hinge")
        scene.hold(shell, np.arange(len(points)), name="frame")
        scene.drag(**LAWS["quadratic"])
        model = scene.build(device, precision, worlds=2)
        assert "drag on 12 triangles of shells" in model.report()
        integrator, state = ddg.Integrator(model, scheme), model.state()
        integrator.watch_wrenches()
        state = integrator.step(state, 0.01)
        expected = plate_force("quadratic", 0.5 * np.pi, np.array([5.0, 1.0, 2.0]))
        for world in range(2):
            np.testing.assert_allclose(model.drag(state).force[world].sum(0), expected, rtol=1e-6)
            np.testing.assert_allclose(integrator.wrenches()["frame"].force[world], -expected, rtol=1e-6)


def test_missing_gradients_are_refused():
    """Names: a function of position of a user, wrenches by coefficients of shells, the radius of rods in a quadratic law."""
    from ddg_warp.adjoint.implicit import Adjoint

    model = plate("cpu", flow=lambda points, t: points)
    with pytest.raises(ddg.SceneError, match="flow is a function of position that has no gradient"):
        Adjoint(ddg.Integrator(model))
    pytest.importorskip("torch")
    from ddg_warp.torch import RodParameters, Simulator

    simulator = Simulator(plate("cpu"), 0.01)
    state = simulator.initial_state()
    coefficients = {"shell_drag.normal": simulator.parameter("shell_drag.normal")}
    with pytest.raises(ddg.SceneError, match=r"wrenches by shell_drag\.normal"):
        simulator.wrenches(state, simulator.step(state, coefficients), coefficients)
    scene = ddg.Scene()
    scene.add_rod(np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5), section=ddg.Circle(0.01), material=CLOTH)
    scene.drag(law=ddg.QuadraticDrag(RHO))
    with pytest.raises(ddg.SceneError, match="'radius' does not change the QuadraticDrag of rod 0"):
        RodParameters(Simulator(scene.build("cpu"), 0.01), names=("radius",))
