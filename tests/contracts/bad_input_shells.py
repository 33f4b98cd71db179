"""Bad inputs to shells: meshes, supports, loads, joints, attachments, meridians, mesh generators, and build."""

# fmt: off
import numpy as np
from bad_inputs import DEVICE, DOME, INF, NAN, RUBBER, TUBE, built, dome, each, refuse, rods, sheet

import ddg_warp as ddg
from ddg_warp.geometry import meshes

M = ddg.Motion
STILL = M(translation=lambda t: (0.0, 0.0, 0.0))
SWING = M(translation=lambda t: (t, 0.0, 0.0))

# --- shells. Vertex (i, j) of the sheet is i + 4 j; 5, 6, 9 and 10 are inside ---
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
TWO = [[0, 1, 2], [0, 2, 3]]


def shell(points=SQUARE, triangles=TWO, **options):
    """Add a shell and build."""
    scene = ddg.Scene()
    scene.add_shell(points, triangles, **({"thickness": 0.1, "material": RUBBER, "name": "odd"} | options))
    return built(scene)


def _square_with(vertex, value):
    points = SQUARE.copy()
    points[vertex] = value
    return points


refuse("shells", {
    "points of two": (lambda: shell(SQUARE[:, :2]), "'odd'", "(4, 2)", "(P, 3)"),
    "points of letters": (lambda: shell([["a", "b", "c"]] * 4), "'odd'", "points", "numbers"),
    "points not finite": (lambda: shell(_square_with(2, NAN)), "'odd'", "vertex 2", "non-finite"),
    "quadrilaterals": (lambda: shell(triangles=[[0, 1, 2, 3]]), "'odd'", "(1, 4)", "(T, 3)"),
    "triangles of fractions": (lambda: shell(triangles=[[0.0, 1.0, 2.5]]), "'odd'", "float64", "whole"),
    "no triangles": (lambda: shell(triangles=np.zeros((0, 3), int)), "'odd'", "(0, 3)", "one at least"),
    "ragged triangles": (lambda: shell(triangles=[[0, 1, 2], [0, 2]]), "'odd'", "three vertices"),
    "vertex that is not": (lambda: shell(triangles=[[0, 1, 2], [0, 2, 4]]), "'odd'", "triangle 1", "0 to 3"),
    "vertex before the first": (lambda: shell(triangles=[[0, 1, 2], [0, 2, -1]]), "'odd'", "triangle 1", "0 to 3"),
    "vertex twice": (lambda: shell(triangles=[[0, 1, 2], [0, 2, 2]]), "'odd'", "triangle 1", "twice"),
    "degenerate": (lambda: shell(_square_with(1, (0.5, 0.5, 0.0))), "'odd'", "triangle 0", "on a line"),
    "unused vertex": (lambda: shell(triangles=[[0, 1, 2]]), "'odd'", "vertex 3", "no triangle"),
    "turned neighbour": (lambda: shell(triangles=[[0, 1, 2], [2, 0, 3]]), "'odd'", "triangles 0 and 1", "direction"),
    "three at an edge": (
        lambda: shell(np.vstack([SQUARE, [[0.5, 0.5, 1.0]]]), [[0, 1, 2], [0, 2, 3], [0, 2, 4]]), "'odd'", "3 triangles"),
    "back to back": (lambda: shell(triangles=[[0, 1, 2], [0, 2, 3], [0, 3, 2]]), "'odd'"),
    "folded back": (lambda: shell(_square_with(3, (1.0, 0.1, 0.0))), "'odd'", "fold back", "move a vertex"),
    "no material": (lambda: shell(material=None), "'odd'", "material", "Material(...)"),
    "bending unknown": (lambda: shell(bending="stiff"), "'odd'", "'stiff'", "'midedge_dof'", "'hinge'"),
    "bending false": (lambda: shell(bending=False), "'odd'", "bending", "'hinge'"),
    "membrane unknown": (lambda: shell(membrane="none"), "'odd'", "'none'", "'flat'", "'curved'"),
    "curved with hinges": (lambda: shell(bending="hinge", membrane="curved"), "'curved'", "midedge_dof"),
    "rest unknown": (lambda: shell(rest="round"), "'odd'", "'round'", "'flat'"),
    "rest one array": (lambda: shell(rest=np.zeros((2, 3))), "'odd'", "rest"),
    "rest a number": (lambda: shell(rest=5), "'odd'", "rest", "two arrays"),
    "rest of wrong shape": (lambda: shell(rest=(np.ones((3, 3)), np.zeros((2, 3)))), "'odd'", "(3, 3)", "(2, 3)"),
    "rest without area": (lambda: shell(rest=(np.ones((2, 3)), np.zeros((2, 3)))), "'odd'", "triangle 0", "no area"),
    "isometric and curved": (lambda: shell(_square_with(2, (1.0, 1.0, 0.5)), bending="isometric"), "flat rest shape", "hinge"),
    "isometric and clamped": (
        lambda: built(sheet(bending="isometric"), lambda s: s.clamp_boundary(0, [0, 1])), "isometric", "no clamped"),
    "in the plane": (lambda: built(sheet(scene=ddg.Scene(dimension=2))), "dimension 3"),
})
each(
    "shells",
    "thickness",
    [0.0, -1.0, NAN, [0.1, 0.1, 0.1], [0.1, -0.1], "thin", None],
    lambda v: shell(thickness=v),
    "'odd'",
    "thickness",
)

