"""Bad inputs to contact: laws, settings of pairs of objects, and obstacles."""

# fmt: off
import numpy as np
from bad_inputs import DOME, INF, NAN, RUBBER, built, dome, each, refuse, rods

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.dynamic_relaxation import relax

TURN = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
FLAT = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [2.0, 0.0, -1.0]])


def scene() -> ddg.Scene:
    """Return a scene of two separate clamped rods, 'rod' and 'odd'."""
    made = rods(np.linspace((0.0, 0.5, 0.0), (1.0, 0.5, 0.0), 5))
    made.clamp([0, 1])
    return made


def in_contact(**options) -> ddg.Scene:
    """Return the two rods with contact."""
    made = scene()
    made.contact(**options)
    return made


def obstructed(shape, made: ddg.Scene | None = None, **options) -> ddg.Scene:
    """Return the two rods in contact, with an obstacle."""
    made = made or in_contact()
    made.add_obstacle(shape, **options)
    return made


def step(made: ddg.Scene, **options):
    """Return the state after a step of a scene."""
    model = built(made)
    return ddg.Integrator(model, **options).step(model.state(), 1e-3)


def separate(made: ddg.Scene, gap):
    """Resolve overlaps of the initial state to a minimum gap."""
    model = built(made)
    return model.resolve_overlaps(model.state(), gap)


def build_pair(*names, **options):
    """Build the two rods over a floor, with contact settings between two names."""
    made = obstructed(ddg.Plane((0.0, 0.0, -1.0)), name="floor")
    made.contact_between(*names, **options)
    return built(made)


def _two_roots():
    """Build rods with a root length for each of two partners."""
    made = obstructed(ddg.Plane((0.0, 0.0, -1.0)), name="floor")
    for partner, length in (("floor", 0.1), ("odd", 0.2)):
        made.contact_between("rod", partner, root_length=length)
    return built(made)


for _name, _unit in (("range", "[m]"), ("stiffness", "[N/m]"), ("velocity", "[m/s]")):
    each("contact", _name, [0.0, -1.0, NAN, INF, "large", (1.0, 2.0)], lambda v, name=_name: in_contact(**{name: v}),
         f"contact: {_name}", "positive", _unit)
each("contact", "friction", [-1.0, NAN, INF, "rough", True, (0.1, 0.2, 0.3)], lambda v: in_contact(friction=v),
     "contact: friction", "zero or more", "contact_between")
each("contact", "exclusion_length", [-1.0, NAN, INF, "far"], lambda v: in_contact(exclusion_length=v), "exclusion_length", "zero or")
each("contact", "friction_iterations", [0, -1, 2.5, "two"], lambda v: in_contact(friction_iterations=v), "friction_iterations", "whole")
each("contact", "law", ["spring", None, 3], lambda v: in_contact(law=v), "contact: law", "'barrier' or 'penalty'")
each("contact", "friction law", ["dry", None], lambda v: in_contact(friction_law=v), "friction_law", "'logistic' or 'polynomial'")
each("contact", "radius", [0.1, [1.0]], lambda v: in_contact(radius=v), "contact: radius", "dictionary")
each("contact", "radius of a name", [0.0, -1.0, NAN, INF, "thick", [1.0, 2.0]], lambda v: in_contact(radius={"odd": v}),
     "contact: radius of 'odd'", "positive", "[m]")
each("contact", "objects", [[], 3, ()], lambda v: in_contact(objects=v), "contact: objects", "names")
each("contact", "names of objects", ["none", ["rod", "none"]], lambda v: built(in_contact(objects=v)),
     "contact: objects names", "'odd', 'rod'")
