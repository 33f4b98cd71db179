"""Arguments of public calls as data: for each one a value that changes what is observed, or that is refused.

A `Call` runs with keyword arguments and returns what is observed; its rows are argument -> changed value. `test_effect` runs every
argument that a signature lists, so that a new argument needs a row.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np

import ddg_warp as ddg
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.run.simulate import simulate

DEVICE, DT = "cpu", 1e-2
RUBBER = ddg.Material(1e6, 0.3, 1000.0)
MAGNET = ddg.Stiffness(EA=1e3, EI1=0.1, GJ=0.1, mass_per_length=0.1, rotary_inertia=1e-3, radius=0.01, area=1e-4)
NOTHING = object()  # in place of an argument: it is left out


@dataclass(frozen=True)
class Change:
    """A changed value of an argument, beside which other arguments have other values, before and after.

    Attributes:
        value: of the argument; beside: others, both times; before: of the argument itself before the change.
        refused: whether the call with `value` has to be refused, and not to be observed.
    """

    value: object
    beside: dict = field(default_factory=dict)
    before: object = None
    refused: bool = False


@dataclass(frozen=True)
class Call:
    """A public call: `run(**arguments)` returns what is observed.

    Attributes:
        of: whose signature lists the arguments; kinds: dataclasses whose fields it takes, too.
        base: arguments that it is given; subjects: those that are no options, but what it is about.
        rows: argument -> changed value, or `Change`.
    """

    of: Callable
    run: Callable
    base: dict
    rows: dict
    subjects: tuple[str, ...] = ()
    kinds: tuple[type, ...] = ()

    @property
    def arguments(self) -> list[str]:
        """Names of all arguments, without the subjects."""
        listed = inspect.signature(self.of).parameters.values()
        names = [each.name for each in listed if each.kind not in (each.VAR_KEYWORD, each.VAR_POSITIONAL)]
        names += [each.name for kind in self.kinds for each in fields(kind)]
        return [name for name in dict.fromkeys(names) if name not in ("self", *self.subjects)]


CALLS: dict[str, Call] = {}


def observed(call: Call, arguments: dict):
    """What a call shows, to be compared; a refusal shows its message."""
    given = {name: value for name, value in arguments.items() if value is not NOTHING}
    try:
        return "seen", _comparable(call.run(**given))
    except (ValueError, SolverError) as error:
        return "refused", str(error)


def _comparable(value):
    if isinstance(value, np.ndarray):
        return value.shape, value.tolist()
    if isinstance(value, dict):
        return {str(name): _comparable(part) for name, part in value.items()}
    return [_comparable(part) for part in value] if isinstance(value, list | tuple) else value


# --- what is looked at ---
def at_state(state) -> list:
    """What a state shows."""
    model = state.model
    names = [] if model.surfaces is None else model.surfaces.names.tolist()
    reactions = [(reaction.force, reaction.moment) for reaction in model.reactions(state)]
    return [
        state.points(),
        state.velocities(),
        state.angles(),
        model.energies(state),
        reactions,
        names,
        model.curves.names.tolist(),
    ]


def stepped(scene: ddg.Scene, steps: int = 1, **options) -> list:
    """What a scene shows after some steps."""
    model = scene.build(DEVICE, "float64")
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(steps):
        state = integrator.step(state, DT)
    return [*at_state(state), state.obstacle_points()]


def scene_call(
    name: str, base: dict, rows: dict, before: Callable, after: Callable | None = None, steps: int = 1
) -> None:
    """Add a method of `Scene`, called between `before(scene)` and `after(scene)`."""

    def run(**given):
        scene = ddg.Scene()
        before(scene)
        getattr(scene, name)(**given)
        if after is not None:
            after(scene)
        return stepped(scene, steps)

    CALLS[name] = Call(getattr(ddg.Scene, name), run, base, rows)


# --- rods ---
def line(nodes: int = 6, at: float = 0.0) -> np.ndarray:
    """A straight rod along x, at a place along y."""
    points = np.zeros((nodes, 3))
    points[:, 0], points[:, 1] = np.linspace(0.0, 0.5, nodes), at
    return points


ARC = np.stack(
    [np.sin(np.linspace(0.0, 1.0, 6)), 0.2 * np.linspace(0.0, 1.0, 6), 1.0 - np.cos(np.linspace(0.0, 1.0, 6))], -1
)
RING = np.stack([np.cos(np.arange(6)), np.sin(np.arange(6)), np.zeros(6)], -1)
ROD = {
    "points": ARC + [0.0, 0.0, 0.1],
    "section": ddg.Rectangle(0.03, 0.02),
    "material": ddg.Material(2e6, 0.3),
    "closed": Change(True, {"points": RING}),
    "natural": "straight",
    "director": (0.0, 1.0, 0.3),
    "twist": Change(False, {"points": line(), "section": ddg.Circle(0.02)}),
    "bend": False,
    "name": "odd",
    "laws": {"rod_stretch": ddg.Law(quadratic, stiffness=10.0)},
    "curvature": Change("angle", {"natural": "straight"}),
}
BASE = {"points": ARC, "section": ddg.Circle(0.02), "material": RUBBER}
scene_call("add_rod", BASE, ROD | {"director": Change((0.0, 1.0, 0.3), {"section": ddg.Rectangle(0.03, 0.02)})},
           lambda s: None, lambda s: s.clamp(0))  # fmt: skip


def _wrapped(change):
    """A row of `add_rod` as one of `add_rods`."""
    if isinstance(change, Change) and "points" in change.beside:
        return Change(change.value, change.beside | {"points": [change.beside["points"]]})
    return change


scene_call("add_rods", BASE | {"points": [ARC]}, {name: _wrapped(change) for name, change in CALLS["add_rod"].rows.items()} | {
    "points": [ARC, ARC + [0.0, 1.0, 0.0]]}, lambda s: None, lambda s: s.clamp(0))  # fmt: skip


def two(scene: ddg.Scene) -> None:
    """Two curved rods with sections that are not round."""
    scene.add_rods([ARC, ARC + [0.0, 0.5, 0.0]], section=ddg.Rectangle(0.03, 0.02), material=RUBBER)


def held(scene: ddg.Scene) -> None:
    """The same, clamped."""
    two(scene)
    scene.clamp([0, 1])


LIFT = ddg.Motion(lambda t: (0.0, 0.0, t), lambda t: t)
scene_call("clamp", {"rods": 0}, {"rods": [0, 1], "edges": [1], "motion": LIFT}, two)
scene_call("clamp_end", {"rods": 0}, {
    "rods": [0, 1], "end": "last", "motion": LIFT, "components": "yz", "tangent": (1.0, 0.1, 0.0), "director": (0.0, 1.0, 0.5)},
    two)  # fmt: skip
scene_call("fix", {"rods": 0, "nodes": [0]}, {"rods": [0, 1], "nodes": [1], "components": "xy", "motion": LIFT}, two)
scene_call(
    "fix_twist",
    {"rods": 0, "edges": [2]},
    {"rods": [0, 1], "edges": [3], "motion": ddg.Motion(angle=lambda t: 9.0 * t)},
    held,
)


def _half(t: float) -> float:
    return 0.5


LOADS = {"rods": [0, 1], "amplitude": _half}
scene_call("add_force", {"rods": 0, "node": -1, "force": (0, 0, 1)}, LOADS | {"node": 3, "force": (0, 1, 0)}, held)
scene_call("add_twisting_moment", {"rods": 0, "edge": -1, "moment": 0.1}, LOADS | {"edge": 2, "moment": 0.2}, held)
scene_call(
    "add_couple", {"rods": 0, "edge": -1, "couple": (0, 0.1, 0)}, LOADS | {"edge": 2, "couple": (0, 0, 0.1)}, held
)
scene_call("add_mass", {"rods": 0, "node": -1, "mass": 0.1}, {"rods": [0, 1], "node": 3, "mass": 0.2}, held)
scene_call("drag", {"rods": 0, "tangential": 1.0, "normal": 2.0}, {
    "rods": [0, 1], "law": Change(ddg.Viscous(1.0), {"tangential": NOTHING, "normal": NOTHING}, ddg.Viscous(2.0)),
    "tangential": 2.0, "normal": 1.0, "rotational": 1.0, "nodes": 1.0}, held,
    lambda s: s.add_twisting_moment(0, -1, 0.1))  # fmt: skip
scene_call("join", {"members": [(0, -1), (1, 0)]}, {"members": [(0, 0), (1, 0)], "rigid": False},
           lambda s: (s.add_rods([ARC, ARC[[-1]] + ARC], section=ddg.Circle(0.02), material=RUBBER),
                      s.add_rod(ARC * [1, -1, 1], section=ddg.Circle(0.02), material=RUBBER)), lambda s: s.clamp(0))  # fmt: skip
CALLS["join"].rows["members"] = [(0, 0), (2, 0)]


# --- sections, materials, laws, drag ---
def of_section(section, material=RUBBER, **scene) -> list:
    """What a rod of a section shows after some steps under a twisting moment and in a fluid."""
    made = ddg.Scene(**scene)
    made.add_rod(ARC, section=section, material=None if isinstance(section, ddg.Stiffness) else material)
    made.clamp(0)
    made.add_twisting_moment(0, -1, 0.05)
    return stepped(made)


def section_call(kind: type, base: dict, rows: dict) -> None:
    """Add a section."""
    CALLS[kind.__name__] = Call(kind, lambda **given: of_section(kind(**given)), base, rows)


section_call(ddg.Circle, {"radius": 0.02}, {"radius": 0.03})
section_call(ddg.Ellipse, {"a": 0.02, "b": 0.03}, {"a": 0.025, "b": 0.025})
section_call(ddg.Rectangle, {"width": 0.02, "height": 0.03}, {"width": 0.025, "height": 0.025})
section_call(ddg.Ribbon, {"width": 0.1, "thickness": 0.01}, {"width": 0.12, "thickness": 0.012, "law": "sano_wada"})
CALLS["Material"] = Call(ddg.Material, lambda **given: of_section(ddg.Circle(0.02), ddg.Material(**given)), {"young": 1e6}, {
    "young": 2e6, "poisson": 0.3, "density": 500.0, "viscosity": 0.1})  # fmt: skip
WIRE = {"EA": 1e3, "EI1": 0.1, "GJ": 0.1, "mass_per_length": 0.1, "rotary_inertia": 1e-3, "radius": 0.01, "area": 1e-4}


def of_stiffness(**given) -> list:
    """What a magnetised rod of a stiffness shows in a viscous fluid."""
    scene = ddg.Scene()
    scene.add_rod(ARC, section=ddg.Stiffness(**given))
    scene.clamp(0)
    scene.magnetize(0, 1e5)
    scene.magnetic_field((0.0, 0.0, 1e-2))
    scene.drag(0, ddg.Viscous(1.0))
    scene.add_twisting_moment(0, -1, 0.05)
    return stepped(scene)


CALLS["Stiffness"] = Call(ddg.Stiffness, of_stiffness, WIRE, {name: 2.0 * value for name, value in WIRE.items()} | {
    "EI2": 0.2, "viscosity": 0.1})  # fmt: skip


def in_fluid(law) -> list:
    """What a falling rod shows with a law of drag."""
    scene = ddg.Scene()
    scene.add_rod(ARC, section=ddg.Circle(0.02), material=RUBBER)
    scene.drag(0, law)
    return stepped(scene)


CALLS["Viscous"] = Call(ddg.Viscous, lambda **given: in_fluid(ddg.Viscous(**given)), {"viscosity": 1.0}, {
    "viscosity": 2.0, "theory": Change("gray_hancock", {"scale": 2.0}), "scale": 2.0, "radius": 0.01})  # fmt: skip
GRANULAR = {"lateral": 10.0, "friction": 5.0}
CALLS["Granular"] = Call(ddg.Granular, lambda **given: in_fluid(ddg.Granular(**given)), GRANULAR, {
    "lateral": 20.0, "friction": 6.0, "leading": 1.0, "angle": 0.5, "speed": 1e-1})  # fmt: skip


def with_law(density, stiffness=10.0) -> list:
    """What a rod shows with a law of stretching."""
    scene = ddg.Scene()
    scene.add_rod(
        ARC, section=ddg.Circle(0.02), material=RUBBER, laws={"rod_stretch": ddg.Law(density, stiffness=stiffness)}
    )
    scene.clamp(0)
    return stepped(scene)


CALLS["Law"] = Call(ddg.Law, with_law, {"density": quadratic}, {"density": Change(3.0, refused=True)})


# --- motions ---
def moved(motion, controls=None) -> list:
    """What a rod shows whose clamp moves."""
    scene = ddg.Scene()
    two(scene)
    scene.clamp(0, motion=motion)
    model = scene.build(DEVICE, "float64")
    state, integrator = model.state(), ddg.Integrator(model)
    for _ in range(2):
        state = integrator.step(state, DT, controls)
    return at_state(state)


TURN = {"angle": lambda t: 9.0 * t}
CALLS["Motion"] = Call(ddg.Motion, lambda **given: moved(ddg.Motion(**given)), TURN, {
    "translation": lambda t: (t, 0, 0), "angle": lambda t: t, "axis": (1, 0, 0), "pivot": (0, 1, 0)})  # fmt: skip
POSE = ddg.Controls(poses=[[0.1, 0.0, 0.0, 0.0, 0.1, 0.0]])
CALLS["Grip"] = Call(ddg.Grip, lambda **given: moved(ddg.Grip(**given), POSE), {}, {"pivot": (0, 0, 1)})


# --- shells ---
SHEET = dict(zip(("points", "triangles"), meshes.rectangle(2, 2), strict=True))
DOME = np.column_stack([np.sin(np.linspace(0.0, 1.0, 5)), np.cos(np.linspace(0.0, 1.0, 5))])
TUBE = np.column_stack([np.linspace(1.0, 1.5, 5), np.linspace(0.0, 1.0, 5)])


def sheet(scene: ddg.Scene) -> None:
    """A sheet of 9 vertices; (i, j) is i + 3 j."""
    scene.add_shell(**SHEET, thickness=0.05, material=RUBBER)


def clamped(scene: ddg.Scene) -> None:
    """The same, clamped along x."""
    sheet(scene)
    scene.clamp_boundary(0, [0, 1, 2])


def tilted(scene: ddg.Scene) -> None:
    """Two sheets, one over the other."""
    sheet(scene)
    scene.add_shell(SHEET["points"] + [0, 0, 0.3], SHEET["triangles"], thickness=0.05, material=RUBBER)


scene_call("add_shell", SHEET | {"thickness": 0.05, "material": RUBBER}, {
    "points": SHEET["points"] * 1.1, "triangles": SHEET["triangles"][::-1], "thickness": 0.06, "material": ddg.Material(2e6, 0.3),
    "bending": "hinge", "membrane": Change("curved", refused=True), "name": "odd",
    "rest": Change("flat", {"points": SHEET["points"] + [0, 0, 1] * (SHEET["points"][:, :1] - 0.3) ** 2}, "shape")},
    lambda s: None, lambda s: s.clamp_boundary(0, [0, 1, 2]))  # fmt: skip
scene_call(
    "hold",
    {"shell": 0, "vertices": [0, 1, 2]},
    {"shell": 1, "vertices": [0, 2], "components": "z", "motion": LIFT},
    tilted,
)
scene_call("clamp_boundary", {"shell": 0, "vertices": [0, 1, 2]}, {
    "shell": 1, "vertices": [0, 1], "components": "z", "motion": LIFT}, tilted)  # fmt: skip
scene_call("symmetry", {"shell": 0, "vertices": [0, 1, 2], "axis": "y"}, {
    "shell": 1, "vertices": [0, 1], "axis": Change("y", {"vertices": [0, 3, 6]}, "x", refused=True),
    "motion": ddg.Motion(lambda t: (0, t, 0))}, tilted)  # fmt: skip
VERTEX_LOADS = {"shell": 1, "amplitude": _half}


def clamped_twice(scene: ddg.Scene) -> None:
    """Two sheets, both clamped along x."""
    tilted(scene)
    for shell in (0, 1):
        scene.clamp_boundary(shell, [0, 1, 2])


scene_call("add_vertex_force", {"shell": 0, "vertices": [7], "force": (0, 0, 1)}, VERTEX_LOADS | {
    "vertices": [8], "force": (0, 1, 0)}, clamped_twice)  # fmt: skip
scene_call("add_edge_force", {"shell": 0, "path": [6, 7], "force": (0, 0, 1)}, VERTEX_LOADS | {
    "path": [7, 8], "force": (0, 1, 0)}, clamped_twice)  # fmt: skip
scene_call("add_edge_couple", {"shell": 0, "path": [6, 7], "couple": 1.0}, VERTEX_LOADS | {
    "path": [7, 8], "couple": 2.0}, clamped_twice)  # fmt: skip
scene_call("add_pressure", {"shell": 0, "pressure": 10.0}, VERTEX_LOADS | {
    "pressure": 20.0, "triangles": [0, 1], "dead": Change(True, {"pressure": 1e3})}, clamped_twice, steps=2)  # fmt: skip


def stiffened(scene: ddg.Scene) -> None:
    """Two sheets, and two rods along their edges, one on the first, one on the second sheet's place."""
    clamped_twice(scene)
    for height in (0.0, 0.3, 0.0):
        points = SHEET["points"][[6, 7, 8]] + [0, 0, height]
        scene.add_rod(points, section=ddg.Circle(0.02), material=RUBBER)