MOVED = lambda t: np.zeros((3, 3))  # noqa: E731
ON_SHELLS = {
    "hold nothing": (lambda s: s.hold(0, []), "vertices", "nothing is chosen"),
    "hold a far vertex": (lambda s: s.hold(0, [16]), "vertex 16", "16 vertices"),
    "hold a vertex from behind": (lambda s: s.hold(0, [-1]), "vertex -1", "16 vertices"),
    "hold a fraction": (lambda s: s.hold(0, [0.5]), "vertices [0.5]", "whole"),
    "hold by a short mask": (lambda s: s.hold(0, np.ones(4, bool)), "mask of 4", "there are 16"),
    "hold by an empty mask": (lambda s: s.hold(0, np.zeros(16, bool)), "False everywhere"),
    "hold another shell": (lambda s: s.hold(1, [0]), "shell 1", "1 shells"),
    "hold a shell from behind": (lambda s: s.hold(-1, [0]), "shell -1", "1 shells"),
    "hold no shell": (lambda s: s.hold(None, [0]), "shell"),
    "hold no components": (lambda s: s.hold(0, [0], ""), "hold", "''", "'xyz'"),
    "hold components": (lambda s: s.hold(0, [0], "r"), "hold", "'r'", "'xyz'"),
    "hold by a function": (lambda s: s.hold(0, [0], motion=lambda t: t), "hold: motion", "Motion("),
    "hold each of others": (lambda s: s.hold(0, [0, 1], motion=M(MOVED)), "3 displacements of 2 vertices"),
    "hold away": (lambda s: s.hold(0, [0], motion=M(lambda t: (0.0, 0.0, 1.0))), "hold", "t = 0", "subtract"),
    "hold still and moving": (
        lambda s: (s.hold(0, [0, 1]), s.hold(0, [1, 2], "z", SWING)), "(0.333333, 0, 0)", "fixed by one", "along z"),
    "hold by two motions": (
        lambda s: (s.hold(0, [1], motion=STILL), s.hold(0, [1, 2], "z", SWING)), "(0.333333, 0, 0)", "two motions along z"),
    "clamp one vertex": (lambda s: s.clamp_boundary(0, [5]), "clamp_boundary", "vertex 5", "use hold"),
    "clamp vertices apart": (lambda s: s.clamp_boundary(0, [0, 1, 10]), "clamp_boundary", "vertex 10", "use hold"),
    "clamp nothing": (lambda s: s.clamp_boundary(0, []), "vertices", "nothing is chosen"),
    "symmetry axis": (lambda s: s.symmetry(0, [0, 1], "w"), "symmetry", "'w'", "'x'"),
    "symmetry of no plane": (lambda s: s.symmetry(0, [0, 1, 2, 3, 7], "y"), "vertex 7", "off the plane y = 0"),
    "symmetry of one vertex": (lambda s: s.symmetry(0, [0], "y"), "symmetry", "vertex 0", "boundary edge"),
    "symmetry inside": (lambda s: s.symmetry(0, [4, 5, 6, 7], "y"), "symmetry", "boundary edge"),
    "force nan": (lambda s: s.add_vertex_force(0, [0], (NAN, 0.0, 0.0)), "add_vertex_force", "finite"),
    "force of two": (lambda s: s.add_vertex_force(0, [0], (1.0, 0.0)), "add_vertex_force", "(1, 3)"),
    "forces of others": (lambda s: s.add_vertex_force(0, [0, 1], np.ones((3, 3))), "add_vertex_force", "(2, 3)"),
    "force twice": (lambda s: s.add_vertex_force(0, [4, 4], (0.0, 0.0, 1.0)), "4 is named twice"),
    "force nowhere": (lambda s: s.add_vertex_force(0, [], (0.0, 0.0, 1.0)), "nothing is chosen"),
    "force amplitude": (lambda s: s.add_vertex_force(0, [0], (0.0, 0.0, 1.0), 2.0), "amplitude", "function"),
    "edge force inside": (lambda s: s.add_edge_force(0, [4, 5, 6, 7], (0.0, 0.0, 1.0)), "boundary edge", "vertex 4", "pairs"),
    "edge force across": (lambda s: s.add_edge_force(0, [0, 15], (0.0, 0.0, 1.0)), "boundary edge", "vertex 0"),
    "edge force of one": (lambda s: s.add_edge_force(0, [3], (0.0, 0.0, 1.0)), "boundary edge", "vertex 3"),
    "edge force of no edge": (lambda s: s.add_edge_force(0, [[0, 7]], (0.0, 0.0, 1.0)), "no edge between the vertices 0 and 7"),
    "edge force twice": (lambda s: s.add_edge_force(0, [[0, 1], [1, 0]], (0.0, 0.0, 1.0)), "named twice"),
    "edge force a number": (lambda s: s.add_edge_force(0, [0, 1], 1.0), "add_edge_force", "three finite"),
    "pressure nan": (lambda s: s.add_pressure(0, NAN), "add_pressure", "finite"),
    "pressure of others": (lambda s: s.add_pressure(0, [1.0, 2.0]), "add_pressure", "(18,)"),
    "pressure a word": (lambda s: s.add_pressure(0, "high"), "add_pressure", "numbers"),
    "pressure on nothing": (lambda s: s.add_pressure(0, 1.0, []), "add_pressure", "nothing is chosen"),
    "pressure far away": (lambda s: s.add_pressure(0, 1.0, [18]), "triangle 18", "18"),
    "pressure twice": (lambda s: s.add_pressure(0, 1.0, [0, 0]), "0 is named twice"),
    "pressure dead no": (lambda s: s.add_pressure(0, 1.0, dead="no"), "dead", "True or False"),
    "pressure amplitude": (lambda s: s.add_pressure(0, 1.0, amplitude=1.0), "amplitude", "function"),
}
refuse("shells", {name: (lambda a=add: built(sheet(), a), *words) for name, (add, *words) in ON_SHELLS.items()})


