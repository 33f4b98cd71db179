"""Values from torch are validated as by `Model.set_parameter`; failed worlds and missing gradients are reported."""

import copy
import io
import pickle
import threading
import warnings

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import GradientWarning, SceneError
from tests.adjoint import differences

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator, WorldState  # noqa: E402
from ddg_warp.torch.gradient_check_scenes import scene_of  # noqa: E402
from tests.pairwise import covering  # noqa: E402

REAL = torch.float64
INVALID = {"nan": float("nan"), "inf": float("inf"), "negative": -1.0}


def simulator(name: str, worlds: int = 1, dt: float = 2e-3, **options) -> Simulator:
    return Simulator(scene_of(name).build(differences.DEVICE, "float64", worlds=worlds), dt, **options)


def gripped(worlds: int = 1, nodes: int = 9, dt: float = 0.02) -> Simulator:
    """A rod of 0.3 m that a grip holds at an end."""
    scene = ddg.Scene()
    points = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), nodes)
    rod = scene.add_rod(points, section=ddg.Circle(0.004), material=ddg.Material(1e6, density=1000.0))
    scene.clamp(rod, motion=ddg.Grip())
    return Simulator(scene.build(differences.DEVICE, "float64", worlds=worlds), dt)


# --- values that parameters may not have ---
@covering(1, name=("rod", "rods joined rigidly", "shell, hinge", "rod with drag", "rods in contact"), value=INVALID)
def test_a_value_that_is_refused_takes_its_world_out_of_the_step(name, value):
    """Invalid values of any parameter fail the second of three worlds with NaN and a named reason.

    The others stay bitwise equal, and the next step succeeds.
    """
    sim = simulator(name, 3)
    start, engine = sim.initial_state(), sim.engine(3)
    for parameter in engine.tables.names():
        if np.isfinite(INVALID[value]) and engine.tables.rule(parameter)[1](np.array(INVALID[value])):
            continue  # this one may be that
        usual = sim.parameter(parameter)
        good = sim.step(start, {parameter: usual})
        values = usual.clone()
        values[1] = INVALID[value]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GradientWarning)
            failed = sim.step(start, {parameter: values})
        codes = ["converged", "invalid_input", "converged"]
        assert failed.outcomes().tolist() == sim.outcomes().tolist() == codes, parameter
        assert failed.failed.tolist() == [False, True, False]
        assert torch.isnan(failed.positions[1]).all() and torch.isnan(failed.velocities[1]).all()
        torch.testing.assert_close(failed.positions[[0, 2]], good.positions[[0, 2]], rtol=0.0, atol=0.0)
        with torch.no_grad():
            after = sim.step(failed, {parameter: usual})  # a failed world stays failed
        assert after.outcomes().tolist() == ["converged", "given_up", "converged"]
        again = sim.step(start, {parameter: usual})
        torch.testing.assert_close(again.positions, good.positions, rtol=0.0, atol=0.0)


def test_plain_numbers_are_refused_as_set_parameter_refuses_them():
    sim = simulator("rod")
    for value in (float("nan"), float("inf"), -1.0, [1.0, -2.0]):
        with pytest.raises(SceneError, match=r"rod_bend_twist\.stiffness_1"):
            sim.step(sim.initial_state(), {"rod_bend_twist.stiffness_1": value})


@pytest.mark.parametrize(
    ("tensor", "said"),
    [
        (torch.ones(1, 1, device="meta"), "meta"),
        (torch.ones(1, 1).to_sparse(), "sparse"),
        (torch.ones(1, 1, dtype=torch.complex64), "complex"),
        (torch.ones(1, 1, dtype=torch.bool), "bool"),
    ],
    ids=["meta", "sparse", "complex", "bool"],
)
def test_tensors_that_hold_no_real_numbers_are_refused(tensor, said):
    sim = simulator("rod")
    start, points = sim.initial_state(), sim.model.points_count
    with pytest.raises(SceneError, match=said):
        sim.step(start, {"rod_bend_twist.stiffness_1": tensor})
    wide = torch.zeros(points, 3).to_sparse() if said == "sparse" else tensor.expand(points, 3)
    with pytest.raises(SceneError, match=said):
        sim.step(start, None, {"forces": wide})
    with pytest.raises(SceneError, match=said):
        sim.initial_state(positions=wide)


def test_an_equilibrium_names_the_world_and_the_parameter():
    sim = simulator("rod", 3)
    values = sim.parameter("rod_bend_twist.stiffness_1").clone()
    values[2] = -1.0
    with pytest.raises(SceneError, match=r"rod_bend_twist\.stiffness_1 is refused in world 2"):
        sim.equilibrium({"rod_bend_twist.stiffness_1": values})


