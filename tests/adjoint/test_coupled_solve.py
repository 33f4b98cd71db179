"""Linear systems of the coupled adjoint: conjugate gradients on the device against sparse factors."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.adjoint.implicit import Adjoint
from ddg_warp.adjoint.linear_solve import HostSolve
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.coupled_tangent import CoupledTangent
from ddg_warp.solve.linear.exact_system import ExactSystem
from ddg_warp.solve.linear.pcg import PCG

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402
from tests.adjoint import differences  # noqa: E402
from tests.adjoint.differences import TIGHT, built, cotangent, directions, entries, moving_state  # noqa: E402
from tests.adjoint.test_adjoint import DT, SCENES, SOFT  # noqa: E402
from tests.pairwise import chosen, covering  # noqa: E402
from tests.torch.test_torch import STIFFNESS  # noqa: E402

RATE = 1.0 / DT


def oblique():
    """A sheet with an edge on a plane that is across no axis."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), mass_damping=0.7)
    vertices, triangles = meshes.rectangle(3, 2, (0.3, 0.2))
    angle = 0.5
    turn = np.array([[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]])
    shell = scene.add_shell(np.asarray(vertices) @ turn.T, triangles, thickness=0.004, material=SOFT)
    left, right = (np.flatnonzero(vertices[:, 0] == x) for x in (vertices[:, 0].min(), vertices[:, 0].max()))
    scene.symmetry(shell, left, turn[:, 0])
    scene.hold(shell, right[:1])
    return scene


def strut(density=1000.0):
    """A straight rod with one branch, between two supports."""
    scene, t = ddg.Scene(gravity=(0.0, 0.0, 0.0)), np.linspace(0.0, 1.0, 9)
    material = ddg.Material(young=1e6, density=density)
    rods = [
        scene.add_rod(np.outer(t, axis) + start, section=ddg.Circle(0.01), material=material)
        for axis, start in (((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.2), (0.5, 0.0, 0.0)))
    ]
    scene.fix(rods[0], [0, -1])
    scene.join([(rods[0], 4), (rods[1], 0)])
    return scene


def squeezed(name: str):
    """A model, and a state in which it is shorter than at rest by a third: its Hessian is indefinite."""
    model = built({"strut": strut, "sheet": SCENES["sheet"]}[name]())
    state, coupled = model.state(), model.coupled
    q = coupled.rest().q.numpy()
    q[: coupled.host.nodes, 0] *= 0.67
    state.coupled.q.assign(q)
    return model, state


def by_both(model, state, rate: float, **attributes):
    """Solve for one right-hand side; return the system, both solutions and the tangent of the factors."""
    coupled = model.coupled
    right = np.random.default_rng(1).normal(size=(model.worlds * coupled.blocks, 3))
    angles = (np.arange(coupled.blocks) >= coupled.host.nodes) & (
        np.arange(coupled.blocks) < coupled.blocks - coupled.host.spins
    )
    right[np.tile(angles, model.worlds), 1:] = 0.0
    solution = wp.zeros(len(right), dtype=coupled.vector, device=coupled.device)
    coefficient, system = rate * (rate + model.scene.mass_damping), ExactSystem(model)
    for name, value in attributes.items():
        setattr(system.krylov, name, value)
    rates = wp.full(model.worlds, rate, dtype=coupled.real, device=coupled.device)
    system.solve(
        state.coupled, coefficient, rates, wp.array(right, dtype=coupled.vector, device=coupled.device), solution
    )
    tangent = CoupledTangent(model, 0)
    solve = HostSolve(tangent)
    wanted = solve(SimpleNamespace(coupled=state.coupled), rate, coefficient, None, tangent.into(right.ravel()))
    return system, solution.numpy(), tangent.back(wanted).reshape(-1, 3), tangent


def off(solution: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(solution - expected).max() / np.abs(expected).max())


SYSTEMS = {
    name: SCENES[name] for name in ("joined", "hinged", "sheet", "hinges", "midedge", "stiffened", "moving_joined")
}


