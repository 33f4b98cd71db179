"""Identification from motion capture: EI, GJ and damping of a cable that two robots hold, from a folder of published recordings.

Recordings are read by `ddg_warp.learn.mocap`: pickles of markers over time, those in `train` to learn from, those in `eval` to be tried
on, such as data_set/DLO1 of a clone of the public repository that is named there. Without a folder the scene writes one in that format:
a cable of other edges, in other steps and by another rule than the learner's, with noise on every coordinate and markers that the
cameras lose. Windows of half a second are worlds of one simulator. Each starts with positions, velocities and twist that frames show,
those around its start where it is learned from, those before alone where it is predicted; its grips move as their markers did, and what
the others are off is learned from by gradients through all steps. Windows of recordings that were not learned from tell what it is
worth. Motions do not show the mass: EI and GJ are those of a cable of so much per length. What runs is the learned cable, held as in
the first of those windows.
"""

import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.learn import mocap
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _cable, _learn

TRUTH = {"EI": 6.0e-3, "GJ": 4.0e-3, "viscosity": 0.03}  # N m^2, N m^2, s; of the cable that the scene records
GUESS = {"EI": 0.012, "GJ": 0.002, "viscosity": 0.015}  # where the search begins
NAMES = {
    "EI": ("rod_bend_twist.stiffness_1", "rod_bend_twist.stiffness_2"),
    "GJ": ("rod_bend_twist.stiffness_3",),
    "viscosity": ("rod_bend_twist.viscosity", "rod_stretch.viscosity"),
}
MASS = 0.05  # kg/m
LENGTH, MARKERS = 1.0, 13  # of the cable that the scene records [m], and on it
NOISE = 2e-4  # m, standard deviation of a coordinate
LOST = 0.01  # of all markers, those that cameras lose
SETTLED, RECORDED = 1.0, 2.5  # s, until that cable has come to hang between its grips, and recorded then
FINE = {"parts": 4, "dt": 0.0025}  # edges between its markers, and its steps [s]
SEEDS = {"train": (1, 2), "eval": (3,)}  # of its motions
FRAMES = 50  # of a window
SCALE = 5e-3  # m, of what is off
WITHIN = {
    "EI": 0.05,
    "GJ": 0.1,
    "viscosity": 0.15,
}  # relative errors that other edges and steps, noise and lost markers leave
CLOSE, SAME = 1.5e-3, 5e-3  # m
BALL = 0.008  # m, radius of the markers drawn
PARTS, DT = 2, 0.005  # edges between markers of the learner's cable, and its steps [s]
UNITS = {"EI": "EI [N m^2]", "GJ": "GJ [N m^2]", "viscosity": "viscosity [s]"}
OFF = "markers of windows held out, off on average a coordinate [m]"


def build(folder: str = "", mass: float = MASS, windows: int = 8) -> ddg.Scene:
    """The learned cable in a window held out; building takes as long as learning it.

    Args:
        folder: of recordings, with folders train and eval; without one, recordings that the scene makes
        mass: of the cable per length [kg/m]
        windows: to learn from, and others to be tried on, at most
    """
    if windows < 1 or not mass > 0.0:
        raise ValueError(f"windows = {windows}, mass = {mass}: take a window at least, and a positive mass")
    _learn.require_torch("identify_from_recording")
    found = learn(folder, mass, windows)
    scene = _cable.moved(found["tried"][0], PARTS, found["values"], mass, DT)
    scene.initial = Start(scene.initial, **found)
    return scene


