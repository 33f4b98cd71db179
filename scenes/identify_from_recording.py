"""Identification from motion capture: EI, GJ and damping of a cable gripped by two robots, from published recordings.

Recordings are read by `ddg_warp.data.mocap`: pickles of markers over time in `train`, for the fit, and `eval`, for validation. An
example is data_set/DLO1 of a clone of the public repository named there. Without a folder the scene writes one in that format: a
cable of other edges, steps and scheme than the fitted one, with noise on every coordinate and lost markers. Windows of half a
second are worlds of one simulator. Each starts with positions, velocities and twist estimated from frames: around the start for the
fit, before it for validation. Grips follow their markers. The fit minimises errors of the other markers by gradients through all
steps. Validation windows of `eval` measure its accuracy. Motions do not determine the mass: EI and GJ hold for the given mass per
length. The run is the fitted cable in the first validation window.
"""

import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.data import mocap
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _cable, _learn

TRUTH = {"EI": 6.0e-3, "GJ": 4.0e-3, "viscosity": 0.03}  # N m^2, N m^2, s; of the synthetic cable
GUESS = {"EI": 0.012, "GJ": 0.002, "viscosity": 0.015}  # initial guess
NAMES = {
    "EI": ("rod_bend_twist.stiffness_1", "rod_bend_twist.stiffness_2"),
    "GJ": ("rod_bend_twist.stiffness_3",),
    "viscosity": ("rod_bend_twist.viscosity", "rod_stretch.viscosity"),
}
MASS = 0.05  # kg/m
LENGTH, MARKERS = 1.0, 13  # length [m] and number of markers of the synthetic cable
NOISE = 2e-4  # m, standard deviation of a coordinate
LOST = 0.01  # fraction of lost markers
SETTLED, RECORDED = 1.0, 2.5  # s, before the recording, until the cable hangs between its grips, and of the recording
FINE = {"parts": 4, "dt": 0.0025}  # edges between markers, and time step [s], of the synthetic cable
SEEDS = {"train": (1, 2), "eval": (3,)}  # of motions
FRAMES = 50  # frames of a window
SCALE = 5e-3  # m, scale of errors
WITHIN = {
    "EI": 0.05,
    "GJ": 0.1,
    "viscosity": 0.15,
}  # relative errors by discretisation, noise and lost markers
CLOSE, SAME = 1.5e-3, 5e-3  # m
BALL = 0.008  # m, radius of the drawn markers
PARTS, DT = 2, 0.005  # edges between markers, and time step [s], of the fitted cable
UNITS = {"EI": "EI [N m^2]", "GJ": "GJ [N m^2]", "viscosity": "viscosity [s]"}
OFF = "markers of windows held out, off on average a coordinate [m]"


def build(folder: str = "", mass: float = MASS, windows: int = 8) -> ddg.Scene:
    """Build the fitted cable in a validation window; building includes the fit.

    Args:
        folder: folder with recordings in train and eval; by default the scene makes them
        mass: mass of the cable per length [kg/m]
        windows: largest number of windows for the fit, and for validation
    """
    if windows < 1 or not mass > 0.0:
        raise ValueError(f"windows = {windows}, mass = {mass}: take a window at least, and a positive mass")
    _learn.require_torch("identify_from_recording")
    fit = learn(folder, mass, windows)
    scene = _cable.moved(fit["tried"][0], PARTS, fit["values"], mass, DT)
    scene.initial = Start(scene.initial, **fit)
    return scene


@dataclass(frozen=True)
class Start:
    """Initial state of a run, with the result of the fit.

    Attributes:
        make: function from the model to the state.
        values: EI, GJ and viscosity.
        tried: validation windows with markers (windows, F, M, 3) [m] in `seen`, NaN where one is lost.
        predicted: simulated markers of these windows, "guessed" and "learned".
        losses: mean squared errors over (5 mm)^2, in every evaluation of the search.
        own: whether the scene made the recordings.
    """

    make: Callable
    values: dict
    tried: list
    predicted: dict
    losses: list
    own: bool

    def __call__(self, model):
        return self.make(model)

    def off(self, name: str) -> float:
        """Return the mean absolute error of a coordinate of free markers [m]."""
        return float(
            np.nanmean(np.abs(self.predicted[name] - inner(np.stack([window.seen[1:] for window in self.tried]))))
        )


def inner(markers):
    """Return the markers (..., M - 4, 3) outside the grips."""
    return markers[..., _cable.ENDS : -_cable.ENDS, :]


