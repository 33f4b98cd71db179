"""Hinged roof: a shallow cylindrical roof is pressed at its crown and snaps through.

Case 3.8 of Sze, Liu and Lo (2004), thickness 12.7 or 6.35. The crown is lowered under displacement control, which passes the first
limit load. Limit loads agree with a Ritz solution by Kirchhoff and Love's theory to 0.2 %.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.scenes import _sze

RADIUS, HALF_LENGTH, HALF_ANGLE = 2540.0, 254.0, 0.1  # mm, mm, rad
YOUNG, POISSON = 3102.75, 0.3  # N/mm^2, 1
LIMIT = {12.7: 2226.3, 6.35: 585.9}  # thickness [mm] -> first limit load [N]
LENGTH_UNIT = "mm"
HEIGHTS = 5.0  # magnification of heights in the picture


def build(
    thickness: float = 12.7,
    drop: float = 16.0,
    n: int = 12,
    pattern: str = "crossed",
    membrane: str = "curved",
    steps: int = 32,
) -> ddg.Scene:
    """Build a quarter of the roof; its axis is z, its crown at y = 0 faces +x.

    Args:
        thickness: 12.7 or 6.35 [mm]
        drop: displacement of the crown [mm]
        n: cells around half and along half of the roof
        pattern: how cells become triangles: right, alternating, crossed or jittered
        membrane: flat or curved, see Scene.add_shell
        steps: load steps
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=steps))
    flat, triangles = _sze.sheet(n, n, (1.0, 1.0), pattern)
    points = _sze.cylinder_part(flat, RADIUS, HALF_LENGTH, HALF_ANGLE)
    material = ddg.Material(density=1.0, young=YOUNG, poisson=POISSON)
    roof = scene.add_shell(points, triangles, thickness=thickness, material=material, membrane=membrane)
    scene.symmetry(roof, _sze.side(flat, 0, 0.0), "y")
    scene.symmetry(roof, _sze.side(flat, 1, 0.0), "z")
    scene.hold(roof, _sze.side(flat, 0, 1.0))
    scene.hold(roof, [0], "x", motion=Motion(translation=lambda t: (-drop * t, 0.0, 0.0)))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the drop of the crown [mm] and the reaction there for the whole roof [N]."""
    from ddg_warp.solve.equilibrium.tangent import Tangent

    crown = model.coupled.host.shells[0].nodes[0]
    force = -4.0 * Tangent(model).gradient(state)[3 * crown]
    return {"drop": -_sze.displacement(model, state, 0, 0), "force": float(force)}


def limit(series) -> tuple[float, float]:
    """Return the first limit load [N] and the drop there [mm] by a quartic around the first maximum, or NaN without one."""
    drop, force = np.array(series["drop"]), np.array(series["force"])
    peaks = np.flatnonzero((force[1:-1] >= force[:-2]) & (force[1:-1] > force[2:])) + 1
    if not peaks.size:
        return float("nan"), float("nan")
    near = slice(max(0, peaks[0] - 2), peaks[0] + 3)
    curve = np.polynomial.Polynomial.fit(drop[near], force[near], min(4, len(drop[near]) - 1))
    roots = curve.deriv().roots()
    position = roots[np.argmin(np.abs(roots - drop[peaks[0]]))].real
    return float(curve(position)), float(position)


def check(result) -> list[ddg.Check]:
    """Check the first limit load against the table, to 1.5 % at 12 cells."""
    thickness = float(result.scene.shells[0].thickness)
    if thickness not in LIMIT:
        return [
            ddg.Check.skip("limit load [N]", f"there are tables for thicknesses of {' and '.join(map(str, LIMIT))} mm")
        ]
    return [ddg.Check("limit load [N]", limit(result.series)[0], LIMIT[thickness], 0.015, _sze.SOURCE, relative=True)]


def picture(result, frames) -> dict:
    """Draw the quarter at the start, at the limit load and at the end, with magnified heights, and the force over the drop."""
    drop, force = (np.array(result.series[name]) for name in ("drop", "force"))
    _, at_peak = limit(result.series)
    times = sorted(frames)
    times = times[0], min(times, key=lambda t: abs(t * drop[-1] - at_peak)), times[-1]  # the first without a limit
    upright = {t: frames[t][:, [1, 2, 0]] * [1.0, 1.0, HEIGHTS] - [0.0, 0.0, HEIGHTS * RADIUS] for t in times}
    return {
        "points_by_time": upright,
        "note": f"a quarter, crown to the left and in front; heights times {HEIGHTS:g}",
        "chart": {
            "lines": [
                ("whole roof", drop, force, "-"),
                (
                    "limit load of Sze, Liu and Lo",
                    [at_peak],
                    [LIMIT.get(float(result.scene.shells[0].thickness), np.nan)],
                    "o",
                ),
            ],
            "x": "drop of the crown [mm]",
            "y": "force [N]",
        },
    }


def benchmark() -> ddg.bench.Study:
    """Study the limit load over meshes and membranes; the published one is of a finite mesh, too."""
    return ddg.bench.Study({"n": (4, 8, 12), "membrane": ("flat", "curved")}, "limit load", series=("membrane",))
