"""Bad inputs to models: integrators, steps, states, queries, parameters, rest shapes."""

# fmt: off
import numpy as np
from bad_inputs import INF, NAN, RING, STIFFNESS, built, clamped, each, integrator, line, model, refuse, rods

import ddg_warp as ddg
from ddg_warp.model import rest_shapes
from ddg_warp.postprocess import quantities


# --- Integrator and step ---
def _controlled(**options) -> ddg.AdaptiveStepper:
    return ddg.AdaptiveStepper(ddg.Integrator(model(), **options), 1e-3)


each("Integrator", "model", [None, 3, "rods"], ddg.Integrator, "Integrator", "scene.build()")
refuse("Integrator", {
    "a scene": (lambda: ddg.Integrator(rods()), "Integrator", "Scene", "scene.build()"),
    "partitioned ring": (lambda: ddg.Integrator(built(rods(RING, closed=True)), linear="cyclic_reduction"), "rod 1", "closed", "auto"),
    "massless": (lambda: ddg.Integrator(_massless()), "node 2", "rod 1", "no mass", "density"),
    "massless net": (lambda: ddg.Integrator(_massless(True)), "node 2 of rod 1", "no mass", "density"),
    "massless, drag across": (lambda: ddg.Integrator(_massless(drag=True)), "node 2", "rod 1", "no mass", "drag along and across"),
    "massless net, drag across": (lambda: ddg.Integrator(_massless(True, True)), "node 2 of rod 1", "drag along and across"),
    "chain rods": (lambda: ddg.Integrator(model(), linear="substructuring"), "'substructuring'", "coupled systems", "auto"),
    "multilevel rods": (lambda: ddg.Integrator(model(), linear="multilevel"), "'multilevel'", "coupled systems", "auto"),
    "chain_multilevel rods": (lambda: ddg.Integrator(model(), linear="substructuring_multilevel"), "coupled systems", "auto"),
    "sweep of a net": (lambda: ddg.Integrator(model("net"), linear="sweep"), "'sweep'", "with a coupled system"),
    "psd of a projective net": (lambda: ddg.Integrator(model("net"), psd="none", solver="projective"), "'none'", "projective"),
    "psd none of a sheet": (lambda: ddg.Integrator(model("hinge"), psd="none"), "'none'", "left out", "progressive"),
    "psd of projective": (lambda: ddg.Integrator(model(), psd="project", solver="projective"), "psd", "projective", "gauss_newton"),
})
each(
    "Integrator",
    "scheme",
    ["rk4", None, 2],
    lambda v: ddg.Integrator(model(), v),
    "scheme",
    "implicit_euler",
    "implicit_midpoint",
)
each("Integrator", "solver", ["magic", None], lambda v: ddg.Integrator(model(), solver=v), "solver", "newton", "projective")
each("Integrator", "linear", ["ilu", None, 3], lambda v: ddg.Integrator(model(), linear=v), "linear", "sweep", "cyclic_reduction")
each(
    "Integrator",
    "retry_limit",
    [-1, 1.5, "some", True],
    lambda v: ddg.Integrator(model(), retry_limit=v),
    "retry_limit",
    "0 for no",
)
each(
    "Integrator",
    "energy_bound",
    [0.0, -0.1, 1.0, NAN, "small", True],
    lambda v: ddg.Integrator(model(), "implicit_midpoint", energy_bound=v),
    "energy_bound",
    "between 0 and 1",
)
each("AdaptiveStepper", "integrator", [None, 3, "rods"], lambda v: ddg.AdaptiveStepper(v, 1e-3), "Integrator(model)")
for name, values, word in (
    ("error", [0.0, -1.0, NAN, INF, "small", None], "m/s"),
    ("halvings", [-1, 1.5, "many", None], "whole"),
):

    def control(value, name=name):
        ddg.AdaptiveStepper(ddg.Integrator(model()), **({"error": 1e-3} | {name: value}))

    each("AdaptiveStepper", name, values, control, name, word)