# --- joints and attachments ---
def rods_and_sheet() -> ddg.Scene:
    """Return a scene with the rods and the sheet."""
    return sheet(scene=rods())


refuse("joints", {
    "one member": (lambda: rods().join([(0, 0)]), "join", "two different members"),
    "the same twice": (lambda: rods().join([(0, 0), (0, 0)]), "join", "two different members"),
    "no pair": (lambda: rods().join([0, 3]), "join: 0", "(rod, node)"),
    "a rod and a number": (lambda: rods().join([(0, 0), 3]), "join: 3", "(rod, node)"),
    "triples": (lambda: rods().join([(0, 0, 0), (1, 0)]), "join: (0, 0, 0)", "(rod, node)"),
    "number": (lambda: rods().join(5), "join: 5", "(rod, node)"),
    "nothing": (lambda: rods().join([]), "join", "two different members"),
    "no rod": (lambda: rods().join([(0, 0), (2, 0)]), "rod 2", "2 rods"),
    "no node": (lambda: rods().join([(0, 0), (1, 5)]), "node 5", "rod 1", "5 nodes"),
    "node fraction": (lambda: rods().join([(0, 0), (1, 0.5)]), "join: node", "whole"),
    "nothing coincides": (lambda: rods().join_coincident([0]), "join_coincident", "no nodes coincide", "cross or meet"),
    "coincident rod": (lambda: rods().join_coincident([0, 7]), "rod 7", "2 rods"),
    "coincident rigid": (lambda: rods().join_coincident(rigid="no"), "rigid", "True or False"),
    "rigid no": (lambda: rods().join([(0, 0), (1, 0)], rigid="no"), "rigid", "True or False"),
    "apart": (lambda: built(rods(), lambda s: s.join([(0, 0), (1, -1)])), "joint 0", "apart at rest"),
    "rigid without twist": (lambda: built(rods(twist=False), lambda s: s.join([(0, 0), (1, 0)])), "rod 1", "rigid=False"),
    "attach no rod": (lambda: rods_and_sheet().attach(2, [0], 0, [0]), "rod 2", "2 rods"),
    "attach rods": (lambda: rods_and_sheet().attach([0, 1], [0], 0, [0]), "attach: rod", "one whole number"),
    "attach no node": (lambda: rods_and_sheet().attach(1, [5], 0, [0]), "node 5", "rod 1"),
    "attach no shell": (lambda: rods_and_sheet().attach(1, [0], 1, [0]), "shell 1", "1 shells"),
    "attach no vertex": (lambda: rods_and_sheet().attach(1, [0], 0, [16]), "vertex 16", "16 vertices"),
    "attach others": (lambda: rods_and_sheet().attach(1, [0, 1], 0, [0]), "2 nodes", "1 vertices", "as many"),
    "attach nothing": (lambda: rods_and_sheet().attach(1, [], 0, []), "nothing is chosen"),
    "attach spin": (lambda: rods_and_sheet().attach(1, [0], 0, [0], spin="stuck"), "attach: spin", "'stuck'", "'glued' or 'free'"),
    "attach apart": (lambda: built(rods_and_sheet(), lambda s: s.attach(1, [0], 0, [5])), "node 0 of rod 1", "vertex 5", "apart"),
})