refuse("contact", {
    "twice": (lambda: in_contact().contact(), "has contact already", "contact_between"),
    "radius of no object": (lambda: built(in_contact(radius={"none": 0.1})), "radius names 'none'", "'odd', 'rod'"),
    "radius of what can not touch": (lambda: built(in_contact(objects="rod", radius={"odd": 0.1})), "radius names 'odd'", "are 'rod'"),
    "between a name that is not there": (lambda: build_pair("rod", "none", ignore=True), "names 'none'", "'floor', 'odd', 'rod'"),
    "friction by direction of a shell": (lambda: _shell_over_floor((0.1, 0.2, 0.3)), "'shell' and 'floor'", "rods on an obstacle"),
    "between numbers": (lambda: build_pair(0, 1, ignore=True), "contact_between: one is 0", "text"),
    "between obstacles": (lambda: build_pair("floor", "floor", friction=0.1), "'floor' and 'floor'", "no contact between obstacles"),
    "between, and nothing": (lambda: build_pair("rod", "floor"), "'rod' and 'floor'", "no exception", "ignore=True"),
    "between, ignored and rough": (lambda: build_pair("rod", "odd", ignore=True, friction=0.1), "'rod' and 'odd'", "no friction"),
    "between, ignored a little": (lambda: build_pair("rod", "odd", ignore=0.5), "'rod' and 'odd'", "ignore", "True or False"),
    "between without contact": (lambda: built(scene(), lambda s: s.contact_between("rod", "odd", ignore=True)), "add scene.contact()"),
    "obstacles without contact": (lambda: built(obstructed(ddg.Plane(), scene())), "obstacle 0 ('obstacle')", "add scene.contact()"),
    "in a plane": (lambda: built(rods(scene=ddg.Scene(dimension=2)), lambda s: s.contact()), "dimension 3", "dimension=2"),
    "shells of revolution": (lambda: built(dome(DOME), lambda s: s.contact()), "shell of revolution 0 ('dome')", "has no contact"),
    "overlap": (lambda: step(obstructed(ddg.Plane((0.0, 0.0, 1.0)))), "rod 0", "'obstacle'", "overlap by", "separate them"),
})
each("contact", "between friction", [-1.0, NAN, INF, "rough"], lambda v: build_pair("rod", "floor", friction=v),
     "'rod' and 'floor'", "friction")
each("contact", "friction by direction", [(0.1, 0.2), (0.1, 0.2, NAN), [0.1, (0.2, 0.3)], (0.1, 0.2, "rough"), ()],
     lambda v: build_pair("rod", "floor", friction=v), "'rod' and 'floor'", "forwards, backwards and across", "three finite numbers")
each("contact", "friction across", [(0.1, 0.2, -0.3)], lambda v: build_pair("rod", "floor", friction=v),
     "'rod' and 'floor'", "friction across is -0.3", "zero or more")
each("contact", "friction by direction of two", [("rod", "odd"), ("odd", "odd")], lambda v: build_pair(*v, friction=(0.1, 0.2, 0.3)),
     "friction forwards, backwards and across", "rods on an obstacle", "one coefficient")
each("contact", "between stiffness", [0.0, -1.0, NAN, "hard"], lambda v: build_pair("rod", "odd", stiffness=v),
     "'rod' and 'odd'", "stiffness")
each("contact", "between range", [0.0, -1.0, NAN, "far"], lambda v: build_pair("rod", "odd", range=v), "'rod' and 'odd'", "range")
each("contact", "root length", [0.0, -1.0, NAN, "far"], lambda v: build_pair("rod", "floor", root_length=v), "'rod' and 'floor'",
     "root_length", "[m]")
refuse("contact", {
    "roots of a floor": (lambda: build_pair("floor", "rod", root_length=0.1), "'floor' and 'rod'", "of rods", "name rods first"),
    "two lengths of roots": (_two_roots, "'rod' and 'odd'", "0.2, and 0.1", "give one length"),
})
GAPS = [0.0, -1.0, NAN, "far"]
each("contact", "gap to push apart to", GAPS, lambda v: separate(in_contact(), v), "resolve_overlaps: gap", "positive")
refuse("contact", {
    "pushed apart too far": (lambda: separate(in_contact(), 1e3), "resolve_overlaps: gap is 1000 m", "may not exceed"),
    "pushed apart without contact": (lambda: separate(scene(), None), "resolve_overlaps", "add scene.contact()"),
    "pushed apart what is held": (
        lambda: separate(obstructed(ddg.Plane((0.0, 0.0, 1.0))), None), "resolve_overlaps", "'obstacle'", "rounds"),
})

each("obstacles", "shape", [None, ddg.Plane, "plane", 3], obstructed,
     "add_obstacle 'obstacle'", "give Plane, Sphere, Capsule, Box or Mesh")
ONE = (np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0, 1, 2]]))


UNTURNED = np.eye(3)


