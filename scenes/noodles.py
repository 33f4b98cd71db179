"""Noodles: strands are poured into a bowl, 9 of 97 nodes, or 121 of 961 with 4.8 m each.

They hang above the bowl, straight and side by side, and fall into it end first. Weight bends them over (EI / w)^(1/3) = 6 cm,
so that they coil and lie down in loops on each other. The bowl is a mesh, half of a sphere.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scenes import _many_rods

EDGE = 5e-3  # m
SPACING = 0.05  # m, between strands
RADIUS = 3e-3  # m
GAP = 3e-3  # m, activation distance
CLEAR = 0.02  # m, between the bowl and the lowest ends
BENDING, STRETCHING, MASS = 2.44e-3, 1e4, 1.0  # N m^2, N, kg/m
FRICTION = 0.05
CONTACT = 3e3  # N/m: strands that fall end first press with a hundred times their weight
RTOL = 3e-2  # relative to the weight of a rod: position errors are a fiftieth of the change by half the step
SLIP = 1e-2  # m/s, stick threshold of friction
WALL = 1e-3  # m, half the thickness of the bowl
CELLS = 0.06  # m, approximate side of the bowl's triangles


def build(
    count: int = 9,
    nodes: int = 97,
    bowl: float = 0.2,
    dt: float = 1.0 / 120.0,
    duration: float = 0.7,
    twist: bool = True,
    seed: int = -1,
) -> ddg.Scene:
    """Build strands on a square grid above the bowl.

    Args:
        count: number of strands
        nodes: nodes of a strand, 5 mm apart
        bowl: radius of the bowl [m]; the large case has 1.1
        dt: time step [s]
        duration: duration of the run [s]; the large case takes 4 s
        twist: whether strands have twist, which does not act on straight round ones with free ends
        seed: seed of the initial jitter of nodes, a fifth of the activation distance; no jitter below 0
    """
    side = int(np.ceil(np.sqrt(count)))
    number = np.arange(count)
    across = SPACING * (np.stack([number % side, number // side], axis=1) - 0.5 * (side - 1))
    far = np.linalg.norm(across, axis=1).max() + RADIUS + GAP
    if far > 0.8 * bowl:
        raise ValueError(
            f"bowl = {bowl} m; strands hang up to {far:.3g} m from its axis, give {1.25 * far:.3g} or more"
        )
    above = CLEAR + RADIUS + GAP + WALL - np.sqrt((bowl - RADIUS) ** 2 - (across**2).sum(1))
    points = np.empty((count, nodes, 3))
    points[..., :2] = across[:, None]
    points[..., 2] = above[:, None] + EDGE * np.arange(nodes)
    # each strand is bowed by a fraction of its radius, in its own direction
    bow = 0.2 * RADIUS * np.sin(np.linspace(0.0, 3.0 * np.pi, nodes))
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    points[..., :2] += bow[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
    scene = ddg.Scene(
        analysis=ddg.Dynamics(dt=dt, duration=duration, rtol=RTOL),
        initial=lambda model: _many_rods.jittered(model, seed),
    )
    scene.add_rods(
        points,
        section=ddg.Stiffness(
            EA=STRETCHING,
            EI1=BENDING,
            GJ=BENDING,
            mass_per_length=MASS,
            rotary_inertia=0.5 * MASS * RADIUS**2,
            radius=RADIUS,
            viscosity=2e-3,
        ),
        natural="straight",
        twist=twist,
        name="noodles",
    )
    cap, triangles = meshes.spherical_cap(max(8, round(0.5 * np.pi * bowl / CELLS)), bowl)
    scene.contact(range=GAP, stiffness=CONTACT, friction=FRICTION, velocity=SLIP)
    scene.add_obstacle(ddg.Mesh(cap * [1.0, 1.0, -1.0], triangles, WALL), name="bowl")
    return scene


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with the largest distance of nodes from the centre of the bowl [m]."""
    observed = _many_rods.observe(model, state)
    return {**observed, "farthest": float(np.linalg.norm(below(state.points()), axis=1).max(initial=0.0))}


def below(points: np.ndarray) -> np.ndarray:
    """Return the points (n, 3) below the rim."""
    return points[points[:, 2] < 0.0]


def check(result) -> list[ddg.Check]:
    """Check no crossing, no overlap, all nodes inside the bowl, energy, and the weight on the bowl except for friction."""
    bowl = float(np.abs(result.model.scene.obstacles[0].shape.points[:, 2]).max())
    inside = max(result.series["farthest"]) / (bowl - RADIUS)
    return [
        *_many_rods.checks(result),
        _many_rods.weight_check(result, FRICTION),
        _many_rods.energy_check(result),
        ddg.Check("farthest node below the rim over the bowl's radius", inside, 0.0, 1.0, "the bowl has no hole"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the height of the strands' centre at 0.3 s over steps."""
    return ddg.bench.Study(
        {"dt": (1 / 60, 1 / 120, 1 / 240)},
        lambda result: result.state.points()[:, 2].mean(),
        {"dt": 1 / 960},
        fixed={"count": 4, "duration": 0.3},
        unit="m",
    )


def picture(result, frames) -> dict:
    """Draw the strands before, during and after pouring, in the bowl."""
    shape = result.model.scene.obstacles[0].shape
    back = shape.points[shape.cells].mean(axis=1)[:, 1] > 0.0  # the half that occludes nothing
    times = list(frames)
    times = times[0], times[len(times) // 2], times[-1]
    return {
        "points_by_time": {t: frames[t] for t in times},
        "bodies": {t: (shape.points, shape.cells[back]) for t in times},
        "colors": _many_rods.colors(result.model),
        "side_by_side": True,
    }
