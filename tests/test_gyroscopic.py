"""Gyroscopic couples of spinning rods: tops in closed form, conservation laws, and options."""

import numpy as np
import pytest

import ddg_warp as ddg

RADIUS, LENGTH, DENSITY, EDGES = 5e-3, 0.1, 1000.0, 6
SECTION, MATERIAL = ddg.Circle(RADIUS), ddg.Material(1e8, density=DENSITY)
STORAGES = pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
X, Y, Z = np.eye(3)


class Top:
    """Stiff straight rod along x, in one piece or two rigidly joined ones."""

    def __init__(self, device, first: float, joined: bool = False, hinged: bool = False, **scene):
        scene = ddg.Scene(**({"gravity": (0.0, 0.0, 0.0)} | scene))
        points = np.outer(np.linspace(first, first + LENGTH, EDGES + 1), X)
        half = EDGES // 2
        self.pieces = [(0, half + 1), (half + 1, EDGES + 2)] if joined else [(0, EDGES + 1)]
        parts = [points[: half + 1], points[half:]] if joined else [points]
        rods = [scene.add_rod(part, section=SECTION, material=MATERIAL, director=Z) for part in parts]
        if joined:
            scene.join([(rods[0], -1), (rods[1], 0)])
        if hinged:
            scene.fix(rods[0], [0])
        line = DENSITY * np.pi * RADIUS**2
        halves = [np.concatenate([[0.5], np.ones(b - a - 2), [0.5]]) for a, b in self.pieces]
        self.mass = np.concatenate(halves) * line * LENGTH / EDGES
        self.inertia = 0.5 * line * RADIUS**2 * LENGTH  # about the axis
        self.model = scene.build(device, "float64")

    def turning(self, rate: float, spin: float):
        """Return a state that rotates about z at a rate and spins."""
        points = self.model.state().points()
        return self.model.state(velocities=np.cross(rate * Z, points), spins=np.full(EDGES, spin))

    def momentum(self, state, spin: float) -> np.ndarray:
        """Return the angular momentum about the origin, for constant spins of an untwisted rod."""
        x, v = state.points(), state.velocities()
        edges = np.concatenate([np.diff(x[a:b], axis=0) for a, b in self.pieces])
        tangents = edges / np.linalg.norm(edges, axis=1, keepdims=True)
        return (self.mass[:, None] * np.cross(x, v)).sum(0) + self.inertia / EDGES * spin * tangents.sum(0)

    def energy(self, state) -> float:
        """Return kinetic energy without spins plus elastic energy [J]."""
        return 0.5 * (self.mass * (state.velocities() ** 2).sum(1)).sum() + sum(self.model.energies(state).values())


# A free symmetric top has I3 w along its axis and J W across it. The axis cones about the angular momentum,
# tilted by atan(I3 w / J W) from the transverse plane. It leaves the initial plane by at most the sine of twice that
# angle.
@STORAGES
def test_a_free_top_cones_and_keeps_its_angular_momentum(device, joined):
    rate, spin = 10.0, 200.0
    top = Top(device, -0.5 * LENGTH, joined)
    drifts, height = [], 0.0
    for dt in (2e-3, 1e-3):
        state = top.turning(rate, spin)
        first, energy = top.momentum(state, spin), top.energy(state)
        integrator = ddg.Integrator(top.model, "implicit_midpoint", rtol=1e-10)
        drift = 0.0
        for _ in range(round(0.3 / dt)):
            state = integrator.step(state, dt)
            drift = max(drift, np.linalg.norm(top.momentum(state, spin) - first))
            axis = state.points()[-1] - state.points()[0]
            height = max(height, abs(axis[2]) / np.linalg.norm(axis))
        drifts.append(drift / np.linalg.norm(first))
    assert top.energy(state) == pytest.approx(energy, rel=1e-3)
    across = rate * (top.mass * top.model.state().points()[:, 0] ** 2).sum()
    assert height == pytest.approx(np.sin(2.0 * np.arctan(top.inertia * spin / across)), rel=1e-3)
    assert drifts[-1] < 2e-5
    assert np.log2(drifts[0] / drifts[1]) == pytest.approx(2.0, abs=0.1)