scene_call("attach", {"rod": 0, "nodes": [0, 1, 2], "shell": 0, "vertices": [6, 7, 8]}, {
    "rod": 2, "nodes": Change([0, 1], {"vertices": [6, 7]}, [1, 2]), "shell": Change(1, {"rod": 1}, 0),
    "vertices": Change([8, 7, 6], {"nodes": [2, 1, 0]}, [6, 7]), "spin": "free"}, stiffened)  # fmt: skip


# --- shells of revolution ---
def tube(scene: ddg.Scene) -> None:
    """Two shells of revolution with rims."""
    for shift in (0.0, 3.0):
        scene.add_axisymmetric_shell(TUBE + [0, shift], thickness=0.05, material=RUBBER)


def held_tube(scene: ddg.Scene) -> None:
    """The same, clamped at their last rims."""
    tube(scene)
    for shell in (0, 1):
        scene.clamp_ring(shell, "last")


def domes(scene: ddg.Scene) -> None:
    """Two with poles at both ends, held at their middles."""
    for shift in (0.0, 3.0):
        ball = np.column_stack([np.sin(np.linspace(0, np.pi, 7)), shift - np.cos(np.linspace(0, np.pi, 7))])
        ball[[0, -1], 0] = 0.0
        shell = scene.add_axisymmetric_shell(ball, thickness=0.05, material=RUBBER)
        scene.hold_ring(shell, [3])


