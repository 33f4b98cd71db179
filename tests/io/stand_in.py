"""Model and states without Warp, with the minimal interface of recorder and writers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ddg_warp.geometry import meshes
from ddg_warp.io import Curves, Surfaces

SAIL, BALL = meshes.rectangle(4, 2), meshes.sphere(0)


def curves() -> Curves:
    """Return two open rods of 5 points and a closed one of 6, in two batches."""
    counts = np.array([5, 5, 6])
    return Curves(
        counts=counts,
        closed=np.array([False, False, True]),
        radius=np.repeat([0.01, 0.01, 0.02], counts),
        names=np.array(["strand", "strand", "ring"], dtype=object),
        batch=np.array([0, 0, 1]),
    )


def rest_points() -> np.ndarray:
    """Return positions [m], shape (16, 3): lines along x and a circle in the plane z = 1."""
    line = np.linspace(0.0, 1.0, 5)
    angle = 2.0 * np.pi * np.arange(6) / 6
    rods = [np.stack([line, np.full(5, y), np.zeros(5)], axis=1) for y in (0.0, 0.5)]
    return np.concatenate([*rods, np.stack([np.cos(angle), np.sin(angle), np.ones(6)], axis=1)])


def surfaces() -> Surfaces:
    """Return a sail of 4 x 2 cells, fixed to the ring at its first vertex, and a ball; their other points follow the rods'."""
    (_, sail), (_, ball) = SAIL, BALL
    return Surfaces(
        triangles=np.concatenate([np.where(sail == 0, 15, 15 + sail), 30 + ball]),
        first=np.array([0, len(sail)]),
        names=np.array(["sail", "ball"], dtype=object),
        thickness=np.repeat([1e-3, 2e-3], [len(sail), len(ball)]),
    )


def surface_points() -> np.ndarray:
    """Return the positions of surface points without rod points [m], shape (26, 3)."""
    return np.concatenate([SAIL[0][1:] + [0.5, -1.0, 1.0], BALL[0] + [0.0, 0.0, 3.0]])


@dataclass
class State:
    """Points advanced by a pseudo-random map: a wrong restart shows."""

    time: float
    q: np.ndarray
    model: object = None

    def points(self) -> np.ndarray:
        return self.q

    def velocities(self) -> np.ndarray:
        return np.cos(self.q)

    def obstacle_points(self) -> np.ndarray:
        return np.zeros((0, 3))

    def directors(self) -> np.ndarray:
        return np.tile([0.0, 0.0, 1.0], (14, 1))

    def snapshot(self) -> dict[str, np.ndarray]:
        return {"time": np.array(self.time), "0/q": self.q, "0/seed": np.arange(3, dtype=np.int32)}


@dataclass
class Model:
    """Model of `worlds` copies."""

    curves: Curves = field(default_factory=curves)
    surfaces: Surfaces | None = None
    obstacles: object = None
    contact_scales: object = None
    worlds: int = 1
    scene: object = None
    bodies: tuple = ()
    rigid_bodies: object = None

    def parameters(self) -> dict[str, np.ndarray]:
        return {"bend_stiffness": np.array([1e-3, 2e-3]), "density": np.array(1000.0)}

    def state(self) -> State:
        points = rest_points()
        if self.surfaces is not None:
            points = np.concatenate([points, surface_points()])
        return State(0.0, points if self.worlds == 1 else np.stack([points + k for k in range(self.worlds)]), self)

    def restore(self, snapshot: dict[str, np.ndarray]) -> State:
        return State(float(snapshot["time"]), snapshot["0/q"].copy(), self)


def step(state: State, dt: float = 0.01) -> State:
    """Return the next state; the map is chaotic: only bitwise equal states evolve equally."""
    return State(state.time + dt, np.sin(3.0 * state.q + state.time), state.model)
