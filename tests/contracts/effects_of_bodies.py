"""Arguments of calls on rigid bodies as data; see `effects`."""

from effects import CALLS, DEVICE, DT, NOTHING, RUBBER, Call, Change, line

import ddg_warp as ddg
from ddg_warp.scene.handle import BODY, Handle

FIRST, SECOND, THIRD = (Handle(k, BODY) for k in range(3))
TILTED = (0.0, 1.0, 0.3)


def observe_bodies(scene: ddg.Scene, steps: int = 2, controls: ddg.Controls | None = None) -> list:
    """Return poses and rates of all bodies after some steps, the points of rods, and whether a body has the name 'odd'."""
    model = scene.build(DEVICE, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(steps):
        state = integrator.step(state, DT, controls)
    poses = [state.body(k) for k in range(len(scene.bodies))]
    values = [(pose.position, pose.rotation, pose.velocity, pose.angular_velocity) for pose in poses]
    return [values, state.points(), state.obstacle_points(), "odd" in [body.name for body in scene.bodies]]


def observe_controlled(**named) -> list:
    """Observe three bodies under controls, of which a driven hinge and a free one join the first with its neighbours."""
    scene = ddg.Scene()
    three_bodies(scene)
    scene.hinge(FIRST, SECOND, point=(0.15, 0.0, 0.0), axis=(0.0, 1.0, 0.0), angle=lambda t: 0.0)
    scene.hinge(SECOND, THIRD, point=(0.45, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    return observe_bodies(scene, controls=ddg.Controls(**named))


def body_call(name: str, base: dict, rows: dict, before, after=None, listed: str | None = None) -> None:
    """Add a method of `Scene` on bodies, called between `before(scene)` and `after(scene)`; the handle's name is observed, too."""

    def run(**named):
        scene = ddg.Scene()
        before(scene)
        handle = getattr(scene, name)(**named)
        if after is not None:
            after(scene)
        return [getattr(handle, "name", ""), *observe_bodies(scene)]

    CALLS[listed or name] = Call(getattr(ddg.Scene, name), run, base, rows)


def clamped_rod(scene: ddg.Scene) -> None:
    """Add a clamped rod along x."""
    scene.add_rod(line(), section=ddg.Circle(0.02), material=RUBBER)
    scene.clamp(0)


def three_bodies(scene: ddg.Scene) -> None:
    """Add three bodies side by side, which rotate."""
    for k in range(3):
        box = ddg.Box((0.3 * k, 0.0, 0.0), (0.1, 0.05, 0.03))
        scene.add_body(box, density=100.0, angular_velocity=(0.5, 1.0 + k, 0.2), name=f"box {k}")


BALL = {"shapes": ddg.Sphere((0.55, 0.0, 0.0), 0.05), "density": 1000.0}
MASS = {"shapes": NOTHING, "density": NOTHING, "mass": 1.0, "inertia": (1e-2,) * 3, "center": (0.55, 0.0, 0.0)}
body_call("add_body", BALL, {
    "shapes": ddg.Box((0.55, 0.0, 0.0), (0.05, 0.05, 0.05)), "density": 500.0,
    "mass": Change(2.0, {"density": NOTHING}, 1.0), "inertia": Change((2e-2,) * 3, MASS, (1e-2,) * 3),
    "center": Change((0.6, 0.0, 0.0), MASS, (0.55, 0.0, 0.0)), "velocity": (0.0, 0.1, 0.0),
    "angular_velocity": (0.0, 1.0, 0.0), "name": "odd"},
    clamped_rod, lambda s: s.attach(0, [-1], FIRST))  # fmt: skip
body_call("attach", {"rod": 0, "nodes": [-1], "shell": FIRST}, {
    "nodes": [-2], "shell": SECOND, "frame": False, "vertices": Change([0], refused=True), "spin": Change("free", refused=True)},
    lambda s: (clamped_rod(s), three_bodies(s)), listed="attach to a body")  # fmt: skip
CALLS["attach"].rows["frame"] = Change(True, refused=True)
PINNED = {"first": FIRST, "point": (0.1, 0.0, 0.0)}
PAIR = {"second": SECOND}
body_call("ball", PINNED, {
    "first": SECOND, "second": SECOND, "point": (0.0, 0.1, 0.0), "stiffness": Change(10.0, PAIR, 1e4), "name": "odd"},
    three_bodies)  # fmt: skip
body_call("hinge", PINNED | {"axis": (0.0, 1.0, 0.0)}, {
    "first": SECOND, "second": SECOND, "point": (0.0, 0.1, 0.0), "axis": TILTED, "angle": lambda t: 3.0 * t, "torque": 1.0,
    "spring": 0.5, "damping": 0.1, "stops": (-1e-3, 1e-3), "stiffness": Change(10.0, PAIR, 1e4), "name": "odd"},
    three_bodies)  # fmt: skip
body_call("weld", {"first": FIRST, "second": SECOND}, {
    "first": THIRD, "second": THIRD, "point": (0.5, 0.1, 0.0), "stiffness": 10.0, "name": "odd"},
    three_bodies)  # fmt: skip
CALLS["controls of bodies"] = Call(ddg.Controls, observe_controlled, {}, {
    "angles": [0.1, 0.0], "torques": [0.0, 0.5], "wrenches": [[1.0, 0, 0, 0, 0, 0], [0] * 6, [0, 0, 0, 0, 0, 0.1]]})  # fmt: skip
