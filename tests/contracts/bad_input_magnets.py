"""Bad inputs to magnets: magnetisations, fields and pairs of dipoles."""

# fmt: off
import dataclasses

import numpy as np
from bad_inputs import INF, NAN, STIFFNESS, built, clamped, each, line, refuse, rods

import ddg_warp as ddg

AREA = dataclasses.replace(STIFFNESS, area=1e-4)


def magnets(magnetisation=1e4, edges=None, scene=None, **options) -> ddg.Scene:
    """Return `rods` with sections of known area; rod 1 is magnetised."""
    scene = scene or rods(section=AREA, **options)
    scene.magnetize(1, magnetisation, edges)
    return scene


UNIT = np.eye(3)
each("magnets", "magnetisation", [NAN, INF, "strong", (1.0, 2.0), np.ones((5, 3)), None], magnets,
     "magnetize", "rod 1", "magnetisation", "(4, 3)")
refuse("magnets", {
    "edge out of range": (lambda: magnets(edges=[4]), "edge 4", "rod 1", "4 edges"),
    "edge twice": (lambda: magnets(edges=[0, -4]), "rod 1", "edges", "twice"),
    "no such rod": (lambda: rods(section=AREA).magnetize(2, 1e4), "rod 2", "does not exist"),
    "no area": (lambda: rods().magnetize(1, 1e4), "rod 1", "'odd'", "area", "Stiffness(..., area=...)"),
    "across without twist": (lambda: magnets((1e4, 0.0, 0.0), twist=False), "rod 1", "no twist", "tangent alone"),
    "across the plane": (
        lambda: magnets((1e4, 0.0, 0.0), scene=rods(section=AREA, scene=ddg.Scene(dimension=2))),
        *("rod 1", "across the plane", "give 0"),
    ),
    "no field or dipole acts": (lambda: built(magnets()), "no field or dipole acts on rod 1", "magnetic_field", "add_dipoles"),
    "field alone": (lambda: built(clamped(), lambda s: s.magnetic_field((0.0, 0.0, 1.0))), "no rod is magnetised", "magnetize"),
    "dipoles alone": (lambda: built(clamped(), lambda s: s.add_dipoles()), "no rod is magnetised", "magnetize"),
    "dipole without magnetisation": (lambda: built(magnets(), lambda s: s.add_dipoles([0, 1])), "rod 0", "not magnetised"),
    "dipoles out of reach": (lambda: built(magnets(), lambda s: s.add_dipoles(cutoff=1e-3)), "add_dipoles", "cutoff", "larger"),
    "dipoles of no rod": (lambda: magnets().add_dipoles([7]), "rod 7", "does not exist"),
    "dipoles at one point": (
        lambda: built(magnets(), lambda s: s.magnetize(s.add_rod(line(), section=AREA), 1e4), lambda s: s.add_dipoles()),
        *("edge 0 of rod 1", "edge 0 of rod 2", "one point"),
    ),
    "dipoles across and without twist": (
        lambda: built(
            magnets((1e4, 0.0, 0.0)),
            lambda s: s.magnetize(s.add_rod(line() + UNIT[1], section=AREA, twist=False), 1e4),
            lambda s: s.add_dipoles(),
        ),
        *("rods 1 and 2", "no twist", "twist=True"),
    ),
    "two fields": (lambda: (s := magnets(), s.magnetic_field(UNIT[2]), s.magnetic_field(UNIT[0])), "a field", "sum of both"),
    "field out of the plane": (
        lambda: magnets(scene=rods(section=AREA, scene=ddg.Scene(dimension=2))).magnetic_field(UNIT[1]),
        *("magnetic_field", "leave the plane", "give 0 along y"),
    ),
    "field of a wrong function": (lambda: magnets().magnetic_field(lambda t: 1.0), "magnetic field", "t = 0", "(3,)"),
    "field of several": (lambda: magnets().magnetic_field(lambda t: np.ones((2, 3))), "magnetic_field", "(2, 3)", "give (3,)"),
    "field that fails": (lambda: magnets().magnetic_field(lambda t: 1.0 / t), "magnetic field", "fails at t = 0", "ZeroDivision"),
    "field not finite": (lambda: magnets().magnetic_field(lambda t: (0.0, 0.0, NAN)), "magnetic field", "not finite at t = 0"),
    "gradient of a wrong shape": (lambda: magnets().magnetic_field(UNIT[2], UNIT[2:] * [[1.0], [2.0]]), "gradient", "(3, 3)"),
    "divergence": (lambda: magnets().magnetic_field(UNIT[2], UNIT), "divergence of 3 T/m", "trace"),
    "curl": (lambda: magnets().magnetic_field(UNIT[2], np.diag([1.0, 1.0], 1) * [1.0, 1.0, 0.0]), "curl", "symmetric"),
})
each("magnets", "field", [NAN, (0.0, 1.0), "up", (0.0, 0.0, INF), None], lambda v: magnets().magnetic_field(v),
     "magnetic_field: value", "three")
each("magnets", "origin", [NAN, (0.0, 1.0)], lambda v: magnets().magnetic_field(UNIT[2], origin=v), "origin", "three finite numbers")
each("magnets", "gradient", [NAN, INF, "steep"], lambda v: magnets().magnetic_field(UNIT[2], v), "gradient", "finite")
each("magnets", "cutoff", [0.0, -1.0, NAN, "far"], lambda v: magnets().add_dipoles(cutoff=v), "add_dipoles: cutoff", "positive")
each("magnets", "area", [-1.0, NAN, "large"], lambda v: built(rods(section=dataclasses.replace(STIFFNESS, area=v))), "rod 1", "area")
