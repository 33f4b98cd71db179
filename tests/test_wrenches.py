"""Wrenches of steps: balances of momentum and angular momentum, statics, worlds."""

import dataclasses

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.tangent import Tangent

DT, STEPS = 0.004, 5
RUBBER = ddg.Material(young=2e6, poisson=0.35, density=1000.0, viscosity=1e-3)
SECTION = ddg.Circle(0.01)
EULER, MIDPOINT = "implicit_euler", "implicit_midpoint"
OPTIONS = {"rtol": 1e-13, "max_iterations": 200}


def line(start, end, n=14) -> np.ndarray:
    return np.linspace(np.asarray(start, float), np.asarray(end, float), n)


def shaken(t: float) -> tuple:
    return (0.02 * np.sin(20.0 * t), 0.01 * t, 0.05 * t * t)


def shake() -> ddg.Motion:
    return ddg.Motion(shaken, lambda t: 0.3 * np.sin(9.0 * t), (1.0, 0.5, 0.2), (0.0, 0.1, 0.0))


def pendulum(scene):
    rod = scene.add_rod(line((0, 0, 0), (0.5, 0, 0.1)), section=SECTION, material=RUBBER)
    scene.clamp_end(rod, motion=shake())
    return rod


def pinned(scene):
    """Add a rod between a pinned and a sliding end, a closed rod, and a rod without twist."""
    rod = scene.add_rod(line((0, 0, 0), (0.5, 0, 0)), section=SECTION, material=RUBBER)
    scene.fix(rod, [0, 3], motion=shake())
    scene.fix(rod, [-1], components="yz")
    angle = 2.0 * np.pi * np.arange(12) / 12
    ring = 0.2 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    scene.clamp(scene.add_rod(ring, section=SECTION, material=RUBBER, closed=True), motion=shake())
    scene.fix(scene.add_rod(line((0, 2, 0), (1, 2, 0)), section=SECTION, material=RUBBER, twist=False), [0, 5])


def joined(scene):
    pendulum(scene)
    scene.add_rod(line((0.5, 0, 0.1), (0.9, 0.1, 0.1)), section=SECTION, material=RUBBER)
    scene.join([(0, -1), (1, 0)])


def sheet(scene, bending):
    points, triangles = meshes.rectangle(5, 4, (0.4, 0.3))
    shell = scene.add_shell(points, triangles, thickness=4e-3, material=RUBBER, bending=bending)
    low, side = (np.flatnonzero(points[:, axis] < 1e-9) for axis in (0, 1))
    scene.clamp_boundary(shell, low, motion=shake())
    scene.clamp_boundary(shell, side[side != low[0]])
    scene.hold(shell, [len(points) - 1], "z")


def oblique(scene):
    """Add a sheet on an oblique symmetry plane and one along an axis; a corner is common to their edges."""
    points, triangles = meshes.rectangle(5, 4, (0.4, 0.3))
    low, side = (np.flatnonzero(points[:, axis] < 1e-9) for axis in (0, 1))
    c, s = np.cos(0.6), np.sin(0.6)
    points = points @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    shell = scene.add_shell(points, triangles, thickness=4e-3, material=RUBBER)
    scene.symmetry(shell, low, (c, 0.0, s))
    scene.symmetry(shell, side, "y")
    scene.hold(shell, [len(points) - 1], "xz")


def stiffened(scene):
    """Add a clamped sheet and a rod on top."""
    points, triangles = meshes.rectangle(5, 4, (0.4, 0.3))
    shell = scene.add_shell(points, triangles, thickness=4e-3, material=RUBBER)
    scene.clamp_boundary(shell, np.flatnonzero(points[:, 0] < 1e-9), motion=shake())
    row = np.flatnonzero(np.abs(points[:, 1] - points[:, 1].max()) < 1e-9)
    row = row[np.argsort(points[row, 0])]
    rod = scene.add_rod(points[row], section=SECTION, material=RUBBER)
    scene.attach(rod, range(len(row)), shell, row)


