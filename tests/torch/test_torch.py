"""The simulator as a torch module: gradients of everything that goes in, transforms, batches."""

import copy
import os
import pickle
import time

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.adjoint import linear_solve
from ddg_warp.errors import SceneError
from ddg_warp.geometry import meshes
from tests.adjoint import differences
from tests.adjoint.differences import CLOSE, SIDES, TIGHT, WEIGHTS, built
from tests.adjoint.test_adjoint import CURVE, DT, SCENES, SOFT, a_scene

torch = pytest.importorskip("torch")
from ddg_warp.torch import RodParameters, ShellParameters, Simulator  # noqa: E402
from tests.pairwise import chosen, covering  # noqa: E402

STIFFNESS = {
    "twisted": "rod_bend_twist.stiffness_1",
    "planar": "planar_bend.stiffness",
    "joined": "rod_bend_twist.stiffness_1",
    "sheet": "shell_stretch.stiffness",
}


def simulator(name: str, **options) -> Simulator:
    return Simulator(built(SCENES[name]()), DT, **TIGHT, **options)


def gripped(scheme: str = "implicit_euler") -> Simulator:
    """A rod fixed at both ends, one of which a grip translates and rotates."""
    scene = a_scene()
    rod = scene.add_rod(CURVE, section=ddg.Ellipse(0.004, 0.003), material=SOFT)
    scene.clamp(rod, motion=ddg.Grip(pivot=(0.1, 0.0, 0.0)))
    scene.clamp(rod, edges=[-1])
    return Simulator(built(scene), DT, scheme=scheme, **TIGHT)


def normal(*shape: int):
    """Normal numbers, the same on every device."""
    return torch.randn(shape, dtype=torch.float64, device="cpu").to(differences.DEVICE)


def check(loss, values: dict, sizes: dict) -> None:
    """Compare the gradient of loss(**values) with central differences of fourth order, along the sum of random directions.

    Steps in all inputs change the loss alike, but none is above ten times its size in `sizes`. Where the two differ, each input is
    compared alone.
    """
    values = {name: value.clone().requires_grad_() for name, value in values.items()}
    gradients = torch.autograd.grad(loss(**values), values.values())
    torch.manual_seed(3)
    steps, changes = {}, {}
    for (name, value), gradient in zip(values.items(), gradients, strict=True):
        direction = torch.rand(value.shape, dtype=value.dtype, device="cpu").to(value.device)
        steps[name] = sizes[name] * direction * torch.where(gradient < 0.0, -1.0, 1.0) * (gradient != 0.0)
        changes[name] = float((gradient * steps[name]).sum())

    def difference(steps: dict) -> float:
        with torch.no_grad():
            losses = {
                x: float(loss(**(values | {n: values[n] + x * step for n, step in steps.items()}))) for x in SIDES
            }
        return sum(weight * losses[x] for x, weight in zip(SIDES, WEIGHTS, strict=True))

    if len(values) > 1:
        usual = np.median(np.abs(list(changes.values())))
        factors = {name: min(usual / abs(change), 10.0) if change else 1.0 for name, change in changes.items()}
        wanted = sum(factors[name] * change for name, change in changes.items())
        if wanted == pytest.approx(difference({name: factors[name] * steps[name] for name in steps}), rel=CLOSE):
            return
    for name, change in changes.items():
        assert change == pytest.approx(difference({name: steps[name]}), rel=CLOSE), name


@pytest.mark.parametrize("name", STIFFNESS)
def test_every_input_has_a_gradient(name):
    sim, term = simulator(name), STIFFNESS[name]
    first = torch.tensor(sim.model.state().points())
    flat = torch.tensor([1.0, 0.0, 1.0] if name == "planar" else [1.0, 1.0, 1.0])
    torch.manual_seed(1)
    force = 1e-3 * normal(2, len(first), 3) * flat
    weight = normal(len(first), 3)

    def loss(positions, velocities, stiffness, forces, gravity):
        state = sim.initial_state(positions=positions, velocities=velocities)
        *_, state = sim.rollout(state, {term: stiffness}, {"forces": forces, "gravity": gravity}, steps=3)
        return (weight * state.positions).sum() + 0.1 * (state.velocities**2).sum()

    values = {
        "positions": first.expand(2, -1, -1),
        "velocities": torch.zeros((2, len(first), 3), dtype=torch.float64),
        "stiffness": sim.parameter(term, 2),
        "forces": force,
        "gravity": torch.tensor([[0.0, 0.0, -9.81], [1.0, 0.0, -5.0]], dtype=torch.float64),
    }
    sizes = {"positions": 1e-7, "velocities": 1e-5, "forces": 1e-5, "gravity": 1e-2}
    check(loss, values, sizes | {"stiffness": 1e-3 * float(values["stiffness"].max())})