def test_a_control_that_is_no_number_fails_its_world_alone():
    sim = simulator("rods joined rigidly", 3)
    forces = torch.zeros(3, sim.model.points_count, 3, dtype=REAL)
    good = sim.step(sim.initial_state(), None, {"forces": forces})
    forces[1, 0, 2] = torch.nan  # on a fixed node
    failed = sim.step(sim.initial_state(), None, {"forces": forces})
    assert failed.outcomes().tolist() == ["converged", "invalid_input", "converged"]
    assert torch.isnan(failed.positions[1]).all()
    torch.testing.assert_close(failed.positions[[0, 2]], good.positions[[0, 2]], rtol=0.0, atol=0.0)


# --- worlds without a gradient ---
def rotated_grip(sim: Simulator, angles, steps: int = 1):
    """Return poses of a grip rotated by angles (B,) about its y axis, and the states of `steps` steps."""
    poses = torch.zeros(len(angles), 1, 6, dtype=REAL)
    poses[:, 0, 4] = torch.as_tensor(angles)
    poses.requires_grad_()
    states = sim.rollout(sim.initial_state(len(angles)), None, lambda k: {"poses": (k + 1) * poses}, steps=steps)
    return poses, states


def test_worlds_that_lose_their_gradient_are_reported_and_left_out():
    """A world rotated by over 90 degrees in a step has no gradient; masked losses keep the gradients of the others."""
    sim = gripped()
    with pytest.warns(GradientWarning, match="state.differentiable") as caught:
        poses, (end,) = rotated_grip(sim, [0.1, 1.8, 0.2])
        assert sim.outcomes().tolist() == ["converged", "no_gradient", "converged"]  # which waits for the device
        rotated_grip(sim, [0.1, 1.8, 0.2])
    assert len(caught) == 1  # once
    assert end.differentiable.tolist() == [True, False, True]
    assert torch.isfinite(end.positions).all() and not end.failed.any()
    tips = end.positions[:, -1, 2]
    (whole,) = torch.autograd.grad(tips.sum(), poses, retain_graph=True)
    assert torch.isfinite(whole[[0, 2]]).all() and torch.isnan(whole[1]).any()
    (masked,) = torch.autograd.grad((tips * end.differentiable).sum(), poses)
    torch.testing.assert_close(masked[[0, 2]], whole[[0, 2]], rtol=0.0, atol=0.0)
    assert (masked[1] == 0.0).all()


@pytest.mark.parametrize("checkpoint_every", [None, 2])
def test_a_lost_gradient_is_remembered_along_a_rollout(checkpoint_every):
    sim = gripped(dt=0.05)
    poses = torch.zeros(2, 1, 6, dtype=REAL, requires_grad=True)
    rotations = torch.zeros(4, 2, 1, 6, dtype=REAL)
    rotations[1:, 1, 0, 4] = 1.8  # in the second step alone
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GradientWarning)
        start = sim.initial_state(2)
        values = {"steps": 4, "checkpoint_every": checkpoint_every}
        states = sim.rollout(start, None, lambda k: {"poses": poses + rotations[k]}, **values)
    assert [state.differentiable.tolist() for state in states] == [[True, True], *3 * [[True, False]]]
    (result,) = torch.autograd.grad((states[-1].positions.sum((1, 2)) * states[-1].differentiable).sum(), poses)
    assert torch.isfinite(result).all() and (result[1] == 0.0).all() and (result[0] != 0.0).any()
    assert states[-1].detach().differentiable.all()


@pytest.mark.parametrize(
    "name", ["rod", "rods joined rigidly", "shell, hinge", "rods in contact", "held rod that rubs a gripped ball"]
)
def test_worlds_that_failed_spoil_no_gradient_of_others(name):
    """A NaN world that the loss leaves out does not change derivatives by inputs common to all worlds."""
    sim, parameter = simulator(name, 2), None
    for parameter in sim.engine(2).tables.names():
        if parameter.endswith(("stiffness", "stiffness_1")):
            break
    wide = simulator(name, 3)
    result = []
    for each, spoiled in ((sim, False), (wide, True)):
        factor = torch.ones((), dtype=REAL, requires_grad=True)
        value = factor * each.parameter(parameter)
        if spoiled:
            value = torch.cat([value[:1], -value[:1], value[1:2]])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GradientWarning)
            *_, state = each.rollout(each.initial_state(), {parameter: value}, steps=3)
        kept = state.positions[state.differentiable]
        assert len(kept) == 2
        result.append(torch.autograd.grad((kept**2).sum(), factor)[0])
    torch.testing.assert_close(*result, rtol=1e-12, atol=0.0)


