"""Residual network: a network learns forces that a simulator lacks from recordings, through its steps.

The run is the recording: twelve thin rods, clamped at one end, fall and swing in a fluid with five times more drag across than
along them. Four markers on each are recorded every 20 ms, each coordinate with noise. The trained simulator has no fluid: rods of a
third of the edges, stepped by implicit Euler instead of the midpoint rule in steps four times as long. A network of one hidden
layer, the same at every node, adds forces per length along and across the rod as functions of these speeds. It therefore rotates
with the rod. It is trained on the beginning of six motions, end to end through all steps (Um et al., Solver-in-the-loop, NeurIPS
2020), and validated on the six others, for longer. It learns drag minus the numerical damping of implicit Euler.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH = 0.4  # m
SECTION = ddg.Stiffness(EA=200.0, EI1=1.5e-3, GJ=1e-3, mass_per_length=0.02, rotary_inertia=1e-6, radius=0.004)
TANGENTIAL, NORMAL = 0.05, 0.25  # N s/m^2, drag of the fluid
RODS, TAUGHT = 12, 6  # recorded rods, and number of training rods
APART = 0.5  # m
MARKERS = 4  # at a quarter, half, three quarters and the whole of the length
SEEN = 0.02  # s, between frames of the camera
NOISE = 1e-3  # m, standard deviation of a coordinate
DURATION, LEARNED = 0.8, 0.5  # s, of the recording, and of its training window
EDGES, DT = 12, 0.01  # edges and time step [s] of the trained simulator
ROUNDS, RATE = 60, 2e-2  # rounds of the search, and largest learning rate of Adam
SCALE = 0.1  # N s/m^2, of the output of the network
BETTER = 5.0  # least ratio of errors without and with the network


def build(n: int = 36, step: float = 0.0025) -> ddg.Scene:
    """Build the recorded rods.

    Args:
        n: edges of a rod, a multiple of the markers
        step: time step [s], an integer fraction of 20 ms
    """
    if n < 2 * MARKERS or n % MARKERS or abs(SEEN / step - round(SEEN / step)) > 1e-6:
        raise ValueError(f"n = {n}, step = {step}: take a multiple of {MARKERS} edges and a part of {SEEN} s")
    scene = rods(n, range(RODS), ddg.Dynamics(dt=step, duration=DURATION, scheme="implicit_midpoint"))
    scene.drag(tangential=TANGENTIAL, normal=NORMAL)
    return scene


def rods(n: int, chosen, analysis: ddg.Dynamics) -> ddg.Scene:
    """Return a scene of chosen rods of n edges, each straight and still in its own direction, in vacuum."""
    directions = np.random.default_rng(0).normal(size=(RODS, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    scene = ddg.Scene(analysis=analysis)
    for number in chosen:
        root = np.array([APART * (number % 4), APART * (number // 4), 0.0])
        points = root + np.linspace(0.0, LENGTH, n + 1)[:, None] * directions[number]
        scene.clamp(scene.add_rod(points, section=SECTION, twist=False, name=f"rod_{number}"))
    return scene


def markers(points):
    """Return markers (..., 4, 3) of rods (..., nodes, 3)."""
    stride = (points.shape[-2] - 1) // MARKERS
    return points[..., stride::stride, :]


def observe(model, state) -> dict[str, float]:
    """Return coordinates of the markers [m], without noise."""
    positions = markers(state.points().reshape(RODS, -1, 3)).reshape(-1, 3)
    return {
        f"{axis}{k // MARKERS}_{k % MARKERS}": float(p[i])
        for k, p in enumerate(positions)
        for i, axis in enumerate("xyz")
    }


def recording(result) -> np.ndarray:
    """Return recorded markers (frames, rods, 4, 3) [m], from 20 ms on, with noise."""
    every, names = (
        round(SEEN / result.dt),
        [f"{axis}{rod}_{k}" for rod in range(RODS) for k in range(MARKERS) for axis in "xyz"],
    )
    exact = np.stack([result.series[name] for name in names], axis=1)
    frames = exact[every::every].reshape(-1, RODS, MARKERS, 3)
    return frames + np.random.default_rng(1).normal(scale=NOISE, size=frames.shape)


def network():
    """Return a network from speeds along and across a rod to drag coefficients over SCALE, initially zero."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        first, last = torch.nn.Linear(2, 16), torch.nn.Linear(16, 2)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    return torch.nn.Sequential(first, torch.nn.Tanh(), last).double()


