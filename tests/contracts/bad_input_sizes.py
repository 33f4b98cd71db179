"""Bad sizes: products that overflow or underflow, steps and ranges far from the scale, overlapping starts."""

# fmt: off
import numpy as np
from bad_inputs import (
    DEVICE,
    DOME,
    RUBBER,
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
from ddg_warp.solve.equilibrium import continuation, stability, statics
from ddg_warp.solve.stepping.adaptive_step import AdaptiveStepper

FAR, NEAR = [1e300, 1e200, -1e100], [1e-300, 1e-200, -1e-100]
LARGE, SMALL = [1e300, 1e100, 10**400], [1e-300, 1e-100]
OUTSIDE = ("magnitudes are from", "units")


def sizes(group: str, name: str, action, values=(*LARGE[:2], *SMALL), words=OUTSIDE) -> None:
    """Add a case for each of some values that are too large or too small."""
    each(group, name, values, action, *words)


# --- positions ---
each("sizes: positions", "rod", FAR, lambda v: rods(line() * v), "rods 'odd'", "points", "overflow")
each("sizes: positions", "rod near", NEAR, lambda v: rods(line() * v), "rods 'odd'", "points", "underflow")
each("sizes: positions", "shell", FAR, lambda v: ddg.Scene().add_shell(meshes.rectangle(2, 2)[0] * v, meshes.rectangle(2, 2)[1],
     thickness=0.01, material=RUBBER, name="far"), "far", "points", "overflow")
each("sizes: positions", "shell near", NEAR, lambda v: ddg.Scene().add_shell(meshes.rectangle(2, 2)[0] * v, meshes.rectangle(2, 2)[1],
     thickness=0.01, material=RUBBER, name="near"), "near", "points", "underflow")
each("sizes: positions", "meridian", [1e200, 1e-200], lambda v: dome(DOME * v), "dome", "points", *OUTSIDE)
each("sizes: positions", "mesh", [1e200, 1e-200], lambda v: ddg.Mesh(np.eye(3) * v, [[0, 1, 2]]), "Mesh: points", *OUTSIDE)
each("sizes: positions", "state", [1e200], lambda v: model().state(points=model().state().points() * v), "points", "overflow")
each("sizes: positions", "velocities", [1e200], lambda v: model().state(velocities=np.full((12, 3), v)), "velocities", "overflow")

# --- sections and materials ---
sizes("sizes: sections", "young", ddg.Material, words=("Material: young", *OUTSIDE))
sizes("sizes: sections", "density", lambda v: ddg.Material(1.0, density=v), words=("Material: density", *OUTSIDE))
sizes("sizes: sections", "viscosity", lambda v: ddg.Material(1.0, viscosity=v), words=("Material: viscosity", *OUTSIDE))
sizes("sizes: sections", "radius", ddg.Circle, words=("Circle: radius", *OUTSIDE))
sizes("sizes: sections", "a", lambda v: ddg.Ellipse(v, 1.0), words=("Ellipse: a", *OUTSIDE))
sizes("sizes: sections", "width", lambda v: ddg.Rectangle(v, 1.0), words=("Rectangle: width", *OUTSIDE))
for name in ("EA", "EI1", "GJ", "mass_per_length", "rotary_inertia", "radius", "viscosity", "area"):

    def section(v, name=name):
        return built(rods(section=ddg.Stiffness(**{"EA": 1.0, "EI1": 1.0, "GJ": 1.0, "mass_per_length": 1.0} | {name: v})))

    each("sizes: sections", name, [1e200, 1e-200], section, "rod 1 ('odd')", name, *OUTSIDE)
each("sizes: sections", "EI of a radius", [1e-20, 1e20],
     lambda v: built(rods(section=ddg.Circle(v), material=ddg.Material(1e5))), "rod 1 ('odd')", "EI1", *OUTSIDE)
sizes("sizes: sections", "thickness", lambda v: sheet(thickness=v), words=("shell 'sheet': thickness", *OUTSIDE))
each("sizes: sections", "stiffness of a shell", [1e-30, 1e30],
     lambda v: built(sheet(thickness=v)), "shell 'sheet'", "bending stiffness", *OUTSIDE)
each("sizes: sections", "stiffness of a meridian", [1e-30, 1e30],
     lambda v: built(dome(thickness=v), lambda s: s.hold_ring(0, 5)), "bending stiffness", *OUTSIDE)
each("sizes: sections", "natural curvature", [1e200, 1e-200],
     lambda v: built(rods(natural=(v, 0.0, 0.0))), "rod 1 ('odd')", "natural", *OUTSIDE)

# --- loads, drag, magnets, scenes ---
sizes("sizes: loads", "force", lambda v: clamped().add_force(0, -1, (0.0, v, 0.0)), words=("add_force: force", *OUTSIDE))
sizes("sizes: loads", "moment", lambda v: clamped().add_twisting_moment(0, -1, v), words=("moment", *OUTSIDE))
sizes("sizes: loads", "couple", lambda v: clamped().add_couple(0, -1, (0.0, v, 0.0)), words=("couple", *OUTSIDE))
sizes("sizes: loads", "mass", lambda v: clamped().add_mass(0, -1, v), words=("mass", *OUTSIDE))
sizes("sizes: loads", "pressure", lambda v: sheet().add_pressure(0, v), words=("pressure", *OUTSIDE))
sizes("sizes: loads", "gravity", lambda v: ddg.Scene(gravity=(0.0, 0.0, v)), words=("gravity", *OUTSIDE))
sizes("sizes: loads", "mass_damping", lambda v: ddg.Scene(mass_damping=v), words=("mass_damping", *OUTSIDE))
sizes("sizes: loads", "tangential drag", lambda v: rods().drag(0, tangential=v, normal=1.0), words=("drag: tangential", *OUTSIDE))
sizes("sizes: loads", "drag of nodes", lambda v: rods().drag(0, nodes=v), words=("drag: nodes", *OUTSIDE))
sizes("sizes: loads", "viscosity of a fluid", ddg.Viscous, words=("Viscous: viscosity", *OUTSIDE))
sizes("sizes: loads", "radius in a fluid", lambda v: ddg.Viscous(1.0, radius=v), words=("Viscous: radius", *OUTSIDE))
sizes("sizes: loads", "field", lambda v: rods().magnetic_field((0.0, 0.0, v)), words=("magnetic_field: value", *OUTSIDE))
sizes("sizes: loads", "amplitude", lambda v: clamped().add_force(0, -1, (0.0, 0.0, 1.0), lambda t: v), (1e300, 1e100),
      ("amplitude", "too large", "correct the function"))
sizes("sizes: loads", "translation", lambda v: ddg.Motion(lambda t: (0.0, v, 0.0)), (1e300, 1e100), ("translation", "too large"))

# --- steps ---
sizes("sizes: steps", "dt", lambda v: integrator().step(model().state(), v), (*LARGE[:2], *SMALL), ("dt is", *OUTSIDE))
sizes("sizes: steps", "dt of many digits", lambda v: integrator().step(model().state(), v), (10**400,), ("dt is", "positive"))
sizes("sizes: steps", "dt of an analysis", lambda v: ddg.Dynamics(dt=v), words=("Dynamics: dt", *OUTSIDE))
sizes("sizes: steps", "rtol", lambda v: ddg.Integrator(model(), rtol=v), words=("rtol", *OUTSIDE))
sizes("sizes: steps", "linear_rtol", lambda v: ddg.Integrator(model(), linear_rtol=v), words=("linear_rtol", *OUTSIDE))
sizes("sizes: steps", "max_iterations", lambda v: ddg.Integrator(model(), max_iterations=v), (2**31, 10**30),
      ("max_iterations", "at most"))
sizes("sizes: steps", "halvings", lambda v: AdaptiveStepper(integrator(), 1e-3, v), (2000, 41, 10**30), ("halvings", "at most 40"))
sizes("sizes: steps", "error", lambda v: AdaptiveStepper(integrator(), v), (*LARGE[:2], *SMALL), ("AdaptiveStepper: error", *OUTSIDE))

# --- equilibria ---
sizes("sizes: equilibria", "end", lambda v: statics.solve(model(), end=v), (1e300, 1e-300), ("statics: end", *OUTSIDE))
sizes("sizes: equilibria", "rotation_cap", lambda v: statics.solve(model(), rotation_cap=v), (1e300, 10**30 * 10**60, 1e-300),
      ("rotation_cap", *OUTSIDE))
for name in ("step", "max_step"):

    def short(v, name=name):
        return continuation.Continuation(model(), **{name: v})

    sizes("sizes: equilibria", f"{name} below min_step", short, (1e-12, 1e-9), (name, "below min_step", "smaller min_step"))
    sizes("sizes: equilibria", name, short, (1e300, 1e-300), (name, *OUTSIDE))
sizes("sizes: equilibria", "load of a spectrum", lambda v: stability.spectrum(model(), model().state(), load=v), (1e300,),
      ("spectrum: load", *OUTSIDE))


# --- contact ---
def crossed_rods(gap: float = 0.02, radius: float = 0.01, **options) -> ddg.Scene:
    """Return two crossed rods a gap apart, 'low' and 'high'; the first is clamped."""
    scene = ddg.Scene()
    for name, axis, z in (("low", 0, 0.0), ("high", 1, 2.0 * radius + gap)):
        points = np.zeros((5, 3))
        points[:, axis], points[:, 2] = np.linspace(-0.5, 0.5, 5), z
        scene.add_rod(points, section=ddg.Circle(radius), material=ddg.Material(1e6), name=name)
    scene.clamp(0)
    scene.contact(**options)
    return scene


def step(scene: ddg.Scene, steps: int = 1):
    """Return the state after some steps of a scene."""
    made = scene.build(DEVICE, "float64")
    state, steps_of = made.state(), ddg.Integrator(made, retry_limit=2)
    for _ in range(steps):
        state = steps_of.step(state, 0.01)
    return state


def driven_through(obstacle: str = "rods", law: str = "barrier") -> ddg.Scene:
    """Return fully constrained rods with a prescribed motion through each other, or an obstacle through them."""
    scene = crossed_rods(law=law)
    scene.clamp(0, slice(None))
    down = ddg.Motion(lambda t: (0.0, 0.0, -2.0 * t))
    scene.clamp(1, slice(None), motion=down if obstacle == "rods" else None)
    if obstacle == "plane":
        scene.add_obstacle(ddg.Plane((0.0, 0.0, -0.02)), motion=ddg.Motion(lambda t: (0.0, 0.0, 4.0 * t)), name="floor")
    return scene


for name in ("range", "stiffness", "velocity"):

    def rub(v, name=name):
        return rods().contact(friction=0.1, **{name: v})

    sizes("sizes: contact", name, rub, words=(f"contact: {name}", *OUTSIDE))
sizes("sizes: contact", "radius", lambda v: rods().contact(radius={"odd": v}), words=("contact: radius of 'odd'", *OUTSIDE))
sizes("sizes: contact", "exclusion_length", lambda v: rods().contact(exclusion_length=v), words=("contact: exclusion_length", *OUTSIDE))
each("sizes: contact", "range beyond the scene", [1e60, 1e10, 1e3], lambda v: built(crossed_rods(range=v)),
     "range between 'high' and 'high'", "far beyond the size of the scene", "half of the smallest radius")
each("sizes: contact", "range that is lost", [1e-60, 1e-20, 1e-14], lambda v: built(crossed_rods(range=v)),
     "range between 'high' and 'high'", "lost in positions")
each("sizes: contact", "gap that is too small", [1e-8, 1e-12, 1e-15], lambda v: step(crossed_rods(v)),
     "edge", "of rod 0", "of rod 1", "too close for a barrier", "resolve_overlaps")
each("sizes: contact", "gap that is too small for an equilibrium", [1e-12], lambda v: statics.solve(built(crossed_rods(v))),
     "of rod 0", "of rod 1", "too close for a barrier", "resolve_overlaps")
refuse("sizes: steps", {"dt of too many digits": (lambda: integrator().step(model().state(), 10**5000), "dt is", "positive")})
refuse("sizes: contact", {
    "no gap": (lambda: step(crossed_rods(0.0)), "of rod 0", "of rod 1", "have no gap at the start", "resolve_overlaps"),
    "no radius": (lambda: built(rods(section=ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, radius=0.0), name="thin"),
                                lambda s: s.contact()), "rod 1 ('thin')", "radius", "positive"),
    "held through held": (lambda: step(driven_through(), 2), "both fixed", "motion of support 2 (clamp)", "change that motion"),
    "held through held, penalty": (lambda: step(driven_through(law="penalty"), 4), "both fixed", "motion of support 2 (clamp)"),
    "a plane through what is held": (lambda: step(driven_through("plane"), 2), "both fixed", "motion of obstacle 'floor'"),
    "held through held in an equilibrium": (lambda: statics.solve(built(driven_through()), max_cuts=1),
                                            "in_the_way", "both fixed", "support 2 (clamp)"),
})


