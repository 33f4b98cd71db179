"""Bad inputs to equilibria: statics, continuation, stability."""

# fmt: off
from bad_inputs import INF, NAN, built, clamped, each, line, model, refuse, rods, sheet

import ddg_warp as ddg
from ddg_warp.solve.equilibrium import continuation, stability, statics

# --- statics ---
each("statics", "model", [None, 3], statics.solve, "statics", "scene.build()")
each("statics", "state", [3, "rest"], lambda v: statics.solve(model(), v), "statics", "model.state()")
each("statics", "load_steps", [0, 1.5, "two", None], lambda v: statics.solve(model(), load_steps=v), "load_steps", "at least 1")
each("statics", "mode", ["downhill", None], lambda v: statics.solve(model(), mode=v), "mode", "minimise", "follow")
each("statics", "solver", ["magic", None], lambda v: statics.solve(model(), solver=v), "solver", "direct", "pcg")
each("statics", "end", [NAN, "full", None], lambda v: statics.solve(model(), end=v), "end", "finite")
each("statics", "start", [INF, "none"], lambda v: statics.solve(model(), start=v), "start", "finite")
for name in ("rtol", "floor_factor", "rotation_cap"):

    def tolerance(v, name=name):
        return statics.solve(model(), **{name: v})

    each("statics", name, [0.0, NAN, "small"], tolerance, name, "positive")
each("statics", "max_iterations", [0, 1.5], lambda v: statics.solve(model(), max_iterations=v), "max_iterations", "at least 1")
each("statics", "max_cuts", [0, "few"], lambda v: statics.solve(model(), max_cuts=v), "max_cuts", "at least 1")


def _solve_underconstrained(components: str):
    scene = rods()
    scene.clamp(0)
    if components:
        scene.fix(1, [0, 2, 4], components=components)
    return statics.solve(built(scene))


def _solve(change, **options):
    scene = rods()
    scene.clamp(0)
    change(scene)
    return statics.solve(built(scene), **options)


def _force(amplitude):
    return lambda s: (s.clamp(1), s.add_force(1, -1, (0.0, 0.0, 1.0), amplitude))


refuse("statics", {
    "a scene": (lambda: statics.solve(clamped()), "statics", "Scene", "scene.build()"),
    "state of another model": (lambda: statics.solve(model(), model("net").state()), "another model"),
    "free": (lambda: _solve_underconstrained(""), "rod 1", "along x", "supports", "clamp"),
    "free along z": (lambda: _solve_underconstrained("xy"), "rod 1", "along z", "supports"),
    "free along x": (lambda: _solve_underconstrained("yz"), "rod 1", "along x", "supports"),
    "free sheet": (lambda: statics.solve(built(sheet())), "supported along x", "scene.hold"),
    "pcg of rods": (lambda: statics.solve(model(), solver="pcg"), "'pcg'", "solver='direct'"),
    "pcg follows": (lambda: statics.solve(model("net"), solver="pcg", mode="follow"), "'follow'", "solver='direct'"),
    "amplitude that ends": (lambda: _solve(_force(lambda t: t if t < 0.5 else NAN), load_steps=4), "amplitude", "t = 0.5"),
    "motion that ends": (
        lambda: _solve(lambda s: s.clamp(1, motion=ddg.Motion(lambda t: (t if t < 0.5 else NAN, 0.0, 0.0))), load_steps=4),
        *("translation", "not finite", "t = 0.5")),
    "motion that jumps": (
        lambda: _solve(lambda s: s.clamp(1, motion=ddg.Motion(lambda t: (0.0, 0.0, 0.0 if t < 0.3 else 1e20))), max_cuts=3),
        *("jumps at t = 0.3", "continuous", "load parameter")),
    "amplitude of three later": (lambda: _solve(_force(lambda t: t if t < 0.5 else (t, t, t))), "amplitude", "one number", "t = 1"),
    "sheet, motion that ends": (
        lambda: statics.solve(_hinged(ddg.Motion(lambda t: (0.0, 0.0, 0.0 if t < 0.5 else NAN)))), "translation", "t = 1"),
})


def _hinged(motion):
    scene = sheet(2, bending="hinge")
    scene.hold(0, [0, 1, 2, 6, 7, 8], motion=motion)
    return built(scene)


# --- continuation ---
TIP = ddg.Displacement.of(11, "z")


def _path(watch=None, **options):
    return continuation.Continuation(model(), watch, **options)