@pytest.mark.parametrize("scheme", ["implicit_euler", "implicit_midpoint"])
def test_poses_and_moments_have_gradients(scheme):
    """Gradients of steps with poses, and of a step that keeps the last poses."""
    sim = gripped(scheme)

    def loss(poses, moments):
        state = sim.initial_state(2)
        for number in range(3):
            state = sim.step(state, None, {"poses": poses * (number + 1), "moments": moments})
        state = sim.step(state)
        return (state.positions**2).sum() + 0.1 * (state.angles[:, 1:-1]).sum() + 0.01 * (state.velocities**2).sum()

    poses = torch.tensor([[[0.001, 0.002, -0.001, 0.02, 0.01, 0.03]], [[0.0, 0.001, 0.0, 0.05, -0.04, 0.01]]])
    moments = 1e-6 * torch.ones((2, len(CURVE) - 1))
    check(loss, {"poses": poses.double(), "moments": moments.double()}, {"poses": 1e-6, "moments": 1e-8})


@pytest.mark.parametrize("shape", [(), (2, 1), (1, 9), (2, 9)])
def test_gradients_have_the_shape_of_the_input(shape):
    sim = simulator("twisted")
    values = sim.parameter("rod_stretch.stiffness", 2).mean() * torch.ones(shape, dtype=torch.float64)
    values.requires_grad_()
    state = sim.step(sim.initial_state(2), {"rod_stretch.stiffness": values})
    (gradient,) = torch.autograd.grad((state.positions**2).sum(), values)
    whole = sim.parameter("rod_stretch.stiffness", 2).mean().expand(2, 9).clone().requires_grad_()
    again = sim.step(sim.initial_state(2), {"rod_stretch.stiffness": whole})
    (wide,) = torch.autograd.grad((again.positions**2).sum(), whole)
    assert gradient.shape == shape
    torch.testing.assert_close(gradient, wide.sum_to_size(shape), rtol=1e-10, atol=0.0)


def test_elements_are_counted_rod_by_rod():
    """The stretch of one edge of the second rod moves that rod alone."""
    sim = simulator("twisted")
    rest = torch.zeros((1, 9), dtype=torch.float64, requires_grad=True)
    state = sim.step(sim.initial_state(), {"rod_stretch.rest": rest})
    (gradient,) = torch.autograd.grad((state.positions[0, len(CURVE) :] ** 2).sum(), rest)
    assert (gradient[0, :5] == 0.0).all()
    assert (gradient[0, 5:] != 0.0).all()


@pytest.mark.parametrize("name", ["twisted", "joined"])
def test_transforms(name):
    """vmap maps a batch to worlds; grad and vmap of grad equal a loop of backward passes."""
    sim, term = simulator(name), STIFFNESS[name]

    def loss(stiffness, velocities):
        *_, state = sim.rollout(sim.initial_state(1, velocities=velocities), {term: stiffness}, steps=2)
        return (state.positions**2).sum() + (state.velocities**2).sum()

    stiffness = sim.parameter(term)[0, 0] * torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    points = sim.model.points_count
    velocities = torch.zeros((3, points, 3), dtype=torch.float64)
    one = [torch.func.grad(loss)(k, v) for k, v in zip(stiffness, velocities, strict=True)]
    many = torch.func.vmap(torch.func.grad(loss))(stiffness, velocities)
    torch.testing.assert_close(many, torch.stack(one), rtol=1e-9, atol=0.0)
    values = torch.func.vmap(loss)(stiffness, velocities)
    torch.testing.assert_close(values, torch.stack([loss(k, v) for k, v in zip(stiffness, velocities, strict=True)]))


