"""Values of a wrong type at public calls: texts for numbers, numbers for names, no array, no model, no state."""

# fmt: off
import numpy as np
import torch
from bad_inputs import (
    RING,
    RUBBER,
    STIFFNESS,
    built,
    clamped,
    dome,
    each,
    integrator,
    line,
    model,
    refuse,
    rods,
    sheet,
)

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.model import rest_shapes
from ddg_warp.postprocess import fields, quantities, sag_free
from ddg_warp.solve.equilibrium import continuation, stability, statics
from ddg_warp.solve.stepping.adaptive_step import AdaptiveStepper

NUMBERS = [b"0.3", "0.3", True, 1j, [[1.0], [2.0, 3.0]], {"a": 1.0}, 10**400]  # which are none
GRAD = torch.ones(3, dtype=torch.float64, requires_grad=True)


class Odd:
    """Object without a repr."""

    def __repr__(self) -> str:
        raise RuntimeError("no")


# --- numbers ---
each("kinds: numbers", "young", NUMBERS, ddg.Material, "Material: young")
each("kinds: numbers", "radius", NUMBERS, ddg.Circle, "Circle: radius")
each("kinds: numbers", "friction", NUMBERS, lambda v: rods().contact(friction=v), "contact: friction")
each("kinds: numbers", "range", NUMBERS, lambda v: rods().contact(range=v), "contact: range", "positive")
each("kinds: numbers", "tangential drag", NUMBERS, lambda v: rods().drag(0, tangential=v, normal=1.0), "drag: tangential")
each("kinds: numbers", "dt", NUMBERS, lambda v: integrator().step(model().state(), v), "dt", "positive")
each("kinds: numbers", "error", NUMBERS, lambda v: AdaptiveStepper(integrator(), v), "AdaptiveStepper: error", "positive")
each("kinds: numbers", "thickness", NUMBERS, lambda v: sheet(thickness=v), "shell 'sheet': thickness")
each("kinds: numbers", "stiffness of a law", NUMBERS, lambda v: ddg.Law(None, stiffness=[1.0, v]), "Law: stiffness")
each("kinds: numbers", "EA", NUMBERS, lambda v: built(rods(section=ddg.Stiffness(v))), "EA")
each("kinds: numbers", "mass", NUMBERS, lambda v: clamped().add_mass(0, -1, v), "mass")
each("kinds: numbers", "pressure", NUMBERS, lambda v: sheet().add_pressure(0, v), "add_pressure: pressure")
each("kinds: numbers", "load of a spectrum", NUMBERS, lambda v: stability.spectrum(model(), model().state(), load=v), "spectrum: load")
each("kinds: numbers", "factor of reactions", NUMBERS, lambda v: quantities.reactions(model(), model().state(), factor=v), "factor")
each("kinds: numbers", "values under control", NUMBERS,
     lambda v: continuation.Continuation(model(), {"tip": ddg.Displacement.of(6, "z")}).control("tip", v), "control: values")
refuse("kinds: numbers", {
    "an object without a repr": (lambda: ddg.Circle(Odd()), "Circle: radius", "a value of type Odd"),
    "a long text": (lambda: ddg.Circle("1" * 9999), "Circle: radius", "..."),
})

# --- arrays ---
ARRAYS = [GRAD, [GRAD, GRAD], np.ones(3, bool), np.ones(3) * 1j, [["a"]], b"points", {1: 2}, [[1.0], [2.0, 3.0]]]
for kind, words, action in (
    ("points of a rod", "rods 'rod': points", lambda v: ddg.Scene().add_rod(v, section=STIFFNESS)),
    ("director", "rods 'rod': director", lambda v: ddg.Scene().add_rod(line(), section=STIFFNESS, director=v)),
    ("points of a shell", "points", lambda v: ddg.Scene().add_shell(v, [[0, 1, 2]], thickness=0.1, material=RUBBER)),
    ("points of a meridian", "points", lambda v: ddg.Scene().add_axisymmetric_shell(v, thickness=0.1, material=RUBBER)),
    ("points of a mesh", "Mesh: points", lambda v: ddg.Mesh(v, [[0, 1, 2]])),
    ("points of a state", "points", lambda v: model().state(points=v)),
    ("spins of a state", "spins", lambda v: model().state(spins=v)),
    ("points of a writhe", "writhe: points", quantities.writhe),
    ("force", "add_force: force", lambda v: clamped().add_force(0, -1, [v, v, v])),
    ("natural", "natural", lambda v: built(rods(natural=[v, 0.0, 0.0]))),
    ("rest of a meridian", "rest", lambda v: built(dome(rest=(v, v)), lambda s: s.hold_ring(0, 5))),
    ("rest of a shell", "rest", lambda v: sheet(rest=(v, v))),
    ("tangent of a clamp", "clamp_end: tangent", lambda v: rods().clamp_end(0, tangent=[v, v])),
    ("rotation of a box", "Box: rotation", lambda v: ddg.Box((0, 0, 0), (1, 1, 1), v)),
    ("forces of a step", "forces", lambda v: integrator().step(integrator().model.state(), 0.1, ddg.Controls(forces=v))),
    ("stretch", "first", lambda v: rest_shapes.grown_metric(*meshes.rectangle(1, 1), v)),
):
    names = ("a gradient", "tensors of a gradient", "bools", "complex", "texts", "bytes", "a dictionary", "ragged")
    refuse("kinds: arrays", {f"{kind}: {name}": (lambda v=v, action=action: action(v), words)
                             for name, v in zip(names, ARRAYS, strict=True)})
