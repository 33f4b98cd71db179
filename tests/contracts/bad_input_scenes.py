"""Bad inputs to scenes: settings, rods, sections, materials, and the supports, motions and loads of rods."""

# fmt: off
import numpy as np
from bad_inputs import (
    INF,
    NAN,
    RING,
    RUBBER,
    STIFFNESS,
    built,
    each,
    line,
    refuse,
    rods,
)

import ddg_warp as ddg

BARE = ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0)  # without radius


def _in_fluid(scene):
    scene.drag(tangential=1.0, normal=2.0)


# --- Scene(...) ---
each("scene", "gravity", [(0.0, 0.0), 9.81, (0.0, 0.0, NAN), "down", (0.0, 0.0, 1.0, 0.0), None],
     lambda v: ddg.Scene(gravity=v), "gravity", "three finite numbers")
each("scene", "dimension", [1, 4, "3", None], lambda v: ddg.Scene(dimension=v), "dimension", "2 or 3")
each(
    "scene",
    "mass_damping",
    [-1.0, NAN, INF, (1.0, 2.0), "much"],
    lambda v: ddg.Scene(mass_damping=v),
    "mass_damping",
    "not negative",
)
each("scene", "flow", [(0.0, 1.0), 3.0, "fast", (0.0, 0.0, NAN), None], lambda v: ddg.Scene(flow=v), "flow", "three finite numbers")
each("scene", "flow to", [(0.0, 1.0), 3.0, None, (0.0, NAN, 0.0), np.zeros((2, 3))],
     lambda v: built(rods(scene=ddg.Scene(flow=lambda t: v)), _in_fluid), "flow", "t = 0")
each("scene", "field of flow", [(1.0, 0.0, 0.0), 3.0, None, np.full((12, 3), NAN), np.zeros((2, 3))],
     lambda v: built(rods(scene=ddg.Scene(flow=lambda points, t: v)), _in_fluid), "flow", "t = 0")
refuse("scene", {
    "field of flow out of the plane": (
        lambda: built(rods(scene=ddg.Scene(dimension=2, flow=lambda points, t: points + 1.0)), _in_fluid), "flow", "0 along y"),
    "field of flow that fails": (
        lambda: built(rods(scene=ddg.Scene(flow=lambda points, t: points[:, 7])), _in_fluid), "flow", "IndexError"),
    "flow without drag": (lambda: built(rods(scene=ddg.Scene(flow=(1.0, 0.0, 0.0)))), "flow", "drag(...)"),
    "flow out of the plane": (
        lambda: built(rods(scene=ddg.Scene(dimension=2, flow=(0.0, 1.0, 0.0))), _in_fluid), "flow", "0 along y"),
})
for _name, _value, *_words in (
    ("mean", (0.0, 0.0, 0.0), "zero"), ("mean", 8.0, "three finite numbers"), ("intensity", -0.1, "from 0"),
    ("length", 0.0, "[m]"), ("seed", -1, "whole number"), ("modes", 0, "whole number"), ("spectrum", "white", "'kraichnan'"),
):

    def _turbulence(value, name=_name):
        ddg.Turbulence(**({"mean": (8.0, 0.0, 0.0), "intensity": 0.1, "length": 1.0} | {name: value}))

    each("scene", f"turbulence, {_name} {_value}", [_value], _turbulence, f"Turbulence: {_name}", *_words)