def balance(integrator, before, after, dt) -> tuple:
    """Return the excess of force and of moment about the origin that no wrench explains, over the largest term."""
    model, tangent = integrator.model, Tangent(integrator.model)
    midpoint, damping = integrator.scheme == MIDPOINT, model.scene.mass_damping
    force, moment = np.zeros((2, 3)), np.zeros((2, 3))
    for part, stepper in zip(tangent.parts, integrator._parts, strict=True):
        q0, q1 = (part.back(part.dofs(state)) for state in (before, after))
        v0, v1 = (part.back(part.rates(state)) for state in (before, after))
        q, v = (0.5 * (q0 + q1), 0.5 * (v0 + v1)) if midpoint else (q1, v1)
        inner = part.mass * ((v1 - v0) / dt + damping * v)
        outer = part.loads(after.time, q) if model.scene.loads else part.weight().ravel()
        drag = np.zeros_like(q)
        if stepper.inertia:
            drag = resistance(part, stepper, q, q0)
        host = part.host
        x = q[host.dofs(np.arange(host.nodes))] if host.axes == (0, 1, 2) else planar(q, host)
        for i, values in enumerate((inner, outer - drag)):
            f = values[host.dofs(np.arange(host.nodes))]
            if host.axes != (0, 1, 2):
                f = planar(values, host)
            force[i] += f.sum(0)
            moment[i] += np.cross(x, f).sum(0)
            angles = edges_with_twist(part)
            if len(angles):
                ends = host.edge_ends(angles)
                edge = q[host.dofs(ends[:, 1])] - q[host.dofs(ends[:, 0])]
                tangents = edge / np.linalg.norm(edge, axis=1, keepdims=True)
                lagged = lagged_tangents(part, stepper, angles)
                axes = (tangents + lagged) / (1.0 + (tangents * lagged).sum(1, keepdims=True))
                moment[i] += (axes * values[host.dofs(angles)[:, :1]]).sum(0)
    wrenches = integrator.wrenches()
    pushes = sum(wrench.force for wrench in wrenches)
    turns = sum(wrench.moment + np.cross(wrench.point, wrench.force) for wrench in wrenches)
    size = np.abs([*force, pushes]).max(), np.abs([*moment, turns]).max()
    return np.abs(force[0] - force[1] - pushes).max() / size[0], np.abs(moment[0] - moment[1] - turns).max() / size[1]


def planar(values, host) -> np.ndarray:
    dofs = host.dofs(np.arange(host.nodes))
    return np.where(dofs < 0, 0.0, values[dofs])


def edges_with_twist(part) -> np.ndarray:
    host = part.host
    if part.model.coupled is not None and part.part is part.model.coupled:
        return host.nodes + np.arange(host.rod_edges)
    if not part.group.kind.twist:
        return np.zeros(0, int)
    k, column = np.divmod(np.arange(host.nodes), len(host.rods))
    return host.nodes + np.flatnonzero(k < host.count[column] - (0 if host.kind.closed else 1))


def lagged_tangents(part, stepper, angles) -> np.ndarray:
    """Return the tangents that the last solve transported frames from (angles, 3)."""
    if hasattr(part, "group"):
        frame = stepper.newton.iterates.frame.numpy()
        return frame[3:6].reshape(3, -1).T[angles - part.host.nodes]
    return stepper._lagged[0].numpy()[3:6].T


def resistance(part, stepper, q, q0) -> np.ndarray:
    """Return drag of the last solve on all dofs, from dofs at its start."""
    mass = stepper.newton.loading.mass.numpy()
    if hasattr(part, "group"):
        mass = mass.T.ravel()
        drag = np.zeros((len(mass), part.block))
        x = q.reshape(len(mass), part.block)
        for node, each in enumerate(mass):
            dim = part.group.kind.dim
            drag[node, :dim] = each["stiffness"] @ (x[node, :dim] - each["reference"])
            drag[node, dim:] = each["spin"] * (x - q0.reshape(x.shape))[node, dim:]
        return drag.ravel()
    x = q.reshape(-1, 3)
    return np.concatenate([each["stiffness"] @ (x[i] - each["reference"]) for i, each in enumerate(mass.ravel())])


def run(scene, device, scheme=EULER, steps=STEPS, dt=DT, precision="float64", **options):
    """Return integrator, state before the last step, and after."""
    model = scene.build(device, precision)
    integrator = ddg.Integrator(model, scheme, **(OPTIONS | options))
    integrator.watch_wrenches()
    after = model.state()
    for _ in range(steps):
        before, after = after, integrator.step(after, dt)
    return integrator, before, after


SCENES = {
    "pendulum": pendulum,
    "pinned": pinned,
    "joined": joined,
    "midedge_dof": lambda scene: sheet(scene, "midedge_dof"),
    "hinge": lambda scene: sheet(scene, "hinge"),
    "oblique": oblique,
    "stiffened": stiffened,
}


