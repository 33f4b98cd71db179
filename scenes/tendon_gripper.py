"""Tendon gripper: fingers of hinged boxes, bent by tendons, press a cylinder against a palm and hold it.

A finger has two phalanges, hinged to a palm and to each other. A tendon, a rod, runs from the tip of the finger to a slide, which
pulls it. At rest the moments on each finger about its hinge at the palm vanish: of the tendon's force, of the contacts with the
cylinder, and of the weight,

    (r_t - r_h) x T + sum_c (r_c - r_h) x f_c + sum_i m_i (r_i - r_h) x g = 0    along the hinge.

The floor carries the cylinder first and is then lowered, so that friction carries its weight.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _bodies, _many_rods

PALM, PHALANX = 0.03, 0.05  # m, half distance of the hinges at the palm, length of a phalanx
THICK, WIDE = 0.006, 0.012  # m, half sides of a phalanx
ROUND = 1e-3  # m, radius of rounded surfaces
CYLINDER, HEIGHT = 0.02, 0.06  # m, radius and height of the cylinder
DENSITY, OBJECT = 1000.0, 400.0  # kg/m^3, of phalanges and cylinder
GRAVITY = 9.81  # m/s^2
RANGE, STIFFNESS, SLIP = 1e-3, 2e4, 2e-3  # m, N/m, m/s
TENDON = ddg.Stiffness(
    EA=20.0, EI1=1e-7, GJ=1e-7, mass_per_length=1e-3, rotary_inertia=1e-9, radius=1e-3, viscosity=5e-3
)
EDGES = 4  # edges of a tendon
INSIDE = 0.012  # m, of the tendons' ends at the tips inside of the fingers
PULLED, LOWERED = 0.6, 0.9  # s: the slides have arrived; the floor begins to fall
NAMES = (
    "moment on the left finger over that of its tendon",
    "moment on the right finger over that of its tendon",
    "force of fingers and palm over the weight of the cylinder",
    "fall of the cylinder after the floor left it [m]",
)


def build(
    pull: float = 0.06, friction: float = 0.8, dt: float = 5e-3, duration: float = 1.5, sides: int = 24
) -> ddg.Scene:
    """Build palm and fingers in the plane of x and y, the cylinder upright along z between them.

    Args:
        pull: displacement of the slides [m]
        friction: Coulomb friction coefficient everywhere
        dt: time step [s]
        duration: duration of the run [s]
        sides: edges around the cylinder
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY), analysis=ddg.Dynamics(dt=dt, duration=duration))
    profile = [(0.0, -0.5 * HEIGHT), (CYLINDER, -0.5 * HEIGHT), (CYLINDER, 0.5 * HEIGHT), (0.0, 0.5 * HEIGHT)]
    center = (0.0, CYLINDER + 2.0 * ROUND + 2.0 * RANGE, 0.0)
    grasped = _bodies.moved(_bodies.revolved(profile, sides, ROUND), shift=center)
    scene.add_body(grasped, density=OBJECT, name="cylinder")
    palm = scene.add_body(
        ddg.Box((0.0, -THICK, 0.0), (0.6 * PALM, THICK, WIDE), radius=ROUND), density=DENSITY, name="palm"
    )
    scene.weld(palm)
    for side, name in ((-1, "left"), (1, "right")):
        x, before = side * PALM, None
        for k in range(2):
            y = k * PHALANX
            box = ddg.Box((x, y + 0.5 * PHALANX, 0.0), (THICK, 0.5 * PHALANX - 2 * ROUND, WIDE), radius=ROUND)
            body = scene.add_body(box, density=DENSITY, name=f"{name} {k}")
            hinge = {"point": (x, y, 0.0), "axis": (0.0, 0.0, 1.0), "damping": 2e-3}
            scene.hinge(body, **hinge) if before is None else scene.hinge(before, body, **hinge)
            before = body
        tip = np.array([x - side * INSIDE, 2.0 * PHALANX - 4 * ROUND, 0.0])
        slide = np.array([x - side * INSIDE, 0.0, 0.0])
        tendon = scene.add_rod(np.linspace(slide, tip, EDGES + 1), section=TENDON, twist=False, name=f"{name} tendon")
        scene.attach(tendon, [-1], before, frame=False)
        motion = ddg.Motion(translation=lambda t: (0.0, -pull * min(t / PULLED, 1.0), 0.0))
        scene.fix(tendon, [0], motion=motion, name=f"{name} slide")
    bottom = -0.5 * HEIGHT - ROUND - 0.9 * RANGE
    fall = ddg.Motion(translation=lambda t: (0.0, 0.0, -0.05 * max(0.0, t - LOWERED)))
    scene.add_obstacle(ddg.Plane((0.0, 0.0, bottom)), motion=fall, name="floor")
    names = [body.name for body in scene.bodies]
    scene.contact(
        objects=names, range=RANGE, stiffness=STIFFNESS, **_many_rods.friction_options(friction, velocity=SLIP)
    )
    return scene