def forces(correction, state):
    """Return forces on nodes (1, rods nodes, 3) [N] as functions of velocities along and across."""
    import torch

    points, velocities = (values.reshape(-1, EDGES + 1, 3) for values in (state.positions, state.velocities))
    edges = torch.nn.functional.normalize(points.diff(dim=1), dim=2)
    tangents = torch.cat([edges[:, :1], edges[:, 1:] + edges[:, :-1], edges[:, -1:]], 1)
    tangents = torch.nn.functional.normalize(tangents, dim=2)
    along = (velocities * tangents).sum(2, keepdim=True)
    across = velocities - along * tangents
    speeds = torch.cat([along.abs(), ((across**2).sum(2, keepdim=True) + 1e-12).sqrt()], 2)  # smooth at rest, too
    drag = SCALE * LENGTH / EDGES * correction(speeds)
    return -(drag[..., :1] * along * tangents + drag[..., 1:] * across).reshape(1, -1, 3)


def motion(simulator, frames: int, correction=None):
    """Return markers (frames, rods, 4, 3) of the simulated rods, with or without correction."""
    import torch

    state, positions = simulator.initial_state(), []
    for number in range(1, frames * round(SEEN / DT) + 1):
        state = simulator.step(state, controls=correction and {"forces": forces(correction, state)})
        if number % round(SEEN / DT) == 0:
            positions.append(markers(state.positions.reshape(-1, EDGES + 1, 3)))
    return torch.stack(positions)


@_learn.one_thread()
def learn(recorded: np.ndarray) -> dict:
    """Train the network on a recording (frames, rods, 4, 3) [m].

    Returns:
        "losses" of the search, and validation markers, "recorded", "uncorrected" and "corrected" (frames, 6, 4, 3) [m].
    """
    import torch

    from ddg_warp.torch import Simulator

    groups = (range(TAUGHT), range(TAUGHT, RODS))
    analysis = ddg.Dynamics(dt=DT, duration=DURATION)
    training, validation = (Simulator(rods(EDGES, item, analysis).build("cpu", "float64"), DT) for item in groups)
    correction, losses = network(), []
    frames, target = round(LEARNED / SEEN), torch.tensor(recorded)
    search = torch.optim.Adam(correction.parameters(), lr=RATE)
    rates = torch.optim.lr_scheduler.OneCycleLR(search, RATE, total_steps=ROUNDS, pct_start=0.2)
    for _ in range(ROUNDS):
        loss = ((motion(training, frames, correction) - target[:frames, :TAUGHT]) ** 2).sum(3).mean() / NOISE**2
        search.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(correction.parameters(), 1e4, error_if_nonfinite=True)
        search.step()
        rates.step()
        losses.append(loss.item())
    with torch.no_grad():
        uncorrected, corrected = (motion(validation, len(recorded), item).numpy() for item in (None, correction))
    return {"losses": losses, "recorded": recorded[:, TAUGHT:], "uncorrected": uncorrected, "corrected": corrected}


def check(result) -> list[ddg.Check]:
    """Check the error of the corrected simulator on validation motions."""
    name = "error of other motions over that uncorrected"

    def make() -> list[ddg.Check]:
        fit = result.learned = learn(recording(result))
        off = {
            kind: np.sqrt(((fit[kind] - fit["recorded"]) ** 2).sum(3).mean()) for kind in ("uncorrected", "corrected")
        }
        note = f"{1e3 * off['corrected']:.1f} instead of {1e3 * off['uncorrected']:.0f} mm, root mean square"
        return [ddg.Check(name, off["corrected"] / off["uncorrected"], 0.0, 1.0 / BETTER, note)]

    return _learn.skipped([name]) or once_reached(result, DURATION, [name], make)


def plot(result) -> dict:
    """Plot the height of the free end of some validation rods."""
    fit, lines = result.learned, []
    times = SEEN * (1.0 + np.arange(len(fit["recorded"])))
    kinds = (("recorded", "recorded", "o"), ("without a network", "uncorrected", "--"), ("with it", "corrected", "-"))
    for rod in range(3):
        lines += [(label, times, 1e3 * fit[name][:, rod, -1, 2], style) for label, name, style in kinds]
    return {
        "lines": lines,
        "x": f"time [s]; it has learned from {LEARNED:g} s of other rods",
        "y": "height of free ends [mm]",
        "title": "Motions in a fluid that the simulator does not know",
    }


def benchmark() -> ddg.bench.Study:
    """Study the free end of a recorded rod over edges and steps."""
    return ddg.bench.Study(
        {"n": (12, 24, 36), "dt": (0.01, 0.005, 0.0025)},
        lambda result: result.state.points()[-1],
        {"n": 72, "dt": 0.00125},
        series=("dt",),
        unit="m",
    )