def test_checkpoints_change_nothing():
    sim = simulator("twisted")
    result = []
    for every in (None, 1, 3):
        stiffness = torch.tensor(1.5e-4, dtype=torch.float64, requires_grad=True)
        states = sim.rollout(
            sim.initial_state(), {STIFFNESS["twisted"]: stiffness}, steps=7, save=2, checkpoint_every=every
        )
        assert len(states) == 3
        (gradient,) = torch.autograd.grad(sum((state.positions**2).sum() for state in states), stiffness)
        result.append(float(gradient))
    assert result[0] == result[1] == result[2]


def test_rollouts_store_as_much_as_memory_allows():
    sim = simulator("twisted")
    state, steps = sim.initial_state(batch=3), 30
    all_of_it = sim.plan(state, steps=steps).memory
    result = []
    for memory in (None, all_of_it, 0.5 * all_of_it):
        planned = sim.plan(state, steps=steps, save=steps, memory=memory)
        assert (planned.every is None) == (memory != 0.5 * all_of_it)
        stiffness = torch.tensor(1.5e-4, dtype=torch.float64, requires_grad=True)
        saved = {}

        def keep(tensor, saved=saved):
            saved[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            options = {"steps": steps, "save": steps, "memory": memory}
            (end,) = sim.rollout(state, {STIFFNESS["twisted"]: stiffness}, **options)
        fixed = sum(value.untyped_storage().nbytes() for value in state.values) + 1000  # the start, and the parameters
        if planned.every is None:  # with checkpoints torch saves none of them here
            assert planned.memory <= sum(saved.values()) + fixed and sum(saved.values()) <= planned.memory + fixed
        assert planned.memory <= (memory or all_of_it)
        result.append(float(torch.autograd.grad((end.positions**2).sum(), stiffness)[0]))
    assert result[0] == result[1] == result[2]
    with pytest.raises(SceneError, match="rollout: 30 steps hold"):
        sim.rollout(state, steps=steps, memory=0.1 * all_of_it)


def test_steps_are_those_of_the_integrator():
    sim, model = simulator("joined"), built(SCENES["joined"]())
    integrator, state = ddg.Integrator(model, **TIGHT), model.state()
    tensors = sim.initial_state()
    for _ in range(4):
        state, tensors = integrator.step(state, DT), sim.step(tensors)
    np.testing.assert_array_equal(tensors.positions[0].cpu().numpy(), state.points())
    np.testing.assert_array_equal(tensors.velocities[0].cpu().numpy(), state.velocities())
    np.testing.assert_array_equal(tensors.angles[0].cpu().numpy(), state.angles())


@pytest.mark.parametrize(
    ("name", "scheme"), [("twisted", "implicit_euler"), ("joined", "implicit_euler"), ("joined", "implicit_midpoint")]
)
def test_a_world_without_a_gradient_says_so_alone(name, scheme):
    """One of two worlds is thrown so fast that its step takes substeps."""
    sim = Simulator(built(SCENES[name]()), 0.02, max_iterations=4, scheme=scheme)
    points = sim.model.points_count
    speed = torch.zeros((2, points, 3), dtype=torch.float64)
    torch.manual_seed(0)
    speed[1, 2:] = normal(points - 2, 3)
    speed.requires_grad_()
    state = sim.step(sim.initial_state(velocities=speed))
    (gradient,) = torch.autograd.grad((state.positions**2).sum(), speed)
    assert torch.isfinite(gradient[0]).all()
    assert torch.isnan(gradient[1]).any()
    assert torch.isfinite(state.positions).all()
    still = torch.zeros_like(speed).requires_grad_()
    (gradient,) = torch.autograd.grad((sim.step(sim.initial_state(velocities=still)).positions ** 2).sum(), still)
    assert torch.isfinite(gradient).all()
    for rod_adjoint in sim.engine(2).adjoint.rod_adjoints:  # NaN do not stay in the padding of shorter rods either
        assert all(np.isfinite(array.numpy()).all() for array in rod_adjoint._start_state.arrays().values())


def test_twice_and_forward_mode_are_refused():
    sim = simulator("planar")
    k = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    state = sim.step(sim.initial_state(), {STIFFNESS["planar"]: k})
    (gradient,) = torch.autograd.grad((state.positions**2).sum(), k, create_graph=True)
    with pytest.raises(NotImplementedError, match="first derivatives alone"):
        gradient.backward()
    with pytest.raises(NotImplementedError, match="no forward-mode derivatives"):
        torch.func.jvp(
            lambda k: sim.step(sim.initial_state(), {STIFFNESS["planar"]: k}).positions, (k.detach(),), (k.detach(),)
        )


def test_missing_inputs_default_to_the_model():
    sim = simulator("twisted")
    usual = sim.step(sim.initial_state()).positions
    soft = sim.step(sim.initial_state(), {STIFFNESS["twisted"]: 1e-6}).positions
    again = sim.step(sim.initial_state(), {"rod_stretch.viscosity": 0.01}).positions
    assert (soft != usual).any()
    torch.testing.assert_close(again, usual, rtol=0.0, atol=0.0)


def resting(name: str) -> Simulator:
    scene = SCENES[name]()
    if name == "twisted":
        scene.fix(1, [-1])
    return Simulator(built(scene), DT)


@pytest.mark.parametrize("name", ["twisted", "sheet"])
def test_equilibria(name):
    sim, term = resting(name), STIFFNESS[name]

    def loss(stiffness):
        return (sim.equilibrium({term: stiffness}, batch=2, rtol=1e-12).positions ** 2).sum()

    values = sim.parameter(term, 2) * torch.tensor([[1.0], [2.0]])
    check(loss, {"stiffness": values}, {"stiffness": 1e-2 * float(values.max())})


@chosen(["planar"], name=STIFFNESS)
def test_equilibria_are_those_of_a_new_simulator(name):
    """Bit for bit, by each parameter that is not zero, after one by other values of it."""
    sim = resting(name)
    for parameter in sim.engine(1).tables.names():
        values = sim.parameter(parameter)
        if not values.any():
            continue
        sim.equilibrium({parameter: values})
        result, wanted = (each.equilibrium({parameter: 1.3 * values}).positions for each in (sim, resting(name)))
        torch.testing.assert_close(result, wanted, rtol=0.0, atol=0.0)


@covering(1, name=STIFFNESS, end=(1.0, 0.7))
def test_equilibria_under_controls(name, end):
    """Gradients of equilibria of two worlds by loads, scaled by the load parameter, and a stiffness."""
    sim, term = resting(name), STIFFNESS[name]
    points, edges = sim.model.points_count, sim.model.order.edges_count
    flat = torch.tensor([1.0, 0.0, 1.0] if name == "planar" else [1.0, 1.0, 1.0])
    torch.manual_seed(1)
    weight = normal(points, 3)
    values = {
        "forces": 1e-3 * normal(2, points, 3) * flat,
        "gravity": torch.tensor([[0.0, 0.0, -9.81], [1.0, 0.0, -5.0]], dtype=torch.float64),
        "stiffness": sim.parameter(term, 2),
    }
    sizes = {"forces": 1e-5, "gravity": 1e-2, "stiffness": 1e-2 * float(values["stiffness"].max())}
    if name in ("twisted", "joined"):
        values["moments"], sizes["moments"] = 1e-5 * normal(2, edges), 1e-7

    def loss(stiffness, **controls):
        result = sim.equilibrium({term: stiffness}, controls, batch=2, rtol=1e-13, end=end)
        return (weight * result.positions).sum()

    check(loss, values, sizes)


def pressed_by_a_grip(scene):
    """A sheet under follower pressure, whose first vertices and normals a grip prescribes."""
    points, triangles = meshes.rectangle(3, 2, (0.3, 0.2))
    shell = scene.add_shell(points, triangles, thickness=0.004, material=SOFT)
    scene.clamp_boundary(shell, np.flatnonzero(points[:, 0] <= 0.0), motion=ddg.Grip())
    scene.add_pressure(shell, 5.0)


def gripped_joint(scene):
    """Two rods joined rigidly, of which a grip clamps the first."""
    rods = [
        scene.add_rod(CURVE + shift, section=ddg.Ellipse(0.004, 0.003), material=SOFT)
        for shift in (0.0, CURVE[-1] - CURVE[0])
    ]
    scene.join([(rods[0], -1), (rods[1], 0)])
    scene.clamp(rods[0], motion=ddg.Grip())


@pytest.mark.parametrize("hold", [None, gripped_joint, pressed_by_a_grip], ids=["rod", "joined", "sheet"])
def test_equilibria_by_poses(hold):
    """Gradients by poses next to moments on edges moved by a grip, and follower loads on them."""
    sim, scene = gripped(), a_scene()
    if hold:
        hold(scene)
        sim = Simulator(built(scene), DT)
    torch.manual_seed(2)
    weight = normal(sim.model.points_count, 3)
    poses = torch.tensor([[[0.001, 0.002, -0.001, 0.02, 0.01, 0.03]], [[0.0, 0.001, 0.0, 0.05, -0.04, 0.01]]])
    values, sizes = {"poses": poses.double()}, {"poses": 1e-5}
    if hold is not pressed_by_a_grip:
        moments = 1e-4 * torch.ones((2, sim.model.order.edges_count), dtype=torch.float64)
        values["moments"], sizes["moments"] = moments, 1e-7

    def loss(**controls):
        return (weight * sim.equilibrium(None, controls, batch=2, rtol=1e-13, load_steps=2).positions).sum()

    check(loss, values, sizes)


def test_an_equilibrium_under_controls_repeats():
    """Bit for bit, with its gradients; and is that of the model without them where they are zero."""
    sim = resting("joined")
    forces = 1e-3 * torch.ones((2, sim.model.points_count, 3), dtype=torch.float64)
    forces.requires_grad_()

    def once():
        result = sim.equilibrium(None, {"forces": forces}, batch=2).positions
        return result, *torch.autograd.grad((result**2).sum(), forces)

    for first, second in zip(once(), once(), strict=True):
        torch.testing.assert_close(first, second, rtol=0.0, atol=0.0)
    plain = sim.equilibrium(batch=2).positions
    still = sim.equilibrium(None, {"forces": 0.0 * forces}, batch=2).positions
    torch.testing.assert_close(still, plain, rtol=0.0, atol=0.0)
    assert (once()[0] != plain).any()


def test_copies_and_pickles():
    sim = simulator("twisted")
    factors = RodParameters(sim)
    second = pickle.loads(pickle.dumps(sim))
    for each in (copy.deepcopy(sim), second):
        state = each.step(each.initial_state(), copy.deepcopy(factors)())
        torch.testing.assert_close(
            state.positions, sim.step(sim.initial_state(), factors()).positions, rtol=0.0, atol=0.0
        )
    again = RodParameters(sim)
    with torch.no_grad():
        factors.logarithms["bending"] += 0.3
    again.load_state_dict(factors.state_dict())
    torch.testing.assert_close(again()["rod_bend_twist.stiffness_1"], factors()["rod_bend_twist.stiffness_1"])


@pytest.mark.parametrize("name", ["lone", "joined"])
def test_parameters_of_the_model_go_into_other_worlds(name):
    """Element values set before the simulator exists apply to all worlds and pickles, and not to the scene."""
    sim, stiffness = gripped() if name == "lone" else simulator(name), "rod_bend_twist.stiffness_2"
    values = np.linspace(1.0, 2.0, sim.parameter(stiffness).shape[1]) * float(sim.parameter(stiffness)[0, 0])
    sim.model.set_parameter(*stiffness.split("."), values)
    wanted = torch.tensor(values).expand(3, -1)
    for each in (sim, pickle.loads(pickle.dumps(sim)), copy.deepcopy(sim)):
        torch.testing.assert_close(each.parameter(stiffness, 3), wanted, rtol=0.0, atol=0.0)
    two = sim.model.scene.build(device=differences.DEVICE, precision="float64", worlds=2)
    two.set_parameter(*stiffness.split("."), values[:2])
    with pytest.raises(SceneError, match="stiffness_2 differs between the 2 worlds"):
        Simulator(two, DT).parameter(stiffness, 3)


def test_rest_shapes_of_the_model_go_along():
    """Rest shapes go into pickles and other worlds; shell modules start from them."""
    model = SCENES["sheet"]().build(device=differences.DEVICE, precision="float64")
    model.set_rest(0, points=model.state().points() * [1.2, 1.1, 0.5])
    sim, usual = Simulator(model, DT, **TIGHT), simulator("sheet")
    second = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(sim))))
    with torch.no_grad():
        plain, moved, again, wide = (
            each.step(each.initial_state(worlds)).positions
            for each, worlds in ((usual, 1), (sim, 1), (second, 1), (sim, 3))
        )
        metrics = [ShellParameters(each, ("metric",)).quantities()["metric"] for each in (sim, second)]
    assert float((moved - plain).abs().max()) > 1e-6
    torch.testing.assert_close(again, moved, rtol=0.0, atol=0.0)
    torch.testing.assert_close(wide, moved.expand(3, -1, -1), rtol=0.0, atol=0.0)
    torch.testing.assert_close(metrics[1], metrics[0], rtol=0.0, atol=0.0)