each("AdaptiveStepper", "dt", [0.0, -1.0, NAN, None], lambda v: _controlled().advance(model().state(), v), "dt")
refuse("AdaptiveStepper", {"midpoint": (lambda: _controlled(scheme="implicit_midpoint"), "implicit_euler", "implicit_midpoint")})
each("Integrator", "check_every", [0, -1, 1.5, "often"], lambda v: ddg.Integrator(model(), check_every=v), "check_every", "whole")
each("Integrator", "psd", ["exact", None], lambda v: ddg.Integrator(model(), psd=v), "psd", "gauss_newton", "progressive")
for name in ("rtol", "floor_factor", "rotation_cap", "linear_rtol"):

    def positive(v, name=name):
        return ddg.Integrator(model(), **{name: v})

    each("Integrator", name, [0.0, -1.0, NAN, INF, "small", True], positive, name, "positive")
for name in ("max_iterations", "max_halvings"):

    def whole(v, name=name):
        return ddg.Integrator(model(), **{name: v})

    each("Integrator", name, [0, 2.5, "many", False], whole, name, "at least 1")


def _massless(joined: bool = False, drag: bool = False):
    scene = rods(section=ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0))
    scene.clamp(1)
    if drag:
        scene.drag(1, tangential=0.0, normal=1.0)
    if joined:
        scene.join([(0, 0), (1, 0)])
    return built(scene)


def _step(state=None, dt=0.01, kind="rods"):
    return integrator(kind).step(model(kind).state() if state is None else state, dt)


each("step", "dt", [0.0, -0.01, NAN, INF, "0.01", None, (0.01, 0.02), True], lambda v: _step(dt=v), "dt is", "positive and finite")
each("step", "dt of a net", [0.0, "0.01"], lambda v: _step(dt=v, kind="net"), "dt is", "positive and finite")
each("step", "state", [3, "rest", [1.0]], _step, "step", "model.state()")
refuse("step", {
    "none": (lambda: integrator().step(None, 0.01), "step: the state is None", "model.state()"),
    "points": (lambda: _step(model().state().points()), "step", "model.state()"),
    "state of another model": (lambda: _step(model("net").state()), "another model", "model.state()"),
    "motion that ends": (lambda: _moving(lambda t: (0.0, 0.0, 0.0 if t < 0.005 else NAN)), "translation", "not finite", "t = 0.01"),
    "motion that fails": (lambda: _moving(lambda t: (0.0, 0.0, 0.0 / (0.01 - t))), "translation", "ZeroDivision", "t = 0.01"),
    "motion of two later": (lambda: _moving(lambda t: (0.0,) * (3 if t < 0.005 else 2)), "translation", "(0.0, 0.0)", "t = 0.01"),
    "each of others later": (lambda: _moving(lambda t: np.zeros((1 if t < 0.005 else 2, 3))), "translation", "(2, 3)", "t = 0.01"),
    "angle that ends": (lambda: _moving(None, lambda t: 0.0 if t < 0.005 else INF), "angle", "not finite", "t = 0.01"),
    "amplitude that ends": (lambda: _loaded(lambda t: 1.0 if t < 0.005 else NAN), "amplitude", "not finite", "t = 0.01"),
    "net, motion that ends": (
        lambda: _moving(lambda t: (0.0, 0.0, 0.0 if t < 0.005 else NAN), coupled=True),
        "translation",
        "t = 0.01",
    ),
    "net, amplitude that ends": (lambda: _loaded(lambda t: 1.0 if t < 0.005 else NAN, coupled=True), "amplitude", "t = 0.01"),
    "flow that ends": (lambda: _in_flow(lambda t: (0.0, 0.0, 0.0 if t < 0.005 else NAN)), "flow", "not finite", "t = 0.01"),
    "net, flow of two later": (lambda: _in_flow(lambda t: (0.0,) * (3 if t < 0.005 else 2), True), "flow", "(0.0, 0.0)", "t = 0.01"),
    "out of the plane": (lambda: _step_planar(lambda t: (0.0, t, 0.0)), "translation", "y component", "t = 0.01"),
    "motion that jumps": (lambda: _moving(_jump), "jumps at t = 0.005", "continuous"),
    "net, motion that jumps": (lambda: _moving(_jump, coupled=True), "jumps at t = 0.005", "continuous"),
})