@pytest.mark.parametrize("name", [*SYSTEMS, "oblique"])
def test_conjugate_gradients_agree_with_factors(name):
    model = (SYSTEMS | {"oblique": oblique})[name]().build(device=differences.DEVICE, precision="float64", worlds=2)
    system, solution, wanted, tangent = by_both(model, moving_state(model), RATE)
    assert not system.failed.numpy().any()
    assert off(solution, wanted) < 1e-9
    if name != "oblique":
        assert np.all(solution.ravel()[~tangent.free] == 0.0)


def test_rods_that_branch_are_eliminated():
    """Substructuring is exact for a tree of rods: one iteration."""
    model = built(SCENES["joined"]())
    system, *_ = by_both(model, moving_state(model), RATE)
    assert system.system.iterations.numpy()[0] == 1


@pytest.mark.parametrize("name", ["strut", "sheet"])
def test_an_indefinite_matrix(name):
    model, state = squeezed(name)
    system, solution, wanted, tangent = by_both(model, state, 1.0)
    matrix = tangent.hessian(SimpleNamespace(coupled=state.coupled)).toarray() + np.diag(tangent.mass)
    spectrum = np.linalg.eigvalsh(matrix[tangent.free][:, tangent.free])
    assert (spectrum < 0.0).sum() > 2
    assert not system.failed.numpy().any()
    assert off(solution, wanted) < 1e-7


def test_rounding_errors_are_no_failure():
    """Rods as thin as hair, in long steps: stretching is 1e13 times as stiff as inertia."""
    scene, t = ddg.Scene(gravity=(0.0, 0.0, -9.81)), np.linspace(0.0, 0.2, 65)
    hair = ddg.Material(young=4e9, density=1300.0)
    points = np.stack([t, 0.3 * t * t, 0.02 * np.sin(20.0 * t)], 1)
    twig = points[32] + np.outer(t[:32], (0.3, 0.3, 0.2))
    rods = [scene.add_rod(curve, section=ddg.Circle(4e-5), material=hair) for curve in (points, twig)]
    scene.clamp(rods[0])
    scene.join([(rods[0], 32), (rods[1], 0)])
    model = built(scene)
    system, solution, wanted, _ = by_both(model, model.state(), 60.0)
    assert not system.failed.numpy().any()
    assert off(solution, wanted) < 1e-6


def test_a_world_without_a_right_hand_side():
    model = SCENES["sheet"]().build(device=differences.DEVICE, precision="float64", worlds=2)
    state, coupled, system = moving_state(model), model.coupled, ExactSystem(model)
    right = np.zeros((2 * coupled.blocks, 3))
    right[coupled.blocks + 5] = 1.0
    solution = wp.full(len(right), coupled.vector(1.0, 1.0, 1.0), dtype=coupled.vector, device=coupled.device)
    rates = wp.full(2, RATE, dtype=coupled.real, device=coupled.device)
    system.solve(state.coupled, RATE**2, rates, wp.array(right, dtype=coupled.vector, device=coupled.device), solution)
    assert np.all(solution.numpy()[: coupled.blocks] == 0.0)
    assert np.abs(solution.numpy()[coupled.blocks :]).max() > 0.0
    assert not system.failed.numpy().any()


def vjp_of_step(model, state, scheme: str, weights: dict, **how):
    """Derivatives by the state before a step and by parameters, and the reverse that found them."""
    adjoint = Adjoint(ddg.Integrator(model, scheme=scheme, **TIGHT))
    _, tape = adjoint.step(state, DT)
    s = DT / 2.0 if scheme == "implicit_midpoint" else DT
    weights = cotangent(model, weights)
    adjoint.vjp(tape, weights)
    gradient, inputs = adjoint.vjp_of_parts(tape.before, tape.after, tape.parts, weights, s, **how)
    values = {name: array.numpy() for name, array in entries(gradient).items()}
    return values | {f"parameters {i}": rows.numpy() for i, rows in enumerate(inputs[-1].parameters)}