each("continuation", "model", [None, 3], continuation.Continuation, "continuation", "scene.build()")
each("continuation", "watch", [3, "tip", (11, "z")], lambda v: _path({"tip": v}), "watch['tip']", "Displacement.of")
each("continuation", "axis", ["w", None, 2], lambda v: ddg.Displacement.of(0, v), "axis", "'x'")
each("continuation", "point", [0.5, "tip", None], lambda v: ddg.Displacement.of(v, "z"), "point", "whole")
each("continuation", "weight", [NAN, "much"], lambda v: ddg.Displacement.of(0, "z", v), "weight", "finite")
each("continuation", "terms", [5, ((0, "z"),)], ddg.Displacement, "term", "weight")
each("continuation", "step", [0.0, NAN, "small"], lambda v: _path(step=v), "step", "positive")
each("continuation", "iterations", [0, 2.5], lambda v: _path(iterations=v), "iterations", "at least 1")
each("continuation", "direction", [0, 2, "up", None], lambda v: _path().trace(direction=v), "direction", "-1")
each("continuation", "start", [NAN, "rest"], lambda v: _path().trace(start=v), "start", "finite")
each("continuation", "state", [3, "rest"], lambda v: _path().trace(v), "continuation", "model.state()")
each("continuation", "stop", [3, "soon"], lambda v: _path().trace(stop=v), "stop", "StopCriterion(...)")
each("continuation", "steps", [0, 1.5, "few"], lambda v: ddg.StopCriterion(steps=v), "steps", "whole number")
each("continuation", "limit_points", [0, 1.5], lambda v: ddg.StopCriterion(limit_points=v), "limit_points", "whole number")
each("continuation", "load", [(1.0, 0.0), 1.0, (0.0, NAN)], lambda v: ddg.StopCriterion(load=v), "load", "lowest")
each("continuation", "displacement", ["tip", ("tip", 1.0, 0.0)], lambda v: ddg.StopCriterion(displacement=v), "displacement", "lowest")
each(
    "continuation",
    "side",
    [0, "left"],
    lambda v: _path().switch(_path().trace(stop=ddg.StopCriterion(steps=1)).points[0], side=v),
    "side",
    "-1",
)
each("continuation", "switch", [None, 3], lambda v: _path().switch(v), "switch", "path.bifurcations")
each("continuation", "values", ["far", [0.1, NAN]], lambda v: _path({"tip": TIP}).control("tip", v), "control: values", "finite")
refuse("continuation", {
    "worlds": (lambda: continuation.Continuation(model("rods", 2)), "one world", "2"),
    "watched point": (lambda: _path({"tip": ddg.Displacement.of(12, "z")}), "point 12", "12 points"),
    "watched elsewhere": (lambda: _path().control("tip", [0.1]), "'tip'", "watch="),
    "stop elsewhere": (lambda: _path().trace(stop=ddg.StopCriterion(displacement=("tip", 0.0, 1.0))), "'tip'", "watched"),
    "state of another model": (lambda: _path().trace(model("net").state()), "another model"),
    "switch at a regular point": (
        lambda: _path().switch(_path().trace(stop=ddg.StopCriterion(steps=1)).points[0]), "regular", "bifurcation"),
})

# --- stability ---
each("stability", "model", [None, 3], lambda v: stability.spectrum(v, None), "spectrum", "scene.build()")
each("stability", "state", [None, 3], lambda v: stability.spectrum(model(), v), "spectrum", "model.state()")
each("stability", "count", [0, -1, 1.5, "all"], lambda v: stability.spectrum(model(), model().state(), v), "count", "whole number")
each(
    "stability",
    "metric",
    ["foo", None, 3],
    lambda v: stability.spectrum(model(), model().state(), 1, v),
    "metric",
    "'mass'",
    "'unit'",
)
each("stability", "buckling count", [0, 1.5], lambda v: stability.buckling(model(), model().state(), model().state(), v), "count")
refuse("stability", {
    "state of another model": (lambda: stability.spectrum(model(), model("net").state()), "another model"),
    "buckling of another": (lambda: stability.buckling(model(), model().state(), model("net").state()), "another model"),
    "massless": (lambda: stability.spectrum(_massless_model(), _massless_model().state()), "mass", "density", "metric='unit'"),
})
BARE = []


def _massless_model():
    if not BARE:
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        scene.clamp(scene.add_rod(line(), section=ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0)))
        BARE.append(built(scene))
    return BARE[0]