def _jump(t):
    return (0.0, 0.0, 0.0 if t < 0.005 else 1e20)


def _step_scene(scene):
    made = built(scene)
    return ddg.Integrator(made).step(made.state(), 0.01)


def _in_flow(flow, coupled=False):
    scene = rods(scene=ddg.Scene(flow=flow))
    scene.drag(tangential=1.0, normal=1.0)
    if coupled:
        scene.join([(0, 0), (1, 0)])
    return _step_scene(scene)


def _moving(translation=None, angle=None, coupled=False):
    functions = {"translation": translation, "angle": angle}
    scene = rods()
    scene.clamp(0)
    scene.fix(1, [0], motion=ddg.Motion(**{name: f for name, f in functions.items() if f}))
    if coupled:
        scene.join([(1, 4), (scene.add_rod(line() + [1.0, 0.0, 0.0], section=STIFFNESS), 0)], rigid=False)
    return _step_scene(scene)


def _loaded(amplitude, coupled=False):
    scene = clamped()
    scene.add_force(1, -1, (0.0, 0.0, 1.0), amplitude)
    if coupled:
        scene.join([(0, 0), (1, 0)])
    return _step_scene(scene)


def _step_planar(translation):
    scene = rods(scene=ddg.Scene(dimension=2))
    scene.clamp([0, 1], motion=ddg.Motion(translation))
    return _step_scene(scene)


# --- states; `rods` have 12 points and 10 edges ---
POINTS = np.zeros((12, 3))
BAD = np.where(np.arange(36).reshape(12, 3) == 25, NAN, 0.0)
for field in ("points", "velocities"):

    def make(v, field=field):
        return model().state(**{field: v})

    each("state", field, [POINTS[1:], np.zeros((2, 12, 3)), 0.0], make, field, "(12, 3)")
    each("state", field, [BAD], make, field, "node 8", "not finite")
    each("state", field, ["rest", [[0.0], [0.0, 1.0]]], make, field, "numbers")
each("state", "spins", [np.zeros(7), 0.0], lambda v: model().state(spins=v), "spins", "(10,)")
each("state", "spins", [np.full(10, NAN)], lambda v: model().state(spins=v), "spins", "edge 0", "not finite")
each("state", "spins", ["fast"], lambda v: model().state(spins=v), "spins", "numbers")
each("state", "snapshot", [None, 3, "file"], lambda v: model().restore(v), "restore", "state.snapshot()")
refuse("state", {
    "empty snapshot": (lambda: model().restore({}), "another model"),
    "snapshot of a net": (lambda: model().restore(model("net").state().snapshot()), "another model"),
    "snapshot of worlds": (lambda: model().restore(model("rods", 2).state().snapshot()), "another model"),
    "net, points": (lambda: model("net").state(points=POINTS[1:]), "points", "(12, 3)"),
})

# --- inquiries ---
for question in ("energies", "reactions", "stresses"):

    def ask(v, question=question):
        return getattr(model(), question)(v)

    each("inquiries", question, [None, 3, "rest"], ask, question, "model.state()")
    refuse("inquiries", {f"{question} of another": (lambda a=ask: a(model("net").state()), "another model")})
refuse("inquiries", {
    "twist of no rod": (lambda: quantities.total_twist(model(), model().state(), 7), "rod 7", "twist"),
    "fields of no surface": (lambda: quantities.triangle_fields(model(), model().state()), "no surfaces"),
})

