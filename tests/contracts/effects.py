"""Arguments of public calls as data: for each one a value that changes the observation, or that is refused.

A `Call` runs with keyword arguments and returns an observation; its rows are argument -> changed value. `test_effect` runs every
argument of a signature, so that a new argument needs a row.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np

import ddg_warp as ddg
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.geometry import meshes
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.run.simulate import simulate
from tests.contracts import forces

DEVICE, DT = "cpu", 1e-2
RUBBER = ddg.Material(1e6, 0.3, 1000.0)
MAGNET = ddg.Stiffness(EA=1e3, EI1=0.1, GJ=0.1, mass_per_length=0.1, rotary_inertia=1e-3, radius=0.01, area=1e-4)
NOTHING = object()  # value of an omitted argument


@dataclass(frozen=True)
class Change:
    """Changed value of an argument, with values of other arguments before and after the change.

    Attributes:
        `value`: changed value of the argument.
        `beside`: other arguments, equal before and after.
        `before`: value of the argument before the change.
        `refused`: the call with `value` must be refused.
    """

    value: object
    beside: dict = field(default_factory=dict)
    before: object = None
    refused: bool = False


@dataclass(frozen=True)
class Call:
    """Public call: `run(**arguments)` returns an observation.

    Attributes:
        of: callable with the signature.
        kinds: dataclasses with fields accepted as arguments, too.
        base: default arguments.
        subjects: arguments that are no options.
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
    """Return the observation of a call in comparable form; a refusal yields the message."""
    named = {name: value for name, value in arguments.items() if value is not NOTHING}
    try:
        return "seen", _comparable(call.run(**named))
    except (ValueError, SolverError) as error:
        return "refused", str(error)


def _comparable(value):
    if isinstance(value, np.ndarray):
        return value.shape, value.tolist()
    if isinstance(value, dict):
        return {str(name): _comparable(item) for name, item in value.items()}
    return [_comparable(item) for item in value] if isinstance(value, list | tuple) else value


# --- observations ---
def observe_state(state) -> list:
    """Return the observable quantities of a state."""
    model = state.model
    names = [] if model.surfaces is None else model.surfaces.names.tolist()
    reactions = [(reaction.force, reaction.moment) for reaction in model.reactions(state)]
    try:
        named = model.reactions(state)["left"].force
    except SceneError:  # no support has the name
        named = None
    return [
        named,
        state.points(),
        state.velocities(),
        state.angles(),
        model.energies(state),
        reactions,
        names,
        model.curves.names.tolist(),
        [] if model.surfaces is None or model.surfaces.uv is None else model.surfaces.uv,
    ]


def observe_steps(scene: ddg.Scene, steps: int = 1, **options) -> list:
    """Return the observation of a scene after some steps."""
    model = scene.build(DEVICE, "float64")
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(steps):
        state = integrator.step(state, DT)
    return [*observe_state(state), state.obstacle_points()]


def scene_call(
    name: str, base: dict, rows: dict, before: Callable, after: Callable | None = None, steps: int = 1
) -> None:
    """Add a method of `Scene`, called between `before(scene)` and `after(scene)`."""

    def run(**named):
        scene = ddg.Scene()
        before(scene)
        getattr(scene, name)(**named)
        if after is not None:
            after(scene)
        return observe_steps(scene, steps)

    CALLS[name] = Call(getattr(ddg.Scene, name), run, base, rows)


# --- rods ---
def line(nodes: int = 6, y: float = 0.0) -> np.ndarray:
    """Return a straight rod along x, at a given y."""
    points = np.zeros((nodes, 3))
    points[:, 0], points[:, 1] = np.linspace(0.0, 0.5, nodes), y
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
    """Return a row of `add_rod` as a row of `add_rods`."""
    if isinstance(change, Change) and "points" in change.beside:
        return Change(change.value, change.beside | {"points": [change.beside["points"]]})
    return change


scene_call("add_rods", BASE | {"points": [ARC]}, {name: _wrapped(change) for name, change in CALLS["add_rod"].rows.items()} | {
    "points": [ARC, ARC + [0.0, 1.0, 0.0]]}, lambda s: None, lambda s: s.clamp(0))  # fmt: skip


def two_rods(scene: ddg.Scene) -> None:
    """Add two curved rods with rectangular sections."""
    scene.add_rods([ARC, ARC + [0.0, 0.5, 0.0]], section=ddg.Rectangle(0.03, 0.02), material=RUBBER)


def two_clamped_rods(scene: ddg.Scene) -> None:
    """Add two curved rods, clamped."""
    two_rods(scene)
    scene.clamp([0, 1])