scene_call("add_axisymmetric_shell", {"points": DOME, "thickness": 0.05, "material": RUBBER}, {
    "points": DOME * 1.1, "thickness": 0.06, "material": ddg.Material(2e6, 0.3), "rest": "flat", "name": "odd"},
    lambda s: None, lambda s: s.hold_ring(0, [4]))  # fmt: skip
SIDE = ddg.Motion(lambda t: (t, 0, 0))
scene_call("hold_ring", {"shell": 0, "nodes": [0]}, {"shell": 1, "nodes": [1], "components": "z", "motion": SIDE}, tube)
scene_call("clamp_ring", {"shell": 0, "end": "first"}, {
    "shell": 1, "end": "last", "components": "z", "tangent": (0.1, 1.0), "motion": SIDE}, tube)  # fmt: skip
scene_call("symmetry_ring", {"shell": 0, "end": "first"}, {"shell": 1, "end": "last"}, tube)
scene_call(
    "add_ring_force",
    {"shell": 0, "nodes": [0], "force": (1, 0)},
    VERTEX_LOADS | {"nodes": [1], "force": (0, 1)},
    held_tube,
)
scene_call("add_pole_force", {"shell": 0, "force": 1.0}, VERTEX_LOADS | {"force": 2.0, "end": "last"}, domes)
scene_call("add_axisymmetric_pressure", {"shell": 0, "pressure": 10.0}, VERTEX_LOADS | {
    "pressure": 20.0, "edges": [0], "dead": Change(True, {"pressure": 1e4})}, held_tube, steps=2)  # fmt: skip