refuse("scene", {
    "gust": (lambda: ddg.Gust(6.0), "Gust: peak", "three finite numbers"),
    "gust without duration": (lambda: ddg.Gust((6.0, 0.0, 0.0), duration=0.0), "Gust: duration", "[s]"),
    "flow that is added": (lambda: ddg.Gust((6.0, 0.0, 0.0)) + 3.0, "flow that is added", "three finite numbers"),
    "grid of points": (lambda: ddg.FlowGrid(np.zeros((4, 3)), (0, 0, 0), (1, 1, 1)), "(4, 3)", "(nx, ny, nz, 3)"),
    "grid in time": (lambda: ddg.FlowGrid(np.zeros((2, 2, 2, 3)), (0, 0, 0), (1, 1, 1), [0.0, 1.0]), "(times, nx, ny, nz, 3)"),
    "grid at times": (lambda: ddg.FlowGrid(np.zeros((2, 2, 2, 2, 3)), (0, 0, 0), (1, 1, 1), [1.0, 0.0]), "FlowGrid: times are"),
    "grid nan": (lambda: ddg.FlowGrid(np.full((2, 2, 2, 3), NAN), (0, 0, 0), (1, 1, 1)), "velocities", "not all finite"),
    "grid upside down": (lambda: ddg.FlowGrid(np.zeros((2, 2, 2, 3)), (0, 0, 0), (1, -1, 1)), "upper is -1 along y", "larger"),
})
each("scene", "analysis", [None, "statics", 3], lambda v: ddg.Scene(analysis=v), "analysis", "Dynamics(...)")
each("scene", "callbacks", [[5], print, [print, None]], lambda v: ddg.Scene(callbacks=v), "callbacks", "functions of the state")
each("scene", "initial", [5, "rest"], lambda v: ddg.Scene(initial=v), "initial", "function of the model")
each("analysis", "dt", [0.0, -1.0, NAN, "0.01", None], lambda v: ddg.Dynamics(dt=v), "Dynamics: dt", "positive")
each("analysis", "duration", [0.0, INF, "long"], lambda v: ddg.Dynamics(duration=v), "Dynamics: duration", "positive")
each("analysis", "unconverged", [-0.1, 1.0, True], lambda v: ddg.Dynamics(unconverged_fraction=v), "unconverged_fraction", "from 0")
each("analysis", "precision", ["double", 64], lambda v: ddg.Dynamics(precision=v), "Dynamics: precision", "float64")
each("analysis", "scheme", ["rk4", None, 3], lambda v: ddg.Dynamics(scheme=v), "scheme", "implicit_euler")
each("analysis", "error", [0.0, -1e-4, NAN, INF, "1e-4", True], lambda v: ddg.Dynamics(error=v), "Dynamics: error", "positive")
refuse("analysis", {
    "error with rtol": (lambda: ddg.Dynamics(error=1e-4, rtol=1e-2), "rtol", "leave out rtol or error"),
    "error with unconverged": (lambda: ddg.Dynamics(error=1e-4, unconverged_fraction=0.1), "unconverged_fraction", "error"),
})
each("analysis", "load_steps", [0, 1.5, True, "two"], lambda v: ddg.Statics(load_steps=v), "load_steps", "whole number")
each("analysis", "trace step", [0.0, -1.0, NAN], lambda v: ddg.PathAnalysis(step=v), "PathAnalysis: step", "positive")
refuse("analysis", {
    "trace stop": (lambda: ddg.PathAnalysis(stop=5), "stop", "StopCriterion(...)"),
    "trace watch": (lambda: ddg.PathAnalysis(watch={"tip": 3}), "watch", "Displacement.of"),
})