def observe(model, state) -> dict[str, float]:
    """Return `_bodies.observe` with height of the cylinder [m], force of fingers and palm on it [N], moments at hinges [N m]."""
    contacts, scene = model.contacts(state), model.scene
    names = {f"body {k} ('{body.name}')": body.name for k, body in enumerate(scene.bodies)}
    labels = [[names.get(contacts.names[k], "floor") for k in pair] for pair in contacts.objects]
    force, grip = contacts.force + contacts.friction, 0.0
    for pair, value in zip(labels, force, strict=True):
        if "cylinder" in pair and "floor" not in pair:
            grip += value[2] if pair[0] == "cylinder" else -value[2]
    moments = {}
    for side, name in ((-1, "left"), (1, "right")):
        hinge = np.array([side * PALM, 0.0, 0.0])
        tendon = state.points(model.rod(f"{name} tendon"))
        pulled = np.cross(tendon[-1] - hinge, _force(tendon, model, state, name))[2]
        total = pulled
        for pair, point, value in zip(labels, contacts.point, force, strict=True):
            signs = [label.startswith(name) for label in pair]
            if signs[0] != signs[1]:
                value = value if signs[0] else -value
                total += np.cross(point - hinge, value)[2]
        moments |= {f"{name} tendon": float(pulled), f"{name} moment": float(total)}
    return _bodies.observe(model, state) | {
        "height": float(state.body("cylinder").position[2]),
        "grip": float(grip),
        **moments,
    }


def _force(tendon: np.ndarray, model, state, name: str) -> np.ndarray:
    """Return the force of a tendon on the tip (3,) [N]."""
    along = tendon[-2] - tendon[-1]
    return model.stresses(state).rod(f"{name} tendon").axial_force[-1] * along / np.linalg.norm(along)


def check(result) -> list[ddg.Check]:
    """Check the moments on the fingers, and that these hold the cylinder."""
    scene = result.scene
    checks = _many_rods.checks(result)
    return checks + once_reached(result, max(LOWERED, scene.analysis.duration), NAMES, lambda: _checks(result))


def _checks(result) -> list[ddg.Check]:
    last = {name: values[-1] for name, values in result.series.items()}
    weight = GRAVITY * result.scene.bodies[0].mass
    fell = result.at(LOWERED, "height") - last["height"]
    ratios = [last[f"{name} moment"] / last[f"{name} tendon"] for name in ("left", "right")]
    return [
        *(ddg.Check(name, ratio, 0.0, 0.03, "equilibrium") for name, ratio in zip(NAMES, ratios, strict=False)),
        ddg.Check(NAMES[2], last["grip"] / weight, 1.0, 0.03, "friction carries it"),
        ddg.Check(NAMES[3], fell, 0.0, 2e-3, "it sticks, creeping by less than the stick threshold"),
    ]


def picture(result, frames) -> dict:
    """Draw the gripper open, closed, and holding the cylinder."""
    times = sorted(frames)
    return {"points_by_time": {t: frames[t] for t in (times[0], times[2], times[-1])}, "side_by_side": True}


def benchmark() -> ddg.bench.Study:
    """Study the tendon's moment over steps."""
    return ddg.bench.Study(
        {"dt": (1e-2, 5e-3, 2.5e-3)}, lambda result: result.series["left tendon"][-1], {"dt": 1.25e-3}, unit="N m"
    )