# --- magnets ---
def wires(scene: ddg.Scene) -> None:
    """Two rods that can be magnetised, clamped."""
    scene.add_rods([line(4), line(4, 0.1)], section=MAGNET)
    scene.clamp([0, 1])


scene_call("magnetize", {"rods": 0, "magnetisation": 1e5}, {"rods": 1, "magnetisation": 2e5, "edges": [1]}, wires,
           lambda s: s.magnetic_field((0, 0, 0.01)))  # fmt: skip
scene_call("magnetic_field", {"value": (0, 0, 0.01)}, {
    "value": (0, 0, 0.02), "gradient": np.diag([1e-2, 1e-2, -2e-2]),
    "origin": Change((1, 0, 0), {"gradient": np.diag([1e-2, 1e-2, -2e-2])})}, wires, lambda s: s.magnetize([0, 1], 1e5))  # fmt: skip
scene_call("add_dipoles", {}, {"rods": [0], "cutoff": 0.12}, lambda s: (wires(s), s.magnetize([0, 1], 1e6)))


# --- contact ---
def apart(scene: ddg.Scene) -> None:
    """A rod above another, 'low', across it, which falls onto it, and a third that touches neither."""
    low, high = line(5), line(5)[:, [1, 0, 2]] + [0.25, -0.25, 0.021]
    scene.add_rod(low, section=ddg.Circle(0.01), material=RUBBER, name="low")
    scene.add_rod(high, section=ddg.Circle(0.01), material=RUBBER, name="high")
    scene.clamp([0])