def assert_balanced(integrator, before, after, dt=DT, tolerance=1e-9):
    force, moment = balance(integrator, before, after, dt)
    assert force < tolerance
    assert moment < tolerance


@pytest.mark.parametrize("scheme", [EULER, MIDPOINT])
@pytest.mark.parametrize("name", SCENES)
def test_wrenches_balance_momentum(device, name, scheme):
    """The rate of momentum is the sum of weights, mass damping and wrenches; angular momentum likewise."""
    scene = ddg.Scene(gravity=(0.3, 0.2, -9.81), mass_damping=0.8)
    SCENES[name](scene)
    assert_balanced(*run(scene, device, scheme))


@pytest.mark.parametrize("name", ["pendulum", "joined"])
@pytest.mark.parametrize("scheme", [EULER, MIDPOINT])
def test_wrenches_balance_drag_and_loads(device, scheme, name):
    """Include drag of a flow, a load in time, a couple and a twisting moment in the balance."""
    scene = ddg.Scene(gravity=(0.0, 0.2, -9.81), mass_damping=0.8, flow=(0.5, 0.2, 0.1))
    SCENES[name](scene)
    scene.drag([0], tangential=0.3, normal=0.8, rotational=1e-3)
    assert_balanced(*run(scene, device, scheme))


def test_wrenches_of_planar_rods(device):
    for coupled in (False, True):
        scene = ddg.Scene(gravity=(0.3, 0.0, -9.81), mass_damping=0.8, dimension=2)
        rod = scene.add_rod(line((0, 0, 0), (0.5, 0, 0.1)), section=SECTION, material=RUBBER)
        scene.clamp_end(rod, motion=ddg.Motion(lambda t: (0.1 * t, 0.0, 0.2 * t * t)))
        if coupled:
            scene.add_rod(line((0.5, 0, 0.1), (0.9, 0, 0.1)), section=SECTION, material=RUBBER)
            scene.join([(0, -1), (1, 0)])
        integrator, before, after = run(scene, device)
        force, moment = balance(integrator, before, after, DT)
        assert force < 1e-9
        assert moment < 1e-9


def lying(obstacle=None, rods=1, motion=None, height=0.011, **contact):
    """Return a scene of rods that a grip draws over an obstacle."""
    scene = ddg.Scene(gravity=(0.0, 0.3, -9.81), mass_damping=0.8)
    for i in range(rods):
        rod = scene.add_rod(line((0, 0.1 * i, height), (0.5, 0.1 * i, height)), section=SECTION, material=RUBBER)
        scene.clamp_end(rod, motion=ddg.Motion(lambda t: (0.05 * t, 0.02 * t, 0.0)))
    scene.contact(**contact)
    if obstacle is not None:
        scene.add_obstacle(obstacle, motion=motion)
    return scene


OBSTACLES = {
    "plane": (ddg.Plane(), None),
    "sphere": (
        ddg.Sphere((0.3, 0.0, -0.1), 0.1),
        ddg.Motion(angle=lambda t: 3.0 * t, axis=(0.0, 1.0, 0.0), pivot=(0.3, 0.0, -0.1)),
    ),
    "box": (ddg.Box((0.3, 0.0, -0.05), (0.1, 0.1, 0.05)), ddg.Motion(lambda t: (0.0, 0.0, 0.01 * t))),
}


@pytest.mark.parametrize("name", OBSTACLES)
@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_wrenches_of_obstacles(device, name, friction):
    """Include contact and friction on obstacles, moved ones too, in the balance."""
    obstacle, motion = OBSTACLES[name]
    scene = lying(obstacle, 2, motion, friction=friction)
    integrator, before, after = run(scene, device, steps=1, rtol=1e-11)
    for _ in range(30):
        before, after = after, integrator.step(after, DT)
        if np.abs(integrator.wrenches()[-1].force).max() > 1.0:
            break
    assert np.abs(integrator.wrenches()[-1].force).max() > 1.0
    force, moment = balance(integrator, before, after, DT)
    assert force < 1e-9
    if not friction:  # the model leaves out couples of friction across a rod
        assert moment < 1e-9