def _frames(count: int, shift=0.0, turn=UNTURNED):
    """Return a motion of rods by constant frames."""
    return ddg.FrameMotion(np.zeros((count, 3)), lambda t: (np.full((count, 3), shift), np.tile(turn, (count, 1, 1))))


refuse("roots", {
    "frames of two rods for one": (lambda: scene().clamp(0, motion=_frames(2)), "clamp", "frames of 2 rods", "there are 1"),
    "frames of an obstacle": (lambda: obstructed(ddg.Plane(), motion=_frames(1)), "add_obstacle", "Motion"),
    "frames that start displaced": (lambda: built(scene(), lambda s: s.clamp(0, motion=_frames(1, 1.0))), "t = 0 is (1.0, 1.0, 1.0)"),
    "frames that are no number": (lambda: _frames(1, NAN), "FrameMotion: translations at t = 0 of rod 0", "finite"),
    "frames of another shape": (lambda: _frames(1, turn=np.eye(2)), "FrameMotion: rotations", "(1, 2, 2)", "give (1, 3, 3)"),
    "frames that are no function": (lambda: ddg.FrameMotion(np.zeros((1, 3)), 3.0), "FrameMotion: frames is 3.0", "function"),
    "an animation that runs back": (lambda: ddg.AnimatedMesh([1.0, 0.0], np.stack([ONE[0]] * 2), ONE[1]), "times do not increase"),
    "an animation with a frame too few": (lambda: ddg.AnimatedMesh([0.0, 1.0], ONE[0][None], ONE[1]), "(1, 3, 3)", "(frames,)"),
    "an animation with nan": (lambda: ddg.AnimatedMesh([0.0], NAN * ONE[0][None], ONE[1]), "frame 0", "not finite"),
    "roots that are no points": (lambda: ddg.AnimatedMesh([0.0], ONE[0][None], ONE[1]).bind([[0.0, 1.0]]), "bind: roots", "(1, 2)"),
})
each("obstacles", "motion", ["up", 3.0, len], lambda v: obstructed(ddg.Plane(), motion=v), "add_obstacle", "Motion")
each("obstacles", "name", [3, "", None], lambda v: obstructed(ddg.Plane(), name=v), "add_obstacle: name", "text")
each("obstacles", "point", [(0.0, 0.0), NAN, "here", (0.0, 0.0, INF)], ddg.Plane, "Plane: point", "three finite numbers")
each("obstacles", "normal", [(0.0, 0.0), (0.0, 0.0, NAN)], lambda v: ddg.Plane(normal=v), "Plane: normal", "three finite numbers")
each("obstacles", "center", [(0.0, 0.0), NAN, None], lambda v: ddg.Sphere(v, 0.1), "Sphere: center", "three finite numbers")
each("obstacles", "radius of a ball", [0.0, -1.0, NAN, INF, "big"], lambda v: ddg.Sphere((0.0,) * 3, v), "Sphere: radius", "positive")
each("obstacles", "end", [(0.0, 0.0), NAN, None], lambda v: ddg.Capsule((0.0,) * 3, v, 0.1), "Capsule: end", "three finite numbers")
each("obstacles", "radius of a capsule", [0.0, -1.0, NAN, "big"], lambda v: ddg.Capsule((0.0,) * 3, (1.0,) * 3, v),
     "Capsule: radius", "positive")
each("obstacles", "half lengths", [1.0, (1.0, 1.0), (0.0, 1.0, 1.0), (1.0, -1.0, 1.0)], lambda v: ddg.Box((0.0,) * 3, v), "Box: half")
each("obstacles", "rotation", [np.eye(2), 2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), "turned", 0.3],
     lambda v: ddg.Box((0.0,) * 3, (1.0,) * 3, v), "Box: rotation", "(3, 3)")
each("obstacles", "half a thickness", [-1.0, NAN, INF, "thick"], lambda v: ddg.Mesh(*meshes.sphere(0), v),
     "Mesh: radius", "zero or more")