def test_stiffnesses_are_identified():
    """Motion of a rod identifies three stiffnesses by gradients of their logarithms."""
    sim = simulator("twisted")
    truth = {"bending": 0.7, "twisting": 1.4}
    factors = RodParameters(sim, names=tuple(truth))
    with torch.no_grad():
        for name, value in truth.items():
            factors.logarithms[name].fill_(np.log(value))
    recorded = [s.positions.detach() for s in sim.rollout(sim.initial_state(), factors(), steps=10)]
    with torch.no_grad():
        for name in truth:
            factors.logarithms[name].zero_()
    optimiser = torch.optim.LBFGS(
        factors.parameters(),
        lr=1.0,
        max_iter=60,
        tolerance_grad=1e-14,
        tolerance_change=1e-16,
        line_search_fn="strong_wolfe",
    )

    def closure():
        optimiser.zero_grad()
        states = sim.rollout(sim.initial_state(), factors(), steps=10)
        loss = 1e10 * sum(((s.positions - r) ** 2).sum() for s, r in zip(states, recorded, strict=True))
        loss.backward()
        return loss

    optimiser.step(closure)
    for name, value in truth.items():
        assert float(factors.logarithms[name].exp()) == pytest.approx(value, rel=1e-3)


@pytest.mark.parametrize(
    ("parameters", "controls", "message"),
    [
        ({"rod_bend.stiffness": 1.0}, None, "no object has 'rod_bend.stiffness'; this model has rod_bend_twist"),
        (
            {"rod_stretch.stiffness": torch.ones(4)},
            None,
            r"rod_stretch.stiffness has shape \(4,\); give \(\), \(2, 1\)",
        ),
        (None, {"force": torch.zeros(3)}, "there is no 'force'; there are angles, torques, wrenches, forces"),
        (None, {"gravity": torch.zeros(4)}, r"gravity have shape \(4,\); they are \(3,\) or \(2, 3\)"),
        (None, {"poses": torch.zeros((0, 6))}, "poses of no grip"),
        ([1.0], None, r"parameters are \[1.0\]; give a dictionary"),
        (None, torch.zeros(3), "controls are tensor.*give a dictionary"),
        ({"rod_stretch": 1.0}, None, "no object has 'rod_stretch'; this model has"),
        (
            {"rod_stretch.stiffness": "stiff"},
            None,
            "rod_stretch.stiffness is 'stiff', no array of numbers; give numbers",
        ),
        ({"rod_stretch.stiffness": -1.0}, None, "rod_stretch.stiffness: value 0 is -1; it is finite and not negative"),
        ({"rod_stretch.measure": [[1.0], [0.0]]}, None, "rod_stretch.measure: value 1 is 0; it is finite and positive"),
        ({"rod_stretch.rest": np.nan}, None, "rod_stretch.rest: value 0 is nan; it is finite"),
        (None, {"gravity": (0.0, np.nan, 0.0)}, "gravity: entry 1 is not finite"),
        (None, {"forces": "none"}, "controls: forces is 'none', no array of numbers; give numbers or a tensor"),
    ],
)
def test_invalid_inputs_are_refused(parameters, controls, message):
    sim = simulator("twisted")
    with pytest.raises(SceneError, match=message):
        sim.step(sim.initial_state(2), parameters, controls)