@STORAGES
def test_a_heavy_top_precesses(device, joined):
    """Hinged at an end and released level at W = (moment of weight) / (I3 w), the top stays level and precesses at W."""
    spin = 3e3
    top = Top(device, 0.0, joined, hinged=True, gravity=(0.0, 0.0, -9.81))
    rate = 9.81 * (top.mass * top.model.state().points()[:, 0]).sum() / (top.inertia * spin)
    state, dt = top.turning(rate, spin), 1e-3
    integrator = ddg.Integrator(top.model, "implicit_midpoint", rtol=1e-10)
    for _ in range(200):
        state = integrator.step(state, dt)
    tip = state.points()[-1] / LENGTH
    assert abs(tip[2]) < 5e-3  # without the couple it would swing down within 0.1 s
    assert np.arctan2(tip[1], tip[0]) == pytest.approx(200 * dt * rate, rel=5e-3)


@STORAGES
@pytest.mark.parametrize("spin", [200.0, 2e3])
def test_implicit_euler_never_gains_energy(device, joined, spin):
    """Kinetic and elastic energy only fall, even if the couple rotates velocities by a tenth of a radian in a step."""
    top = Top(device, -0.5 * LENGTH, joined)
    state, energies = top.turning(10.0, spin), []
    integrator = ddg.Integrator(top.model, rtol=1e-10)
    for _ in range(50):
        energies.append(top.energy(state))
        state = integrator.step(state, 1e-3)
    assert np.all(np.diff(energies) <= 1e-9 * energies[0])


@STORAGES
def test_failed_step_keeps_velocities(device, joined):
    top = Top(device, -0.5 * LENGTH, joined)
    state = top.turning(10.0, 2e3)
    options = {"retry_limit": 1, "max_iterations": 1, "rtol": 1e-15, "check_every": 10**9}
    integrator = ddg.Integrator(top.model, **options)
    after = integrator.step(state, 5e-2)
    assert integrator.outcomes() != "converged"
    np.testing.assert_allclose(after.velocities(), state.velocities(), atol=1e-12)


def test_gyroscopic_couples_act_only_on_states_with_spins(device):
    """Later states inherit the spins, from snapshots too, bit by bit; `gyroscopic` decides for all states."""
    top = Top(device, -0.5 * LENGTH)

    def run(integrator, state, steps: int):
        for _ in range(steps):
            state = integrator.step(state, 1e-3)
        return state

    free = ddg.Integrator(top.model)
    run(free, top.model.state(velocities=top.turning(10.0, 0.0).velocities()), 2)
    assert free._gyroscope is None
    through = run(ddg.Integrator(top.model), top.turning(10.0, 200.0), 6)
    half = run(free, top.turning(10.0, 200.0), 3)
    resumed = run(ddg.Integrator(top.model), top.model.restore(half.snapshot()), 3)
    np.testing.assert_array_equal(resumed.velocities(), through.velocities())
    without = run(ddg.Integrator(top.model, gyroscopic=False), top.turning(10.0, 200.0), 6)
    assert np.abs(without.points()[:, 2]).max() < 1e-12 < np.abs(through.points()[:, 2]).max()
    silent = top.turning(10.0, 200.0)
    silent.spun = False
    enabled = run(ddg.Integrator(top.model, gyroscopic=True), silent, 6)
    np.testing.assert_array_equal(enabled.velocities(), through.velocities())


def test_gradients_are_refused(device):
    pytest.importorskip("torch")
    from ddg_warp.adjoint.implicit import Adjoint
    from ddg_warp.torch import Simulator

    top = Top(device, -0.5 * LENGTH)
    state = top.turning(10.0, 200.0)
    with pytest.raises(ddg.SceneError, match=r"no gradient goes through the gyroscopic couples.*gyroscopic=False"):
        Adjoint(ddg.Integrator(top.model)).step(state, 1e-3)
    with pytest.raises(ddg.SceneError, match=r"no gradient goes through the gyroscopic couples.*gyroscopic=False"):
        Simulator(top.model, 1e-3).world_state(state)
    Adjoint(ddg.Integrator(top.model, gyroscopic=False)).step(state, 1e-3)
    taken = Simulator(top.model, 1e-3, gyroscopic=True)
    velocities = taken.step(taken.world_state(state)).velocities.detach().cpu().numpy()
    np.testing.assert_array_equal(velocities[0], ddg.Integrator(top.model).step(state, 1e-3).velocities())