def touching(scene: ddg.Scene, **options) -> None:
    """The same in contact."""
    apart(scene)
    scene.contact(**({"range": 5e-3, "friction": 0.5} | options))


def slide(scene: ddg.Scene) -> None:
    """What pushes the upper rod sideways."""
    for node in (0, -1):
        scene.add_force(1, node, (0.2, 0.1, -0.2))


RUB = {"range": 5e-3, "friction": 0.5}
scene_call("contact", RUB, {
    "law": "penalty", "range": 6e-3, "stiffness": 10.0, "friction": 0.1, "friction_law": "polynomial", "velocity": 1e-2, "lags": 2,
    "rolling": True, "radius": {"low": 0.0095}, "objects": "low"}, apart, slide, steps=2)  # fmt: skip


def coiled(**given) -> list:
    """What a rod shows whose ends touch each other, if they are far enough apart along it to be a pair."""
    scene = ddg.Scene()
    turns = np.linspace(0.0, 2.0 * np.pi, 13)
    points = 0.2 * np.column_stack([np.sin(turns), np.cos(turns), 0.02 * turns])
    scene.add_rod(points, section=ddg.Circle(0.01), material=RUBBER, name="coil")
    scene.contact(range=1e-2, **given)
    return stepped(scene, 1)


CALLS["contact of a coil"] = Call(ddg.Scene.contact, coiled, {}, {"apart": 5.0})