@covering(1, solver=("sweep", "cyclic_reduction"), case=((1e7, 0.02), (1e11, 0.002)))
def test_mixed_precision_solves_adjoints_in_float64(monkeypatch, case, solver):
    """Gradients by velocities are dt times the adjoint: in float32 its rounding would leave errors of 1e-4."""
    young, radius = case
    monkeypatch.setattr(linear_solve, "automatic", lambda group: solver)
    scene, points = ddg.Scene(gravity=(0.0, 0.0, -9.81)), np.zeros((24, 3))
    points[:, 0] = np.linspace(0.0, 1.0, len(points))
    material = ddg.Material(young=young, poisson=0.5, density=1000.0)
    scene.clamp(scene.add_rod(points, section=ddg.Circle(radius), material=material, natural=(0.5, 0.2, 0.7)))
    gradients = []
    for precision in ("float64", "mixed"):
        sim = Simulator(scene.build(device=differences.DEVICE, precision=precision), 0.005, rtol=1e-12)
        rest = sim.initial_state()
        thrown = torch.zeros_like(rest.positions)
        thrown[..., 2] = rest.positions[..., 0] ** 2
        thrown.requires_grad_()
        *_, state = sim.rollout(sim.initial_state(velocities=thrown), steps=20)
        gradients.append(torch.autograd.grad(((state.positions - rest.positions) ** 2).sum(), thrown)[0].cpu().numpy())
    exact, result = gradients
    assert np.linalg.norm(result - exact) < 1e-6 * np.linalg.norm(exact)


