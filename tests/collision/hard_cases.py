"""Materials, rods, runs and brute-force gaps for hard cases of contact."""

import numpy as np
from brute_force import SIDES, admissible_pairs, distances

import ddg_warp as ddg

RADIUS = 2e-3  # m
DENSITY = 1000.0  # kg/m^3
SOFT = ddg.Material(young=1e6, density=DENSITY, poisson=0.5)
AREA = np.pi * RADIUS**2
MU, RANGE = 0.3, 1e-3  # of contact [-, m]
WEIGHT = DENSITY * AREA * 9.81  # of rods, per length [N/m]


def line(length: float, edges: int, along=(1.0, 0.0, 0.0), middle=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the nodes of a straight rod (edges + 1, 3) [m]."""
    return np.linspace(-0.5, 0.5, edges + 1)[:, None] * length * np.array(along) + np.array(middle)


def rod(scene: ddg.Scene, points: np.ndarray, name: str = "rod", material=SOFT, **options) -> int:
    """Add a round rod and return the number."""
    return scene.add_rod(points, section=ddg.Circle(RADIUS), material=material, name=name, **options)


def fix_nodes(scene: ddg.Scene, number: int, nodes: int) -> None:
    """Fix all nodes of a rod."""
    scene.fix(number, list(range(nodes)))


def run(scene: ddg.Scene, device, steps: int, dt: float, points=None, velocities=None, retries: int = 0, **options):
    """Return the model, integrator and states of a run with at most `retries` steps repeated in substeps."""
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model, check_every=1, **options), model.state(points, velocities)
    states = [state]
    for _ in range(steps):
        state = integrator.step(state, dt)
        assert np.isfinite(state.points()).all()
        states.append(state)
    statistics = integrator.statistics()
    failed = sum(n for name, n in statistics["outcomes"].items() if not name.startswith("converged"))
    assert failed == statistics["retries"] <= retries
    return model, integrator, states


def energy(model, states) -> np.ndarray:
    """Return the total energy of every state [J]."""
    return np.array([sum(model.energies(state).values()) for state in states])


def assert_no_energy_is_made(total: np.ndarray) -> None:
    assert np.diff(total).max() <= 1e-9 * (np.ptp(total) + np.abs(total).max())


def forces_on(contacts, number: int) -> np.ndarray:
    """Return the contact forces (n, 3) on object `number` [N]."""
    sign = (contacts.objects == number).astype(float) @ [1.0, -1.0]
    return (sign[:, None] * contacts.force)[sign != 0.0]


def least_gap(model, state) -> float:
    """Return the smallest gap of rods and shells, by all pairs in NumPy [m]."""
    shapes, x, gaps = model.touch.shapes, state.coupled.q.numpy(), []
    for sides in SIDES:
        if set(sides) <= set(shapes.sizes):
            distance, thickness = distances(shapes, x, *sides, *admissible_pairs(shapes, *sides))
            gaps.append(float((distance - thickness).min(initial=np.inf)))
    return min(gaps)


def mass_of_node(edges: int, length: float = 0.1) -> float:
    """Return the mass of an inner node of a rod [kg]."""
    return DENSITY * AREA * length / edges


def heap_at_rest(ratio: float | None, dt: float) -> ddg.Scene:
    """Return two rods across two others on a floor.

    `ratio` is the contact stiffness over m / dt^2; None takes the default stiffness.
    """
    scene = ddg.Scene(mass_damping=20.0)
    for name, along, across, height in (("low", 0, 1, 1.4), ("high", 1, 0, 3.8)):
        for side in (-0.03, 0.03):
            middle = side * np.eye(3)[across] + [0.0, 0.0, height * RADIUS]
            rod(scene, line(0.1, 10, np.eye(3)[along], middle), f"{name} {side}")
    scene.add_obstacle(ddg.Plane(), name="floor")
    stiffness = None if ratio is None else ratio * mass_of_node(10) / dt**2
    scene.contact(range=RANGE, stiffness=stiffness, friction=0.4, velocity=1e-5)
    return scene
