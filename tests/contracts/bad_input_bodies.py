"""Bad inputs to rigid bodies: shapes, masses, inertia, attachments, joints, contact and queries."""

# fmt: off
from importlib.util import find_spec

import numpy as np
from bad_inputs import DEVICE, INF, NAN, STIFFNESS, built, each, line, refuse

import ddg_warp as ddg
from ddg_warp.geometry import meshes

BALL = ddg.Sphere((0.0, 0.0, 0.0), 0.1)
OPEN = ddg.Mesh(*meshes.rectangle(2, 2))
ROUND = meshes.sphere(1, 0.1)
INSIDE_OUT = ROUND[1].copy()
INSIDE_OUT[0] = INSIDE_OUT[0][::-1]
MASS = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0), "center": (0.0, 0.0, 0.0)}


def add(shapes=BALL, **options):
    """Add a body to an empty scene."""
    return ddg.Scene().add_body(shapes, **({"density": 1.0} | options))


def plain(**options):
    """Add a body by mass, inertia and center."""
    return ddg.Scene().add_body(**(MASS | options))


def bodies(*nodes, count: int = 2, **options) -> tuple[ddg.Scene, list]:
    """Return a scene with a rod along x and bodies, of which the first ones carry its `nodes`."""
    scene = ddg.Scene()
    rod = scene.add_rod(line(5), section=STIFFNESS, **options)
    made = [scene.add_body(ddg.Sphere((0.5 * k, 0.5, 0.0), 0.1), density=1.0, name=f"ball {k}") for k in range(count)]
    for node, body in zip(nodes, made, strict=False):
        scene.attach(rod, [node], body)
    return scene, made


def joined(call: str, *chosen, **options):
    """Join bodies of a scene, by number."""
    scene, made = bodies()
    return getattr(scene, call)(*(made[k] if isinstance(k, int) else k for k in chosen), **options)


def hinged(**options):
    return joined("hinge", 0, 1, **({"point": (0.0, 0.0, 0.0), "axis": (0.0, 0.0, 1.0)} | options))


def touching(shape, **options):
    """Build a body of a shape in contact with a floor."""
    scene = ddg.Scene()
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -1.0)), name="floor")
    scene.add_body(shape, density=1.0, name="odd")
    scene.contact(**({"range": 1e-3} | options))
    return scene.build(DEVICE)


each("bodies", "shapes", [3.0, "ball", [3.0]], add, "add_body", "is no body", "closed Mesh")
each("bodies", "density", [0.0, -1.0, NAN, INF, "heavy", (1.0, 2.0)], lambda v: add(density=v), "add_body: density", "kg/m^3")
each("bodies", "mass", [0.0, -1.0, NAN, INF, "heavy"], lambda v: add(density=None, mass=v), "add_body: mass", "kg")
each("bodies", "center", [3.0, (0.0, 1.0), (0.0, 0.0, NAN), "here"], lambda v: plain(center=v), "add_body: center", "three finite")
each("bodies", "inertia", [3.0, (1.0, 2.0), np.ones((2, 2)), (1.0, NAN, 1.0), np.triu(np.ones((3, 3)))],
     lambda v: plain(inertia=v), "add_body: inertia", "tensor (3, 3)")
each("bodies", "inertia that is none", [(1.0, 1.0, 3.0), (0.0, 1.0, 1.0), (-1.0, 1.0, 1.0), np.ones((3, 3))],
     lambda v: plain(inertia=v), "add_body", "principal moments of inertia", "none exceeds the sum of the others")
for _name in ("velocity", "angular_velocity"):
    each("bodies", _name, [3.0, (0.0, 1.0), (0.0, 0.0, NAN), "fast"], lambda v, name=_name: add(**{name: v}),
         f"add_body: {_name}", "three finite")
each("bodies", "name", [3, "", None], lambda v: add(name=v), "add_body: name", "text")
refuse("bodies", {
    "density and mass": (lambda: add(mass=1.0), "add_body", "either density or mass"),
    "no mass": (lambda: add(density=None), "add_body", "either density or mass"),
    "constructor of a shape": (lambda: add(ddg.Box), "add_body", "is no body"),
    "no shapes": (lambda: add(None), "add_body", "without shapes", "mass, inertia and center"),
    "no inertia": (lambda: plain(inertia=None), "add_body", "without shapes"),
    "center of shapes": (lambda: add(center=(0.0, 0.0, 1.0)), "add_body", "center and inertia belong to a mass"),
    "inertia and density": (lambda: add(inertia=(1.0, 1.0, 1.0)), "add_body", "center and inertia belong to a mass"),
    "an open mesh": (lambda: add(OPEN), "add_body", "Mesh is open", "close it"),
    "a triangle inside out": (lambda: add(ddg.Mesh(ROUND[0], INSIDE_OUT)), "add_body", "not oriented alike"),
    "a plane": (lambda: add(ddg.Plane()), "add_body", "is no body"),
})

