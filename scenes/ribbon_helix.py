"""Ribbon helix: a straight strip wound on a cylinder, which bends as a developable surface.

A strip of paper is wound at the angle a to the hoops of a cylinder of radius R. Its curvature is k = cos^2 a / R and its twist t =
sin a cos a / R. It is a piece of a plane rolled up with the curvature 1 / R at any angle: 2 E / D W L = 1 / R^2. This is Sadowsky's
energy (k^2 + t^2)^2 / k^2 (Sadowsky 1930). A rod of the same section has separate bending and twist energies and only 0.58 of it at
45 degrees and nu = 0.3. The ends are fixed as on the cylinder. The helix between them is an equilibrium of every law, as its
strains are uniform and a force and a moment along its axis hold it.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes

RADIUS = 0.1  # m
LENGTH = 0.5  # m
THICKNESS = 1e-4  # m
YOUNG = 3.0e9  # Pa
POISSON = 0.3
SOURCE = "strip of a plane rolled up (Sadowsky 1930)"
LAWS = ("sadowsky", "audoly_neukirch", "sano_wada", "kirchhoff")


def build(angle: float = 45.0, law: str = "sadowsky", width: float = 0.1, n: int = 100) -> ddg.Scene:
    """Build the strip around z, drawn on the cylinder and free between its ends.

    Args:
        angle: angle of the strip to the hoops [degrees]
        law: sadowsky, audoly_neukirch, sano_wada, or kirchhoff: a rod with the strip's section
        width: width of the strip [m]
        n: edges of the strip
    """
    if law not in LAWS:
        raise ValueError(f"law = {law!r}: one of {', '.join(LAWS)}")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    a = np.radians(angle)
    along = np.linspace(0.0, LENGTH, n + 1)
    section = ddg.Ribbon(width, THICKNESS, law if law != "kirchhoff" else LAWS[0])
    material = ddg.Material(YOUNG, POISSON)
    strip = scene.add_rod(
        on_cylinder(along, a),
        section=section.stiffness(material) if law == "kirchhoff" else section,
        material=None if law == "kirchhoff" else material,
        natural="straight",
        director=across(0.5 * (along[1:] + along[:-1]), a),
        name="strip",
    )
    scene.clamp(strip, edges=[0, -1])
    return scene


def on_cylinder(along: np.ndarray, a: float) -> np.ndarray:
    """Return points (., 3) [m] of the centreline at arc lengths (.,) on the cylinder, at the angle a to its hoops."""
    angle = along * np.cos(a) / RADIUS
    return np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), along * np.sin(a)], axis=1)


def across(along: np.ndarray, a: float) -> np.ndarray:
    """Return directions (., 3) across the strip, tangent to the cylinder."""
    angle = along * np.cos(a) / RADIUS
    return np.stack([np.sin(a) * np.sin(angle), -np.sin(a) * np.cos(angle), np.full_like(angle, np.cos(a))], axis=1)


def strains(angle: float) -> tuple[float, float]:
    """Return curvature and twist [1/m] at an angle [degrees]."""
    a = np.radians(angle)
    return np.cos(a) ** 2 / RADIUS, np.sin(a) * np.cos(a) / RADIUS


def exact(angle: float, law: str, width: float) -> float:
    """Return 2 E R^2 / D W L of uniform strains: the rod's energy plus the constraint of the section by a law."""
    k, t = strains(angle)
    rod = (1.0 - POISSON**2) * k**2 + 2.0 * (1.0 - POISSON) * t**2
    x = (3.0 * (1.0 - POISSON**2)) ** 0.25 * width * np.sqrt(k / THICKNESS)
    crossover = np.sqrt(60.0 / (1.0 - POISSON**2)) * THICKNESS / width**2
    kept = {
        "kirchhoff": 0.0,
        "sadowsky": (POISSON * k**2 + t**2) ** 2 / k**2,
        "audoly_neukirch": (POISSON * k**2 + t**2) ** 2
        / k**2
        * (1.0 - 2.0 / x * (np.cosh(x) - np.cos(x)) / (np.sinh(x) + np.sin(x))),
        "sano_wada": t**4 / (k**2 + crossover**2),
    }
    return (rod + kept[law]) * RADIUS**2


def normalised_energy(model, state) -> float:
    """Return 2 E R^2 / D W L of the length with bending energy, without half of both end edges."""
    points = model.scene.batches[0].points[0]
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    covered = length.sum() - 0.5 * (length[0] + length[-1])
    stiffness = model.scene.batches[0].section.EI2 / (1.0 - POISSON**2)  # D W
    return float(2.0 * model.energies(state)["rod_bend_twist"] * RADIUS**2 / (stiffness * covered))


def check(result) -> list[ddg.Check]:
    """Check the energy against the helix, and the distance of the strip from the cylinder."""
    scene, points = result.model.scene, result.state.points()
    batch = scene.batches[0]
    law = batch.laws["rod_bend_twist"].density.name if batch.laws else "kirchhoff"
    width = np.sqrt(12.0 * batch.section.EI1 / batch.section.EA)
    drawn = batch.points[0]
    rise = drawn[-1, 2] - drawn[0, 2]
    angle = np.degrees(np.arcsin(rise / LENGTH))
    away = np.abs(np.hypot(points[:, 0], points[:, 1]) / RADIUS - 1.0).max()
    n = len(points) - 1
    return [
        ddg.Check(
            "2 E R^2 / D W L",
            normalised_energy(result.model, result.state),
            exact(angle, law, width),
            min(ddg.Check.COARSEST, 5e-4 + 20.0 / n**2),
            SOURCE,
            relative=True,
        ),
        ddg.Check("distance from the cylinder [R]", away, 0.0, min(ddg.Check.COARSEST, 10.0 / n**2), SOURCE),
    ]


def picture(result, frames) -> dict:
    """Draw the strip in full width on the cylinder."""
    points, section = result.state.points(), result.model.scene.batches[0].section
    width, side = np.sqrt(12.0 * section.EI1 / section.EA), result.state.directors()
    side = np.concatenate([side[:1], 0.5 * (side[1:] + side[:-1]), side[-1:]])[:, None]
    edges = np.linspace(-0.5, 0.5, 9)[:, None] * np.ones(3) * width
    strip = (points[:, None] + edges * side).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(points) - 1), np.arange(8), indexing="ij")
    first = (9 * i + j).ravel()
    cells = np.concatenate([np.stack([first, first + 9, first + 10], 1), np.stack([first, first + 10, first + 1], 1)])
    ring, around = meshes.cylinder(48, 1, 0.98 * RADIUS, 1.2 * np.ptp(strip[:, 2]))
    ring = ring + [0.0, 0.0, np.mean(strip[:, 2]) - np.mean(ring[:, 2])]
    shades = np.concatenate([np.full((len(around), 3), 0.8), np.tile([0.82, 0.29, 0.36], (len(cells), 1))])
    body = np.concatenate([ring, strip]), np.concatenate([around, cells + len(ring)]), shades
    return {"points_by_time": {1.0: points}, "bodies": {1.0: body}, "angles": (18.0, 60.0), "fixed": None}


def benchmark() -> ddg.bench.Study:
    """Study the energy over the nodes of the strip."""
    return ddg.bench.Study({"n": (25, 50, 100, 200)}, "2 E R^2")
