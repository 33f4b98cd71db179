"""Bad inputs to steps with different controls per world: controls, grips, outcomes, resets."""

# fmt: off
import numpy as np
from bad_inputs import INF, NAN, built, dome, each, integrator, model, refuse, rods, sheet

import ddg_warp as ddg
from ddg_warp import statics

OUT = np.zeros((2, 6))
OUT[1, 1] = 0.1
SPIN = np.zeros((2, 6))
SPIN[1, 5] = 0.1
BAD = np.zeros((2, 2, 6))
BAD[1, 1, 3] = NAN


def _gripped(dimension: int = 3, worlds: int = 2):
    scene = rods(scene=ddg.Scene(dimension=dimension))
    scene.clamp(0, motion=ddg.Grip())
    scene.clamp(1, motion=ddg.Grip())
    return scene.build("cpu", "float64", worlds=worlds)


def _gripped_dome():
    scene = dome()
    scene.clamp_ring(0, "last", motion=ddg.Grip())
    return scene.build("cpu", "float64")


def _magnetic(dimension: int = 3):
    scene = ddg.Scene(dimension=dimension)
    rod = scene.add_rod(np.outer(np.arange(4.0), (1, 0, 0)), section=ddg.Circle(0.01), material=ddg.Material(1e6, density=1e3))
    scene.magnetize(rod, 1e4)
    scene.magnetic_field((0.0, 0.0, 0.0))
    return built(scene)


def _apply(made, **controls):
    return ddg.Integrator(made).step(made.state(), 0.01, ddg.Controls(**controls))


def _reset(mask=(True, False), to=None, made=None):
    made = made or _gripped()
    return ddg.Integrator(made).reset(made.state(), mask, to)


def _plain():
    scene = rods(twist=False)
    scene.clamp([0, 1])
    return built(scene)


def _symmetry():
    scene = sheet()
    scene.symmetry(0, scene.shells[0].points[:, 0] == 0.0, "x", motion=ddg.Grip())


def _step(controls):
    return integrator().step(model("rods").state(), 0.01, controls)


each("Controls", "controls", [3, {"gravity": (0, 0, 1)}, "up"], _step, "step: controls", "Controls(")
each("Controls", "of an equilibrium", [3, "up"], lambda v: statics.solve(model(), controls=v), "statics: controls", "Controls(")
each("Controls", "gravity", [1.0, (0.0, 1.0), "down", NAN, (0.0, 0.0, INF)], lambda v: _apply(model(), gravity=v), "Controls: gravity")
each("Controls", "field", [1.0, (0.0, 1.0), NAN], lambda v: _apply(_magnetic(), field=v), "Controls: field")
refuse("Controls", {
    "a field of nothing": (
        lambda: _apply(model(), field=(0.0, 0.0, 1.0)), "field acts on nothing", "scene.magnetize", "magnetic_field"),
    "a field out of the plane": (lambda: _apply(_magnetic(dimension=2), field=(0.0, 1.0, 0.0)), "Controls: field", "0 along y"),
    "poses without grips": (lambda: _apply(model(), poses=np.zeros((0, 6))), "poses of no grip", "Grip"),
    "poses of one": (lambda: _apply(_gripped(), poses=np.zeros((1, 6))), "poses have shape (1, 6)", "(2, 6)", "(2, 2, 6)"),
    "poses of three worlds": (lambda: _apply(_gripped(), poses=np.zeros((3, 2, 6))), "poses have shape (3, 2, 6)", "(2, 2, 6)"),
    "poses that are not finite": (lambda: _apply(_gripped(), poses=BAD), "poses: entry 1 in world 1", "not finite"),
    "poses out of the plane": (lambda: _apply(_gripped(2), poses=OUT), "grip 1", "plane of x and z", "along y"),
    "poses that turn out of it": (lambda: _apply(_gripped(2), poses=SPIN), "grip 1", "rotation about x and z"),
    "a rim that turns out of it": (lambda: _apply(_gripped_dome(), poses=SPIN[1:]), "grip 0", "rotation about x and z"),
    "forces on few": (lambda: _apply(model(), forces=np.zeros((3, 3))), "forces have shape (3, 3)", "(12, 3)"),
    "forces out of the plane": (lambda: _apply(_gripped(2), forces=np.ones((12, 3))), "point 0", "plane of x and z", "0 along y"),
    "forces around a ring": (lambda: _apply(_gripped_dome(), forces=np.ones((6, 3))), "point 0", "plane of x and z", "0 along y"),
    "forces as words": (lambda: _apply(model(), forces="many"), "forces", "no array of numbers"),
    "moments on nodes": (lambda: _apply(model(), moments=np.zeros(12)), "moments have shape (12,)", "(10,)"),
    "moments without twist": (lambda: _apply(_plain(), moments=np.ones(10)), "edge 0 of rod 1 ('odd')", "no twist", "twist=True"),
    "gravity out of the plane": (lambda: _apply(_gripped(2), gravity=(0.0, 1.0, 0.0)), "gravity", "0 along y"),
    "gravity across the axis": (lambda: _apply(_gripped_dome(), gravity=(1.0, 0.0, 0.0)), "gravity", "0 along x and y"),
})
each("Grip", "position", ["there", None, (NAN, 0, 0), (0, 0)], lambda v: ddg.Grip().at(v), "Grip.at: position")
each("Grip", "quaternion", ["up", (1, 0, 0), (NAN, 0, 0, 0), (2, 0, 0, 0)], lambda v: ddg.Grip().at((0, 0, 0), v), "quaternion")
each("Grip", "near", ["there", (0, 0, 0), 3], lambda v: ddg.Grip().at((0, 0, 0), near=v), "Grip.at: near")
each("Grip", "pivot", [1.0, (0.0, 1.0), "there", (NAN, 0.0, 0.0)], ddg.Grip, "Grip: pivot", "three finite")
refuse("Grip", {
    "of a plane of symmetry": (_symmetry, "symmetry", "does not rotate", "Motion(translation"),
    "a class": (lambda: rods().clamp(1, motion=ddg.Grip), "clamp: motion", "Grip(pivot=...)"),
})
each("reset", "mask", [True, (True,), (1, 0), (0.0, 1.0), "all", None], _reset, "reset: the mask", "bools (2,)")
refuse("reset", {
    "a state": (lambda: _reset(to=3), "reset: to is 3", "state of this model"),
    "a snapshot": (lambda: _reset(to=model().state().snapshot()), "reset: to", "state of this model"),
    "another model": (lambda: _reset(to=model().state()), "another model", "worlds=1"),
    "of two worlds": (lambda: _reset(to=_gripped().state()), "another model", "worlds=1"),
    "another state": (lambda: ddg.Integrator(model()).reset(model("net").state(), [True]), "another model", "model.state()"),
    "a world that is not there": (lambda: integrator().failure(model("rods").state(), 1), "world 1 does not exist", "has 1"),
})
each("Integrator", "failures", ["ignore", None, True], lambda v: ddg.Integrator(model(), failures=v), "failures", "'raise' or 'flag'")