LIFT = ddg.Motion(lambda t: (0.0, 0.0, t), lambda t: t)
scene_call("clamp", {"rods": 0}, {"rods": [0, 1], "edges": [1], "motion": LIFT, "name": "left"}, two_rods)
scene_call("clamp_end", {"rods": 0}, {
    "rods": [0, 1], "end": "last", "motion": LIFT, "components": "yz", "name": "left",
    "tangent": (1.0, 0.1, 0.0), "director": (0.0, 1.0, 0.5)},
    two_rods)  # fmt: skip
scene_call(
    "fix",
    {"rods": 0, "nodes": [0]},
    {"rods": [0, 1], "nodes": [1], "components": "xy", "motion": LIFT, "name": "left"},
    two_rods,
)
scene_call(
    "fix_twist",
    {"rods": 0, "edges": [2]},
    {"rods": [0, 1], "edges": [3], "motion": ddg.Motion(angle=lambda t: 9.0 * t), "name": "left"},
    two_clamped_rods,
)


def _half(t: float) -> float:
    return 0.5


LOADS = {"rods": [0, 1], "amplitude": _half}
scene_call(
    "add_force", {"rods": 0, "node": -1, "force": (0, 0, 1)}, LOADS | {"node": 3, "force": (0, 1, 0)}, two_clamped_rods
)
scene_call(
    "add_twisting_moment", {"rods": 0, "edge": -1, "moment": 0.1}, LOADS | {"edge": 2, "moment": 0.2}, two_clamped_rods
)
scene_call(
    "add_couple",
    {"rods": 0, "edge": -1, "couple": (0, 0.1, 0)},
    LOADS | {"edge": 2, "couple": (0, 0, 0.1)},
    two_clamped_rods,
)
scene_call("add_mass", {"rods": 0, "node": -1, "mass": 0.1}, {"rods": [0, 1], "node": 3, "mass": 0.2}, two_clamped_rods)
scene_call("drag", {"rods": 0, "tangential": 1.0, "normal": 2.0}, {
    "rods": [0, 1], "law": Change(ddg.Viscous(1.0), {"tangential": NOTHING, "normal": NOTHING}, ddg.Viscous(2.0)),
    "shells": Change(0, {"rods": NOTHING}, NOTHING), "tangential": 2.0, "normal": 1.0, "rotational": 1.0, "nodes": 1.0},
    lambda s: (two_clamped_rods(s), s.add_shell(*meshes.rectangle(1, 1), thickness=0.01, material=RUBBER)),
    lambda s: s.add_twisting_moment(0, -1, 0.1))  # fmt: skip
scene_call("join", {"members": [(0, -1), (1, 0)]}, {
    "members": [(0, 0), (1, 0)], "rigid": False, "laws": {"rigid_joint": ddg.Law(quadratic, stiffness=0.1)}},
           lambda s: (s.add_rods([ARC, ARC[[-1]] + ARC], section=ddg.Circle(0.02), material=RUBBER),
                      s.add_rod(ARC * [1, -1, 1], section=ddg.Circle(0.02), material=RUBBER)), lambda s: s.clamp(0))  # fmt: skip
CALLS["join"].rows["members"] = [(0, 0), (2, 0)]

scene_call("join_coincident", {}, {
    "rods": [0, 2], "rigid": False, "laws": {"rigid_joint": ddg.Law(quadratic, stiffness=0.1)}},
           lambda s: (s.add_rods([ARC, ARC[[-1]] + ARC], section=ddg.Circle(0.02), material=RUBBER),
                      s.add_rod(ARC[[-1]] + ARC * [1, -1, 1], section=ddg.Circle(0.02), material=RUBBER)),
           lambda s: s.clamp(0))  # fmt: skip


# --- sections, materials, laws, drag ---
def observe_section(section, material=RUBBER, **scene) -> list:
    """Observe a rod of a section under a twisting moment."""
    made = ddg.Scene(**scene)
    made.add_rod(ARC, section=section, material=None if isinstance(section, ddg.Stiffness) else material)
    made.clamp(0)
    made.add_twisting_moment(0, -1, 0.05)
    return observe_steps(made)


def section_call(kind: type, base: dict, rows: dict) -> None:
    """Add a section."""
    CALLS[kind.__name__] = Call(kind, lambda **named: observe_section(kind(**named)), base, rows)