refuse("kinds: arrays", {
    "a gradient says what helps": (lambda: ddg.Scene().add_rod(GRAD, section=STIFFNESS), "detach()"),
    "one number for a tangent": (lambda: rods().clamp_end(0, tangent=2.5), "clamp_end: tangent", "(3,)"),
    "one number for a force on vertices": (lambda: sheet().add_vertex_force(0, [1, 2], 2.5), "add_vertex_force: force", "(3,)"),
    "one number for a force on rings": (lambda: dome().add_ring_force(0, [1, 2], 2.5), "add_ring_force: force", "(2,)"),
    "one number for a gradient": (lambda: rods().magnetic_field((0, 0, 1), gradient=0.0), "magnetic_field: gradient", "(3, 3)"),
    "NaN in the points of a state": (lambda: model().state(points=np.where(np.eye(12, 3) > 0, np.nan, 0.0)), "points", "node 0"),
    "triangles of a weld": (lambda: meshes.weld(RING, True, 1e-3), "weld: triangles", "(T, 3)"),
    "no points of a weld": (lambda: meshes.weld(None, [[0, 1, 2]], 1e-3), "weld: points"),
    "section and material that do not broadcast": (
        lambda: rods(section=ddg.Circle(np.ones(4)), material=ddg.Material(np.ones(3))), "rods 'odd'", "do not go together"),
    "sides that do not broadcast": (lambda: ddg.Rectangle([1.0, 2.0], [1.0, 2.0, 3.0]), "Rectangle", "broadcast"),
    "a thickness that does not broadcast": (lambda: ddg.Ribbon([1.0, 2.0], [0.1, 0.1, 0.1]), "Ribbon", "broadcast"),
    "an index beyond integers": (lambda: rods().clamp(0, np.array([2**64 - 1], np.uint64)), "does not exist"),
})

# --- names ---
NAMES = [None, 3, b"rod", ["a"], {"a": 1}, ""]
each("kinds: names", "rod", NAMES, lambda v: rods(name=v), "add_rods: name", "text")
each("kinds: names", "shell", NAMES, lambda v: sheet(name=v), "add_shell: name", "text")
each("kinds: names", "meridian", NAMES, lambda v: dome(name=v), "add_axisymmetric_shell: name", "text")
each("kinds: names", "obstacle", NAMES, lambda v: rods().add_obstacle(ddg.Plane(), name=v), "add_obstacle: name", "text")
each("kinds: names", "one of two", NAMES, lambda v: rods().contact_between(v, "rod", ignore=True), "contact_between: one", "text")
each("kinds: names", "other of two", NAMES, lambda v: rods().contact_between("rod", v, ignore=True), "contact_between: other", "text")
each("kinds: names", "objects", [[["a"]], [3], 3, [], [b"rod"]],
     lambda v: rods().contact(objects=v), "contact: objects", "list of names")
each("kinds: names", "radius", [{3: 0.1}, {("a",): 0.1}, [0.1]], lambda v: rods().contact(radius=v), "contact:", "radius")
each("kinds: names", "precision", [["float64"], {"a": 1}, b"float64", 3], lambda v: clamped().build("cpu", v), "precision", "mixed")
each("kinds: names", "device", [[], 0, {"a": 1}, b"cpu"], lambda v: clamped().build(v), "device")
each("kinds: names", "linear", [["sweep"], {"a": 1}, b"sweep"], lambda v: ddg.Integrator(model(), linear=v), "cyclic_reduction")
each("kinds: names", "mode", [["follow"], b"follow"], lambda v: statics.solve(model(), mode=v), "mode", "minimise")
each("kinds: names", "displacement", [["tip"], {"a": 1}, None],
     lambda v: continuation.Continuation(model(), {"tip": ddg.Displacement.of(6, "z")}).control(v, [0.1]), "is watched")