def test_outcomes_are_those_of_the_last_batch():
    sim = simulator("rod")
    with pytest.raises(SceneError, match="no step"):
        sim.outcomes()
    for batch in (4, 2):
        sim.step(sim.initial_state(batch))
        assert sim.outcomes().tolist() == ["converged"] * batch


# --- parameters of the model that change between calls ---
@pytest.mark.parametrize("name", ["rod", "rods joined rigidly", "shell, hinge"])
def test_steps_follow_the_model_for_every_batch_size(name):
    """Bit for bit as a new simulator, whether tensors were handed in before or not."""
    sim = simulator(name)
    parameter = next(n for n in sim.engine(1).tables.names() if n.endswith(("stiffness", "stiffness_1")))
    for factor in (1.0, 1.5, 0.7):
        sim.model.set_parameter(*parameter.rsplit(".", 1), factor * float(simulator(name).parameter(parameter).max()))
        fresh = Simulator(sim.model, sim.dt)
        for batch in (1, 2, 3):
            sim.step(sim.initial_state(batch), {parameter: 2.0 * sim.parameter(parameter, batch)})
            first, second = (each.rollout(each.initial_state(batch), steps=2)[-1] for each in (sim, fresh))
            for a, b in zip(first.values, second.values, strict=True):
                torch.testing.assert_close(a, b, rtol=0.0, atol=0.0)