# --- rods; all kinds are compiled by the same code: a twisted rod in space represents them ---
ROD = {
    "zero-length edge": ({"points": line(n3=(0.5, 0.0, 0.0))}, "rod 1", "'odd'", "edge 2", "no length", "remove"),
    "edge of rounding": ({"points": line(n3=(0.5 + 1e-16, 0.0, 0.0))}, "rod 1", "edge 2", "one point", "remove"),
    "nan point": ({"points": line(n3=(NAN, 0.0, 0.0))}, "rod 1", "'odd'", "node 3", "non-finite"),
    "infinite point": ({"points": line(n4=(INF, 0.0, 0.0))}, "rod 1", "node 4", "non-finite"),
    "one point": ({"points": np.zeros(3)}, "rod 1", "1 nodes", "at least 3"),
    "too few nodes": ({"points": line(2), "closed": True}, "rod 1", "2 nodes", "at least 3"),
    "too few nodes of a chain": ({"points": line(1), "bend": False}, "rod 1", "1 nodes", "at least 2"),
    "too few nodes of a ring": ({"points": line(2), "bend": False, "closed": True}, "rod 1", "2 nodes", "at least 3"),
    "folded": ({"points": line(n4=(0.6, 0.0, 0.0))}, "rod 1", "edges 2 and 2 + 1", "fold back", "move a node"),
    "folded at the seam": ({"points": line(), "closed": True}, "rod 1", "fold back", "move a node"),
    "closed twice": ({"points": RING[[0, 1, 2, 3, 0]], "closed": True}, "rod 1", "node 4 lies on node 0", "leave the last"),
    "closed twice, by rounding": (
        {"points": RING[[0, 1, 2, 3, 0]] + 2e-16 * np.eye(5)[:, 4:] * [1.0, 1.0, 1.0], "closed": True},
        *("rod 1", "node 4 lies on node 0"),
    ),
    "curved without twist": ({"points": RING, "twist": False}, "rod 1", "curved", "twist=True", "natural='straight'"),
    "two sections without twist": (
        {"section": ddg.Rectangle(0.1, 0.2), "material": RUBBER, "twist": False},
        *("rod 1", "EI1 and EI2", "twist=True"),
    ),
    "natural not finite": ({"natural": (0.0, [0.0, NAN, 0.0], 0.0)}, "rod 1", "natural", "vertex 1", "finite"),
    "natural of wrong shape": ({"natural": (np.zeros(7), 0.0, 0.0)}, "rod 1", "natural", "3 vertices"),
    "natural of two": ({"natural": (0.0, 0.0)}, "rod 1", "natural", "3 arrays"),
    "natural unknown": ({"natural": "curly"}, "rod 1", "'curly'", "'shape'", "'straight'"),
    "natural a number": ({"natural": 3.0}, "rod 1", "natural", "3 arrays"),
    "natural none": ({"natural": None}, "rod 1", "natural", "3 arrays"),
    "natural no number": ({"natural": ("a", 0.0, 0.0)}, "rod 1", "natural", "numbers"),
    "curvature by angle without bending": ({"curvature": "angle", "bend": False}, "'odd'", "'angle'", "leave it out"),
    "director of wrong shape": ({"director": (1.0, 0.0)}, "rod 1", "director", "(2,)", "(rods, edges, 3)"),
    "director of another rod": ({"director": np.ones((1, 7, 3))}, "rod 1", "director", "(1, 7, 3)"),
    "director not finite": ({"director": (0.0, NAN, 1.0)}, "rod 1", "director", "edge 0", "finite"),
    "director zero": ({"director": (0.0, 0.0, 0.0)}, "rod 1", "director", "edge 0", "across"),
    "director no number": ({"director": "up"}, "'odd'", "director", "numbers"),
    "director along the rod": ({"director": (2.0, 0.0, 0.0)}, "rod 1", "director", "edge 0", "parallel", "across"),
    "director along an edge": (
        {"director": np.array([[[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])},
        *("rod 1", "director", "edge 2", "parallel"),
    ),
    "of another plane": ({"points": line()[:, [1, 0, 2]], "scene": 2}, "rod 1", "edge 0", "plane of x and z"),
    "points of 2": ({"points": np.zeros((5, 2))}, "'odd'", "(1, 5, 2)", "(rods, nodes, 3)"),
    "points of 4 axes": ({"points": np.zeros((1, 2, 5, 3))}, "'odd'", "(1, 1, 2, 5, 3)", "(rods, nodes, 3)"),
    "ragged points": ({"points": [[0, 0, 0], [1, 1]]}, "'odd'", "(rods, nodes, 3)"),
    "points of letters": ({"points": [["a", "b", "c"]] * 4}, "'odd'", "(rods, nodes, 3)"),
    "section a number": ({"section": 3.0}, "'odd'", "section 3.0", "Circle"),
    "section none": ({"section": None}, "'odd'", "section None", "Circle"),
    "section without material": ({"section": ddg.Circle(0.1)}, "'odd'", "Circle", "material=Material"),
    "material a number": ({"section": ddg.Circle(0.1), "material": 1e7}, "'odd'", "Circle", "material=Material"),
}


def _rod(options: dict):
    options = dict(options)
    scene = ddg.Scene(dimension=options.pop("scene", 3))
    return built(rods(options.pop("points", None), scene, **options))


refuse("rods", {name: (lambda o=options: _rod(o), *words) for name, (options, *words) in ROD.items()})
each("rods", "curvature", ["secant", None, 1], lambda v: rods(curvature=v), "'odd'", "curvature", "tangent", "angle")
for flag in ("closed", "twist", "bend"):
    each("rods", flag, ["no", "yes", 1, None], lambda v, f=flag: rods(**{f: v}), "'odd'", flag, "True or False")
refuse("rods", {"none": (lambda: built(ddg.Scene(), lambda s: s.add_rods(np.zeros((0, 5, 3)), section=STIFFNESS, name="odd")),
                         "'odd'", "at least")})

# --- sections and materials ---
SECTION = {"EA": 1e3, "EI1": 1.0, "EI2": 1.0, "GJ": 1.0, "mass_per_length": 1.0}
for field in ("EA", "EI1", "EI2", "GJ"):

    def stiff(v, field=field):
        return built(rods(section=ddg.Stiffness(**(SECTION | {field: v}))))

    each("sections", field, [-1.0, NAN, INF, [1.0, 1.0, -1.0, 1.0]], stiff, "rod 1", "'odd'", field, "finite and not negative")
    each("sections", field, [0.0], stiff, "rod 1", "'odd'", field, "is zero", "bend=False")
    each("sections", field, ["stiff", [1.0, 2.0, 3.0]], stiff, "rod 1", "'odd'", field, "broadcast", "4 edges")
for field in ("mass_per_length", "rotary_inertia", "radius", "viscosity"):

    def inert(v, field=field):
        return built(rods(section=ddg.Stiffness(**(SECTION | {field: v}))))

    each("sections", field, [-1.0, NAN, np.ones(7), "heavy"], inert, "rod 1", "'odd'", field)
each("materials", "young", [-1.0, 0.0, NAN, "soft", None], ddg.Material, "young", "positive")
each("materials", "poisson", [-1.0, 0.51, NAN, "half"], lambda v: ddg.Material(1.0, v), "poisson", "0.5")
each("materials", "density", [-1.0, INF, "light"], lambda v: ddg.Material(1.0, 0.3, v), "density", "not negative")
each("materials", "viscosity", [-1.0, NAN], lambda v: ddg.Material(1.0, 0.3, 1.0, v), "viscosity", "not negative")
each("sections", "circle's radius", [-0.1, 0.0, NAN, [0.1, 0.0], "thin", None], ddg.Circle, "Circle", "radius", "positive")
each("sections", "b", [0.0, -1.0, INF], lambda v: ddg.Ellipse(0.1, v), "Ellipse", "b =", "positive")
each("sections", "width", [0.0, -1.0, NAN], lambda v: ddg.Rectangle(v, 1.0), "Rectangle", "width", "positive")
each("sections", "thickness", [0.0, NAN, "thin"], lambda v: ddg.Ribbon(1.0, v), "Ribbon", "thickness", "positive")
each("sections", "thick ribbon", [1.0, 2.0], lambda v: ddg.Ribbon(1.0, v), "Ribbon", "less than the width")
each("sections", "law", ["kirchhoff", None], lambda v: ddg.Ribbon(1.0, 0.1, v), "Ribbon: law", "sadowsky")

# --- supports of rods. Rod 0 has 7 nodes, rod 1 has 5 ---
M = ddg.Motion
STILL = M(translation=lambda t: (0.0, 0.0, 0.0))
SWING = M(translation=lambda t: (t, 0.0, 0.0))
SUPPORTS = {
    "clamp edge": (lambda s: s.clamp([0, 1], [5]), "edge 5", "rod 1", "4 edges"),
    "clamp last edge": (lambda s: s.clamp(1, [-5]), "edge -5", "rod 1", "4 edges"),
    "clamp fraction": (lambda s: s.clamp(1, [1.5]), "edges [1.5]", "whole"),
    "clamp nothing": (lambda s: s.clamp(1, []), "clamp: edges", "nothing is chosen"),
    "clamp by a name": (lambda s: s.clamp(1, "first"), "clamp: edges", "whole"),
    "clamp none": (lambda s: s.clamp(1, None), "clamp: edges", "whole"),
    "clamp by a short mask": (lambda s: s.clamp(1, [True, False]), "clamp: edges", "mask of 2", "there are 4"),
    "clamp by an empty mask": (lambda s: s.clamp(1, np.zeros(4, bool)), "clamp: edges", "False everywhere"),
    "clamp by a mask of several": (lambda s: s.clamp([0, 1], np.ones(4, bool)), "clamp: edges", "different sizes"),
    "clamp by a slice of several": (lambda s: s.clamp([0, 1], slice(2)), "clamp: edges", "different sizes"),
    "clamp by a mixed list": (lambda s: s.clamp(1, [True, 2]), "clamp: edges", "whole numbers, or a mask"),
    "clamp two axes": (lambda s: s.clamp(1, [[0, 1]]), "clamp: edges", "whole numbers"),
    "clamp no rods": (lambda s: s.clamp([], [0]), "rods", "nothing is chosen"),
    "clamp rods none": (lambda s: s.clamp(None), "rods", "whole numbers"),
    "fix node": (lambda s: s.fix([0, 1], [5]), "node 5", "rod 1", "5 nodes"),
    "fix node from behind": (lambda s: s.fix(1, [-6]), "node -6", "rod 1", "5 nodes"),
    "fix nothing": (lambda s: s.fix(1, np.zeros(0, int)), "fix: nodes", "nothing is chosen"),
    "fix an empty slice": (lambda s: s.fix(1, slice(3, 3)), "fix: nodes", "nothing is chosen"),
    "fix no components": (lambda s: s.fix(1, [0], components=""), "''", "'xyz'"),
    "fix components none": (lambda s: s.fix(1, [0], components=None), "None", "'xyz'"),
    "fix components": (lambda s: s.fix(1, [0], components="xw"), "'xw'", "'xyz'"),
    "fix twist": (lambda s: s.fix_twist(1, [4]), "edge 4", "rod 1", "4 edges"),
    "fix twist of nothing": (lambda s: s.fix_twist(1, []), "fix_twist", "nothing is chosen"),
    "rod": (lambda s: s.fix(2, [0]), "rod 2", "2 rods"),
    "rod before the first": (lambda s: s.clamp([0, -1], [0]), "rod -1", "2 rods"),
    "rod fraction": (lambda s: s.clamp_end(0.5), "rods [0.5]", "whole"),
    "end": (lambda s: s.clamp_end(1, "middle"), "'middle'", "'first'", "'last'"),
    "end a number": (lambda s: s.clamp_end(1, 0), "0", "'first'"),
    "components of an end": (lambda s: s.clamp_end(1, components="q"), "'q'", "'xyz'"),
    "motion a function": (lambda s: s.clamp(1, motion=lambda t: (0.0, 0.0, t)), "clamp: motion", "Motion("),
    "motion of the end": (lambda s: s.clamp_end(1, motion=3), "clamp_end: motion", "Motion("),
    "motion of each edge": (lambda s: s.clamp(1, motion=M(lambda t: np.zeros((2, 3)))), "clamp", "use fix"),
    "motion of each, too many": (lambda s: s.fix(1, [0, 1], motion=M(lambda t: np.zeros((3, 3)))), "3 displacements of 2"),
    "starts away": (lambda s: s.clamp(1, motion=M(lambda t: (0.1, 0.0, t))), "clamp", "t = 0", "(0.1, 0.0, 0.0)", "subtract"),
    "starts turned": (lambda s: s.clamp(1, motion=M(angle=lambda t: 0.5 + t)), "clamp", "angle at t = 0", "0.5", "subtract"),
    "one of each starts away": (
        lambda s: s.fix(1, [0, 1], motion=M(lambda t: [[0.0, 0.0, t], [0.0, 0.2, t]])),
        *("fix", "t = 0", "(0.0, 0.2, 0.0)"),
    ),
    "still and moving node": (
        lambda s: (s.fix(1, [0]), s.fix(1, [0], "x", SWING)), "node 0 of rod 1", "fixed by one", "moved", "along x"
    ),
    "moving and still node": (
        lambda s: (s.fix(1, [0], "x", SWING), s.fix(1, [0])), "node 0 of rod 1", "fixed by one", "moved", "along x"
    ),
    "still and moving clamps that touch": (
        lambda s: (s.clamp(1, [0]), s.clamp(1, [1], SWING)), "node 1 of rod 1", "fixed by one", "same motion"
    ),
    "still and moving edge": (
        lambda s: (s.fix_twist(1, [2]), s.fix_twist(1, [2], SWING)), "edge 2 of rod 1", "fixed by one", "moved"
    ),
    "two motions of a node": (
        lambda s: (s.fix(1, [0], motion=STILL), s.fix(1, [0], "z", SWING)), "node 0 of rod 1", "two motions along z"
    ),
    "two displacements of a node": (
        lambda s: s.fix(1, [0, 0], motion=M(lambda t: [[0.0, 0.0, 0.0], [0.0, 0.0, t]])), "node 0 of rod 1", "two motions along x"
    ),
    "two motions of an edge": (
        lambda s: (s.fix_twist(1, [2], STILL), s.fix_twist(1, [2], SWING)), "edge 2 of rod 1", "two motions"
    ),
    "two motions of an end": (
        lambda s: (s.clamp_end(1, "last", STILL), s.clamp_end(1, "last", SWING)), "node 4 of rod 1", "two motions"
    ),
}
refuse("supports", {name: (lambda a=add: built(rods(), a), *words) for name, (add, *words) in SUPPORTS.items()})
JOINED = lambda s: s.join([(0, 0), (1, 0)])  # noqa: E731
refuse("supports", {
    "net, still and moving node": (
        lambda: built(rods(), JOINED, lambda s: (s.fix(1, [-1]), s.fix(1, [-1], "x", SWING))), "point at (1, 0, 0)", "fixed by one"),
    "net, still and moving at a joint": (
        lambda: built(rods(), JOINED, lambda s: (s.fix(0, [0]), s.fix(1, [0], "x", SWING))), "point at (0, 0, 0)", "fixed by one"),
    "net, two motions of an edge": (
        lambda: built(rods(), JOINED, lambda s: (s.fix_twist(1, [2], STILL), s.fix_twist(1, [2], SWING))), "edge 2 of rod 1", "two"),
    "net, still and moving edge": (
        lambda: built(rods(), JOINED, lambda s: (s.fix_twist(1, [2]), s.fix_twist(1, [2], SWING))), "edge 2 of rod 1", "fixed by one"),
    "end of a closed rod": (lambda: rods(RING, closed=True).clamp_end([0, 1]), "rod 1", "closed", "no end"),
    "angle of a rod without twist": (lambda: rods(twist=False).fix_twist(1, [0]), "rod 1", "no twist", "twist=True"),
    "angle in the plane": (lambda: rods(scene=ddg.Scene(dimension=2)).fix_twist(1, [0]), "no twist", "dimension 3"),
    "turn out of the plane": (
        lambda: rods(scene=ddg.Scene(dimension=2)).clamp(1, motion=M(angle=lambda t: t)), "plane of x and z", "axis=(0, 1, 0)"),
})

# --- motions ---
each("motions", "translation", [(1, 0, 0), 3.0, None, "up"], lambda v: M(translation=v), "translation", "function of the time")
each("motions", "angle", [1.0, None], lambda v: M(angle=v), "angle", "function of the time")
each("motions", "axis", [(0.0, 0.0, 0.0), (1.0, 0.0), "z", (NAN, 0.0, 1.0)], lambda v: M(axis=v), "axis", "three")
each("motions", "pivot", [(1.0, 0.0), None, (0.0, INF, 0.0)], lambda v: M(pivot=v), "pivot", "three finite")
each("motions", "translation to", [(0.0, 0.0), 0.0, "far", (0.0, 0.0, NAN), None, np.zeros((2, 2)), [[0.0, 0.0, 0.0], [0.0]]],
     lambda v: M(translation=lambda t: v), "Motion: translation", "bad_input_scenes.py", "t = 0")
each("motions", "angle to", [(0.0, 0.0), NAN, "far", None], lambda v: M(angle=lambda t: v), "Motion: angle", "t = 0")
refuse("motions", {"translation that fails": (lambda: M(lambda t: 1 / 0), "translation", "ZeroDivisionError", "t = 0")})

# --- loads of rods ---
LOADS = {
    "force node": (lambda s: s.add_force(1, 5, (0.0, 0.0, 1.0)), "node 5", "rod 1", "5 nodes"),
    "force rod": (lambda s: s.add_force(7, 0, (0.0, 0.0, 1.0)), "rod 7", "2 rods"),
    "force rod twice": (lambda s: s.add_force([1, 1], 0, (0.0, 0.0, 1.0)), "rods", "1 is named twice"),
    "force nodes": (lambda s: s.add_force(1, [0, 1], (0.0, 0.0, 1.0)), "add_force: node", "one whole number"),
    "force node fraction": (lambda s: s.add_force(1, 0.5, (0.0, 0.0, 1.0)), "node", "0.5", "whole"),
    "force node true": (lambda s: s.add_force(1, True, (0.0, 0.0, 1.0)), "node", "mask"),
    "force nan": (lambda s: s.add_force(1, 3, (0.0, 0.0, NAN)), "force on node 3", "three finite"),
    "force of two": (lambda s: s.add_force(1, 3, (0.0, 1.0)), "force on node 3", "three finite"),
    "force a number": (lambda s: s.add_force(1, 3, 1.0), "force on node 3", "three finite"),
    "force a word": (lambda s: s.add_force(1, 3, "down"), "force on node 3", "three finite"),
    "amplitude": (lambda s: s.add_force(1, 3, (0.0, 0.0, 1.0), amplitude=2.0), "amplitude", "2.0", "function"),
    "amplitude of three": (lambda s: s.add_force(1, 3, (0.0, 0.0, 1.0), lambda t: (t, 0, 0)), "amplitude", "one number"),
    "amplitude nan": (lambda s: s.add_force(1, 3, (0.0, 0.0, 1.0), lambda t: NAN), "amplitude", "not finite at t = 0"),
    "amplitude none": (lambda s: s.add_force(1, 3, (0.0, 0.0, 1.0), lambda t: None), "amplitude", "one number", "t = 0"),
    "amplitude that fails": (lambda s: s.add_force(1, 3, (0.0, 0.0, 1.0), lambda t: {}[t]), "amplitude", "KeyError"),
    "moment edge": (lambda s: s.add_twisting_moment(1, 4, 1.0), "edge 4", "rod 1", "4 edges"),
    "moment nan": (lambda s: s.add_twisting_moment(1, 3, NAN), "moment on edge 3", "finite"),
    "moment of three": (lambda s: s.add_twisting_moment(1, 3, (1.0, 0.0, 0.0)), "moment on edge 3", "one finite number"),
    "couple nan": (lambda s: s.add_couple(1, 3, (NAN, 0.0, 0.0)), "couple on edge 3", "three finite"),
    "couple of two": (lambda s: s.add_couple(1, 3, (1.0, 0.0)), "couple on edge 3", "three finite"),
    "couple edge": (lambda s: s.add_couple(1, 4, (1.0, 0.0, 0.0)), "edge 4", "rod 1", "4 edges"),
    "drag rod": (lambda s: s.drag(7, tangential=1.0, normal=1.0), "rod 7", "2 rods"),
    "drag rod twice": (lambda s: s.drag([1, 1], tangential=1.0, normal=1.0), "drag: rods", "1 is named twice"),
    "drag twice": (lambda s: (s.drag(1, ddg.Viscous(1.0)), _in_fluid(s)), "rod 1 has drag already"),
    "drag of nothing": (lambda s: s.drag(1), "drag: tangential", "None"),
    "drag one way": (lambda s: s.drag(1, tangential=1.0), "drag: normal", "None"),
    "drag negative": (lambda s: s.drag(1, tangential=-1.0, normal=1.0), "drag: tangential", "not negative"),
    "drag nan": (lambda s: s.drag(1, tangential=1.0, normal=1.0, rotational=NAN), "drag: rotational", "[N s]"),
    "drag by a number": (lambda s: s.drag(1, 3.0), "drag: law is 3.0", "Viscous"),
    "drag by both": (lambda s: s.drag(1, ddg.Viscous(1.0), normal=2.0), "law and coefficients", "one of them"),
    "drag viscosity": (lambda s: s.drag(1, ddg.Viscous(0.0)), "Viscous: viscosity", "[Pa s]"),
    "drag theory": (lambda s: s.drag(1, ddg.Viscous(1.0, "stokes")), "Viscous: theory", "'lighthill'"),
    "drag scale": (lambda s: s.drag(1, ddg.Viscous(1.0, "lighthill")), "'lighthill'", "scale"),
    "drag scale negative": (lambda s: s.drag(1, ddg.Viscous(1.0, scale=-1.0)), "Viscous: scale", "positive"),
    "drag of a thick rod": (lambda s: s.drag(1, ddg.Viscous(1.0, scale=1e-3)), "'odd'", "too large", "tangential"),
    "drag of three edges": (lambda s: s.drag(1, tangential=[1.0] * 3, normal=1.0), "tangential has shape (3,)", "'odd'", "4 edges"),
    "drag of rods": (lambda s: s.drag([0, 1], tangential=1.0, normal=np.ones((3, 1))), "normal has shape (3, 1)", "2 rods"),
    "drag of an edge negative": (lambda s: s.drag(1, tangential=[1.0, -1.0], normal=1.0), "drag: tangential", "not negative"),
    "drag of nodes": (lambda s: s.drag(1, nodes=[1.0] * 4), "nodes has shape (4,)", "'odd'", "5 nodes"),
    "drag of nodes nan": (lambda s: s.drag(1, nodes=NAN), "drag: nodes", "[N s/m]"),
    "drag radius": (lambda s: s.drag(1, ddg.Viscous(1.0, radius=[0.1, 0.0])), "Viscous: radius", "positive"),
    "drag radius of three edges": (lambda s: s.drag(1, ddg.Viscous(1.0, radius=[1e-3] * 3)), "radius has shape (3,)", "4 edges"),
    "drag in sand": (lambda s: s.drag(1, ddg.Granular(-1.0, 1.0)), "Granular: lateral", "not negative"),
    "drag in sand, leading": (lambda s: s.drag(1, ddg.Granular(1.0, 1.0, leading=-2.0)), "Granular: leading", "-friction"),
    "drag in sand, angle": (lambda s: s.drag(1, ddg.Granular(1.0, 1.0, angle=2.0)), "Granular: angle", "pi / 2"),
    "drag in sand, speed": (lambda s: s.drag(1, ddg.Granular(1.0, 1.0, speed=0.0)), "Granular: speed", "positive"),
    "drag, density": (lambda s: s.drag(1, ddg.QuadraticDrag(0.0)), "QuadraticDrag: density", "[kg/m^3]"),
    "drag, C_n": (lambda s: s.drag(1, ddg.QuadraticDrag(1.2, -1.0)), "QuadraticDrag: normal", "not negative"),
    "drag, radius": (lambda s: s.drag(1, ddg.QuadraticDrag(1.2, radius=0.0)), "QuadraticDrag: radius", "positive"),
    "drag without radius": (
        lambda s: s.drag(s.add_rod(line(), section=BARE, name="bare"), ddg.QuadraticDrag(1.2)), "'bare'", "no radius", "radius=..."),
    "drag of nodes, quadratic": (lambda s: s.drag(1, ddg.QuadraticDrag(1.2, radius=0.1), nodes=1.0), "nodes", "leave nodes out"),
    "drag of two kinds": (lambda s: (s.drag(0, ddg.QuadraticDrag(1.2, radius=0.1)), s.drag(1, ddg.Viscous(1.0, radius=1e-3))),
                          "QuadraticDrag", "one kind"),
    "drag of no shell": (lambda s: s.drag(shells=0, normal=1.0, tangential=1.0), "shell 0", "0 shells"),
    "drag of a rod as shell": (lambda s: s.drag(shells=s.add_rod(line(), section=STIFFNESS), normal=1.0, tangential=1.0), "no shell"),
    "mass node": (lambda s: s.add_mass(1, 5, 1.0), "node 5", "rod 1", "5 nodes"),
    "mass zero": (lambda s: s.add_mass(1, 4, 0.0), "mass at node 4 is 0.0", "positive"),
    "mass negative": (lambda s: s.add_mass(1, 4, -1.0), "mass at node 4", "positive"),
    "mass nan": (lambda s: s.add_mass(1, 4, NAN), "mass at node 4 is nan", "positive"),
    "mass infinite": (lambda s: s.add_mass(1, 4, INF), "mass at node 4 is inf", "positive"),
    "mass a word": (lambda s: s.add_mass(1, 4, "heavy"), "mass at node 4", "positive"),
}
refuse("loads", {name: (lambda a=add: built(rods(), a), *words) for name, (add, *words) in LOADS.items()})
PLANAR = {
    "gravity out of the plane": (lambda: built(rods(scene=ddg.Scene(dimension=2, gravity=(0.0, 1.0, -9.81)))), "gravity", "0 along y"),
    "force out of the plane": (lambda: _plane().add_force(1, 0, (0.0, 1.0, 0.0)), "force", "plane of x and z", "0 along y"),
    "couple in the plane": (lambda: _plane().add_couple(1, 0, (1.0, 0.0, 0.0)), "couple", "0 along x and z"),
    "moment in the plane": (lambda: _plane().add_twisting_moment(1, 0, 1.0), "rod", "twist=True", "dimension 3"),
    "moment without twist": (lambda: rods(twist=False).add_twisting_moment(1, 0, 1.0), "rod 1", "twist=True"),
    "moment without bending": (lambda: rods(bend=False).add_twisting_moment(1, 0, 1.0), "rod 1", "twist=True"),
}


def _plane():
    return rods(scene=ddg.Scene(dimension=2))


refuse("loads", PLANAR)