# --- attachments ---
refuse("carried nodes", {
    "two bodies": (lambda: built(bodies(0, 0)[0]), "attach: body 1 cannot carry node 0 of rod 0", "body 0", "join the bodies"),
    "a support": (lambda: built(bodies(0)[0], lambda s: s.fix(0, [0])), "attach: a support fixes", "body 0", "leave one out"),
    "a clamped end": (lambda: built(bodies(0)[0], lambda s: s.clamp_end(0)), "body 0"),
    "no node": (lambda: bodies(5), "node 5 does not exist", "rod 0 has 5 nodes"),
    "no rod": (lambda: bodies()[0].attach(1, [0], bodies()[1][0]), "rod 1", "1 rods"),
    "nothing": (lambda: bodies()[0].attach(0, [], bodies()[1][0]), "attach", "nothing is chosen"),
    "no body": (lambda: ddg.Scene().attach(0, [0], bodies()[1][0]), "body 0 does not exist", "0 bodies"),
    "vertices": (lambda: bodies()[0].attach(0, [0], bodies()[1][0], [0]), "attach: vertices and spin are for a shell", "frame"),
    "spin": (lambda: bodies()[0].attach(0, [0], bodies()[1][0], spin="free"), "attach: vertices and spin are for a shell"),
    "no twist": (lambda: built(bodies(0, twist=False)[0]), "attach", "rod 0", "twist", "frame=False"),
    "an index for a handle": (lambda: bodies()[0].attach(0, [0], 0), "attach", "handle of a body"),
})
each("carried nodes", "frame", [1, "no", 0.5], lambda v: bodies()[0].attach(0, [0], bodies()[1][0], frame=v), "attach: frame", "True")

# --- joints ---
for _call in ("ball", "hinge", "weld"):
    _options = {"point": (0.0, 0.0, 0.0)} | ({"axis": (0.0, 0.0, 1.0)} if _call == "hinge" else {})
    refuse("joints of bodies", {
        f"{_call} of itself": (lambda c=_call, o=_options: joined(c, 0, 0, **o), f"{_call}: body 0 is joined to itself", "the world"),
        f"{_call} of no body": (lambda c=_call, o=_options: getattr(ddg.Scene(), c)(bodies()[1][0], **o),
                                f"{_call}: body 0 does not exist", "0 bodies"),
    })
    each("joints of bodies", f"{_call} of", ["ball", 0.5, [0, 1]], lambda v, c=_call, o=_options: joined(c, v, **o), _call)
    each("joints of bodies", f"{_call} at", [3.0, (0.0, 1.0), (0.0, NAN, 0.0)],
         lambda v, c=_call, o=_options: joined(c, 0, 1, **(o | {"point": v})), f"{_call}: point", "three finite")
    each("joints of bodies", f"{_call} stiffness", [0.0, -1.0, NAN, INF, "stiff"],
         lambda v, c=_call, o=_options: joined(c, 0, 1, **(o | {"stiffness": v})), f"{_call}: stiffness", "N/m")
    each("joints of bodies", f"{_call} name", [3, ["a"]],
         lambda v, c=_call, o=_options: joined(c, 0, 1, **(o | {"name": v})), f"{_call}: name", "text")
each("joints of bodies", "axis", [(0.0, 0.0, 0.0), 3.0, (0.0, NAN, 1.0)], lambda v: hinged(axis=v), "hinge: axis")
each("joints of bodies", "torque", ["much", NAN, (1.0, 2.0)], lambda v: hinged(torque=v), "hinge: torque")
each("joints of bodies", "damping", [-1.0, NAN, INF, "much"], lambda v: hinged(damping=v), "hinge: damping", "zero or more")
each("joints of bodies", "spring", [-1.0, NAN, INF, "soft"], lambda v: hinged(spring=v), "hinge: spring", "zero or more")
each("joints of bodies", "angle", ["open", NAN, (1.0, 2.0)], lambda v: hinged(angle=v), "hinge: angle")
each("joints of bodies", "stops", [(0.5, 1.0), (-1.0, -0.5), (0.0, 0.0), (1.0, -1.0)], lambda v: hinged(stops=v), "hinge: stops",
     "with 0 between them")