# --- meridians ---
each("meridians", "points", [np.zeros((5, 3)), np.zeros((2, 2)), "round", [[0.0, 1.0], [1.0]]],
     dome, "'dome'", "points")
each("meridians", "thickness", [0.0, -1.0, NAN, [0.1, 0.1], "thin"], lambda v: dome(thickness=v), "'dome'", "thickness")


def _dome_with(node, value):
    points = DOME.copy()
    points[node] = value
    return points


refuse("meridians", {
    "not finite": (lambda: dome(_dome_with(2, NAN)), "'dome'", "node 2", "non-finite"),
    "negative radius": (lambda: dome(_dome_with(2, (-0.1, 1.0))), "'dome'", "node 2", "negative radius"),
    "on the axis": (lambda: dome(_dome_with(2, (0.0, 0.5))), "'dome'", "node 2", "on the axis"),
    "no length": (lambda: dome(_dome_with(3, DOME[2])), "'dome'", "edge 2", "no length"),
    "material": (lambda: dome(material=1e7), "'dome'", "material"),
    "rest unknown": (lambda: built(dome(rest="round")), "'round'", "'flat'"),
    "rest shape": (lambda: built(dome(rest=(np.ones((3, 2)), np.zeros((6, 2))))), "'dome'", "rest"),
    "rest negative": (lambda: built(dome(rest=(-np.ones((5, 2)), np.zeros((6, 2))))), "'dome'", "positive metric"),
    "gravity across": (lambda: built(_sideways()), "gravity", "along z"),
    "hold y": (lambda: dome().hold_ring(0, 5, "y"), "hold_ring", "'y'", "'xz'"),
    "hold nothing": (lambda: dome().hold_ring(0, []), "nodes", "nothing is chosen"),
    "hold far": (lambda: dome().hold_ring(0, 6), "node 6", "6 nodes"),
    "hold another": (lambda: dome().hold_ring(1, 0), "axisymmetric shell 1", "1 so far"),
    "hold by a function": (lambda: dome().hold_ring(0, 5, motion=lambda t: t), "hold_ring: motion", "Motion("),
    "hold turning": (lambda: dome().hold_ring(0, 5, motion=M(angle=lambda t: t)), "hold_ring", "axis=(0, 1, 0)"),
    "hold away": (lambda: built(dome(), lambda s: s.hold_ring(0, 5, motion=M(lambda t: (0.0, 0.0, 1.0)))), "hold_ring", "t = 0"),
    "hold still and moving": (
        lambda: built(dome(), lambda s: (s.hold_ring(0, 5), s.hold_ring(0, 5, "z", SWING))), "fixed by one", "along z"),
    "clamp end": (lambda: dome().clamp_ring(0, "middle"), "'middle'", "'first'", "'last'"),
    "clamp pole": (lambda: dome().clamp_ring(0, "first"), "pole", "hold_ring"),
    "clamp tangent": (lambda: dome().clamp_ring(0, "last", tangent=(0.0, 0.0)), "tangent", "not zero"),
    "clamp tangent of three": (lambda: dome().clamp_ring(0, "last", tangent=(0.0, 0.0, 1.0)), "tangent", "(2,)"),
    "force at the pole": (lambda: dome().add_ring_force(0, 0, (0.0, 1.0)), "pole", "add_pole_force"),
    "force of three": (lambda: dome().add_ring_force(0, 5, (0.0, 1.0, 0.0)), "add_ring_force", "(1, 2)"),
    "force nan": (lambda: dome().add_ring_force(0, 5, (0.0, NAN)), "add_ring_force", "finite"),
    "force twice": (lambda: dome().add_ring_force(0, [5, 5], (0.0, 1.0)), "5 is named twice"),
    "force amplitude": (lambda: dome().add_ring_force(0, 5, (0.0, 1.0), 2.0), "amplitude", "function"),
    "pole force at a rim": (lambda: dome().add_pole_force(0, 1.0, "last"), "no pole", "add_ring_force"),
    "pole force nan": (lambda: dome().add_pole_force(0, NAN), "add_pole_force", "finite"),
    "pressure nan": (lambda: dome().add_axisymmetric_pressure(0, NAN), "add_axisymmetric_pressure", "finite"),
    "pressure far": (lambda: dome().add_axisymmetric_pressure(0, 1.0, [5]), "edge 5", "5"),
    "pressure on nothing": (lambda: dome().add_axisymmetric_pressure(0, 1.0, []), "nothing is chosen"),
    "pressure dead": (lambda: dome().add_axisymmetric_pressure(0, 1.0, dead=1), "dead", "True or False"),
    "tube's end": (lambda: dome(TUBE).symmetry_ring(0, "top"), "'top'", "'first'"),
})