section_call(ddg.Circle, {"radius": 0.02}, {"radius": 0.03})
section_call(ddg.Ellipse, {"a": 0.02, "b": 0.03}, {"a": 0.025, "b": 0.025})
section_call(ddg.Rectangle, {"width": 0.02, "height": 0.03}, {"width": 0.025, "height": 0.025})
section_call(ddg.Ribbon, {"width": 0.1, "thickness": 0.01}, {"width": 0.12, "thickness": 0.012, "law": "sano_wada"})
CALLS["Material"] = Call(ddg.Material, lambda **named: observe_section(ddg.Circle(0.02), ddg.Material(**named)), {"young": 1e6}, {
    "young": 2e6, "poisson": 0.3, "density": 500.0, "viscosity": 0.1})  # fmt: skip
WIRE = {"EA": 1e3, "EI1": 0.1, "GJ": 0.1, "mass_per_length": 0.1, "rotary_inertia": 1e-3, "radius": 0.01, "area": 1e-4}


def observe_stiffness(**named) -> list:
    """Observe a magnetised rod of a stiffness in a viscous fluid."""
    scene = ddg.Scene()
    scene.add_rod(ARC, section=ddg.Stiffness(**named))
    scene.clamp(0)
    scene.magnetize(0, 1e5)
    scene.magnetic_field((0.0, 0.0, 1e-2))
    scene.drag(0, ddg.Viscous(1.0))
    scene.add_twisting_moment(0, -1, 0.05)
    return observe_steps(scene)


CALLS["Stiffness"] = Call(ddg.Stiffness, observe_stiffness, WIRE, {name: 2.0 * value for name, value in WIRE.items()} | {
    "EI2": 0.2, "viscosity": 0.1})  # fmt: skip


def observe_drag(law) -> list:
    """Observe a falling rod with a drag law."""
    scene = ddg.Scene()
    scene.add_rod(ARC, section=ddg.Circle(0.02), material=RUBBER)
    scene.drag(0, law)
    return observe_steps(scene)


CALLS["Viscous"] = Call(ddg.Viscous, lambda **named: observe_drag(ddg.Viscous(**named)), {"viscosity": 1.0}, {
    "viscosity": 2.0, "theory": Change("gray_hancock", {"scale": 2.0}), "scale": 2.0, "radius": 0.01})  # fmt: skip
CALLS["QuadraticDrag"] = Call(
    ddg.QuadraticDrag, lambda **named: observe_flow((5, 1, 0), ddg.QuadraticDrag(**named)), {"density": 1e3}, {
    "density": 1.2, "normal": 1.0, "tangential": 0.1, "radius": 0.01})  # fmt: skip
GRANULAR = {"lateral": 10.0, "friction": 5.0}
CALLS["Granular"] = Call(ddg.Granular, lambda **named: observe_drag(ddg.Granular(**named)), GRANULAR, {
    "lateral": 20.0, "friction": 6.0, "leading": 1.0, "angle": 0.5, "speed": 1e-1})  # fmt: skip


def observe_flow(flow, law=None) -> list:
    """Observe a rod in a flow."""
    scene = ddg.Scene(flow=flow)
    scene.add_rod(ARC, section=ddg.Circle(0.02), material=RUBBER)
    scene.drag(0, law or ddg.QuadraticDrag(1.2))
    return observe_steps(scene)


WIND = {"mean": (5.0, 0.0, 0.0), "intensity": 0.2, "length": 1.0}
CALLS["Turbulence"] = Call(ddg.Turbulence, lambda **named: observe_flow(ddg.Turbulence(**named)), WIND, {
    "mean": (4.0, 0.0, 0.0), "intensity": 0.1, "length": 2.0, "seed": 1, "modes": 32, "spectrum": "kraichnan"})  # fmt: skip
CALLS["Gust"] = Call(ddg.Gust, lambda **named: observe_flow(ddg.Gust(**named)), {"peak": (5.0, 0.0, 0.0)}, {
    "peak": (4.0, 0.0, 0.0), "start": 0.005, "duration": 0.1})  # fmt: skip
FLOWS = {"velocities": np.arange(24.0).reshape(2, 2, 2, 3), "lower": (0.0, 0.0, 0.0), "upper": (1.0, 1.0, 1.0)}
CALLS["FlowGrid"] = Call(ddg.FlowGrid, lambda **named: observe_flow(ddg.FlowGrid(**named)), FLOWS, {
    "velocities": np.ones((2, 2, 2, 3)), "lower": (-1.0, 0.0, 0.0), "upper": (2.0, 1.0, 1.0),
    "times": Change([0.0, 0.01], {"velocities": np.arange(48.0).reshape(2, 2, 2, 2, 3)}, [0.0, 1.0])})  # fmt: skip


