"""45-degree bend: a force out of its plane bends and twists a curved cantilever.

Bathe & Bolourchi (Int. J. Numer. Meth. Eng. 14, 1979). An eighth of a circle of radius 100 in, section 1 in x 1 in, E = 1e7 psi,
nu = 0. Two torsion constants are in use: the polar moment of area, 1/6 in^4 (GJ = EI), and that of St. Venant, 0.1406 in^4.
The tips differ by 0.3 in. The reference solves the Kirchhoff rod as a boundary value problem, by shooting and by collocation.
Published numbers scatter around it by the coarseness of their meshes (Simo & Vu-Quoc 1986: 8 elements). Inches and pounds are
kept for comparison.
"""

import numpy as np

import ddg_warp as ddg

RADIUS = 100.0  # in
EI = 1.0e7 / 12.0  # lbf in^2
TORSION = {"polar": EI, "st_venant": 0.5e7 * 0.140577}  # GJ [lbf in^2]
EA = {True: 1.0e7, False: 1.0e11}  # lbf; of an extensible rod, and of a nearly inextensible one
LENGTH_UNIT = "in"
SOURCE = "Kirchhoff rod as a boundary value problem, shooting against collocation to 1e-10"

# (torsion, extensible) -> load [lbf] -> tip [in].
TIP = {
    ("polar", False): {
        300.0: (22.24503474, 58.77968539, 40.18828384),
        450.0: (18.50846405, 52.23929842, 48.49798262),
        600.0: (15.68507816, 47.1512944, 53.46859844),
    },
    ("st_venant", False): {
        300.0: (22.11286663, 58.53649165, 40.47666523),
        450.0: (18.36955748, 51.97044992, 48.69985312),
        600.0: (15.55806009, 46.89277135, 53.60111399),
    },
    ("polar", True): {
        300.0: (22.24528854, 58.7802483, 40.18938842),
        600.0: (15.68535578, 47.15215022, 53.47176295),
    },
}


def build(load: float = 600.0, torsion: str = "polar", extensible: bool = False, n: int = 64) -> ddg.Scene:
    """Build the bend in the plane of x and y, loaded along z.

    Args:
        load: force [lbf]; there are reference numbers for 300, 450 (inextensible) and 600
        torsion: torsion constant, polar or st_venant
        extensible: whether the rod can stretch
        n: edges of the rod
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=6))
    angle = np.linspace(0.0, 0.25 * np.pi, n + 1)
    points = RADIUS * np.stack([1.0 - np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    section = ddg.Stiffness(EA=EA[extensible], EI1=EI, GJ=TORSION[torsion], radius=0.5)
    rod = scene.add_rod(points, section=section, name="bend")
    scene.clamp_end(rod, "first")
    scene.add_force(rod, -1, (0.0, 0.0, load))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the tip position [in]."""
    return dict(zip(("tip_x", "tip_y", "tip_z"), state.points()[-1], strict=True))


def check(result) -> list[ddg.Check]:
    """Check the tip against the boundary value problem at loads with a reference."""
    scene = result.model.scene
    section = scene.batches[0].section
    torsion = next(name for name, GJ in TORSION.items() if section.GJ == GJ)
    tip = TIP.get((torsion, bool(section.EA == EA[True])), {}).get(scene.loads[0].force[2], ())
    if not tip:
        return [ddg.Check.skip("tip [in]", "there are reference numbers for loads of 300, 450 (inextensible) and 600")]
    tolerance = min(ddg.Check.COARSEST, 1e-3 * max(1.0, (32.0 / (result.model.curves.counts[0] - 1)) ** 2))
    return [
        ddg.Check(f"tip {axis} [in]", measured, reference, tolerance, SOURCE, relative=True)
        for axis, measured, reference in zip("xyz", result.state.points()[-1], tip, strict=True)
    ]


def benchmark() -> ddg.bench.Study:
    """Study the tip over the edges of the rod."""
    return ddg.bench.Study({"n": (16, 32, 64, 128)}, "tip y")
