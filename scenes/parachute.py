"""Parachute: a canopy under pressure, its lines and a payload descend at a steady speed.

The pressure follows the canopy; drag of everything else is proportional to mass, so that all accelerations decay. Then, with M the
total mass, m the payload, v the speed of descent and alpha the damping,

    M (g - alpha v) = p A ,        sum over lines of tension times cosine = m (g - alpha v) ,

with A the canopy's area seen from above.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached

RADIUS = 2.0  # m, of the mouth
LINE = 3.0  # m, height of the mouth over the payload
THICKNESS = 2e-3  # m; a soft cloth
CLOTH = ddg.Material(young=2.0e6, poisson=0.3, density=400.0, viscosity=0.02)
GRAVITY = 9.81  # m/s^2
DAMPING = 2.0  # 1/s
STEADY = "steady descent"
SETTLED = 4.0  # s; time of steady descent


def build(
    rings: int = 6,
    lines: int = 12,
    payload: float = 20.0,
    pressure: float = 20.0,
    duration: float = 4.0,
    dt: float = 0.02,
) -> ddg.Scene:
    """Build a shallow canopy with straight lines from the rim to a payload, released from rest.

    Args:
        rings: rings of the canopy's mesh, six times as many vertices around the rim
        lines: number of lines, a divisor of the vertices around the rim
        payload: mass of the payload [kg]
        pressure: pressure on the canopy [Pa]
        duration: end of the run [s]
        dt: time step [s]
    """
    points, triangles = meshes.spherical_cap(rings, RADIUS / np.sin(1.0), 1.0)
    rim = 6 * rings
    if lines < 3 or rim % lines:
        raise ValueError(f"lines = {lines}; give a divisor of the {rim} vertices around the rim, 3 at least")
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY), mass_damping=DAMPING, analysis=ddg.Dynamics(dt=dt, duration=duration)
    )
    canopy = scene.add_shell(points, triangles, thickness=THICKNESS, material=CLOTH, name="canopy")
    scene.add_pressure(canopy, pressure, amplitude=lambda t: min(1.0, t / 0.2))
    lowest = points[:, 2].min()
    edge = np.flatnonzero(points[:, 2] < lowest + 1e-6 * RADIUS)
    edge = edge[np.argsort(np.arctan2(points[edge, 1], points[edge, 0]))][:: rim // lines]
    load = np.array([0.0, 0.0, lowest - LINE])
    section = ddg.Stiffness(EA=2.0e4, mass_per_length=0.02, radius=5e-3, viscosity=0.02)
    cords = []
    for vertex in edge:
        cord = scene.add_rod(np.linspace(points[vertex], load, 5), section=section, bend=False, name="line")
        scene.attach(cord, [0], canopy, [int(vertex)])
        cords.append(cord)
    scene.join([(cord, -1) for cord in cords], rigid=False)
    scene.add_mass([cords[0]], -1, payload)
    return scene


def observe(model, state) -> dict[str, float]:
    """Return speed of descent of payload and canopy [m/s], and the canopy's area seen from above [m^2]."""
    velocity, points = (np.reshape(v, (-1, 3)) for v in (state.velocities(), state.points()))
    rods = int(model.curves.counts.sum())
    corners = points[model.surfaces.triangles]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].sum()
    return {
        "payload": -velocity[rods // len(model.curves.counts) - 1, 2],
        "canopy": -velocity[rods:, 2].mean(),
        "area": area,
    }


def check(result) -> list[ddg.Check]:
    """Check lift and line tensions in steady descent."""
    names = (
        "speed of the canopy over that of the payload",
        "lift over M (g - alpha v)",
        "pull of the lines over m (g - alpha v)",
    )
    return once_reached(result, SETTLED, names, lambda: descent(result, names))


def descent(result, names) -> list[ddg.Check]:
    """Return the checks of a steady canopy."""
    model, state = result.model, result.state
    host, last = model.coupled.host, {name: values[-1] for name, values in result.series.items()}
    total = float(host.mass[: host.nodes, 2].sum())
    carried = model.scene.masses[0][2] + 0.5 * 0.02 * sum(_last_edges(model))
    effective = GRAVITY - DAMPING * last["payload"]
    lift = model.scene.pressures[0].pressure[0] * last["area"]
    tension = model.stresses(state)["rod_stretch"]
    points, ends, pull = state.points().reshape(-1, 3), np.cumsum(model.curves.counts), 0.0
    for end, values in zip(ends, tension, strict=True):
        edge = points[end - 2] - points[end - 1]
        pull += float(values[-1, 0] * edge[2] / np.linalg.norm(edge))
    return [
        ddg.Check(names[0], last["canopy"] / last["payload"], 1.0, 0.01, STEADY),
        ddg.Check(names[1], lift / (total * effective), 1.0, 0.01, STEADY),
        ddg.Check(names[2], pull / (carried * effective), 1.0, 0.01, STEADY),
    ]


def _last_edges(model) -> list[float]:
    """Return rest lengths of the edges at the payload [m]."""
    return [float(np.linalg.norm(batch.points[0, -1] - batch.points[0, -2])) for batch in model.scene.batches]


def picture(result, frames) -> dict:
    """Draw the parachute at a few times, and its speed over time."""
    times = list(frames)[::2]
    lines = [(name, result.times, result.series[name], "-") for name in ("payload", "canopy")]
    return {
        "points_by_time": {t: frames[t] for t in (*times, max(frames))},
        "chart": {"lines": lines, "x": "time [s]", "y": "speed of descent [m/s]"},
    }


def benchmark() -> ddg.bench.Study:
    """Study the speed of payload and canopy at 2 s over steps, rings and tolerances, against a finer run."""
    return ddg.bench.Study(
        {"dt": (0.04, 0.02, 0.01), "rings": (3, 6), "rtol": (1e-4, 1e-8)},
        lambda result: [result.series[name][-1] for name in ("payload", "canopy")],
        {"dt": 0.005, "rings": 12, "rtol": 1e-8},
        fixed={"lines": 6, "duration": 2.0},
        series=("rings", "rtol"),
        unit="m/s",
    )