@chosen(["twisted", "sheet"], name=("twisted", "joined", "planar", "sheet"))
def test_mixed_precision_is_close_to_float64(name):
    """Gradients agree with float64 within 1e-4."""
    gradients = []
    for precision in ("float64", "mixed"):
        scene = SCENES[name]()
        sim = Simulator(scene.build(device=differences.DEVICE, precision=precision), DT, rtol=1e-9)
        stiffness = sim.parameter(STIFFNESS[name]).requires_grad_()
        *_, state = sim.rollout(sim.initial_state(), {STIFFNESS[name]: stiffness}, steps=5)
        gradients.append(torch.autograd.grad((state.positions**2).sum(), stiffness)[0])
    assert float((gradients[1] - gradients[0]).abs().max()) < 1e-4 * float(gradients[0].abs().max())


def test_compiled_functions_go_on_around_steps():
    sim, term = simulator("twisted"), STIFFNESS["twisted"]

    def loss(stiffness):
        state = sim.step(sim.initial_state(), {term: stiffness * 2.0})
        return (torch.sin(state.positions) ** 2).sum()

    stiffness = torch.tensor(1e-4, dtype=torch.float64, requires_grad=True)
    compiled = torch.compile(loss, backend="aot_eager")
    (result,) = torch.autograd.grad(compiled(stiffness), stiffness)
    (wanted,) = torch.autograd.grad(loss(stiffness), stiffness)
    torch.testing.assert_close(result, wanted)