def observe_law(density, stiffness=10.0) -> list:
    """Observe a rod with a stretching law."""
    scene = ddg.Scene()
    scene.add_rod(
        ARC, section=ddg.Circle(0.02), material=RUBBER, laws={"rod_stretch": ddg.Law(density, stiffness=stiffness)}
    )
    scene.clamp(0)
    return observe_steps(scene)


CALLS["Law"] = Call(ddg.Law, observe_law, {"density": quadratic}, {"density": Change(3.0, refused=True)})


# --- motions ---
def observe_motion(motion, controls=None) -> list:
    """Observe rods with a moving clamp."""
    scene = ddg.Scene()
    two_rods(scene)
    scene.clamp(0, motion=motion)
    model = scene.build(DEVICE, "float64")
    state, integrator = model.state(), ddg.Integrator(model)
    for _ in range(2):
        state = integrator.step(state, DT, controls)
    return observe_state(state)


TURN = {"angle": lambda t: 9.0 * t}
CALLS["Motion"] = Call(ddg.Motion, lambda **named: observe_motion(ddg.Motion(**named)), TURN, {
    "translation": lambda t: (t, 0, 0), "angle": lambda t: t, "axis": (1, 0, 0), "pivot": (0, 1, 0)})  # fmt: skip
POSE = ddg.Controls(poses=[[0.1, 0.0, 0.0, 0.0, 0.1, 0.0]])
CALLS["Grip"] = Call(ddg.Grip, lambda **named: observe_motion(ddg.Grip(**named), POSE), {}, {"pivot": (0, 0, 1)})


HALF_TURN, FULL_TURN = (0.0, 0.0, 0.0, 1.0), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 6.0])
CALLS["Grip.at"] = Call(ddg.Grip.at, lambda **named: ddg.Grip().at(**named), {"position": (0, 0, 1)}, {
    "position": (0, 1, 0), "quaternion": HALF_TURN,
    "near": Change(FULL_TURN, {"quaternion": (np.cos(0.1), 0.0, 0.0, -np.sin(0.1))})})  # fmt: skip


# --- fields ---
CURL = {"name": "curl", "parameter": "rod_bend_twist.rest_1", "values": 1.0}
scene_call("prescribe", CURL, {
    "name": Change("", refused=True), "parameter": "rod_bend_twist.rest_2", "values": 2.0, "rods": [1],
    "shell": Change(0, refused=True),
    "over": Change("arc_length", {"values": lambda *where: np.size(where[0])})}, two_rods)  # fmt: skip


def observe_samples(**named) -> list:
    """Observe rods with a natural curvature of samples."""
    scene = ddg.Scene()
    two_rods(scene)
    scene.prescribe("curl", "rod_bend_twist.rest_1", ddg.Samples(**named), over="arc_length")
    return observe_steps(scene)


CALLS["Samples"] = Call(ddg.Samples, observe_samples, {"values": [0.0, 1.0], "arc_lengths": [0.0, 0.5]}, {
    "values": [0.0, 2.0], "arc_lengths": [0.1, 0.5],
    "times": Change([0.0, 1.0], {"values": [[0.0, 1.0], [1.0, 2.0]]}, before=[0.5, 1.0])})  # fmt: skip


# --- shells ---
SHEET = dict(zip(("points", "triangles"), meshes.rectangle(2, 2), strict=True))
DOME = np.column_stack([np.sin(np.linspace(0.0, 1.0, 5)), np.cos(np.linspace(0.0, 1.0, 5))])
TUBE = np.column_stack([np.linspace(1.0, 1.5, 5), np.linspace(0.0, 1.0, 5)])


def sheet(scene: ddg.Scene) -> None:
    """Add a sheet of 9 vertices; (i, j) is i + 3 j."""
    scene.add_shell(**SHEET, thickness=0.05, material=RUBBER)


def clamped_sheet(scene: ddg.Scene) -> None:
    """Add a sheet clamped along x."""
    sheet(scene)
    scene.clamp_boundary(0, [0, 1, 2])


def two_sheets(scene: ddg.Scene) -> None:
    """Add two sheets, one above the other."""
    sheet(scene)
    scene.add_shell(SHEET["points"] + [0, 0, 0.3], SHEET["triangles"], thickness=0.05, material=RUBBER)


