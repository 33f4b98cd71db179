"""Gradients by the implicit function theorem against a Newton iteration unrolled by torch."""

import numpy as np
import pytest

import ddg_warp as ddg
from tests.adjoint.differences import TIGHT, built

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402

DT, STEPS, ITERATIONS = 0.01, 3, 12
YOUNG, DENSITY, RADIUS = 1e6, 1000.0, 0.004
POINTS = np.array([[0.0, 0.0], [0.05, 0.0], [0.095, 0.02], [0.13, 0.055], [0.15, 0.1]])
FREE = 4  # entries of the first edge, which is clamped


def rest_lengths():
    """Return the rest lengths of edges [m] on the device under test."""
    return torch.tensor(np.linalg.norm(np.diff(POINTS, axis=0), axis=1))


def energy(x, bend, gravity):
    """Return the energy of a planar rod.

    It is sum EA/2 l0 (l/l0 - 1)^2 + sum EI/2 w (2 tan(phi/2) / w)^2 - sum m g . x, w the Voronoi lengths.
    """
    area, rest = np.pi * RADIUS**2, rest_lengths()
    edges = x[1:] - x[:-1]
    lengths = torch.sqrt((edges**2).sum(1))
    stretch = 0.5 * YOUNG * area * (rest * (lengths / rest - 1.0) ** 2).sum()
    e, f, w = edges[:-1], edges[1:], 0.5 * (rest[:-1] + rest[1:])
    cross = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
    angles = 2.0 * cross / (lengths[:-1] * lengths[1:] + (e * f).sum(1))
    return stretch + (0.5 * bend * angles**2 / w).sum() - (masses() * (x @ gravity)).sum()


def masses():
    """Return node masses: half of the mass of each adjacent edge."""
    edge_masses = DENSITY * np.pi * RADIUS**2 * rest_lengths()
    none = torch.zeros(1, dtype=edge_masses.dtype)
    return 0.5 * (torch.cat([edge_masses, none]) + torch.cat([none, edge_masses]))


def unrolled(bend, velocities, gravity):
    """Nodes after some steps of implicit Euler, every Newton iteration of which torch records."""
    x, v = torch.tensor(POINTS), velocities
    for _ in range(STEPS):
        start, target = x.flatten()[:FREE], (x + DT * v).flatten()[FREE:]

        def potential(free, start=start, target=target):
            whole = torch.cat([start, free]).reshape(-1, 2)
            inertia = 0.5 / DT**2 * (masses().repeat_interleave(2)[FREE:] * (free - target) ** 2).sum()
            return inertia + energy(whole, bend, gravity)

        free = target
        for _ in range(ITERATIONS):
            slope = torch.func.grad(potential)(free)
            free = free - torch.linalg.solve(torch.func.hessian(potential)(free), slope)
        new = torch.cat([start, free]).reshape(-1, 2)
        x, v = new, (new - x) / DT
    return x


def test_gradients_are_those_of_an_unrolled_tape():
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), dimension=2)
    points = np.insert(POINTS, 1, 0.0, axis=1)
    material = ddg.Material(young=YOUNG, density=DENSITY)
    rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=material, natural="straight")
    scene.clamp(rod)
    simulator = Simulator(built(scene), DT, **TIGHT)
    weight = torch.tensor(np.random.default_rng(5).normal(size=POINTS.shape))
    inputs = {
        "bend": torch.tensor(YOUNG * np.pi * RADIUS**4 / 4.0, dtype=torch.float64),
        "velocities": torch.tensor(np.random.default_rng(6).normal(size=POINTS.shape)) * 0.3,
        "gravity": torch.tensor([1.0, -9.81], dtype=torch.float64),
    }
    inputs["velocities"][: FREE // 2] = 0.0

    def stepped(bend, velocities, gravity):
        def in_space(values):
            return torch.stack([values[..., 0], torch.zeros_like(values[..., 0]), values[..., 1]], -1)

        state = simulator.initial_state(velocities=in_space(velocities))
        controls = {"gravity": in_space(gravity)}
        *_, state = simulator.rollout(state, {"planar_bend.stiffness": bend}, controls, steps=STEPS)
        return state.positions[0][:, [0, 2]]

    results = []
    for steps in (unrolled, stepped):
        leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
        x = steps(**leaves)
        results.append((x.detach().cpu(), torch.autograd.grad((weight * x).sum(), list(leaves.values()))))
    (tape_x, tape), (x, gradients) = results
    assert x.numpy() == pytest.approx(tape_x.numpy(), abs=1e-12)
    for name, by_tape, ours in zip(inputs, tape, gradients, strict=True):
        free = slice(FREE // 2, None) if name == "velocities" else ...
        assert ours[free].cpu().numpy() == pytest.approx(by_tape[free].cpu().numpy(), rel=1e-8, abs=1e-10), name
