"""Lee frame: a column and a beam, joined rigidly and hinged at their far ends, snap through under a force on the beam.

Load and displacement of the loaded point both reverse along the path (Lee, Manuel and Rossow, J. Eng. Mech. Div. ASCE 94, 1968).
Reference: inextensible elastica by collocation, checked by shooting; with the stretch and shear of the original section the limit
loads are 0.1 to 0.3 % lower.
"""

import numpy as np

import ddg_warp as ddg

LEG = 120.0  # cm
EI = 1440.0  # t cm^2
EA = 4.32e6  # t; a thousand times that of the section, nearly inextensible
LENGTH_UNIT = "cm"
SOURCE = "inextensible elastica, collocation"

# Stationary load [t], with downward and rightward displacement of the loaded point [cm].
LIMITS = ((1.855874654, 48.73945421, 26.88685253), (-0.9421287454, 58.20048419, 90.21191386))


def build(n: int = 60, stretch: float = EA) -> ddg.Scene:
    """Build the frame in the plane of x and z: the column along z, the beam along x.

    Args:
        n: edges of each of the two, a multiple of five
        stretch: stretching stiffness [t]
    """
    if n < 5 or n % 5:
        raise ValueError(
            f"n = {n}; it is a multiple of five, 5 at least: the loaded point, a fifth along the beam, is a node"
        )
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    t = np.linspace(0.0, LEG, n + 1)[:, None]
    section = ddg.Stiffness(EA=stretch, EI1=EI, radius=1.0)
    column = scene.add_rod(t * [0.0, 0.0, 1.0], section=section, name="column")
    beam = scene.add_rod(t * [1.0, 0.0, 0.0] + [0.0, 0.0, LEG], section=section, name="beam")
    scene.join([(column, -1), (beam, 0)])
    scene.fix(column, [0])
    scene.fix(beam, [-1])
    scene.add_force(beam, n // 5, (0.0, 0.0, -1.0))
    loaded = n + 1 + n // 5  # its row among the points
    watch = {"v": ddg.Displacement.of(loaded, "z", -1.0), "u": ddg.Displacement.of(loaded, "x")}
    stop = ddg.StopCriterion(limit_points=2)
    scene.analysis = ddg.PathAnalysis(watch, stop, step=0.02, max_step=0.1, load_scale=2.0)
    return scene


def check(result) -> list[ddg.Check]:
    """Check both limit points within the discretisation error."""
    tolerance = min(ddg.Check.COARSEST, 5e-3 * max(1.0, (60.0 / (result.model.curves.counts[0] - 1)) ** 2))
    checks = []
    limits = [(point.load, point.values["v"], point.values["u"]) for point in result.path.limit_points]
    limits += [(np.nan,) * 3] * 2  # a limit that was not met fails
    for name, values, reference in zip(("first", "second"), limits, LIMITS, strict=False):
        for quantity, measured, exact in zip(("load [t]", "v [cm]", "u [cm]"), values, reference, strict=True):
            checks.append(ddg.Check(f"{name} limit, {quantity}", measured, exact, tolerance, SOURCE, relative=True))
    return checks


def benchmark() -> ddg.bench.Study:
    """Study the first limit load over the edges of each leg."""
    return ddg.bench.Study({"n": (20, 40, 60, 120)}, "first limit, load")