each("kinds: names", "fields", [[["twist"]], b"twist", 3, None], lambda v: fields.point_fields(model(), model().state(), v), "fields")
each("kinds: names", "fields of cells", [["twist"]], lambda v: fields.cell_fields(model(), model().state(), v), "cell_fields")

# --- flags, functions, objects ---
each("kinds: flags", "allow_rounding", ["yes", 1, None, b"1"], lambda v: clamped().build("cpu", allow_rounding=v), "allow_rounding")
each("kinds: flags", "dimension", [3.0, "3", b"3", None, [3], 4], lambda v: ddg.Scene(dimension=v), "dimension", "2 or 3")
each("kinds: flags", "copy", [{"gravity": "down"}, {"dimension": 3.0}, {"callbacks": 3}, {"analysis": None}],
     lambda v: rods().copy(**v), "; ")
each("kinds: flags", "section", [ddg.Circle, ddg.Stiffness, RUBBER, b"c"], lambda v: rods(section=v), "section", "Circle")
each("kinds: flags", "stop", ["a", 3.0, ("a", 1.0), ("a", "b", "c"), (1, 0.0, 1.0), {"a": 1}, True],
     lambda v: ddg.StopCriterion(displacement=v), "StopCriterion: displacement")
LOADS = [None, 3.0, (1.0,), ("a", "b"), (2.0, 1.0)]
each("kinds: flags", "load of a stop", LOADS, lambda v: ddg.StopCriterion(load=v), "StopCriterion: load")
each("kinds: flags", "terms", [[], (), 3, None, [1]], ddg.Displacement, "Displacement")
each("kinds: flags", "watch", [3, ["tip"], {3: ddg.Displacement.of(0, "x")}, {"tip": 3}],
     lambda v: continuation.Continuation(model(), v), "watch")
each("kinds: flags", "way", [3, "a", (), {}], lambda v: statics.solve(model(), way=v), "statics: way", "list")
each("kinds: flags", "tangent of a spectrum", [0, "a", []],
     lambda v: stability.spectrum(model(), model().state(), tangent=v), "spectrum: tangent")
each("kinds: flags", "mask", [GRAD, [1.0], "a", [[True], [True, False]]],
     lambda v: integrator().reset(integrator().model.state(), v), "mask")
each("kinds: flags", "equilibrium_at", [3, None, "a"], lambda v: stability.critical(v, 0.0, 1.0), "critical: equilibrium_at")
each("kinds: flags", "points of statistics", [3, None, ["a"]], lambda v: continuation.Continuation(model()).statistics(v), "statistics")
each("kinds: flags", "strains at rest", [3, None, "a"], lambda v: rest_shapes.set_rest_strains(model(), v), "set_rest_strains")
each("kinds: flags", "cuts of a control", [-1, "few", 2.5],
     lambda v: continuation.Continuation(model(), {"tip": ddg.Displacement.of(6, "z")}).control("tip", [0.1], max_cuts=v), "max_cuts")
each("kinds: flags", "step of a switch", [0.0, "a"], lambda v: continuation.Continuation(model()).switch(None, step=v), "switch")
refuse("kinds: flags", {
    "critical of one parameter": (lambda: stability.critical(lambda p: None, 1.0, 1.0), "critical", "both 1"),
    "critical without a pair": (lambda: stability.critical(lambda p: 3, 0.0, 1.0), "critical: equilibrium_at", "(model, state)"),
    "critical without a change": (lambda: stability.critical(lambda p: (model(), model().state()), 0.0, 1.0), "sign changes"),
})

# --- models and states ---
QUESTIONS = tuple(
    getattr(quantities, name)
    for name in ("energies", "reactions", "drag", "stresses", "triangle_fields", "total_twist")
)
for question in (*QUESTIONS, sag_free.rest_strains, sag_free.least_stiffness):
    refuse("kinds: models", {
        f"{question.__name__} of a scene": (lambda q=question: q(clamped(), model().state()), question.__name__, "scene.build()"),
        f"{question.__name__} at points": (lambda q=question: q(model(), line()), question.__name__, "model.state()"),
        f"{question.__name__} at a foreign state": (lambda q=question: q(model(), model("net").state()), question.__name__, "another"),
    })
refuse("kinds: models", {
    "set_rest of a scene": (lambda: rest_shapes.set_rest(sheet(), 0, points=RING), "set_rest", "scene.build()"),
    "set_rest_strains of a scene": (lambda: rest_shapes.set_rest_strains(rods(), {}), "set_rest_strains", "scene.build()"),
    "check at points": (lambda: integrator().check(line()), "check", "model.state()"),
    "resists at points": (lambda: integrator().resists(line()), "resists", "model.state()"),
    "point_fields of a scene": (lambda: fields.point_fields(rods(), model().state(), ["twist"]), "point_fields", "scene.build()"),
})