def _learn(rank: int, folder: str, out: str, cuda: bool) -> None:
    """Run one of two processes with a common parameter and one world and GPU each: half a descent step."""
    import torch.distributed as dist

    if cuda:
        differences.DEVICE = f"cuda:{rank}"
        torch.cuda.set_device(rank)
    dist.init_process_group("nccl" if cuda else "gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    sim = simulator("twisted")
    module = torch.nn.parallel.DistributedDataParallel(RodParameters(sim, names=("bending",)))
    speed = torch.full((1, sim.model.points_count, 3), 0.1 * (rank + 1.0), dtype=torch.float64)
    state = sim.step(sim.initial_state(velocities=speed), module())
    (state.positions**2).sum().backward()
    torch.save(module.module.logarithms["bending"].grad.cpu(), f"{out}{rank}")
    while not all(os.path.exists(f"{out}{second}") for second in range(2)):
        time.sleep(0.01)
    # torch 2.13 can wait for ever where it takes a group apart: that holds the lock that a thread of gloo's waits for
    os._exit(0)


def test_two_processes_share_a_gradient(tmp_path, device):
    """DistributedDataParallel averages the gradients of both processes."""
    cuda = device != "cpu"
    if cuda and torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    torch.multiprocessing.spawn(_learn, (str(tmp_path), str(tmp_path / "gradient"), cuda), nprocs=2)
    result = [torch.load(tmp_path / f"gradient{rank}") for rank in range(2)]
    torch.testing.assert_close(result[0], result[1], rtol=0.0, atol=0.0)
    sim, factors = simulator("twisted"), None
    total = 0.0
    for rank in range(2):
        factors = RodParameters(sim, names=("bending",))
        speed = torch.full((1, sim.model.points_count, 3), 0.1 * (rank + 1.0), dtype=torch.float64)
        state = sim.step(sim.initial_state(velocities=speed), factors())
        (state.positions**2).sum().backward()
        total = total + 0.5 * factors.logarithms["bending"].grad.cpu()
    torch.testing.assert_close(result[0], total, rtol=1e-10, atol=0.0)


@pytest.mark.gpu
def test_steps_run_on_the_stream_that_torch_uses():
    """A side stream orders steps after its pending writes, and its reads after the steps."""
    sim = simulator("twisted")
    first = sim.step(sim.initial_state()).positions
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        speed = torch.zeros((1, sim.model.points_count, 3), dtype=torch.float64)
        torch.cuda._sleep(50_000_000)
        speed += 1.0
        speed.requires_grad_()
        state = sim.step(sim.initial_state(velocities=speed - 1.0))
        (gradient,) = torch.autograd.grad((state.positions**2).sum(), speed)
        result, slope = state.positions.clone(), gradient.abs().sum()
    side.synchronize()
    torch.testing.assert_close(result, first, rtol=0.0, atol=0.0)
    assert float(slope) > 0.0


def test_calls_that_do_not_fit_are_refused():
    sim, planar = simulator("twisted"), simulator("planar")
    state = sim.initial_state()
    force = np.ones((planar.model.points_count, 3))
    for call, message in (
        (lambda: sim.step(None), "the state is None; take one that initial_state"),
        (lambda: planar.step(state), "the state is loaded, or another simulator's"),
        (lambda: sim.initial_state(0), "batch = 0"),
        (lambda: sim.initial_state(positions="here"), "positions are 'here'; give finite numbers"),
        (lambda: sim.rollout(state, steps=3, checkpoint_every=-1), "checkpoint_every = -1"),
        (lambda: Simulator(sim.model, DT, scheme="leapfrog"), "scheme is 'leapfrog'"),
        (lambda: planar.step(planar.initial_state(), None, {"forces": force}), "point 0 stays in the plane of x and z"),
    ):
        with pytest.raises(SceneError, match=message):
            call()


@pytest.mark.parametrize("name", ["twisted", "joined"])
def test_states_of_the_model_step_as_in_its_integrator(name):
    """Translated, rotated and moving states of damped rods in two worlds equal the integrator's step by step."""
    model = SCENES[name]().build(device=differences.DEVICE, precision="float64", worlds=2)
    sim = Simulator(model, DT, **TIGHT)
    random = np.random.default_rng(5)
    points = model.state().points()
    state = model.state(
        points + 1e-3 * random.normal(size=points.shape),
        0.1 * random.normal(size=points.shape),
        angles=0.2 * random.normal(size=(2, model.order.edges_count)),
    )
    world, integrator = sim.world_state(state), ddg.Integrator(model, **TIGHT)
    torch.testing.assert_close(world.angles, torch.tensor(state.angles()), rtol=0.0, atol=0.0)
    for _ in range(3):
        state, world = integrator.step(state, DT), sim.step(world)
    torch.testing.assert_close(world.positions, torch.tensor(state.points()), rtol=0.0, atol=1e-12)
    torch.testing.assert_close(world.angles, torch.tensor(state.angles()), rtol=0.0, atol=1e-10)
    assert all(a.equal(b) for a, b in zip(sim.world_state(world).values, world.values, strict=True))
    with pytest.raises(ValueError, match="angles have shape"):
        model.state(angles=np.zeros(1))