scene_call("add_shell", SHEET | {"thickness": 0.05, "material": RUBBER}, {
    "points": SHEET["points"] * 1.1, "triangles": SHEET["triangles"][::-1], "thickness": 0.06, "material": ddg.Material(2e6, 0.3),
    "bending": "hinge", "membrane": Change("curved", refused=True), "name": "odd", "uv": SHEET["points"][:, :2],
    "laws": Change({"shell_hinge": ddg.Law(quadratic, stiffness=1e-3)}, {"bending": "hinge"}),
    "rest": Change("flat", {"points": SHEET["points"] + [0, 0, 1] * (SHEET["points"][:, :1] - 0.3) ** 2}, "shape")},
    lambda s: None, lambda s: s.clamp_boundary(0, [0, 1, 2]))  # fmt: skip
scene_call(
    "hold",
    {"shell": 0, "vertices": [0, 1, 2]},
    {"shell": 1, "vertices": [0, 2], "components": "z", "motion": LIFT, "name": "left"},
    two_sheets,
)
scene_call("clamp_boundary", {"shell": 0, "vertices": [0, 1, 2]}, {
    "shell": 1, "vertices": [0, 1], "components": "z", "motion": LIFT, "name": "left"}, two_sheets)  # fmt: skip
scene_call("symmetry", {"shell": 0, "vertices": [0, 1, 2], "axis": "y"}, {
    "shell": 1, "vertices": [0, 1], "axis": Change("y", {"vertices": [0, 3, 6]}, "x", refused=True),
    "motion": ddg.Motion(lambda t: (0, t, 0)), "name": "left"}, two_sheets)  # fmt: skip


def rods_and_sheet(scene: ddg.Scene) -> None:
    """Add two clamped rods and a clamped sheet."""
    two_clamped_rods(scene)
    clamped_sheet(scene)


USER = {"name": "tether", "rods": 0, "parameters": {"stiffness": 5.0, "strength": 1.0}}
USER_ROWS = {
    "name": Change("a tether", refused=True), "parameters": {"stiffness": 6.0, "strength": 2.0}, "rods": [0, 1], "nodes": [3, 5],
    "shells": [0], "vertices": Change([7, 8], {"shells": [0]}),
}  # fmt: skip
scene_call("add_nodal_force", USER | {"function": forces.spring}, USER_ROWS | {
    "function": forces.stiffer_spring, "potential": forces.spring_energy}, rods_and_sheet)  # fmt: skip
scene_call("add_pair_force", USER | {"function": forces.bond}, USER_ROWS | {
    "function": forces.stiffer_bond, "potential": forces.bond_energy}, rods_and_sheet)  # fmt: skip
VERTEX_LOADS = {"shell": 1, "amplitude": _half}


def two_clamped_sheets(scene: ddg.Scene) -> None:
    """Add two sheets, both clamped along x."""
    two_sheets(scene)
    for shell in (0, 1):
        scene.clamp_boundary(shell, [0, 1, 2])


scene_call("add_vertex_force", {"shell": 0, "vertices": [7], "force": (0, 0, 1)}, VERTEX_LOADS | {
    "vertices": [8], "force": (0, 1, 0)}, two_clamped_sheets)  # fmt: skip
scene_call("add_edge_force", {"shell": 0, "path": [6, 7], "force": (0, 0, 1)}, VERTEX_LOADS | {
    "path": [7, 8], "force": (0, 1, 0)}, two_clamped_sheets)  # fmt: skip
scene_call("add_edge_couple", {"shell": 0, "path": [6, 7], "couple": 1.0}, VERTEX_LOADS | {
    "path": [7, 8], "couple": 2.0}, two_clamped_sheets)  # fmt: skip
scene_call("add_pressure", {"shell": 0, "pressure": 10.0}, VERTEX_LOADS | {
    "pressure": 20.0, "triangles": [0, 1], "dead": Change(True, {"pressure": 1e3})}, two_clamped_sheets, steps=2)  # fmt: skip


def stiffened(scene: ddg.Scene) -> None:
    """Add two clamped sheets, and rods along their edges: two on the first, one on the second."""
    two_clamped_sheets(scene)
    for height in (0.0, 0.3, 0.0):
        points = SHEET["points"][[6, 7, 8]] + [0, 0, height]
        scene.add_rod(points, section=ddg.Circle(0.02), material=RUBBER)


scene_call("attach", {"rod": 0, "nodes": [0, 1, 2], "shell": 0, "vertices": [6, 7, 8]}, {
    "rod": 2, "nodes": Change([0, 1], {"vertices": [6, 7]}, [1, 2]), "shell": Change(1, {"rod": 1}, 0),
    "vertices": Change([8, 7, 6], {"nodes": [2, 1, 0]}, [6, 7]), "spin": "free"}, stiffened)  # fmt: skip