@dataclass(frozen=True)
class Start:
    """The first state of a run, and what was learned before it.

    Attributes:
        make: the state, from the model.
        values: EI, GJ and viscosity.
        tried: windows held out; seen: markers there (windows, F, M, 3) [m], NaN where one is lost.
        predicted: the same as a simulator has them, "guessed" and "learned".
        losses: mean squares of what is off over (5 mm)^2, in every evaluation of the search.
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
        """Mean distance along a coordinate from markers that were seen [m], grips left out."""
        return float(
            np.nanmean(np.abs(self.predicted[name] - inner(np.stack([window.seen[1:] for window in self.tried]))))
        )


def inner(markers):
    """Those that no grip holds (..., M - 4, 3)."""
    return markers[..., _cable.ENDS : -_cable.ENDS, :]


def record(folder: Path) -> None:
    """Write recordings as they are published: pickles (frames, 3, markers) in train and eval, with noise and lost markers."""
    seeds = [seed for own in SEEDS.values() for seed in own]
    seen = recorded(seeds)
    for split, own in SEEDS.items():
        (folder / split).mkdir()
        for seed in own:
            random = np.random.default_rng([0, seed])
            markers = seen[:, seeds.index(seed)] + random.normal(scale=NOISE, size=(len(seen), MARKERS, 3))
            for frame, marker in np.argwhere(random.random(markers.shape[:2]) < LOST / 3.0):
                markers[frame : frame + random.integers(1, 6), marker] = np.nan
            (folder / split / f"{seed}.pkl").write_bytes(pickle.dumps(markers.swapaxes(1, 2)))


def recorded(seeds: list[int]) -> np.ndarray:
    """Markers (frames, cables, 13, 3) [m] of cables that hang between two grips, each moved and turned in its own way."""
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
    state, seen, every = integrator.model.state(), [], round(1.0 / (mocap.RATE * dt))
    for step in range(round((SETTLED + RECORDED) / dt) + 1):
        if step * dt >= SETTLED - 0.5 * dt and step % every == 0:
            seen.append(state.points().reshape(len(seeds), nodes, 3)[:, ::parts])
        state = integrator.step(state, dt)
    return np.array(seen)


def swing(random, pivot: tuple, sense: float) -> ddg.Motion:
    """Of a grip: inwards until the cable hangs, then to and fro, and about an axis across it, with several frequencies at once."""
    sizes, rates, phases = (
        random.uniform(0.5, 1.0, (4, 2)),
        random.uniform(1.5, 5.0, (4, 2)),
        random.uniform(0.0, 2.0 * np.pi, (4, 2)),
    )
    tilt = random.uniform(0.0, 2.0 * np.pi)

    def waves(t: float) -> np.ndarray:
        later = max(0.0, t - SETTLED)
        return np.tanh(3.0 * later) ** 2 * (sizes * np.sin(rates * later + phases)).sum(1)

    def way(t: float) -> float:
        s = min(1.0, t / SETTLED)
        return s * s * (3.0 - 2.0 * s)

    return ddg.Motion(
        translation=lambda t: tuple([0.12 * sense * way(t), 0.0, 0.0] + 0.06 * waves(t)[:3]),
        angle=lambda t: 0.5 * float(waves(t)[3]),
        axis=(0.0, float(np.cos(tilt)), float(np.sin(tilt))),
        pivot=pivot,
    )


def read(folder: str) -> dict[str, list]:
    """Windows of half a second by split."""
    with tempfile.TemporaryDirectory() as own:
        if not folder:
            record(Path(own))
        root = folder or own
        found = {split: [mocap.read(path) for path in mocap.recordings(split, root=root)] for split in SEEDS}
    return {split: _cable.windows(own, FRAMES, ahead=split == "train") for split, own in found.items()}


class Predictor:
    """Windows as worlds of one simulator."""

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
        """Markers that no grip holds (F, windows, M - 4, 3), of logarithms (3,) of the parameters over the guess."""
        import torch

        parameters = {
            own: self.simulator.parameter(own)[:1] * logarithms[k].exp()
            for k, names in enumerate(NAMES.values())
            for own in names
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
    """What `Start` keeps, but for `make`."""
    import torch

    split = {name: own[:: -(-len(own) // windows)] for name, own in read(folder).items()}
    predict = Predictor(split["train"], mass)
    wanted = torch.tensor(inner(np.stack([window.seen[1:] for window in split["train"]], axis=1)))
    known = torch.isfinite(wanted)

    def loss(logarithms):
        off = torch.where(known, predict(logarithms) - wanted.nan_to_num(), 0.0)
        return ((off / SCALE) ** 2).sum() / known.sum()

    start = torch.zeros(len(NAMES), dtype=torch.float64)
    found, losses = _learn.minimise(loss, start, iterations=40, tolerance=1e-7)
    others = Predictor(split["eval"], mass)
    with torch.no_grad():
        predicted = {name: others(at).numpy().swapaxes(0, 1) for name, at in (("guessed", start), ("learned", found))}
    values = {name: GUESS[name] * float(factor) for name, factor in zip(NAMES, found.exp(), strict=True)}
    return {"values": values, "tried": split["eval"], "predicted": predicted, "losses": losses, "own": not folder}


def check(result) -> list[ddg.Check]:
    """Parameters of the cable that was recorded, where they are known; windows held out; what runs is what was predicted."""
    found = result.learned = result.model.scene.initial
    off, guessed = found.off("learned"), found.off("guessed")
    told = f"{len(found.tried)} windows of {FRAMES / mocap.RATE:g} s; with the first guess {1e3 * guessed:.3g} mm"
    checks = []
    for name, value in found.values.items():
        if found.own:
            checks.append(ddg.Check(UNITS[name], value, TRUTH[name], WITHIN[name], "what was recorded", relative=True))
        else:
            checks.append(
                ddg.Check.skip(f"{UNITS[name]}: {value:.4g}", "that of the cable that was recorded is not known")
            )
    limit = CLOSE if found.own else guessed
    name = "markers of a run off what was predicted [m]"

    def ran() -> list[ddg.Check]:
        last = result.state.points().reshape(-1, 3)[::PARTS]
        away = np.abs(inner(last) - found.predicted["learned"][0, -1]).max()
        return [ddg.Check(name, away, 0.0, SAME, "worlds of a simulator; lengths are those at the start here")]

    return [
        *checks,
        ddg.Check(OFF, off, 0.0, limit, told),
        *once_reached(result, found.tried[0].duration, [name], ran),
    ]


def picture(result, frames) -> dict:
    """The learned cable at a few times, with the markers that were seen as balls."""
    window, parts = result.model.scene.initial.tried[0], 4
    ball, triangles = meshes.sphere(1)
    shown = {t: frames[t] for t in list(frames)[:: max(1, (len(frames) - 1) // parts)]}
    bodies = {}
    for t in shown:
        places = window.seen[min(round(t * mocap.RATE), FRAMES)]
        places = places[np.isfinite(places).all(1)]
        balls = (places[:, None] + BALL * ball).reshape(-1, 3)
        bodies[t] = balls, (triangles[None] + len(ball) * np.arange(len(places))[:, None, None]).reshape(-1, 3)
    return {"points_by_time": shown, "bodies": bodies}


def plot(result) -> dict:
    """How far markers of windows held out are from where they were seen, over the time since the start."""
    found, times = result.learned, np.arange(1, FRAMES + 1) / mocap.RATE
    seen = inner(np.stack([window.seen[1:] for window in found.tried]))
    kinds = (("guessed", "first guess", "--"), ("learned", "learned", "-"))
    lines = [
        (label, times, 1e3 * np.nanmean(np.abs(found.predicted[name] - seen), axis=(0, 2, 3)), style)
        for name, label, style in kinds
    ]
    told = ", ".join(f"{name} = {value:.3g}" for name, value in found.values.items())
    return {
        "lines": lines,
        "x": "time since the start of a window [s]",
        "y": "off on average, a coordinate [mm]",
        "title": f"Windows held out: {told}",
    }


def benchmark() -> ddg.bench.Study:
    """Windows held out over how many were learned from."""
    return ddg.bench.Study({"windows": (1, 2, 4, 8)}, OFF)
