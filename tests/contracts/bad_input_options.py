"""Unknown options, unknown attributes, and options without effect."""

# fmt: off
from dataclasses import replace
from functools import cache

import warp as wp
from bad_inputs import RUBBER, STIFFNESS, built, each, integrator, line, model, refuse, rods

import ddg_warp as ddg
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.solve.equilibrium import continuation, statics
from ddg_warp.solve.newton.rod_newton import NewtonOptions

# --- unknown options ---
refuse("options: unknown", {
    "Integrator": (lambda: ddg.Integrator(model(), foo=1), "Integrator takes no 'foo'", "rtol", "scheme"),
    "Integrator, nearly rtol": (lambda: ddg.Integrator(model(), rtoll=1e-6), "Integrator takes no 'rtoll'", "did you mean 'rtol'"),
    "Integrator, nearly scheme": (lambda: ddg.Integrator(model(), sheme="implicit_euler"), "did you mean 'scheme'"),
    "Integrator, nearly max_iterations": (lambda: ddg.Integrator(model(), max_iteration=3), "did you mean 'max_iterations'"),
    "statics": (lambda: statics.solve(model(), foo=1), "statics.solve takes no 'foo'", "load_steps", "rotation_cap"),
    "statics, nearly load_steps": (lambda: statics.solve(model(), load_step=2), "did you mean 'load_steps'"),
    "statics, nearly mode": (lambda: statics.solve(model(), modes="follow"), "did you mean 'mode'"),
    "Continuation": (lambda: continuation.Continuation(model(), foo=1), "Continuation takes no 'foo'", "watch", "max_step"),
    "Continuation, nearly max_step": (lambda: continuation.Continuation(model(), maxstep=1.0), "did you mean 'max_step'"),
})

SHEET = {"points": line(), "triangles": [[0, 1, 2]]}
refuse("options: unknown", {
    "add_rod, nearly section": (lambda: rods().add_rod(line(), sectoin=STIFFNESS), "add_rod takes no 'sectoin'", "'section'?"),
    "add_rod without a section": (lambda: rods().add_rod(line()), "add_rod", "missing", "'section'"),
    "add_rod without points": (lambda: rods().add_rod(section=STIFFNESS), "add_rod", "missing", "'points'"),
    "add_rod of too much": (lambda: rods().add_rod(line(), STIFFNESS), "add_rod", "too many positional"),
    "add_shell, nearly thickness": (lambda: rods().add_shell(**SHEET, thicknes=0.1, material=RUBBER), "did you mean 'thickness'"),
    "contact, nearly friction": (lambda: rods().contact(fricton=0.1), "contact takes no 'fricton'", "did you mean 'friction'"),
    "clamp, nearly motion": (lambda: rods().clamp(0, motoin=None), "clamp takes no 'motoin'", "did you mean 'motion'"),
    "magnetize, nearly edges": (lambda: rods().magnetize(0, 1.0, edge=[0]), "magnetize takes no 'edge'", "did you mean 'edges'"),
    "hold_ring without a shell": (lambda: rods().hold_ring(nodes=[0]), "hold_ring", "missing", "'shell'"),
    "build, nearly worlds": (lambda: rods().build(world=2), "build takes no 'world'", "did you mean 'worlds'"),
    "Scene, nearly gravity": (lambda: ddg.Scene(gravty=(0, 0, 0)), "Scene takes no 'gravty'", "did you mean 'gravity'"),
    "Material, nearly young": (lambda: ddg.Material(yuong=1e6), "Material takes no 'yuong'", "did you mean 'young'"),
    "Material without young": (ddg.Material, "Material", "missing", "'young'"),
    "Circle of two": (lambda: ddg.Circle(0.1, 0.2), "Circle", "too many positional"),
    "Motion, nearly angle": (lambda: ddg.Motion(angel=lambda t: t), "did you mean 'angle'"),
    "Sphere without a radius": (lambda: ddg.Sphere((0, 0, 0)), "Sphere", "missing", "'radius'"),
    "Trace": (lambda: ddg.PathAnalysis(foo=1), "Trace takes no 'foo'", "load_scale"),
    "Dynamics, nearly duration": (lambda: ddg.Dynamics(durations=1.0), "did you mean 'duration'"),
    "Stop, nearly limit_points": (lambda: ddg.StopCriterion(limit_point=1), "did you mean 'limit_points'"),
    "Viscous, nearly scale": (lambda: ddg.Viscous(1.0, scales=1.0), "did you mean 'scale'"),
    "Controls, nearly forces": (lambda: ddg.Controls(force=[]), "did you mean 'forces'"),
    "NewtonOptions": (lambda: NewtonOptions(foo=1), "NewtonOptions takes no 'foo'", "rtol"),
    "StaticsOptions": (lambda: statics.StaticsOptions(foo=1), "StaticsOptions takes no 'foo'", "rotation_cap"),
})

