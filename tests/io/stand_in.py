"""A model and its states without Warp: what recorder and writers ask of the real ones, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ddg_warp.io import Curves


def curves() -> Curves:
    """Two open rods of 5 points and a closed one of 6, in two batches."""
    counts = np.array([5, 5, 6])
    return Curves(
        counts=counts,
        closed=np.array([False, False, True]),
        radius=np.repeat([0.01, 0.01, 0.02], counts),
        names=np.array(["strand", "strand", "ring"], dtype=object),
        batch=np.array([0, 0, 1]),
    )


def rest_points() -> np.ndarray:
    """Positions [m], shape (16, 3): lines along x and a circle in the plane z = 1."""
    line = np.linspace(0.0, 1.0, 5)
    angle = 2.0 * np.pi * np.arange(6) / 6
    rods = [np.stack([line, np.full(5, y), np.zeros(5)], axis=1) for y in (0.0, 0.5)]
    return np.concatenate([*rods, np.stack([np.cos(angle), np.sin(angle), np.ones(6)], axis=1)])


@dataclass
class State:
    """Points that a pseudo-random map moves, so that a wrong restart shows."""

    time: float
    q: np.ndarray

    def points(self) -> np.ndarray:
        return self.q

    def velocities(self) -> np.ndarray:
        return np.cos(self.q)

    def directors(self) -> np.ndarray:
        return np.tile([0.0, 0.0, 1.0], (14, 1))

    def snapshot(self) -> dict[str, np.ndarray]:
        return {"time": np.array(self.time), "0/q": self.q, "0/seed": np.arange(3, dtype=np.int32)}


@dataclass
class Model:
    """A model of `worlds` copies."""

    curves: Curves = field(default_factory=curves)
    worlds: int = 1
    scene: object = None

    def parameters(self) -> dict[str, np.ndarray]:
        return {"bend_stiffness": np.array([1e-3, 2e-3]), "density": np.array(1000.0)}

    def state(self) -> State:
        points = rest_points()
        return State(0.0, points if self.worlds == 1 else np.stack([points + k for k in range(self.worlds)]))

    def restore(self, snapshot: dict[str, np.ndarray]) -> State:
        return State(float(snapshot["time"]), snapshot["0/q"].copy())


def step(state: State, dt: float = 0.01) -> State:
    """The next state; the map is chaotic enough that only a bitwise equal state continues alike."""
    return State(state.time + dt, np.sin(3.0 * state.q + state.time))