# --- shells of revolution ---
def two_tubes(scene: ddg.Scene) -> None:
    """Add two shells of revolution with rims."""
    for shift in (0.0, 3.0):
        scene.add_axisymmetric_shell(TUBE + [0, shift], thickness=0.05, material=RUBBER)


def two_clamped_tubes(scene: ddg.Scene) -> None:
    """Add two shells of revolution, clamped at their last rims."""
    two_tubes(scene)
    for shell in (0, 1):
        scene.clamp_ring(shell, "last")


def two_domes(scene: ddg.Scene) -> None:
    """Add two closed shells of revolution with a pole at each end, fixed at the equator."""
    for shift in (0.0, 3.0):
        ball = np.column_stack([np.sin(np.linspace(0, np.pi, 7)), shift - np.cos(np.linspace(0, np.pi, 7))])
        ball[[0, -1], 0] = 0.0
        shell = scene.add_axisymmetric_shell(ball, thickness=0.05, material=RUBBER)
        scene.hold_ring(shell, [3])


scene_call("add_axisymmetric_shell", {"points": DOME, "thickness": 0.05, "material": RUBBER}, {
    "points": DOME * 1.1, "thickness": 0.06, "material": ddg.Material(2e6, 0.3), "rest": "flat", "name": "odd"},
    lambda s: None, lambda s: s.hold_ring(0, [4]))  # fmt: skip
SIDE = ddg.Motion(lambda t: (t, 0, 0))
scene_call(
    "hold_ring",
    {"shell": 0, "nodes": [0]},
    {"shell": 1, "nodes": [1], "components": "z", "motion": SIDE, "name": "left"},
    two_tubes,
)
scene_call("clamp_ring", {"shell": 0, "end": "first"}, {
    "shell": 1, "end": "last", "components": "z", "tangent": (0.1, 1.0), "motion": SIDE, "name": "left"}, two_tubes)  # fmt: skip
scene_call("symmetry_ring", {"shell": 0, "end": "first"}, {"shell": 1, "end": "last", "name": "left"}, two_tubes)
scene_call(
    "add_ring_force",
    {"shell": 0, "nodes": [0], "force": (1, 0)},
    VERTEX_LOADS | {"nodes": [1], "force": (0, 1)},
    two_clamped_tubes,
)
scene_call("add_pole_force", {"shell": 0, "force": 1.0}, VERTEX_LOADS | {"force": 2.0, "end": "last"}, two_domes)
scene_call("add_axisymmetric_pressure", {"shell": 0, "pressure": 10.0}, VERTEX_LOADS | {
    "pressure": 20.0, "edges": [0], "dead": Change(True, {"pressure": 1e4})}, two_clamped_tubes, steps=2)  # fmt: skip


# --- magnets ---
def magnets(scene: ddg.Scene) -> None:
    """Add two magnetisable rods, clamped."""
    scene.add_rods([line(4), line(4, 0.1)], section=MAGNET)
    scene.clamp([0, 1])


scene_call("magnetize", {"rods": 0, "magnetisation": 1e5}, {"rods": 1, "magnetisation": 2e5, "edges": [1]}, magnets,
           lambda s: s.magnetic_field((0, 0, 0.01)))  # fmt: skip
scene_call("magnetic_field", {"value": (0, 0, 0.01)}, {
    "value": (0, 0, 0.02), "gradient": np.diag([1e-2, 1e-2, -2e-2]),
    "origin": Change((1, 0, 0), {"gradient": np.diag([1e-2, 1e-2, -2e-2])})}, magnets, lambda s: s.magnetize([0, 1], 1e5))  # fmt: skip
scene_call("add_dipoles", {}, {"rods": [0], "cutoff": 0.12}, lambda s: (magnets(s), s.magnetize([0, 1], 1e6)))


# --- contact ---
def crossed_rods(scene: ddg.Scene) -> None:
    """Add a clamped rod 'low' and a rod 'high' that falls onto the clamped one."""
    low, high = line(5), line(5)[:, [1, 0, 2]] + [0.25, -0.25, 0.021]
    scene.add_rod(low, section=ddg.Circle(0.01), material=RUBBER, name="low")
    scene.add_rod(high, section=ddg.Circle(0.01), material=RUBBER, name="high")
    scene.clamp([0])


def crossed_rods_in_contact(scene: ddg.Scene, **options) -> None:
    """Add two crossed rods in contact."""
    crossed_rods(scene)
    scene.contact(**({"range": 5e-3, "friction": 0.5} | options))


def add_lateral_forces(scene: ddg.Scene) -> None:
    """Add lateral forces on the upper rod."""
    for node in (0, -1):
        scene.add_force(1, node, (0.2, 0.1, -0.2))