scene_call("contact_between", {"one": "low", "other": "high", "friction": 0.3}, {
    "one": "high", "other": "low", "ignore": Change(True, {"friction": NOTHING, "stiffness": 10.0}, False, refused=True),
    "friction": 0.1, "stiffness": 10.0, "range": 6e-3}, touching, slide, steps=2)  # fmt: skip
CALLS["contact_between"].rows["ignore"] = Change(True, {"friction": NOTHING}, refused=False)
FLOOR = ddg.Plane((0.0, 0.0, -0.0105))


def on_floor(shape, motion=None, name: str = "floor") -> list:
    """What a rod shows that falls onto an obstacle that `contact_between` names 'floor'."""
    scene = ddg.Scene()
    scene.add_rod(line(5), section=ddg.Circle(0.01), material=RUBBER, name="low")
    scene.contact(range=5e-3)
    scene.contact_between("low", "floor", stiffness=50.0)
    scene.add_obstacle(shape, motion=motion, name=name)
    return stepped(scene)


CALLS["add_obstacle"] = Call(ddg.Scene.add_obstacle, on_floor, {"shape": FLOOR}, {
    "shape": ddg.Sphere((0.25, 0.0, -0.1), 0.085), "motion": ddg.Motion(lambda t: (0, 0, -t)),
    "name": Change("odd", refused=True)})  # fmt: skip