# --- float32 ---
def scaled(length: float, shell: bool = False) -> ddg.Scene:
    """Return a rod or a sheet of a given size."""
    scene = ddg.Scene()
    if shell:
        scene.add_shell(meshes.rectangle(2, 2)[0] * length, meshes.rectangle(2, 2)[1], thickness=0.01 * length, material=RUBBER)
    else:
        scene.add_rod(line(7) * length, section=ddg.Circle(0.02 * length), material=RUBBER)
        scene.clamp(0)
    return scene


each("sizes: float32", "rod", [1e-12, 1e-11, 1e11], lambda v: scaled(v).build(DEVICE, "float32"),
     "float32", "stiffness", "mixed", "units")
each("sizes: float32", "sheet", [1e-12, 1e-11, 1e13], lambda v: scaled(v, True).build(DEVICE, "float32"), "float32", "shell", "mixed")
refuse("sizes: float32", {
    "stiffness": (lambda: rods(section=ddg.Stiffness(EA=1.0, EI1=1e-44, GJ=1.0)).build(DEVICE, "float32"),
                  "float32", "1e-44", "mixed"),
    "stiffness of a Stiffness": (lambda: rods(section=ddg.Stiffness(EA=1e40, EI1=1.0, GJ=1.0)).build(DEVICE, "float32"),
                                 "float32", "1e+40"),
})