RUB = {"range": 5e-3, "friction": 0.5}
scene_call("contact", RUB, {
    "law": "penalty", "range": 6e-3, "stiffness": 10.0, "friction": 0.1, "friction_law": "polynomial", "velocity": 1e-2,
    "friction_iterations": 2,
    "rolling": True, "radius": {"low": 0.0095}, "objects": "low"}, crossed_rods, add_lateral_forces, steps=2)  # fmt: skip


def observe_coil(**named) -> list:
    """Observe a coil with both ends in contact, if the arc length between them exceeds the exclusion distance."""
    scene = ddg.Scene()
    angle = np.linspace(0.0, 2.0 * np.pi, 13)
    points = 0.2 * np.column_stack([np.sin(angle), np.cos(angle), 0.02 * angle])
    scene.add_rod(points, section=ddg.Circle(0.01), material=RUBBER, name="coil")
    scene.contact(range=1e-2, **named)
    return observe_steps(scene, 1)


CALLS["contact of a coil"] = Call(ddg.Scene.contact, observe_coil, {}, {"exclusion_length": 5.0})

scene_call("contact_between", {"one": "low", "other": "high", "friction": 0.3}, {
    "one": "high", "other": "low", "ignore": Change(True, {"friction": NOTHING, "stiffness": 10.0}, False, refused=True),
    "friction": 0.1, "stiffness": 10.0, "range": 6e-3, "root_length": 0.4},
    crossed_rods_in_contact, add_lateral_forces, steps=2)  # fmt: skip
CALLS["contact_between"].rows["ignore"] = Change(True, {"friction": NOTHING}, refused=False)
FLOOR = ddg.Plane((0.0, 0.0, -0.0105))


def observe_floor(shape, motion=None, name: str = "floor") -> list:
    """Observe a rod that falls onto an obstacle; `contact_between` names it 'floor'."""
    scene = ddg.Scene()
    scene.add_rod(line(5), section=ddg.Circle(0.01), material=RUBBER, name="low")
    scene.contact(range=5e-3)
    scene.contact_between("low", "floor", stiffness=50.0)
    scene.add_obstacle(shape, motion=motion, name=name)
    return observe_steps(scene)


CALLS["add_obstacle"] = Call(ddg.Scene.add_obstacle, observe_floor, {"shape": FLOOR}, {
    "shape": ddg.Sphere((0.25, 0.0, -0.1), 0.085), "motion": ddg.Motion(lambda t: (0, 0, -t)),
    "name": Change("odd", refused=True)})  # fmt: skip
CALLS["Plane"] = Call(ddg.Plane, lambda **named: observe_floor(ddg.Plane(**named)), {"point": (0, 0, -0.0105)}, {
    "point": (0, 0, -0.011), "normal": (0.0, 0.01, 1.0)})  # fmt: skip
CALLS["Sphere"] = Call(ddg.Sphere, lambda **named: observe_floor(ddg.Sphere(**named)), {"center": (0.25, 0, -0.1), "radius": 0.0895}, {
    "center": (0.2, 0, -0.1), "radius": 0.0885})  # fmt: skip
BAR = {"start": (0.25, -0.2, -0.0205), "end": (0.25, 0.2, -0.0205), "radius": 0.01}
CALLS["Capsule"] = Call(ddg.Capsule, lambda **named: observe_floor(ddg.Capsule(**named)), BAR, {
    "start": (0.2, -0.2, -0.0205), "end": (0.2, 0.2, -0.0205), "radius": 0.0095})  # fmt: skip
CUBE = {"center": (0.25, 0, -0.1105), "half": (0.1, 0.1, 0.1)}
CALLS["Box"] = Call(ddg.Box, lambda **named: observe_floor(ddg.Box(**named)), CUBE, {
    "center": (0.25, 0, -0.111), "half": (0.2, 0.1, 0.1), "rotation": np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]]),
    "radius": Change(2e-4)})  # fmt: skip
TABLE = {"points": [[-1, -1, -0.0105], [1, -1, -0.0105], [0, 2, -0.0105], [3, 3, -0.0105]], "cells": [[0, 1, 2]]}
CALLS["Mesh"] = Call(ddg.Mesh, lambda **named: observe_floor(ddg.Mesh(**named)), TABLE, {
    "points": [[-1, -1, -0.011], [1, -1, -0.011], [0, 2, -0.011], [3, 3, -0.011]], "cells": [[1, 3, 2]], "radius": 2e-4})  # fmt: skip


# --- scenes, analyses ---
CALLED: list = []


