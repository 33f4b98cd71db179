"""Bistable ribbon: lateral displacement of the clamped ends makes a symmetric arch lean to one side.

Clamps that approach by a quarter of its length bend a strip to an arch. Then they move apart across the strip, the first by -y / 2,
the last by y / 2. The arch keeps its symmetry under exchange of its ends up to a pitchfork at some y, and leans towards either side
from there on: Yu and Hanna, Extreme Mech. Lett. 34 (2020), "Bifurcations of buckled, clamped anisotropic rods and thin bands under
lateral end translations"; Huang, Wang, Li and Jawed, J. Mech. Phys. Solids 145 (2020), from narrow to wide bands.

Kirchhoff's rod of the same section does so at nearly the same y for all widths, 6 % late at the largest width here. A wider plate
strip does so sooner, and so does a ribbon, 2 to 3 % late. In plates, unlike ribbons, clamps also hinder the warping near the ends.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.model.rest_shapes import grown_metric

LENGTH = 1.0  # m
APPROACH = 0.25  # approach of the clamps over the length
THICKNESS = 5.0e-4  # m
YOUNG = 1.0e9  # Pa
POISSON = 0.3
LAWS = ("audoly_neukirch", "sano_wada", "sadowsky", "kirchhoff")
SOURCE = "plate of this package, `plate`, extrapolated to fine meshes"

# Width [m] -> lateral displacement at the pitchfork [m], from 2 and 4, 4 and 6, 6 and 8 cells over the width at second order.
PLATE = {0.01: 0.2441, 0.02: 0.2350, 0.03: 0.2311}


def build(width: float = 0.03, law: str = "audoly_neukirch", lateral: float = 0.3, n: int = 80) -> ddg.Scene:
    """Build the strip along x as an arch in the plane of x and z, its ends moved along y.

    Args:
        width: width of the strip [m]; there are reference numbers for 0.01, 0.02 and 0.03
        law: audoly_neukirch, sano_wada, sadowsky, or kirchhoff: a rod with the strip's section
        lateral: displacement of one end against the other [m]
        n: edges of the strip
    """
    if law not in LAWS:
        raise ValueError(f"law = {law!r}: one of {', '.join(LAWS)}")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=4))
    section, material = ddg.Ribbon(width, THICKNESS, law if law != "kirchhoff" else LAWS[0]), _material()
    strip = scene.add_rod(
        arch(n),
        section=section.stiffness(material) if law == "kirchhoff" else section,
        material=material,
        natural="straight",
        director=(0.0, 1.0, 0.0),
        name="strip",
    )
    for end, motion in zip(("first", "last"), _motions(lateral), strict=True):
        scene.clamp_end(strip, end, motion, tangent=(1.0, 0.0, 0.0), director=(0.0, 1.0, 0.0))
    return scene


def plate(width: float, cells: int, lateral: float = 0.3) -> ddg.Scene:
    """Return a scene of the strip as a plate, with `cells` square cells over the width."""
    along = 2 * max(1, round(0.5 * cells * LENGTH / width))
    flat, triangles = meshes.rectangle(along, cells, (LENGTH, width), "crossed")
    curve, position = arch(4000), 4000.0 * flat[:, 0] / LENGTH
    x, z = (np.interp(position, np.arange(4001), curve[:, axis]) for axis in (0, 2))
    # The clamp fixes the normals of the drawn triangles; the first and last cell are flat.
    inside = np.minimum(flat[:, 0], LENGTH - flat[:, 0]) > 1.01 * LENGTH / along
    points = np.stack([x, flat[:, 1] - 0.5 * width, np.where(inside, z, 0.0)], axis=1)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=4))
    rest = grown_metric(flat, triangles, 1.0), np.zeros((len(triangles), 3))
    strip = scene.add_shell(points, triangles, thickness=THICKNESS, material=_material(), rest=rest, name="strip")
    for end, motion in zip((0.0, LENGTH), _motions(lateral), strict=True):
        scene.clamp_boundary(strip, np.flatnonzero(np.abs(flat[:, 0] - end) < 1e-9), motion=motion)
    return scene


def _material() -> ddg.Material:
    return ddg.Material(YOUNG, POISSON)


def _motions(lateral: float) -> list[ddg.Motion]:
    return [ddg.Motion(translation=lambda t, y=y: (0.0, y * t, 0.0)) for y in (-0.5 * lateral, 0.5 * lateral)]


def arch(n: int) -> np.ndarray:
    """Return points (n + 1, 3) [m] of an arch with equal edges, horizontal at both ends, with the distance of the clamps."""
    from scipy.optimize import brentq

    wave = np.sin(2.0 * np.pi * (np.arange(n) + 0.5) / n)
    angle = brentq(lambda a: np.cos(a * wave).mean() - (1.0 - APPROACH), 0.0, 2.0) * wave
    steps = LENGTH / n * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return points - [0.5 * points[-1, 0], 0.0, 0.0]


def pitchfork(model, lateral: float = 0.3, step: float = 0.02) -> float:
    """Return the critical lateral displacement [m] of the symmetric arch.

    Args:
        model: model of a strip with the end displacement `lateral` [m] at load parameter 1.
        lateral: that displacement [m].
        step: displacement [m] between equilibria of the path.
    """
    from ddg_warp.solve.equilibrium import stability
    from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions
    from ddg_warp.solve.equilibrium.tangent import Tangent

    tangent, follow = Tangent(model), Equilibrium(model, StaticsOptions(mode="follow"))
    first = 1e-3 * step
    states = {first: Equilibrium(model, StaticsOptions()).load(model.state(), 1, 0.0, first / lateral)}

    def equilibrium(y: float):
        below = max(level for level in states if level <= y)
        if below < y:
            states[y] = follow.load(states[below], 1, below / lateral, y / lateral)
        return model, states[y]

    y = first
    while stability.spectrum(*equilibrium(y), 1, "unit", tangent).eigenvalues[0] > 0.0:
        y += step
        if y > LENGTH:
            return np.nan
    return stability.critical(equilibrium, y - step, y, tolerance=1e-3)


def check(result) -> list[ddg.Check]:
    """Check the pitchfork against the plate, within the effect of hindered warping at this width."""
    batch, points = result.model.scene.batches[0], result.state.points()
    width = float(np.round(np.sqrt(12.0 * batch.section.EI1 / batch.section.EA), 6))
    name = "lateral displacement at the pitchfork [m]"
    if width not in PLATE:
        return [ddg.Check.skip(name, f"there are reference numbers for widths {', '.join(map('{:g}'.format, PLATE))}")]
    lateral = float(points[-1, 1] - points[0, 1])
    measured = pitchfork(result.model, lateral)
    n = len(points) - 1
    tolerance = min(ddg.Check.COARSEST, 0.04 + 20.0 / n**2)
    return [ddg.Check(name, measured, PLATE[width], tolerance, SOURCE, relative=True)]


def benchmark() -> ddg.bench.Study:
    """Study the pitchfork over the nodes of the strip."""
    return ddg.bench.Study({"n": (20, 40, 80, 160)}, "lateral displacement")