each("joints of bodies", "stops of", [0.5, (1.0,), "none", (NAN, 1.0)], lambda v: hinged(stops=v), "hinge: stops")
for _name, _value in (("torque", 1.0), ("damping", 0.1), ("stops", (-1.0, 1.0))):
    each("joints of bodies", f"angle with {_name}", [_value], lambda v, n=_name: hinged(angle=lambda t: t, **{n: v}),
         "hinge: a driven angle leaves nothing to a torque, damping or stops", "leave these out")

# --- contact ---
refuse("contact of bodies", {
    "a sharp box": (lambda: touching(ddg.Box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))), "contact: body 0 ('odd')", "sharp", "radius"),
    "a name": (lambda: touching(BALL, objects=["even"]), "contact", "'even'"),
    "a ball alone": (lambda: built(_alone()), "contact: body 0 ('odd')", "one ball alone", "add an obstacle"),
})


def _alone() -> ddg.Scene:
    """Return a scene of one ball with contact."""
    scene = ddg.Scene()
    scene.add_body(BALL, density=1.0, name="odd")
    scene.contact(range=1e-3)
    return scene


# --- queries ---
def _state():
    return built(bodies()[0]).state()


each("queries of bodies", "body", [2, -1, "odd", 0.5], lambda v: _state().body(v), "body")

# --- with torch ---
if find_spec("torch"):
    import torch

    from ddg_warp.torch import Simulator

    def simulator(*add, pinned: bool = False, count: int = 1, scheme: str = "implicit_euler", **contact) -> Simulator:
        """Return steps of bodies on a rod, the first pinned to the world."""
        scene, made = bodies(*range(1 - pinned), count=count)
        if pinned:
            scene.hinge(made[0], point=(0.0, 0.2, 0.0), axis=(0.0, 0.0, 1.0), torque=0.1)
        for more in add:
            more(scene)
        if contact:
            scene.contact(**contact)
        return Simulator(scene.build(DEVICE, "float64"), 0.01, scheme=scheme)

    def start(rotation=np.eye(3), shift=0.0, **options):  # noqa: B008
        made = simulator(**options)
        poses = made.initial_state().body_poses.clone()
        poses[..., :3], poses[..., 3] = torch.as_tensor(rotation), poses[..., 3] + shift
        return made.initial_state(body_poses=poses)

    def gradient(*add, **options):
        made = simulator(*add, **options)
        wrenches = torch.zeros((1, 1, 6), dtype=torch.float64, requires_grad=True)
        return made.step(made.initial_state(), controls={"wrenches": wrenches}).body_rates.sum().backward()

    def stepped(parameter: str):
        made = simulator(pinned=True)
        return made.step(made.initial_state(), {parameter: 1.0})

    def wrenches():
        made = simulator(lambda scene: scene.clamp(0, edges=[1]))
        before = made.initial_state()
        return made.wrenches(before, made.step(before))

    def follow(scene):
        scene.add_couple(0, -1, (0.0, 0.0, 1e-3))

    each("gradients of bodies", "rotation", [2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0])], start, "body_poses: body 0", "R^T R = 1")
    each("gradients of bodies", "rates", [np.zeros(6), np.zeros((2, 6))], lambda v: simulator().initial_state(body_rates=v),
         "initial_state: body_rates have shape", "(1, 6)")
    refuse("gradients of bodies", {
        "poses without bodies": (lambda: simulator(count=0).initial_state(body_rates=np.zeros((0, 6))), "no rigid body", "add_body"),
        "a centre off its joint": (lambda: start(shift=0.1, pinned=True), "centre of body 0", "about the point"),
        "the mass of a pinned body": (lambda: stepped("body.mass"), "no object has 'body.mass'", "body.inertia"),
        "the torque as a parameter": (lambda: stepped("hinge.torque"), "hinge.torque drives hinges", "controls={'torques'"),
        "the midpoint rule": (lambda: gradient(scheme="implicit_midpoint"), "body 0 ('ball 0')", "midpoint rule", "use"),
        "follower loads": (lambda: gradient(follow), "body 0 ('ball 0')", "follower loads", "leave them out"),
        "wrenches beside a body": (wrenches, "wrenches", "supports at an edge that a rigid body clamps", "Integrator.wrenches"),
        "friction iterations": (lambda: gradient(range=1e-3, friction=0.1, friction_iterations=2), "friction iterations", "set"),
    })