refuse("obstacles", {
    "a normal of zero": (lambda: ddg.Plane(normal=(0.0, 0.0, 0.0)), "Plane", "normal is zero", "not all zero"),
    "a capsule of one point": (lambda: ddg.Capsule((1.0,) * 3, (1.0,) * 3, 0.1), "Capsule", "one point", "Sphere"),
    "a mesh of nothing": (lambda: ddg.Mesh(None, None), "Mesh", "(points, 3)"),
    "a mesh of no triangles": (lambda: ddg.Mesh(FLAT, np.zeros((0, 3), int)), "Mesh", "(T, 3)"),
    "a mesh with a hole": (lambda: ddg.Mesh(FLAT * [1.0, 1.0, NAN], [[0, 1, 2]]), "Mesh", "finite"),
    "a mesh of other points": (lambda: ddg.Mesh(FLAT, [[0, 1, 3]]), "Mesh: triangle 0", "vertices are 0 to 2"),
    "a mesh of fractions": (lambda: ddg.Mesh(FLAT, [[0.0, 1.0, 2.0]]), "Mesh", "whole numbers"),
    "a triangle without area": (lambda: step(obstructed(ddg.Mesh(FLAT, [[0, 1, 2]]))), "triangle 0", "'obstacle'", "no area"),
    "a triangle of two points": (lambda: step(obstructed(ddg.Mesh(FLAT, [[0, 1, 1]]))), "triangle 0", "'obstacle'", "no area"),
    "displacements of others": (
        lambda: obstructed(ddg.Sphere((0.0, 0.0, -1.0), 0.1), motion=ddg.Motion(lambda t: np.zeros((3, 3)))),
        *("add_obstacle 'obstacle'", "3 displacements", "1 points", "one for all"),
    ),
    "a motion that starts elsewhere": (
        lambda: built(obstructed(ddg.Plane((0.0, 0.0, -1.0)), motion=ddg.Motion(lambda t: (0.0, 0.0, 1.0 + t)))),
        *("add_obstacle", "t = 0", "supports start where they are"),
    ),
    "a motion that fails": (
        lambda: step(obstructed(ddg.Plane((0.0, 0.0, -1.0)), motion=ddg.Motion(lambda t: (0.0, 0.0, NAN if t else 0.0)))),
        *("translation", "not finite at t = 0.001"),
    ),
})


def _rough():
    return built(in_contact(friction=0.2))


refuse("contact", {
    "friction in a spectrum": (
        lambda: (model := _rough(), ddg.stability.spectrum(model, model.state())),
        *("contact: stability", "it is 0.2 between", "friction=0", "statics.solve"),
    ),
    "friction without an increment": (
        lambda: ddg.statics.solve(_rough(), start=1.0), "contact: friction", "from 1 to 1", "start other than end",
    ),
    "follows": (lambda: ddg.statics.solve(_rough(), mode="follow"), "contact: ", "paths", "it is 0.2 between", "friction=0"),
    "factors": (lambda: ddg.statics.solve(built(in_contact()), solver="direct"), "contact: ", "'direct'", "solver='auto'"),
    "path": (lambda: ddg.continuation.Continuation(_rough()), "contact: ", "paths", "it is 0.2 between", "friction=0"),
    "relaxation": (lambda: relax(built(in_contact())), "contact: ", "relaxation", "statics.solve"),
    "midpoint": (lambda: step(in_contact(), scheme="implicit_midpoint"), "contact: ", "implicit_euler"),
    "projective": (lambda: step(in_contact(), solver="projective"), "contact: ", "'newton'"),
    "asked without": (lambda: (model := built(scene()), model.contacts(model.state())), "contacts: ", "add scene.contact()"),
    "an oblique plane of symmetry": (
        lambda: step(_on_oblique_plane()), "contact: ", "oblique plane", "axis of space"
    ),
})


def _shell_over_floor(friction) -> ddg.Model:
    made = ddg.Scene()
    made.add_shell(*meshes.rectangle(3, 3), thickness=0.01, material=RUBBER, name="shell")
    made.add_obstacle(ddg.Plane((0.0, 0.0, -1.0)), name="floor")
    made.contact()
    made.contact_between("shell", "floor", friction=friction)
    return built(made)


def _on_oblique_plane() -> ddg.Scene:
    points, triangles = meshes.rectangle(3, 3)
    made = ddg.Scene()
    made.add_shell(points @ TURN, triangles, thickness=0.01, material=RUBBER)
    made.symmetry(0, [0, 4, 8, 12], TURN[0])
    made.contact()
    return made
