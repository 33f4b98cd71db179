"""Shared pieces of scenes of hair: strands of one kind, clamped at their first edge on rigidly moving roots."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.kernels.densities.quadratic import quadratic

GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # rad
HAIR = np.array([0.36, 0.21, 0.11])  # RGB
PANELS = 3  # panels of the picture
GRAVITY = 9.81  # m/s^2
HEAD = 0.97  # radius of the drawn head over that of the roots


def placed(motion: ddg.Motion, rest: np.ndarray, t: float) -> np.ndarray:
    """Return the positions of rest points (..., 3) under a motion at time t."""
    return (rest - motion.pivot) @ motion.rotation(motion.angle(t)).T + motion.pivot + np.asarray(motion.translation(t))


def edge_lengths(points: np.ndarray) -> np.ndarray:
    """Return lengths (..., nodes - 1) of the edges between points (..., nodes, 3)."""
    return np.linalg.norm(np.diff(points, axis=-2), axis=-1)


def as_drawn(points: np.ndarray, **about) -> dict:
    """Return natural shapes and laws for `add_rods` that make strands (count, nodes, 3), clamped at their first edge, hang as drawn.

    Args:
        points: drawn equilibrium.
        about: section and material.
    """
    from ddg_warp.postprocess import sag_free  # imports SciPy, which scenes of hair do without

    scene = ddg.Scene()
    scene.clamp(scene.add_rods(points, **about), edges=[0])
    strains = sag_free.rest_strains(scene.build("cpu", "float64"))
    *natural, stretch = (values.reshape(len(points), -1) for values in strains.values())
    return {"natural": tuple(natural), "laws": {"rod_stretch": ddg.Law(quadratic, rest=stretch)}}


def moments(points: np.ndarray, weight: float) -> np.ndarray:
    """Return moments (rods, nodes - 2) [N m] at inner nodes of rods (rods, nodes, 3) of the weight [N/m] beyond each."""
    half = 0.5 * weight * np.linalg.norm(np.diff(points, axis=1), axis=2)
    load = np.pad(half, ((0, 0), (1, 0))) + np.pad(half, ((0, 0), (0, 1)))
    arms = points[:, None, :, :2] - points[:, 1:-1, None, :2]  # weights act along z: only horizontal arms count
    beyond = np.arange(points.shape[1]) > np.arange(1, points.shape[1] - 1)[:, None]
    return np.linalg.norm((arms * (load[:, None] * beyond)[..., None]).sum(2), axis=2)


def observe(model, state) -> dict[str, float]:
    """Return stretch of edges, root position error [m], kinetic energy [J] and speed [m/s]."""
    batch, support = model.scene.batches[0], model.scene.supports[0]
    shape = (-1, *batch.points.shape)
    points, velocities = state.points().reshape(shape), state.velocities().reshape(shape)
    rest = edge_lengths(batch.points)
    stretch = edge_lengths(points) / rest - 1.0
    off = points[:, :, :2] - placed(support.motion, batch.points[:, :2], state.time)
    cell = 0.5 * (np.pad(rest, ((0, 0), (1, 0))) + np.pad(rest, ((0, 0), (0, 1))))
    square = (velocities**2).sum(axis=-1)
    return {
        "stretch": float(np.abs(stretch).max()),
        "root_error": float(np.abs(off).max()),
        "kinetic": float(0.5 * batch.section.mass_per_length * (cell * square).sum(axis=(1, 2)).max()),
        "speed": float(np.sqrt(square.max())),
    }


def checks(result, stretch: float, source: str) -> list[ddg.Check]:
    """Check convergence, finite values, prescribed roots, lengths and a bound of the energy.

    Args:
        result: a run.
        stretch: bound of the stretch of an edge.
        source: source of that bound.
    """
    outcomes = result.statistics["outcomes"]
    failed = sum(number for name, number in outcomes.items() if not name.startswith("converged"))
    series = {name: np.array(values) for name, values in result.series.items()}
    batch = result.model.scene.batches[0]
    mass = batch.section.mass_per_length * edge_lengths(batch.points).sum()
    bound = 0.5 * mass * top_speed(result) ** 2
    finite = np.isfinite(result.state.points()).all() and all(np.isfinite(values).all() for values in series.values())
    return [
        ddg.Check("solves that did not converge", failed, 0.0, 0.0),
        ddg.Check("values that are not finite", float(not finite), 0.0, 0.0),
        ddg.Check(
            "roots from where they are to be [m]", series["root_error"].max(), 0.0, 1e-12, "the prescribed motion"
        ),
        ddg.Check("largest stretch of an edge", series["stretch"].max(), 0.0, stretch, source),
        ddg.Check(
            "kinetic energy over its bound", series["kinetic"].max() / bound, 0.0, 1.0, "work of roots and gravity"
        ),
    ]


def top_speed(result) -> float:
    """Return a bound of the speed [m/s]: of a strand that moves with the fastest root and falls by its length."""
    longest = edge_lengths(result.model.scene.batches[0].points).sum(axis=1).max()
    return float(np.sqrt(fastest_root(result) ** 2 + 2.0 * GRAVITY * longest))


def stopped(result) -> float:
    """Return the momentum of the longest strand at top speed [N s]."""
    batch = result.model.scene.batches[0]
    return batch.section.mass_per_length * edge_lengths(batch.points).sum(axis=1).max() * top_speed(result)


def fastest_root(result) -> float:
    """Return the top speed [m/s] of any root during the run."""
    batch, support = result.model.scene.batches[0], result.model.scene.supports[0]
    path = np.array([placed(support.motion, batch.points[:, 0], t) for t in result.times])
    return float(np.linalg.norm(np.diff(path, axis=0), axis=-1).max() / result.dt)


def shown(frames) -> dict:
    """Return a few frames (time -> points), the first included."""
    return {t: frames[t] for t in list(frames)[:: max(1, (len(frames) - 1) // (PANELS - 1))]}


def ball(roots: np.ndarray) -> tuple[np.ndarray, float]:
    """Return center (3,) and radius [m] of the least-squares sphere through roots (count, 3)."""
    # |x|^2 = 2 c . x + (r^2 - |c|^2)
    fit, *_ = np.linalg.lstsq(np.column_stack([2.0 * roots, np.ones(len(roots))]), (roots**2).sum(1), rcond=None)
    return fit[:3], float(np.sqrt(fit[3] + fit[:3] @ fit[:3]))


def head(roots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) and triangles (t, 3) of a ball slightly below roots (count, 3)."""
    center, radius = ball(roots)
    points, triangles = meshes.sphere(4)
    return center + HEAD * radius * points, triangles


def colors(count: int) -> np.ndarray:
    """Return varied RGB colors (count, 3) of strands."""
    return np.random.default_rng(1).uniform(0.6, 1.3, (count, 1)) * HAIR
