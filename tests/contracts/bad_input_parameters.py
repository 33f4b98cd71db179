"""Bad inputs to parameter changes, and to steps and roll-outs from torch."""

# fmt: off
from functools import cache

import numpy as np
from bad_inputs import INF, NAN, clamped, each, integrator, model, refuse

import ddg_warp as ddg

STIFFNESS = ("rod_stretch", "stiffness")

for kind in ("rods", "net"):
    each(f"parameters of {kind}", "values",
         [NAN, INF, -1.0, "stiff", b"1.0", True, None, 1j, [1.0, -2.0], np.ones(99), np.ones((2, 2, 2)), 10**400, [[1], [2, 3]], {}],
         lambda v, kind=kind: model(kind).set_parameter(*STIFFNESS, v), "rod_stretch.stiffness")
    each(f"parameters of {kind}", "term", [3, None, "rod_strech", b"rod_stretch", ["rod_stretch"]],
         lambda v, kind=kind: model(kind).set_parameter(v, "stiffness", 1.0), "set_parameter", "this model has")
    each(f"parameters of {kind}", "parameter", [3, None, "stifness", ("stiffness",)],
         lambda v, kind=kind: model(kind).set_parameter("rod_stretch", v, 1.0), "set_parameter", "it has")
    each(f"parameters of {kind}", "valid_values", [("no", "stiffness"), ("rod_stretch", "no")],
         lambda v, kind=kind: model(kind).valid_values(*v, 1.0), "set_parameter")


@cache
def simulator():
    """Return a simulator of two rods, one gripped, made once."""
    from ddg_warp.torch import Simulator

    scene = clamped()
    scene.clamp(1, -1, motion=ddg.Grip())
    return Simulator(scene.build("cpu", "float64"), 0.01)


@cache
def initial_state():
    """Return the initial state of two worlds."""
    return simulator().initial_state(2)


def step(parameters=None, controls=None):
    """Return the state after a step."""
    return simulator().step(initial_state(), parameters, controls)


def rollout(controls=None, **options):
    """Return a roll-out."""
    return simulator().rollout(initial_state(), None, controls, **({"steps": 2} | options))


def new_simulator(**options):
    """Return another simulator of the same model."""
    from ddg_warp.torch import Simulator

    return Simulator(**({"model": simulator().model, "dt": 0.01} | options))


NAME = "rod_stretch.stiffness"
each("simulator", "model", [None, 3, "rods"], lambda v: new_simulator(model=v), "Simulator")
each("simulator", "dt", [0.0, -1.0, NAN, INF, None, "0.01", b"0.01", True, [0.01], 1e300, 1e-300], lambda v: new_simulator(dt=v), "dt")
each("simulator", "scheme", ["rk4", None, 3], lambda v: new_simulator(scheme=v), "scheme")
each("simulator", "failures", ["raise", "flag"], lambda v: new_simulator(failures=v), "failures")
each("simulator", "check_every", [1], lambda v: new_simulator(check_every=v), "check_every")
each("simulator", "foo", [1], lambda v: new_simulator(foo=v), "Simulator", "foo")
each("simulator", "rtol", [-1.0, NAN, "small", None], lambda v: new_simulator(rtol=v), "rtol")
each("simulator", "parameters",
     [3, "stiff", [NAME], {3: 1.0}, {None: 1.0}, {"rod_stretch": 1.0}, {"no.thing": 1.0}, {b"a.b": 1.0}, {"rod_stretch.no": 1.0}],
     step, "parameters")
each("simulator", "values",
     [NAN, INF, -1.0, "stiff", None, b"1.0", 1j, np.ones(99), np.ones((3, 1)), np.ones((2, 1, 1)), [[1.0], [2.0, 3.0]]],
     lambda v: step({NAME: v}), NAME)
each("simulator", "controls", [3, "push", ["forces"], {3: 1.0}, {"force": 1.0}, {None: 1.0}], lambda v: step(None, v), "controls")
each("simulator", "forces",
     [NAN, np.full((12, 3), NAN), np.ones((11, 3)), np.ones((3, 12, 3)), "push", None, 1j * np.ones((12, 3)), b"1"],
     lambda v: step(None, {"forces": v}), "forces")
each("simulator", "poses", [np.zeros((2, 6)), np.zeros(6), np.full((1, 6), INF)], lambda v: step(None, {"poses": v}), "poses")
each("simulator", "field", [(0.0, 0.0, 1.0)], lambda v: step(None, {"field": v}), "field")
each("simulator", "state", [None, 3, "start", (1, 2)], lambda v: simulator().step(v), "state", "world_state(...)")
each("simulator", "batch", [0, -1, 1.5, "two", True], lambda v: simulator().initial_state(v), "batch", "whole number")
each("simulator", "batch", [2**31], lambda v: simulator().initial_state(v), "worlds at most")
each("simulator", "positions", [np.full((12, 3), NAN), "there"], lambda v: simulator().initial_state(positions=v), "positions")
each("simulator", "positions", [np.zeros((11, 3)), np.zeros((3, 12, 2)), 3.0], lambda v: simulator().initial_state(positions=v),
     "points have shape", "(12, 3)")
each("simulator", "world_state", [None, 3, "start"], lambda v: simulator().world_state(v), "world_state")
each("simulator", "batch of an equilibrium", [3, 0, "two"], lambda v: simulator().equilibrium(state=initial_state(), batch=v), "batch")
each("simulator", "options of an equilibrium", [{"foo": 1}, {"load_stps": 2}], lambda v: simulator().equilibrium(batch=2, **v),
     "Simulator.equilibrium")
each("rollout", "steps", [0, -1, 1.5, None, "ten", True], lambda v: rollout(steps=v), "steps")
each("rollout", "save", [0, -1, 1.5, None, 3], lambda v: rollout(save=v), "save")
each("rollout", "checkpoint_every", [0, -1, 1.5, "all"], lambda v: rollout(checkpoint_every=v), "checkpoint_every")
each("rollout", "memory", [0.0, -1.0, NAN, "all", 10.0], lambda v: rollout(memory=v), "memory")
refuse("rollout", {
    "controls that are a number": (lambda: rollout(lambda number: 3), "controls", "dictionary"),
    "controls of no such name": (lambda: rollout(lambda number: {"force": 1.0}), "controls", "'force'"),
})
each("rollout", "outcomes", [3], lambda v: new_simulator().outcomes(), "outcomes")
each("parameter", "name", [None, 3, "stiffness", "rod_stretch.no"], lambda v: simulator().parameter(v), "parameters")
each("parameter", "batch", [0, -1, 1.5, "two"], lambda v: simulator().parameter(NAME, v), "batch")
for kind in ("RodParameters", "ShellParameters"):
    def module(*arguments, kind=kind, **named):
        """Return a module of parameters of a simulator."""
        import ddg_warp.torch as torch_package

        return getattr(torch_package, kind)(*arguments, **named)

    each(kind, "simulator", [None, 3, model, "rods"], module, kind, "Simulator(model, dt)")
    each(kind, "names", [None, 3, "bending", (), (3,), ("bending", "bending"), {"bending"}, ("no",)],
         lambda v, module=module: module(simulator(), names=v), kind)
    each(kind, "batch", [0, -1, 1.5, "two", True], lambda v, module=module: module(simulator(), names=("bending",), batch=v),
         kind, "batch")
refuse("stepping", {
    "copies of integrators": (lambda: __import__("copy").deepcopy(integrator()), "Integrator", "make another"),
    "controls of a step": (lambda: integrator().step(integrator().model.state(), 0.01, {3: 1.0}), "controls", "Controls"),
})