CALLS["Plane"] = Call(ddg.Plane, lambda **given: on_floor(ddg.Plane(**given)), {"point": (0, 0, -0.0105)}, {
    "point": (0, 0, -0.011), "normal": (0.0, 0.01, 1.0)})  # fmt: skip
CALLS["Sphere"] = Call(ddg.Sphere, lambda **given: on_floor(ddg.Sphere(**given)), {"center": (0.25, 0, -0.1), "radius": 0.0895}, {
    "center": (0.2, 0, -0.1), "radius": 0.0885})  # fmt: skip
BAR = {"start": (0.25, -0.2, -0.0205), "end": (0.25, 0.2, -0.0205), "radius": 0.01}
CALLS["Capsule"] = Call(ddg.Capsule, lambda **given: on_floor(ddg.Capsule(**given)), BAR, {
    "start": (0.2, -0.2, -0.0205), "end": (0.2, 0.2, -0.0205), "radius": 0.0095})  # fmt: skip
CUBE = {"center": (0.25, 0, -0.1105), "half": (0.1, 0.1, 0.1)}
CALLS["Box"] = Call(ddg.Box, lambda **given: on_floor(ddg.Box(**given)), CUBE, {
    "center": (0.25, 0, -0.111), "half": (0.2, 0.1, 0.1), "rotation": np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]]),
    "radius": Change(2e-4)})  # fmt: skip
TABLE = {"points": [[-1, -1, -0.0105], [1, -1, -0.0105], [0, 2, -0.0105], [3, 3, -0.0105]], "cells": [[0, 1, 2]]}
CALLS["Mesh"] = Call(ddg.Mesh, lambda **given: on_floor(ddg.Mesh(**given)), TABLE, {
    "points": [[-1, -1, -0.011], [1, -1, -0.011], [0, 2, -0.011], [3, 3, -0.011]], "cells": [[1, 3, 2]], "radius": 2e-4})  # fmt: skip


# --- scenes, analyses ---
CALLED: list = []


def of_scene(late: bool = False, **given) -> list:
    """What a scene shows whose rod drags, with how often a callback was called; `late`: its support starts elsewhere."""
    CALLED.clear()
    scene = ddg.Scene(**given)
    scene.add_rod(line(), section=ddg.Rectangle(0.03, 0.02), material=RUBBER)
    scene.clamp(0, motion=ddg.Motion(lambda t: (0.0, 0.0, 1.0)) if late else None)
    scene.drag(0, tangential=1.0, normal=1.0)
    return [*stepped(scene), len(CALLED), scene.build(DEVICE).precision]


