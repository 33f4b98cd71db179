"""Referenced states never change; without references, two states alternate in the same memory."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes
from ddg_warp.model.state import State
from ddg_warp.run.simulate import simulate

RUBBER = ddg.Material(young=1e6, poisson=0.4, density=1000.0)
DT = 0.01


def rods(scene):
    points = np.zeros((2, 6, 3))
    points[:, :, 0] = np.linspace(0.0, 0.5, 6)
    scene.clamp(scene.add_rods(points, section=ddg.Circle(0.01), material=RUBBER), edges=[0])


def coupled(scene):
    points = np.linspace([0.0, 1.0, 0.0], [0.5, 1.0, 0.0], 6)
    first = scene.add_rod(points, section=ddg.Circle(0.01), material=RUBBER)
    second = scene.add_rod(points[-1] + points - points[0], section=ddg.Circle(0.01), material=RUBBER)
    scene.clamp(first, edges=[0])
    scene.join([(first, -1), (second, 0)])


def shell(scene):
    points, triangles = meshes.rectangle(3, 3)
    scene.hold(scene.add_shell(points, triangles, thickness=0.01, material=RUBBER, bending="hinge"), [0, 3])


SCENES = {"rods": [rods], "net": [coupled], "shell": [shell], "all": [rods, coupled, shell]}


def model_of(name: str, device, worlds: int = 1, **options):
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), **options)
    for build in SCENES[name]:
        build(scene)
    return scene.build(device, worlds=worlds)


def memory(state) -> list[int]:
    return [array.ptr for part in state.parts().values() for array in part.arrays().values()]


def snapshots_of_a_run(model, steps: int) -> list[np.ndarray]:
    """Return snapshots of every state, taken while it is the last."""
    integrator, state, snapshots = ddg.Integrator(model), model.state(), []
    for _ in range(steps):
        state = integrator.step(state, DT)
        snapshots.append(state.snapshot())
    return snapshots


def same(states, expected) -> None:
    for state, wanted in zip(states, expected, strict=True):
        snapshot = state.snapshot()
        assert snapshot.keys() == wanted.keys()
        for name, values in wanted.items():
            np.testing.assert_array_equal(snapshot[name], values, err_msg=name)


@pytest.mark.parametrize(("name", "worlds"), [("rods", 1), ("rods", 3), ("net", 1), ("shell", 3), ("all", 1)])
def test_referenced_states_do_not_change(device, name, worlds):
    """Referenced states equal a run without references, bit for bit; state buffers and captured steps stay two."""
    model = model_of(name, device, worlds)
    expected = snapshots_of_a_run(model, 6)
    integrator, states = ddg.Integrator(model), [model.state()]
    for _ in range(6):
        states.append(integrator.step(states[-1], DT))
    np.testing.assert_allclose([state.time for state in states], np.arange(7) * DT, atol=1e-15)
    same(states[1:], expected)
    assert len({id(state) for state in states}) == 7
    assert len(integrator._graphs._graphs) == 2
    # steps may continue from the last state and from an earlier one
    again = integrator.step(states[3], DT)
    same([again], expected[3:4])
    same(states[1:], expected)


@pytest.mark.parametrize("name", ["rods", "all"])
def test_unreferenced_states_use_two_buffers(device, monkeypatch, name):
    """Twenty steps that keep only the last state use the memory of two."""
    model = model_of(name, device)
    integrator, state, buffers = ddg.Integrator(model), model.state(), set()
    state = integrator.step(state, DT)
    monkeypatch.setattr(model, "empty_state", lambda: pytest.fail("a state was allocated"))
    for _ in range(20):
        state = integrator.step(state, DT)
        buffers.add(tuple(memory(state)))
    assert len(buffers) == 2


@pytest.mark.parametrize("name", ["rods", "net", "shell"])
def test_referenced_arrays_and_views_do_not_change(device, name):
    """Objects taken from a released state stay: a member, an array, a slice, a NumPy view on the CPU."""
    model = model_of(name, device)
    takes = {
        "part": lambda state: state.groups[0] if state.groups else state.coupled,
        "array": lambda state: state.groups[0].x if state.groups else state.coupled.q,
        "slice": lambda state: (state.groups[0].v if state.groups else state.coupled.v)[:2],
        "list": lambda state: state.groups or state.coupled.lag,
        "names": lambda state: (state.groups[0] if state.groups else state.coupled).arrays(),
    }
    if model.wp_device.is_cpu:
        takes["view"] = lambda state: (state.groups[0].x if state.groups else state.coupled.q).numpy()

    def values(taken):
        if isinstance(taken, list):
            return [values(item) for item in taken]
        if isinstance(taken, dict):
            return [values(item) for item in taken.values()]
        if hasattr(taken, "arrays"):
            return values(taken.arrays())
        return np.array(taken if isinstance(taken, np.ndarray) else taken.numpy())

    for kind, take in takes.items():
        integrator, state = ddg.Integrator(model), model.state()
        state = integrator.step(state, DT)
        taken = take(state)
        before = values(taken)
        state = integrator.step(state, DT)
        moved = state.points()
        for _ in range(4):
            state = integrator.step(state, DT)
        for after, original in zip(_flat(values(taken)), _flat(before), strict=True):
            np.testing.assert_array_equal(after, original, err_msg=kind)
        assert not np.array_equal(state.points(), moved)


def _flat(nested):
    return [array for item in nested for array in _flat(item)] if isinstance(nested, list) else [nested]


def test_states_kept_by_callbacks_do_not_change(device):
    """States kept by a callback stay; the last is the state that `simulate` returns."""
    kept: list[State] = []
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), callbacks=[kept.append])
    rods(scene)
    shell(scene)
    scene.analysis = ddg.Dynamics(duration=6 * DT, dt=DT)
    result = simulate(scene, device=device, progress=False)
    assert kept[-1] is result.state
    points = [state.points() for state in kept]
    np.testing.assert_allclose([state.time for state in kept], (1 + np.arange(6)) * DT, atol=1e-15)
    falls = [position[1:6, 2].mean() for position in points]
    assert (np.diff(falls) < 0.0).all()


def test_the_last_good_state_of_an_error_stays(device):
    """Later steps do not overwrite `SolverError.state`."""
    model = model_of("rods", device)
    integrator, strict = ddg.Integrator(model), ddg.Integrator(model, max_iterations=1, retry_limit=0, check_every=1)
    state = model.state()
    with pytest.raises(SolverError) as caught:
        for _ in range(10):
            state = strict.step(state, DT)
    good = caught.value.state.snapshot()
    assert caught.value.state.model is model
    next_state = model.state()
    for _ in range(4):
        next_state = integrator.step(next_state, DT)
        try:
            strict.step(next_state, DT)
        except SolverError:
            pass
    same([caught.value.state], [good])


def test_resumed_run_has_parameters_set_by_callbacks(device, tmp_path):
    """Callbacks set parameters by time, such as muscle activation."""

    def build(duration):
        scene = ddg.Scene(
            analysis=ddg.Dynamics(dt=0.01, duration=duration),
            callbacks=[lambda state: state.model.set_parameter("rod_bend_twist", "rest_1", 20.0 * state.time)],
        )
        rod = scene.add_rod(
            np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 11),
            section=ddg.Circle(0.01),
            material=ddg.Material(young=1e7, density=1000.0),
            natural="straight",
        )
        scene.clamp(rod)
        return scene

    def run(end, **where):
        result = simulate(
            build(end), device=device, duration=end, options={"rtol": 1e-10}, progress=False, usd=False, **where
        )
        return result.state.points().copy()

    straight = run(0.06)
    before = run(0.03, out=tmp_path)
    resumed = run(0.06, resume=tmp_path)
    assert np.abs(straight - before).max() > 1e-2
    np.testing.assert_allclose(resumed, straight, rtol=0.0, atol=1e-10)