def _sideways():
    scene = dome()
    scene.gravity = (1.0, 0.0, 0.0)
    return scene


# --- meshes ---
BAD_COUNTS, BAD_LENGTHS = [0, -1, 3.5, "3", None, True], [0.0, -1.0, NAN, INF, "1", None]
each("meshes", "nx", BAD_COUNTS, lambda v: meshes.rectangle(v, 3), "nx", "whole number")
each("meshes", "ny", BAD_COUNTS, lambda v: meshes.jittered_rectangle(3, v), "ny", "whole number")
each("meshes", "size", [(1.0, 0.0), (-1.0, 1.0), 3.0, "1", (1.0, NAN), (1.0, 1.0, 1.0)][:2] + [(1.0, NAN), "1", (1.0, 1.0, 1.0)],
     lambda v: meshes.rectangle(3, 3, v), "size")
each("meshes", "pattern", ["hexagonal", None, 3], lambda v: meshes.rectangle(3, 3, pattern=v), "pattern", "'crossed'")
each("meshes", "pattern of a ring", ["crossed"], lambda v: meshes.annulus(2, 8, 1.0, 2.0, pattern=v), "pattern", "'right'")
each("meshes", "jitter", [0.5, -0.1, NAN, "much"], lambda v: meshes.jittered_rectangle(3, 3, jitter=v), "jitter", "less than 0.5")
each("meshes", "rings", BAD_COUNTS, meshes.disc, "rings", "whole number")
each("meshes", "disc's radius", BAD_LENGTHS, lambda v: meshes.disc(2, v), "radius", "positive")
each("meshes", "inner", [2.0, 3.0], lambda v: meshes.annulus(2, 8, v, 2.0), "inner", "less than the outer")
each("meshes", "outer", BAD_LENGTHS, lambda v: meshes.annulus(2, 8, 1.0, v), "outer", "positive")
each("meshes", "slit", ["yes", 1], lambda v: meshes.annulus(2, 8, 1.0, 2.0, slit=v), "slit", "True or False")
each("meshes", "n_around", [2, 3.5, "8"], lambda v: meshes.cylinder(v, 3, 1.0, 1.0), "n_around", "at least 3")
each("meshes", "length", BAD_LENGTHS, lambda v: meshes.cylinder(8, 3, 1.0, v), "length", "positive")
each(
    "meshes",
    "angle",
    [0.0, 7.0, -1.0, NAN, "half"],
    lambda v: meshes.cylinder_panel(3, 3, 1.0, 1.0, v),
    "angle",
    "less than 2 pi",
)
each("meshes", "sphere's radius", BAD_LENGTHS, lambda v: meshes.sphere(1, v), "radius", "positive")
each("meshes", "subdivisions", [-1, 1.5, "2"], meshes.sphere, "subdivisions", "whole number")
each("meshes", "cap's angle", [0.0, 4.0, NAN], lambda v: meshes.spherical_cap(2, 1.0, v), "angle", "less than pi")
each("meshes", "minor", [2.0, 3.0], lambda v: meshes.torus(8, 8, 2.0, v), "minor", "thinner")
each("meshes", "tolerance", [0.0, -1.0, NAN, None], lambda v: meshes.weld(*meshes.rectangle(2, 2), v), "tolerance", "positive")
refuse("meshes", {
    "odd around": (lambda: meshes.cylinder(5, 3, 1.0, 1.0, "alternating"), "alternating", "even number"),
    "welded to nothing": (lambda: meshes.weld(*meshes.rectangle(2, 2), 10.0), "weld", "no triangle"),
})

# --- build ---
each("build", "worlds", [0, -1, 1.5, None, "two", True], lambda v: rods().build(DEVICE, worlds=v), "worlds", "whole number")
each("build", "precision", ["half", 64, "double"], lambda v: rods().build(DEVICE, v), "float64", "mixed", "float32")
each("build", "device", ["gpu", "cuda:99", 3.5], lambda v: rods().build(v), "device", "cpu")
refuse("build", {
    "nothing": (lambda: ddg.Scene().build(DEVICE), "no rods", "add_rods"),
    "gravity set later": (lambda: built(rods(), lambda s: setattr(s, "gravity", (0.0, 1.0))), "gravity", "three finite"),
})