def record(folder: Path) -> None:
    """Write recordings as published: pickles (frames, 3, markers) in train and eval, with noise and lost markers."""
    seeds = [seed for group in SEEDS.values() for seed in group]
    exact = recorded(seeds)
    for split, group in SEEDS.items():
        (folder / split).mkdir()
        for seed in group:
            random = np.random.default_rng([0, seed])
            markers = exact[:, seeds.index(seed)] + random.normal(scale=NOISE, size=(len(exact), MARKERS, 3))
            for frame, marker in np.argwhere(random.random(markers.shape[:2]) < LOST / 3.0):
                markers[frame : frame + random.integers(1, 6), marker] = np.nan
            (folder / split / f"{seed}.pkl").write_bytes(pickle.dumps(markers.swapaxes(1, 2)))


def recorded(seeds: list[int]) -> np.ndarray:
    """Return markers (frames, cables, 13, 3) [m] of cables between two grips, each with its own random motion."""
    parts, dt = FINE["parts"], FINE["dt"]
    scene, nodes = ddg.Scene(), (MARKERS - 1) * parts + 1
    for number, seed in enumerate(seeds):
        points = np.linspace((0.0, number, 0.0), (LENGTH, number, 0.0), nodes)
        rod = scene.add_rod(points, section=_cable.section(TRUTH, MASS, MARKERS, parts))
        _, edges = _cable.held(MARKERS, parts)
        random = np.random.default_rng([1, seed])
        for end, first in ((0, 0), (-1, len(edges) // 2)):
            scene.clamp(
                rod, edges=edges[first : first + parts], motion=swing(random, tuple(points[end]), 1.0 + 2.0 * end)
            )
    integrator = ddg.Integrator(scene.build("cpu", "float64"), scheme="implicit_midpoint")
    state, frames, every = integrator.model.state(), [], round(1.0 / (mocap.RATE * dt))
    for step in range(round((SETTLED + RECORDED) / dt) + 1):
        if step * dt >= SETTLED - 0.5 * dt and step % every == 0:
            frames.append(state.points().reshape(len(seeds), nodes, 3)[:, ::parts])
        state = integrator.step(state, dt)
    return np.array(frames)


def swing(random, pivot: tuple, sense: float) -> ddg.Motion:
    """Return the motion of a grip: inwards until the cable hangs, then oscillations in position and about an axis across it."""
    sizes, rates, phases = (
        random.uniform(0.5, 1.0, (4, 2)),
        random.uniform(1.5, 5.0, (4, 2)),
        random.uniform(0.0, 2.0 * np.pi, (4, 2)),
    )
    tilt = random.uniform(0.0, 2.0 * np.pi)

    def waves(t: float) -> np.ndarray:
        later = max(0.0, t - SETTLED)
        return np.tanh(3.0 * later) ** 2 * (sizes * np.sin(rates * later + phases)).sum(1)

    def progress(t: float) -> float:
        s = min(1.0, t / SETTLED)
        return s * s * (3.0 - 2.0 * s)

    return ddg.Motion(
        translation=lambda t: tuple([0.12 * sense * progress(t), 0.0, 0.0] + 0.06 * waves(t)[:3]),
        angle=lambda t: 0.5 * float(waves(t)[3]),
        axis=(0.0, float(np.cos(tilt)), float(np.sin(tilt))),
        pivot=pivot,
    )


def read(folder: str) -> dict[str, list]:
    """Return windows of half a second by split."""
    with tempfile.TemporaryDirectory() as data:
        if not folder:
            record(Path(data))
        root = folder or data
        recordings = {split: [mocap.read(path) for path in mocap.recordings(split, root=root)] for split in SEEDS}
    return {split: _cable.windows(data, FRAMES, ahead=split == "train") for split, data in recordings.items()}


class Predictor:
    """Simulator with one world a window."""

    def __init__(self, windows: list, mass: float):
        from ddg_warp.torch import Simulator

        model = _cable.gripped(windows[0], PARTS, GUESS, mass).build("cpu", "float64", worlds=len(windows))
        self.simulator = Simulator(model, DT)
        self.every = round(1.0 / (mocap.RATE * DT))
        self.state = self.simulator.world_state(_cable.starts(model, windows, PARTS))
        nodes, _ = _cable.held(len(windows[0].points), PARTS)
        times = DT * np.arange(1, FRAMES * self.every + 1)
        rest = model.state().points().reshape(len(windows), -1, 3)[0, nodes]
        self.poses = _cable.poses(windows, PARTS, rest, times)

    def __call__(self, logarithms):
        """Return free markers (F, windows, M - 4, 3) for logarithms (3,) of the parameters over the guess."""
        import torch

        parameters = {
            path: self.simulator.parameter(path)[:1] * logarithms[k].exp()
            for k, names in enumerate(NAMES.values())
            for path in names
        }
        states = self.simulator.rollout(
            self.state,
            parameters,
            lambda number: {"poses": torch.tensor(self.poses[number])},
            steps=len(self.poses),
            save=self.every,
        )
        return inner(torch.stack([state.positions[:, ::PARTS] for state in states]))


@cache
@_learn.one_thread()
def learn(folder: str, mass: float, windows: int) -> dict:
    """Return the attributes of `Start` except `make`."""
    import torch

    split = {name: group[:: -(-len(group) // windows)] for name, group in read(folder).items()}
    predict = Predictor(split["train"], mass)
    wanted = torch.tensor(inner(np.stack([window.seen[1:] for window in split["train"]], axis=1)))
    visible = torch.isfinite(wanted)

    def loss(logarithms):
        off = torch.where(visible, predict(logarithms) - wanted.nan_to_num(), 0.0)
        return ((off / SCALE) ** 2).sum() / visible.sum()

    start = torch.zeros(len(NAMES), dtype=torch.float64)
    fitted, losses = _learn.minimise(loss, start, iterations=40, tolerance=1e-7)
    validation = Predictor(split["eval"], mass)
    with torch.no_grad():
        predicted = {
            name: validation(point).numpy().swapaxes(0, 1) for name, point in (("guessed", start), ("learned", fitted))
        }
    values = {name: GUESS[name] * float(factor) for name, factor in zip(NAMES, fitted.exp(), strict=True)}
    return {"values": values, "tried": split["eval"], "predicted": predicted, "losses": losses, "own": not folder}


def check(result) -> list[ddg.Check]:
    """Check known parameters, validation windows, and the run against its prediction."""
    fit = result.learned = result.model.scene.initial
    off, guessed = fit.off("learned"), fit.off("guessed")
    note = f"{len(fit.tried)} windows of {FRAMES / mocap.RATE:g} s; with the first guess {1e3 * guessed:.3g} mm"
    checks = []
    for name, value in fit.values.items():
        if fit.own:
            checks.append(ddg.Check(UNITS[name], value, TRUTH[name], WITHIN[name], "what was recorded", relative=True))
        else:
            checks.append(
                ddg.Check.skip(f"{UNITS[name]}: {value:.4g}", "that of the cable that was recorded is not known")
            )
    limit = CLOSE if fit.own else guessed
    name = "markers of a run off what was predicted [m]"

    def ran() -> list[ddg.Check]:
        last = result.state.points().reshape(-1, 3)[::PARTS]
        away = np.abs(inner(last) - fit.predicted["learned"][0, -1]).max()
        return [ddg.Check(name, away, 0.0, SAME, "worlds of a simulator; lengths are those at the start here")]

    return [
        *checks,
        ddg.Check(OFF, off, 0.0, limit, note),
        *once_reached(result, fit.tried[0].duration, [name], ran),
    ]


def picture(result, frames) -> dict:
    """Draw the fitted cable at a few times, with recorded markers as balls."""
    window, panels = result.model.scene.initial.tried[0], 4
    ball, triangles = meshes.sphere(1)
    shown = {t: frames[t] for t in list(frames)[:: max(1, (len(frames) - 1) // panels)]}
    bodies = {}
    for t in shown:
        markers = window.seen[min(round(t * mocap.RATE), FRAMES)]
        markers = markers[np.isfinite(markers).all(1)]
        balls = (markers[:, None] + BALL * ball).reshape(-1, 3)
        bodies[t] = balls, (triangles[None] + len(ball) * np.arange(len(markers))[:, None, None]).reshape(-1, 3)
    return {"points_by_time": shown, "bodies": bodies}


def plot(result) -> dict:
    """Plot the error of markers in validation windows over the time since the start."""
    fit, times = result.learned, np.arange(1, FRAMES + 1) / mocap.RATE
    recorded_markers = inner(np.stack([window.seen[1:] for window in fit.tried]))
    kinds = (("guessed", "first guess", "--"), ("learned", "learned", "-"))
    lines = [
        (label, times, 1e3 * np.nanmean(np.abs(fit.predicted[name] - recorded_markers), axis=(0, 2, 3)), style)
        for name, label, style in kinds
    ]
    values = ", ".join(f"{name} = {value:.3g}" for name, value in fit.values.items())
    return {
        "lines": lines,
        "x": "time since the start of a window [s]",
        "y": "off on average, a coordinate [mm]",
        "title": f"Windows held out: {values}",
    }


def benchmark() -> ddg.bench.Study:
    """Study the error of validation windows over the number of fitted windows."""
    return ddg.bench.Study({"windows": (1, 2, 4, 8)}, OFF)