def test_rest_shapes_that_change_are_followed():
    model = scene_of("shell, hinge").build(differences.DEVICE, "float64")
    sim = Simulator(model, 2e-3)
    before = [sim.step(sim.initial_state(batch)).positions for batch in (1, 2)]
    model.set_rest(0, points=1.1 * model.state().points())
    for batch, old in zip((1, 2), before, strict=True):
        result = sim.step(sim.initial_state(batch)).positions
        assert (result != old).any()
        fresh = Simulator(model, 2e-3)
        torch.testing.assert_close(result, fresh.step(fresh.initial_state(batch)).positions, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("checkpoint_every", [None, 2])
def test_a_parameter_that_changes_before_the_reverse_is_refused(checkpoint_every):
    sim = simulator("rod")
    factor = torch.ones((), dtype=REAL, requires_grad=True)
    value = factor * sim.parameter("rod_bend_twist.stiffness_1")
    parameters = {"rod_bend_twist.stiffness_1": value}
    *_, end = sim.rollout(sim.initial_state(), parameters, steps=4, checkpoint_every=checkpoint_every)
    sim.model.set_parameter("rod_stretch", "stiffness", 1.1 * float(sim.parameter("rod_stretch.stiffness")[0, 0]))
    with pytest.raises(SceneError, match="set_parameter"):
        end.positions.sum().backward()


def test_tensors_do_not_change_the_model():
    """A simulator leaves its model unchanged for other integrators."""
    sim, usual = simulator("rods joined rigidly"), simulator("rods joined rigidly").model
    sim.step(sim.initial_state(), {"rod_stretch.stiffness": 3.0 * sim.parameter("rod_stretch.stiffness")})
    first, second = (ddg.Integrator(model).step(model.state(), 2e-3).points() for model in (sim.model, usual))
    np.testing.assert_array_equal(first, second)


# --- roll-outs whose controls have a memory ---
@pytest.mark.parametrize("how", [{"checkpoint_every": 3}, {"memory": 1.1e4}], ids=["checkpoints", "memory"])
def test_controls_with_a_memory_have_the_same_gradient(how):
    """A stateful control function is called once a step, in order."""
    results, called = [], []
    for options in ({}, how):
        sim = gripped()
        random, memory = np.random.default_rng(0), [0.0]
        gain = torch.full((), 0.1, dtype=REAL, requires_grad=True)

        def poses(number, random=random, memory=memory, gain=gain):
            called.append(number)
            memory[0] = 0.5 * memory[0] + float(random.normal())
            pose = torch.zeros(1, 6, dtype=REAL)
            pose[0, 2] = 0.01
            return {"poses": gain * memory[0] * pose}

        *_, end = sim.rollout(sim.initial_state(), None, poses, steps=8, save=8, **options)
        results.append((end.positions, *torch.autograd.grad((end.positions**2).sum(), gain)))
        if options.get("memory"):
            assert sim.plan(sim.initial_state(), poses, steps=8, save=8, **options).every is not None
            called.pop()  # by the plan
    assert called == 2 * list(range(8))
    for first, second in zip(*results, strict=True):
        torch.testing.assert_close(first, second, rtol=0.0, atol=0.0)


def test_a_rollout_that_saves_no_state_is_refused():
    sim = simulator("rod")
    with pytest.raises(SceneError, match="save = 3 of 2 steps"):
        sim.rollout(sim.initial_state(), steps=2, save=3)


# --- copies, pickles and threads ---
def test_states_of_worlds_are_saved_and_go_on_elsewhere():
    sim = gripped()
    state = sim.step(sim.initial_state(2))
    file = io.BytesIO()
    torch.save({"simulator": sim, "state": state}, file)
    file.seek(0)
    loaded = torch.load(file, weights_only=False)
    second, again = loaded["simulator"], loaded["state"]
    with pytest.raises(SceneError, match="world_state"):
        second.step(again)
    with pytest.raises(SceneError, match="world_state"):
        assert again.positions
    first, two, three = sim.step(state), second.step(second.world_state(again)), sim.step(copy.deepcopy(state))
    for result in (two, three):
        torch.testing.assert_close(result.positions, first.positions, rtol=0.0, atol=0.0)
    with pytest.raises(SceneError, match="other shapes"):
        gripped(nodes=7).world_state(pickle.loads(pickle.dumps(state)))
    assert isinstance(again, WorldState)


def test_one_simulator_serves_several_threads():
    """Concurrent steps with different values equal sequential ones bit for bit."""
    sim = gripped()
    values = [float(factor * sim.parameter("rod_bend_twist.stiffness_1")[0, 0]) for factor in (1.0, 2.0, 3.0)]

    def run(value: float) -> torch.Tensor:
        factor = torch.tensor(value, dtype=REAL, device=sim.engine(1).device, requires_grad=True)
        *_, end = sim.rollout(sim.initial_state(), {"rod_bend_twist.stiffness_1": factor}, steps=15)
        return torch.stack([end.positions[0, -1, 2].detach(), *torch.autograd.grad(end.positions.sum(), factor)])

    alone, together = [run(value) for value in values], {}
    threads = [threading.Thread(target=lambda v=v: together.update({v: run(v)})) for v in values]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for value, wanted in zip(values, alone, strict=True):
        torch.testing.assert_close(together[value], wanted, rtol=0.0, atol=0.0)


def test_a_policy_learns_in_worlds_some_of_which_lose_their_gradient():
    """A network learns to rotate a rod's grip so that its free end reaches a goal.

    Noise rotates the grip by 0.3 rad (sigma) in each step of 20 ms. Some of the 64 worlds then rotate too far for a gradient, others in
    every round. The mask leaves them out with one warning; all gradients are finite, and the error halves.
    """
    worlds, steps, goal = 64, 10, torch.tensor([0.0, 0.0, 0.25], dtype=REAL)
    scene = ddg.Scene(mass_damping=0.5)
    points = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 9)
    material = ddg.Material(1e6, density=1000.0, viscosity=5e3)
    scene.clamp(scene.add_rod(points, section=ddg.Circle(0.004), material=material), motion=ddg.Grip())
    sim = Simulator(scene.build(differences.DEVICE, "float64"), 0.02)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = torch.nn.Sequential(torch.nn.Linear(6, 32), torch.nn.Tanh(), torch.nn.Linear(32, 1)).double()
    search, random = torch.optim.Adam(policy.parameters(), lr=1e-2), torch.Generator("cpu").manual_seed(1)

    def seen(state, angle, number):
        ends = [torch.nan_to_num(sim)[:, -1, [0, 2]] for sim in (3.0 * state.positions, 0.1 * state.velocities)]
        return torch.cat([*ends, angle[:, None], torch.full((worlds, 1), number / steps, dtype=REAL)], 1)

    passed, lost = [], []
    with pytest.warns(GradientWarning) as caught:
        for _ in range(20):
            state, angle = sim.initial_state(worlds), torch.zeros(worlds, dtype=REAL)
            for number in range(steps):
                noise = 0.3 * torch.randn(worlds, generator=random, dtype=REAL, device="cpu").to(angle.device)
                angle = angle + 0.5 * torch.tanh(policy(seen(state, angle, number))[:, 0]) + noise
                none = torch.zeros_like(angle)
                poses = torch.stack([none, none, none, none, angle, none], 1)[:, None]
                state = sim.step(state, None, {"poses": poses})
            off = (torch.nan_to_num(state.positions)[:, -1] - goal).norm(dim=1)
            loss = off[state.differentiable].mean()
            search.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0, error_if_nonfinite=True)
            search.step()
            passed.append(float(loss.detach()))
            lost.append(int((~state.differentiable).sum()))
    assert len(caught) == 1
    assert sum(lost) > 20 and max(lost) < worlds // 2
    assert np.mean(passed[-3:]) < passed[0] / 2.0