# --- parameters ---
TERMS = {"rods": "rod_stretch", "net": "rod_stretch", "hinge": "shell_hinge", "midedge": "shell_bend"}
REST = {"rods": "rest", "net": "rest", "hinge": "rest", "midedge": "rest_11"}
for kind, term in TERMS.items():
    stiffness = "stiffness"

    def change(v, kind=kind, term=term):
        return model(kind).set_parameter(term, "stiffness", v)

    each("parameters", f"{kind}, stiffness", [-1.0, NAN, INF], change, term, "stiffness", "not negative")
    each("parameters", f"{kind}, stiffness", ["stiff", None], change, term, "stiffness")
    each(
        "parameters",
        f"{kind}, stiffness",
        [np.ones(99), np.ones((3, 4)), np.ones((1, 1, 2))],
        change,
        term,
        "shape",
        "one number",
    )
    refuse("parameters", {
        f"{kind}, term": (lambda k=kind: model(k).set_parameter("hair", "stiffness", 1.0), "'hair'", "this model has", term),
        f"{kind}, no term": (lambda k=kind: model(k).set_parameter(None, "stiffness", 1.0), "None", "this model has"),
        f"{kind}, name": (lambda k=kind, t=term: model(k).set_parameter(t, "colour", 1.0), "'colour'", "it has", "stiffness"),
        f"{kind}, no name": (lambda k=kind, t=term: model(k).set_parameter(t, 3, 1.0), "3", "it has", "stiffness"),
        f"{kind}, measure": (lambda k=kind, t=term: model(k).set_parameter(t, "measure", 0.0), "measure", "positive"),
        f"{kind}, rest": (lambda k=kind, t=term: model(k).set_parameter(t, REST[k], NAN), "rest", "finite"),
    })
refuse("parameters", {
    "poisson": (lambda: model("midedge").set_parameter("shell_bend", "poisson", 1.0), "poisson", "between -1 and 1"),
    "metric": (lambda: model("midedge").set_parameter("shell_bend", "metric_11", -1.0), "metric_11", "positive"),
})

# --- rest shapes; the sheet has 9 vertices, 8 triangles, 16 edges ---
FLAT, FORMS = np.zeros((9, 3)), np.zeros((8, 3))
each("rest shapes", "shell", [1, -1], lambda v: model("hinge").set_rest(v, points=FLAT), "shell", "the model has 1 shells")
each("rest shapes", "shell", [None, 0.5, "sheet"], lambda v: model("hinge").set_rest(v, points=FLAT), "shell", "whole number")
each(
    "rest shapes",
    "points",
    [0, 0.0, "flat", FLAT[1:], FLAT + NAN],
    lambda v: model("hinge").set_rest(0, points=v),
    "points",
    "(9, 3)",
)
each("rest shapes", "metric", [1.0, FORMS[1:], FORMS + INF], lambda v: model("hinge").set_rest(0, metric=v), "metric", "(8, 3)")
each("rest shapes", "angle", [1.0, FORMS], lambda v: model("hinge").set_rest(0, angle=v), "angle", "(16,)")
each("rest shapes", "curvature", [1.0, "bent"], lambda v: model("midedge").set_rest(0, curvature=v), "curvature", "(8, 3)")
refuse("rest shapes", {
    "of no shell": (lambda: model().set_rest(0, points=FLAT), "shell 0", "0 shells"),
    "nothing": (lambda: model("hinge").set_rest(0), "points, metric, curvature or angle"),
    "points in one": (lambda: model("hinge").set_rest(0, points=FLAT), "set_rest: points", "triangle 0", "no area"),
    "points on a line": (lambda: model("hinge").set_rest(0, points=np.outer(np.arange(9.0), np.ones(3))), "triangle 0", "no area"),
    "metric without area": (lambda: model("hinge").set_rest(0, metric=FORMS), "metric of triangle 0", "a11 > 0"),
    "curvature of hinges": (lambda: model("hinge").set_rest(0, curvature=FORMS), "no rest curvature", "angles"),
    "angle of normals": (lambda: model("midedge").set_rest(0, angle=np.zeros(16)), "no rest angles", "curvature"),
    "direction": (
        lambda: rest_shapes.principal_form([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], 1.0, direction=(0, 0, 1)),
        *("triangle 0", "normal to it", "along the surface")),
})
each("rest shapes", "layer", [0.0, -1.0, NAN, "thin"], lambda v: rest_shapes.bilayer_curvature(0.1, v, 1.0), "h1", "positive")