@covering(
    1,
    name=("sheet", "stiffened", "moving_joined", "sand, joined", "pressure"),
    scheme=("implicit_euler", "implicit_midpoint"),
)
def test_gradients_are_those_of_factors(name, scheme):
    """The whole reverse of a step, by either; and bit by bit once more."""
    model = built(SCENES[name]())
    state = moving_state(model, scheme=scheme)
    weights = directions(model, state, 5)
    solution, wanted, again = (vjp_of_step(model, state, scheme, weights, factors=how) for how in (False, True, False))
    for key, value in wanted.items():
        np.testing.assert_array_equal(solution[key], again[key], err_msg=key)
        if np.abs(value).max() > 1e-9:
            assert off(solution[key], value) < 1e-9, key


@pytest.fixture
def truncated_solver(monkeypatch):
    """End conjugate gradients after their first iteration."""
    once = PCG.__init__

    def cut(self, *arguments, indefinite=False, **options):
        once(self, *arguments, indefinite=indefinite, **options)
        self._limit = 1 if indefinite else self._limit

    monkeypatch.setattr(PCG, "__init__", cut)


def test_unconverged_solves_fall_back_to_factors(truncated_solver):
    model = built(SCENES["sheet"]())
    state = moving_state(model)
    weights = directions(model, state, 5)
    adjoint = Adjoint(ddg.Integrator(model, **TIGHT))
    _, tape = adjoint.step(state, DT)
    gradient, _ = adjoint.vjp(tape, cotangent(model, weights))
    wanted = vjp_of_step(model, state, "implicit_euler", weights, factors=True)
    for key, array in entries(gradient).items():
        np.testing.assert_array_equal(array.numpy(), wanted[key], err_msg=key)


def test_unconverged_worlds_of_torch_are_reported(truncated_solver):
    """Undefined gradients are NaN, as the host does not check steps of torch."""
    simulator = Simulator(built(SCENES["sheet"]()), DT)
    velocities = torch.zeros((1, simulator.model.points_count, 3), dtype=torch.float64, requires_grad=True)
    after = simulator.step(simulator.initial_state(velocities=velocities))
    assert torch.isnan(torch.autograd.grad((after.positions**2).sum(), velocities)[0]).any()


@covering(1, name=("joined", "sheet"), scheme=("implicit_euler", "implicit_midpoint"))
def test_coupled_adjoint_solves_are_replayed(name, scheme):
    """One captured graph serves all steps of a length, with the results of single launches."""
    gradients = []
    for replayed in (True, False):
        simulator = Simulator(built(SCENES[name]()), DT, scheme=scheme, rtol=1e-12)
        graphs = simulator.engine(1)._adjoint() and simulator.engine(1)._graphs
        if not replayed:
            graphs.replay = lambda name, launch: launch()
        stiffness = simulator.parameter(STIFFNESS[name]).requires_grad_()
        *_, state = simulator.rollout(simulator.initial_state(), {STIFFNESS[name]: 1.1 * stiffness}, steps=4)
        gradients.append(torch.autograd.grad((state.positions**2).sum(), stiffness)[0].cpu().numpy())
        assert len(graphs._graphs) == 2 * replayed  # with that which puts worlds to rest that failed
    np.testing.assert_array_equal(*gradients)


@chosen(["sheet"], name=("joined", "sheet"))
def test_mixed_precision(name):
    """Gradients agree with float64 within 1e-4, as the adjoint is solved in float64."""
    gradients = []
    for precision in ("float64", "mixed"):
        simulator = Simulator(SCENES[name]().build(device=differences.DEVICE, precision=precision), DT, rtol=1e-9)
        speed = torch.zeros((1, simulator.model.points_count, 3), dtype=simulator.initial_state().velocities.dtype)
        speed.requires_grad_()
        *_, state = simulator.rollout(simulator.initial_state(velocities=speed), steps=5)
        gradients.append(torch.autograd.grad((state.positions**2).sum(), speed)[0].cpu().numpy())
    assert off(gradients[1], gradients[0]) < 1e-4