def observe_scene(moved_support: bool = False, **named) -> list:
    """Observe a rod with drag and the number of callback calls; `moved_support`: the support starts elsewhere."""
    CALLED.clear()
    scene = ddg.Scene(**named)
    scene.add_rod(line(), section=ddg.Rectangle(0.03, 0.02), material=RUBBER)
    scene.clamp(0, motion=ddg.Motion(lambda t: (0.0, 0.0, 1.0)) if moved_support else None)
    scene.drag(0, tangential=1.0, normal=1.0)
    return [*observe_steps(scene), len(CALLED), scene.build(DEVICE).precision]


CALLS["Scene"] = Call(ddg.Scene, observe_scene, {}, {
    "gravity": (0, 0, -1), "dimension": 2, "analysis": ddg.Dynamics(precision="mixed"), "mass_damping": 1.0, "flow": (1, 0, 0),
    "initial": Change(lambda model: model.state(), {"moved_support": True}), "callbacks": [CALLED.append]})  # fmt: skip


def observe_build(device=DEVICE, precision=None, worlds=1, allow_rounding=False) -> list:
    """Observe a model of a rod too stiff for float32."""
    scene = ddg.Scene()
    scene.add_rod(line(40), section=ddg.Circle(1e-5), material=ddg.Material(1e11))
    scene.clamp(0)
    model = scene.build(device, precision, worlds, allow_rounding)
    state = ddg.Integrator(model).step(model.state(), 1.0)
    return [state.points(), model.precision, model.worlds]


CALLS["build"] = Call(ddg.Scene.build, observe_build, {}, {
    "device": Change("cuda:99", refused=True), "precision": "mixed", "worlds": 2,
    "allow_rounding": Change(True, {"precision": "float32"})})  # fmt: skip


def analyse(analysis, **options) -> list:
    """Observe an analysis of a clamped rod under a force."""
    scene = ddg.Scene(analysis=analysis)
    scene.add_rod(line(), section=ddg.Circle(0.02), material=RUBBER)
    scene.clamp(0)
    scene.add_force(0, -1, (0, 0.3, 0.5))
    result = simulate(scene, device=DEVICE, progress=False, options=options)
    path = (
        [] if result.path is None else [result.path.load, [list(point.values.items()) for point in result.path.points]]
    )
    return [*observe_state(result.state), result.model.precision, result.state.time, str(result.failure), path]


CALLS["Dynamics"] = Call(ddg.Dynamics, lambda **named: analyse(ddg.Dynamics(**named)), {"dt": 0.01, "duration": 0.02}, {
    "dt": 0.02, "duration": 0.03, "scheme": "implicit_midpoint", "rtol": 1e-1, "precision": "mixed",
    "unconverged_fraction": Change(0.1, refused=True), "error": 1e-3})  # fmt: skip
CALLS["Statics"] = Call(ddg.Statics, lambda **named: analyse(ddg.Statics(**named)), {}, {"load_steps": 2})
TIP = {"tip": ddg.Displacement.of(5, "z")}
CALLS["Trace"] = Call(ddg.PathAnalysis, lambda **named: analyse(ddg.PathAnalysis(**named)), {"stop": ddg.StopCriterion(steps=2)}, {
    "watch": TIP, "stop": ddg.StopCriterion(steps=1), "step": 0.01, "max_step": 0.01, "load_scale": 3.0})  # fmt: skip


def observe_stop(**named) -> list:
    """Observe a path with a stop criterion."""
    return analyse(ddg.PathAnalysis(watch=TIP, stop=ddg.StopCriterion(**named), step=0.1, max_step=0.1))


CALLS["Stop"] = Call(ddg.StopCriterion, observe_stop, {"steps": 3}, {
    "steps": 2, "load": (-1.0, 0.01), "displacement": ("tip", -1e-3, 1e-3)})  # fmt: skip
CALLS["Displacement"] = Call(ddg.Displacement, lambda terms: analyse(ddg.PathAnalysis(
    watch={"tip": ddg.Displacement(terms)}, stop=ddg.StopCriterion(
    steps=1))), {"terms": ((5, "z", 1.0),)}, {"terms": ((5, "z", -1.0), (4, "y", 1.0))})  # fmt: skip
CALLS["Displacement.of"] = Call(ddg.Displacement.of, lambda **named: analyse(ddg.PathAnalysis(watch={"tip": ddg.Displacement.of(
    **named)}, stop=ddg.StopCriterion(steps=1))), {"point": 5, "axis": "z"}, {"point": 4, "axis": "y", "weight": 2.0})  # fmt: skip