CALLS["Scene"] = Call(ddg.Scene, of_scene, {}, {
    "gravity": (0, 0, -1), "dimension": 2, "analysis": ddg.Dynamics(precision="mixed"), "mass_damping": 1.0, "flow": (1, 0, 0),
    "initial": Change(lambda model: model.state(), {"late": True}), "callbacks": [CALLED.append]})  # fmt: skip


def built(device=DEVICE, precision=None, worlds=1, allow_rounding=False) -> list:
    """What a model shows of a rod so stiff that float32 loses it."""
    scene = ddg.Scene()
    scene.add_rod(line(40), section=ddg.Circle(1e-5), material=ddg.Material(1e11))
    scene.clamp(0)
    model = scene.build(device, precision, worlds, allow_rounding)
    state = ddg.Integrator(model).step(model.state(), 1.0)
    return [state.points(), model.precision, model.worlds]


CALLS["build"] = Call(ddg.Scene.build, built, {}, {
    "device": Change("cuda:99", refused=True), "precision": "mixed", "worlds": 2,
    "allow_rounding": Change(True, {"precision": "float32"})})  # fmt: skip


def simulated(analysis, **options) -> list:
    """What a run shows of a clamped rod under a force, by an analysis."""
    scene = ddg.Scene(analysis=analysis)
    scene.add_rod(line(), section=ddg.Circle(0.02), material=RUBBER)
    scene.clamp(0)
    scene.add_force(0, -1, (0, 0.3, 0.5))
    result = simulate(scene, device=DEVICE, progress=False, options=options)
    path = (
        [] if result.path is None else [result.path.load, [list(point.values.items()) for point in result.path.points]]
    )
    return [*at_state(result.state), result.model.precision, result.state.time, str(result.failure), path]


CALLS["Dynamics"] = Call(ddg.Dynamics, lambda **given: simulated(ddg.Dynamics(**given)), {"dt": 0.01, "duration": 0.02}, {
    "dt": 0.02, "duration": 0.03, "scheme": "implicit_midpoint", "rtol": 1e-1, "precision": "mixed",
    "outliers": Change(0.1, refused=True)})  # fmt: skip
CALLS["Statics"] = Call(ddg.Statics, lambda **given: simulated(ddg.Statics(**given)), {}, {"load_steps": 2})
TIP = {"tip": ddg.Displacement.of(5, "z")}
CALLS["Trace"] = Call(ddg.Trace, lambda **given: simulated(ddg.Trace(**given)), {"stop": ddg.Stop(steps=2)}, {
    "watch": TIP, "stop": ddg.Stop(steps=1), "step": 0.01, "max_step": 0.01, "load_scale": 3.0})  # fmt: skip


def stopped(**given) -> list:
    """What a path shows that ends by some bound."""
    return simulated(ddg.Trace(watch=TIP, stop=ddg.Stop(**given), step=0.1, max_step=0.1))


CALLS["Stop"] = Call(ddg.Stop, stopped, {"steps": 3}, {
    "steps": 2, "load": (-1.0, 0.01), "displacement": ("tip", -1e-3, 1e-3)})  # fmt: skip
CALLS["Displacement"] = Call(ddg.Displacement, lambda terms: simulated(ddg.Trace(watch={"tip": ddg.Displacement(terms)}, stop=ddg.Stop(
    steps=1))), {"terms": ((5, "z", 1.0),)}, {"terms": ((5, "z", -1.0), (4, "y", 1.0))})  # fmt: skip
CALLS["Displacement.of"] = Call(ddg.Displacement.of, lambda **given: simulated(ddg.Trace(watch={"tip": ddg.Displacement.of(
    **given)}, stop=ddg.Stop(steps=1))), {"row": 5, "axis": "z"}, {"row": 4, "axis": "y", "weight": 2.0})  # fmt: skip