def test_wrenches_of_decoupled_steps(device):
    """Step rods out of contact as uncoupled rods; wrenches equal the coupled system's."""
    scene = lying(ddg.Plane(), 3, height=0.2)
    integrator, before, after = run(scene, device)
    assert integrator._coupled.decoupled
    assert balance(integrator, before, after, DT)[0] < 1e-9
    whole = ddg.Integrator(integrator.model, **OPTIONS)
    whole.step_whole()
    whole.watch_wrenches()
    state = integrator.model.state()
    for _ in range(STEPS):
        state = whole.step(state, DT)
    for one, expected in zip(integrator.wrenches(), whole.wrenches(), strict=True):
        np.testing.assert_allclose(one.force, expected.force, atol=1e-8)
        np.testing.assert_allclose(one.moment, expected.moment, atol=1e-9)
        np.testing.assert_allclose(one.point, expected.point, atol=1e-12)


def test_wrenches_are_means_over_substeps(device):
    """Compare the mean wrench over substeps with the change of momentum."""
    scene = ddg.Scene(gravity=(0.3, 0.2, -9.81))
    pendulum(scene)
    integrator, before, after = run(scene, device, steps=3, dt=0.1, max_iterations=4, rtol=1e-9)
    assert integrator._parts[0].islands.substep_fraction.numpy()[0] < 1.0
    force, _ = balance(integrator, before, after, 0.1)
    assert force < 1e-9


@pytest.mark.parametrize("name", [*SCENES, "lying"])
def test_wrenches_of_equilibria_are_reactions(device, name):
    """A step from an equilibrium at rest exerts the reactions of that equilibrium."""
    scene = ddg.Scene(gravity=(0.3, 0.2, -9.81))
    if name == "lying":
        scene = lying(ddg.Plane(), height=0.0105)
    else:
        SCENES[name](scene)
    for supports in (scene.supports, scene.shell_supports):
        supports[:] = [dataclasses.replace(support, motion=None) for support in supports]
    model = scene.build(device, "float64")
    state = statics.solve(model, rtol=1e-10)
    model.update_strains(state)
    integrator = ddg.Integrator(model, **(OPTIONS | {"rtol": 1e-10}))
    integrator.watch_wrenches()
    state = integrator.step(state, 1e-3)
    reactions = model.reactions(state)
    size = max(np.abs(reaction.force).max() for reaction in reactions)
    for wrench, reaction in zip(integrator.wrenches(), reactions, strict=True):
        np.testing.assert_allclose(wrench.force, reaction.force, atol=1e-5 * size)
        np.testing.assert_allclose(wrench.moment, reaction.moment, atol=1e-5 * size)
        np.testing.assert_allclose(wrench.point, reaction.point)


@pytest.mark.parametrize("name", ["pinned", "joined", "midedge_dof", "lying"])
def test_worlds_have_the_wrenches_of_single_models(device, name):
    """Compare wrenches of worlds with a model of one world, bit by bit, and with a repetition."""
    scene = ddg.Scene(gravity=(0.3, 0.2, -9.81), mass_damping=0.8)
    if name == "lying":
        scene = lying(*OBSTACLES["box"][:1], 2, friction=0.3)
    else:
        SCENES[name](scene)
    results = []
    for worlds in (1, 1, 3):
        model = scene.build(device, "float64", worlds=worlds)
        integrator, state = ddg.Integrator(model), model.state()
        integrator.watch_wrenches()
        for _ in range(4):
            state = integrator.step(state, DT)
        results.append(integrator.wrenches())
    for single, again, several in zip(*results, strict=True):
        for values in ("force", "moment", "point"):
            np.testing.assert_array_equal(getattr(single, values), getattr(again, values))
            for world in getattr(several, values):
                np.testing.assert_array_equal(getattr(single, values), world)


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_wrenches_in_other_precisions(device, precision):
    for name in ("pendulum", "joined"):
        scene = ddg.Scene(gravity=(0.3, 0.2, -9.81), mass_damping=0.8)
        SCENES[name](scene)
        tolerance = 1e-8 if precision == "mixed" else 5e-3
        options = {"rtol": 1e-12} if precision == "mixed" else {"rtol": 1e-4}
        integrator, before, after = run(scene, device, precision=precision, **options)
        assert_balanced(integrator, before, after, tolerance=tolerance)


def test_wrenches_must_be_watched(device):
    scene = ddg.Scene()
    pendulum(scene)
    with pytest.raises(ddg.SceneError, match="watch_wrenches"):
        ddg.Integrator(scene.build(device)).wrenches()


def test_scenes_without_supports_have_no_wrenches(device):
    scene = ddg.Scene()
    scene.add_rod(line((0, 0, 0), (0.5, 0, 0)), section=SECTION, material=RUBBER)
    integrator, _, after = run(scene, device, steps=1)
    assert integrator.wrenches() == []
    assert integrator.model.reactions(after) == []