# --- unknown attributes ---


def assign(made, name: str):
    """Set an attribute."""
    setattr(made, name, 1.0)


refuse("options: attributes", {
    "scene.gravty": (lambda: assign(rods(), "gravty"), "Scene has no attribute 'gravty'", "did you mean 'gravity'"),
    "scene.mass_dampin": (lambda: assign(rods(), "mass_dampin"), "did you mean 'mass_damping'"),
    "scene.foo": (lambda: assign(rods(), "foo"), "Scene has no attribute 'foo'", "gravity", "callbacks"),
    "scene.copy(gravty)": (lambda: rods().copy(gravty=(0, 0, 0)), "Scene has no attribute 'gravty'", "did you mean 'gravity'"),
    "state.tme": (lambda: assign(model().state(), "tme"), "State has no attribute 'tme'", "did you mean 'time'"),
    "state.velocity": (lambda: assign(model().state(), "velocity"), "State has no attribute 'velocity'", "did you mean 'velocities'"),
    "integrator.retry_limt": (lambda: assign(integrator(), "retry_limt"), "did you mean 'retry_limit'"),
    "model.gravity": (lambda: assign(model(), "gravty"), "Model has no attribute 'gravty'"),
    "continuation.optoins": (lambda: assign(continuation.Continuation(model()), "optoins"), "did you mean 'options'"),
})

# --- no effect ---


def smooth(**options) -> ddg.Scene:
    """Return two separate rods with frictionless contact."""
    scene = rods(line() + [0.0, 0.5, 0.0])
    scene.contact(**options)
    return scene


each("options: no effect", "friction_iterations", [2, 3], lambda v: built(smooth(friction_iterations=v)), "contact: lags", "friction")
each("options: no effect", "velocity", [1e-2], lambda v: built(smooth(velocity=v, friction=0.0)), "contact: velocity", "friction")
each("options: no effect", "friction_law", ["polynomial"], lambda v: built(smooth(friction_law=v)), "contact: friction_law", "friction")
refuse("options: no effect", {
    "a material beside a Stiffness": (lambda: rods(section=STIFFNESS, material=RUBBER), "rods 'odd'", "leave material out"),
    "friction_iterations, and friction that contact_between takes away": (
        lambda: built(smooth(friction_iterations=2), lambda s: s.contact_between("rod", "odd", friction=0.0)),
        "friction_iterations", "friction"),
})


# --- laws ---
def inconsistent_law(index: int):
    """Return the quadratic law, the energy or one derivative doubled."""

    @cache
    def laws(real, n):
        functions, values = list(quadratic.laws(real, n)), wp.types.vector(2 * n, real)
        strains, right = wp.types.vector(n, real), functions[index]

        @wp.func
        def twice(e: strains, p: values):
            return real(2.0) * right(e, p)

        functions[index] = twice
        return tuple(functions)

    return replace(quadratic, name="mine", laws=laws)


def build_with_law(index: int):
    """Build a rod with an inconsistent law."""
    return built(rods(laws={"rod_bend_twist": ddg.Law(inconsistent_law(index), stiffness=[1.0, 1.0, 1.0])}))


refuse("options: laws", {
    "slope": (lambda: build_with_law(1), "rod 1 ('odd')", "rod_bend_twist", "slope of the law 'mine'", "derivative of its energy"),
    "energy": (lambda: build_with_law(0), "rod 1 ('odd')", "slope of the law 'mine'", "derivative of its energy"),
    "curvature": (lambda: build_with_law(2), "rod 1 ('odd')", "curvature of the law 'mine'", "derivative of its slope"),
})
