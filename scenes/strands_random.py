"""Random rods: many lengths, node counts, sections and materials in one scene; each rod moves as if alone.

Rods of one scene are sorted, padded and advanced together. None of that may have an effect: without contact a rod has the
same motion in the scene and alone. Helices of random size, clamped at one end, fall and swing.
"""

import numpy as np

import ddg_warp as ddg

SPACING = 0.5  # m, between roots
SOURCE = "the same rods, each simulated alone"


def build(count: int = 36, seed: int = 3) -> ddg.Scene:
    """Build rods on a square grid.

    Args:
        count: number of rods
        seed: seed of the random numbers
    """
    rods = [random_rod(np.random.default_rng([seed, i])) for i in range(count)]
    side = int(np.ceil(np.sqrt(count)))
    for i, rod in enumerate(rods):
        rod["points"] = rod["points"] + SPACING * np.array([i % side, i // side, 0.0])
    return scene_of(rods, ddg.Dynamics(dt=0.005, duration=0.5, scheme="implicit_euler"))


def scene_of(rods: list[dict], analysis: ddg.Dynamics) -> ddg.Scene:
    """Return a scene of rods, each clamped by its first edge."""
    scene = ddg.Scene(analysis=analysis, mass_damping=0.2)
    for options in rods:
        scene.clamp(scene.add_rod(**options), edges=[0])
    return scene


def random_rod(rng: np.random.Generator) -> dict:
    """Return arguments of `add_rod` for a random helix that leaves the origin upwards or sideways."""
    nodes = int(rng.integers(8, 65))
    length = rng.uniform(0.1, 0.6)  # m
    s = np.linspace(0.0, length, nodes)[:, None]
    # number of turns of the helix, and fraction of the length along the circumference
    turns, winding = rng.uniform(0.2, 2.0), rng.uniform(0.2, 0.8)
    phase = 2.0 * np.pi * turns * s / length
    across, along = winding * length / (2.0 * np.pi * turns), np.sqrt(1.0 - winding**2)
    shape = np.hstack([across * np.cos(phase), across * np.sin(phase), along * s])
    shape = (shape - shape[0]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    size = length * rng.uniform(0.01, 0.02)  # m
    kind = str(rng.choice(["circle", "ellipse", "rectangle"]))
    section = {
        "circle": ddg.Circle(size),
        "ellipse": ddg.Ellipse(size, rng.uniform(0.4, 0.9) * size),
        "rectangle": ddg.Rectangle(2.0 * size, rng.uniform(0.3, 1.0) * size),
    }[kind]
    # Young's modulus from the length (EI / w)^(1/3) over which the weight bends the rod, so that the nodes resolve it.
    density, poisson = rng.uniform(500.0, 2000.0), rng.uniform(0.2, 0.5)
    unit = section.stiffness(ddg.Material(1.0, poisson, density))
    bending = rng.uniform(0.2, 0.8) * length
    young = 9.81 * unit.mass_per_length * bending**3 / min(unit.EI1, unit.EI2)
    material = ddg.Material(young, poisson, density)
    return {"points": shape, "section": section, "material": material, "name": kind}


def alone(scene: ddg.Scene, rod: int) -> ddg.Scene:
    """Return a scene with one rod of `scene`, one of its batches."""
    batch = scene.batches[rod]
    return scene_of([{"points": batch.points[0], "section": batch.section, "name": batch.name}], scene.analysis)


def check(result) -> list[ddg.Check]:
    """Check a few rods, short and long, of every section, against the same rods alone, and convergence."""
    from ddg_warp.run.simulate import simulate

    model, scene = result.model, result.scene
    points = np.split(
        result.state.points().reshape(-1, 3)[: model.curves.counts.sum()], np.cumsum(model.curves.counts)[:-1]
    )
    order = np.argsort(model.curves.counts)
    firsts = [np.flatnonzero(model.curves.names == kind)[:1] for kind in ("circle", "ellipse", "rectangle")]
    picked = np.unique(np.concatenate([order[:1], order[-1:], *firsts]))
    failed = sum(number for name, number in result.statistics["outcomes"].items() if not name.startswith("converged"))
    checks = [ddg.Check("solves that did not converge", failed, 0.0, 0.0)]
    tolerance = 1e-9 if model.precision == "float64" else 1e-4
    for rod in picked:
        single = simulate(
            alone(scene, rod),
            device=model.device,
            precision=model.precision,
            dt=result.dt,
            duration=result.times[-1],
            progress=False,
        )
        off = float(np.abs(single.state.points() - points[rod]).max())
        name = f"rod {rod} ({scene.batches[rod].name}, {len(points[rod])} nodes) from where it is alone [m]"
        checks.append(ddg.Check(name, off, 0.0, tolerance, SOURCE))
    return checks


def benchmark() -> ddg.bench.Study:
    """Study all nodes at 0.5 s over steps, schemes and tolerances, against shorter midpoint steps."""
    return ddg.bench.Study(
        {
            "dt": (0.02, 0.01, 0.005, 0.0025),
            "scheme": ("implicit_euler", "implicit_midpoint"),
            "rtol": (1e-4, 1e-8),
        },
        lambda result: result.state.points(),
        {"dt": 0.000625, "scheme": "implicit_midpoint", "rtol": 1e-8},
        fixed={"duration": 0.5},
        series=("scheme", "rtol"),
        unit="m",
    )
