"""Bad input is refused with an error that names the object, its index and the remedy, and nothing is built from it."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.integrate import statics
from ddg_warp.stability import spectrum

NAN = float("nan")
STIFFNESS = ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0, mass_per_length=1.0, rotary_inertia=0.01)
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
RING = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def line(nodes: int = 5, **moved) -> np.ndarray:
    """A straight rod along x; `n3=(1, 2, 3)` moves node 3."""
    points = np.zeros((nodes, 3))
    points[:, 0] = np.linspace(0.0, 1.0, nodes)
    for name, value in moved.items():
        points[int(name[1:])] = value
    return points


def scene_of(points=None, scene=None, **options) -> ddg.Scene:
    """A scene with a good rod 0 of 7 nodes and the rod in question, which is rod 1 and called 'odd'."""
    scene = scene or ddg.Scene()
    scene.add_rod(line(7), section=STIFFNESS)
    scene.add_rod(line() if points is None else points, **({"section": STIFFNESS, "name": "odd"} | options))
    return scene


def refused(action, *words, error=ddg.SceneError) -> None:
    """The action raises, and its message holds all the words."""
    with pytest.raises(error) as caught:
        action()
    missing = [word for word in words if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"


def test_the_good_scene_builds(device):
    """Otherwise all below would be refused for another reason."""
    scene = scene_of()
    scene.clamp(1, edges=[0, -1])
    assert scene.build(device).curves.counts.tolist() == [7, 5]


# What is wrong with a rod; rods of every kind are compiled by the same code, so that a twisted one in space stands for all.
ROD = {
    "zero-length edge": ({"points": line(n3=(0.5, 0.0, 0.0))}, "rod 1", "'odd'", "edge 2", "no length", "remove"),
    "nan point": ({"points": line(n3=(NAN, 0.0, 0.0))}, "rod 1", "'odd'", "node 3", "non-finite"),
    "infinite point": ({"points": line(n4=(np.inf, 0.0, 0.0))}, "rod 1", "node 4", "non-finite"),
    "one point": ({"points": np.zeros(3)}, "rod 1", "1 nodes", "at least 3"),
    "too few nodes": ({"points": line(2)}, "rod 1", "2 nodes", "at least 3"),
    "too few nodes of a chain": ({"points": line(1), "bend": False}, "rod 1", "1 nodes", "at least 2"),
    "too few nodes of a ring": ({"points": line(2), "bend": False, "closed": True}, "rod 1", "2 nodes", "at least 3"),
    "folded": ({"points": line(n4=(0.6, 0.0, 0.0))}, "rod 1", "edges 2 and 2 + 1", "fold back", "move a node"),
    "folded at the seam": ({"points": line(), "closed": True}, "rod 1", "fold back", "move a node"),
    "curved without twist": ({"points": RING, "twist": False}, "rod 1", "curved", "twist=True", "natural='straight'"),
    "two sections without twist": (
        {"section": ddg.Rectangle(0.1, 0.2), "material": RUBBER, "twist": False},
        *("rod 1", "EI1 and EI2", "twist=True"),
    ),
    "natural not finite": ({"natural": (0.0, [0.0, NAN, 0.0], 0.0)}, "rod 1", "natural", "vertex 1", "finite"),
    "natural of wrong shape": ({"natural": (np.zeros(7), 0.0, 0.0)}, "rod 1", "natural", "3 vertices"),
    "natural of two": ({"natural": (0.0, 0.0)}, "rod 1", "natural", "3 arrays"),
    "natural unknown": ({"natural": "curly"}, "rod 1", "'curly'", "'shape'", "'straight'"),
    "natural a number": ({"natural": 3.0}, "rod 1", "natural", "3 arrays"),
    "natural no number": ({"natural": ("a", 0.0, 0.0)}, "rod 1", "natural", "numbers"),
    "director of wrong shape": ({"director": (1.0, 0.0)}, "rod 1", "director", "(2,)", "(rods, edges, 3)"),
    "director of another rod": ({"director": np.ones((1, 7, 3))}, "rod 1", "director", "(1, 7, 3)"),
    "director not finite": ({"director": (0.0, NAN, 1.0)}, "rod 1", "director", "edge 0", "finite"),
    "director along the rod": ({"director": (2.0, 0.0, 0.0)}, "rod 1", "director", "edge 0", "parallel", "across"),
    "director along an edge": (
        {"director": np.array([[[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])},
        *("rod 1", "director", "edge 2", "parallel"),
    ),
}


@pytest.mark.parametrize("name", ROD)
def test_rod(device, name):
    options, *words = ROD[name]
    scene = scene_of(**options)
    refused(lambda: scene.build(device), *words)


@pytest.mark.parametrize("what", ["EA", "EI1", "EI2", "GJ"])
@pytest.mark.parametrize("value", [-1.0, NAN, np.inf, 0.0, [1.0, 2.0, 3.0], [1.0, 1.0, -1.0, 1.0], "stiff"])
def test_stiffness(device, what, value):
    section = ddg.Stiffness(**({"EA": 1e3, "EI1": 1.0, "EI2": 1.0, "GJ": 1.0, "mass_per_length": 1.0} | {what: value}))
    if value == 0.0:
        words = ("is zero", "bend=False")
    elif value in ("stiff", [1.0, 2.0, 3.0]):
        words = ("broadcast", "4 edges")
    else:
        words = ("finite and not negative",)
    refused(lambda: scene_of(section=section).build(device), "rod 1", "'odd'", what, *words)


@pytest.mark.parametrize("what", ["mass_per_length", "rotary_inertia", "radius", "viscosity"])
@pytest.mark.parametrize("value", [-1.0, NAN, np.ones(7)], ids=["negative", "nan", "shape"])
def test_inertia(device, what, value):
    section = ddg.Stiffness(**({"EA": 1e3, "EI1": 1.0, "GJ": 1.0, "mass_per_length": 1.0} | {what: value}))
    refused(lambda: scene_of(section=section).build(device), "rod 1", "'odd'", what)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ddg.Material(-1.0), ("young", "-1.0", "positive")),
        (lambda: ddg.Material(0.0), ("young", "0.0", "positive")),
        (lambda: ddg.Material(NAN), ("young", "nan", "positive")),
        (lambda: ddg.Material("soft"), ("young", "soft", "positive")),
        (lambda: ddg.Material(1.0, -1.0), ("poisson", "-1.0", "0.5")),
        (lambda: ddg.Material(1.0, 0.51), ("poisson", "0.51", "0.5")),
        (lambda: ddg.Material(1.0, NAN), ("poisson", "nan", "0.5")),
        (lambda: ddg.Material(1.0, 0.3, -1.0), ("density", "-1.0", "not negative")),
        (lambda: ddg.Material(1.0, 0.3, 1.0, -1.0), ("viscosity", "-1.0", "not negative")),
        (lambda: ddg.Circle(-0.1), ("Circle", "radius", "-0.1", "positive")),
        (lambda: ddg.Circle(NAN), ("Circle", "radius", "nan", "positive")),
        (lambda: ddg.Circle([0.1, 0.0]), ("Circle", "radius", "positive")),
        (lambda: ddg.Ellipse(0.1, 0.0), ("Ellipse", "b = 0.0", "positive")),
        (lambda: ddg.Rectangle(-1.0, 1.0), ("Rectangle", "width", "positive")),
    ],
)
def test_material_and_section(make, words):
    refused(make, *words)


def test_extremes_that_are_fine():
    ddg.Material(1.0, 0.5, 0.0)
    ddg.Material(1.0, -0.99)
    ddg.Circle(np.array([0.1, 0.2]))


# What `add_rods` itself refuses.
@pytest.mark.parametrize(
    ("points", "options", "words"),
    [
        (np.zeros((5, 2)), {}, ("'odd'", "(1, 5, 2)", "(rods, nodes, 3)")),
        (np.zeros((1, 2, 5, 3)), {}, ("'odd'", "(1, 1, 2, 5, 3)", "(rods, nodes, 3)")),
        ([[0, 0, 0], [1, 1]], {}, ("'odd'", "(rods, nodes, 3)")),
        ([["a", "b", "c"]] * 4, {}, ("'odd'", "(rods, nodes, 3)")),
        (None, {"section": 3.0}, ("'odd'", "section 3.0", "Circle")),
        (None, {"section": None}, ("'odd'", "section None", "Circle")),
        (None, {"section": ddg.Circle(0.1)}, ("'odd'", "Circle", "material=Material")),
        (None, {"section": ddg.Circle(0.1), "material": 1e7}, ("'odd'", "Circle", "material=Material")),
    ],
)
def test_add_rod(points, options, words):
    scene = ddg.Scene()
    refused(lambda: scene_of(points, scene, **options), *words)
    assert scene.rod_count == 1  # only the good one


def test_no_rods(device):
    refused(ddg.Scene().build, "no rods", "add_rods")
    scene = ddg.Scene()
    scene.add_rods(np.zeros((0, 5, 3)), section=STIFFNESS, name="odd")
    refused(lambda: scene.build(device), "'odd'", "at least")


# Supports, loads and masses: (what is done to the scene, words). Rod 0 has 7 nodes, rod 1 has 5.
ADDED = {
    "clamp edge": (lambda s: s.clamp([0, 1], [5]), "edge 5", "rod 1", "4 edges"),
    "clamp last edge": (lambda s: s.clamp(1, [-5]), "edge -5", "rod 1", "4 edges"),
    "clamp fraction": (lambda s: s.clamp(1, [1.5]), "edges [1.5]", "whole"),
    "fix node": (lambda s: s.fix([0, 1], [5]), "node 5", "rod 1", "5 nodes"),
    "fix node from behind": (lambda s: s.fix(1, [-6]), "node -6", "rod 1", "5 nodes"),
    "fix twist": (lambda s: s.fix_twist(1, [4]), "edge 4", "rod 1", "4 edges"),
    "rod": (lambda s: s.fix(2, [0]), "rod 2", "2 rods"),
    "rod before the first": (lambda s: s.clamp([0, -1], [0]), "rod -1", "2 rods"),
    "rod fraction": (lambda s: s.clamp_end(0.5), "rods [0.5]", "whole"),
    "force node": (lambda s: s.add_force(1, 5, (0.0, 0.0, 1.0)), "node 5", "rod 1", "5 nodes"),
    "force rod": (lambda s: s.add_force(7, 0, (0.0, 0.0, 1.0)), "rod 7", "2 rods"),
    "force node fraction": (lambda s: s.add_force(1, 0.5, (0.0, 0.0, 1.0)), "node", "0.5", "whole"),
    "force nan": (lambda s: s.add_force(1, 3, (0.0, 0.0, NAN)), "force on node 3", "three finite"),
    "force of two": (lambda s: s.add_force(1, 3, (0.0, 1.0)), "force on node 3", "three finite"),
    "force a number": (lambda s: s.add_force(1, 3, 1.0), "force on node 3", "three finite"),
    "amplitude": (lambda s: s.add_force(1, 3, (0.0, 0.0, 1.0), amplitude=2.0), "amplitude", "2.0", "function"),
    "moment edge": (lambda s: s.add_twisting_moment(1, 4, 1.0), "edge 4", "rod 1", "4 edges"),
    "moment nan": (lambda s: s.add_twisting_moment(1, 3, NAN), "moment on edge 3", "finite"),
    "couple nan": (lambda s: s.add_couple(1, 3, (NAN, 0.0, 0.0)), "couple on edge 3", "three finite"),
    "couple of two": (lambda s: s.add_couple(1, 3, (1.0, 0.0)), "couple on edge 3", "three finite"),
    "couple edge": (lambda s: s.add_couple(1, 4, (1.0, 0.0, 0.0)), "edge 4", "rod 1", "4 edges"),
    "mass node": (lambda s: s.add_mass(1, 5, 1.0), "node 5", "rod 1", "5 nodes"),
    "mass zero": (lambda s: s.add_mass(1, 4, 0.0), "0.0 kg", "node 4", "positive"),
    "mass nan": (lambda s: s.add_mass(1, 4, NAN), "nan kg", "node 4", "positive"),
    "mass infinite": (lambda s: s.add_mass(1, 4, np.inf), "inf kg", "node 4", "finite"),
    "end": (lambda s: s.clamp_end(1, "middle"), "'middle'", "'first'", "'last'"),
    "components": (lambda s: s.fix(1, [0], components="xw"), "'xw'", "'xyz'"),
    "components of an end": (lambda s: s.clamp_end(1, components="q"), "'q'", "'xyz'"),
    "no components": (lambda s: s.fix(1, [0], components=""), "''", "'xyz'"),
    "motion": (lambda s: s.clamp(1, motion=lambda t: (0.0, 0.0, t)), "motion", "Motion("),
}


@pytest.mark.parametrize("name", ADDED)
def test_supports_and_loads(device, name):
    add, *words = ADDED[name]

    def build():
        scene = scene_of()
        add(scene)
        scene.build(device)

    refused(build, *words)


def test_closed_rod_has_no_end(device):
    scene = scene_of(RING, closed=True)
    scene.clamp_end([0, 1], "first")
    refused(lambda: scene.build(device), "rod 1", "closed", "no end")


def test_moment_needs_twist():
    for scene, options in ((None, {"twist": False}), (None, {"bend": False}), (ddg.Scene(dimension=2), {})):
        scene = scene_of(scene=scene, **options)
        refused(lambda scene=scene: scene.add_twisting_moment(1, 0, 1.0), "rod", "twist=True")
        assert not scene.loads


def test_motion_needs_an_axis():
    refused(lambda: ddg.Motion(axis=(0.0, 0.0, 0.0)), "axis", "three numbers", error=ValueError)


@pytest.mark.parametrize("gravity", [(0.0, 0.0), 9.81, (0.0, 0.0, NAN), "down", (0.0, 0.0, 1.0, 0.0), None])
def test_gravity(device, gravity):
    refused(scene_of(scene=ddg.Scene(gravity=gravity)).build, "gravity", "three finite numbers")


@pytest.mark.parametrize("damping", [-1.0, NAN, np.inf, (1.0, 2.0)])
def test_damping(device, damping):
    refused(scene_of(scene=ddg.Scene(mass_damping=damping)).build, "mass_damping", "not negative")


@pytest.mark.parametrize("dimension", [1, 4, "3"])
def test_dimension(device, dimension):
    scene = ddg.Scene(dimension=dimension)
    scene.add_rod(line(), section=STIFFNESS)
    refused(scene.build, "dimension", "2 or 3")


@pytest.mark.parametrize("worlds", [0, -1, 1.5, None])
def test_worlds(device, worlds):
    refused(lambda: scene_of().build(device, worlds=worlds), "worlds")


def test_precision(device):
    refused(lambda: scene_of().build(device, "half"), "'half'", "float64", "mixed", "float32")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scheme": "rk4"}, ("'rk4'", "implicit_euler", "implicit_midpoint")),
        ({"linear": "ilu"}, ("'ilu'", "jacobi", "block_jacobi", "chain")),
        ({"solver": "magic"}, ("'magic'", "newton", "projective")),
    ],
)
def test_integrator(device, arguments, words):
    refused(lambda: ddg.Integrator(scene_of().build(device), **arguments), *words)


def test_sweep_needs_open_rods(device):
    model = scene_of(RING, closed=True).build(device)
    refused(lambda: ddg.Integrator(model, linear="sweep"), "rod 1", "closed", "auto")


@pytest.mark.parametrize("dt", [0.0, -0.01, NAN, np.inf])
def test_step(device, dt):
    model = scene_of().build(device)
    integrator, state = ddg.Integrator(model), model.state()
    refused(lambda: integrator.step(state, dt), f"dt is {dt}", "positive and finite")
    assert state.time == 0.0
    assert integrator.statistics()["outcomes"] == {}


def test_free_nodes_need_mass(device):
    massless = ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0)
    scene = scene_of(section=massless)
    scene.clamp(1)
    model = scene.build(device)
    refused(lambda: ddg.Integrator(model), "node 2", "rod 1", "no mass", "density")
    scene.fix(1, [2, 3, 4])
    ddg.Integrator(scene.build(device))  # held nodes need none


def test_first_state(device):
    model = scene_of().build(device)
    points = model.state().points()
    bad = points.copy()
    bad[8, 1] = NAN
    refused(lambda: model.state(points=points[1:]), "points", "(11, 3)", "(12, 3)", error=ValueError)
    refused(lambda: model.state(points=bad), "points", "node 8", "not finite", error=ValueError)
    refused(lambda: model.state(velocities=points[1:]), "velocities", "(11, 3)", "(12, 3)", error=ValueError)
    refused(lambda: model.state(velocities=bad), "velocities", "node 8", "not finite", error=ValueError)
    refused(lambda: model.state(points=np.zeros((2, 12, 3))), "points", "(2, 12, 3)", error=ValueError)


def test_snapshot_of_another_model(device):
    model = scene_of().build(device, "float64")
    others = [scene_of(line(6)).build(device, "float64"), scene_of(twist=False).build(device, "float64")]
    others.append(scene_of().build(device, "float64", worlds=2))
    for other in others:
        refused(lambda other=other: model.restore(other.state().snapshot()), "another model", error=ValueError)
    assert (model.restore(model.state().snapshot()).points() == model.state().points()).all()


def test_statics_mode(device):
    scene = scene_of()
    scene.clamp([0, 1])
    refused(lambda: statics.solve(scene.build(device), mode="downhill"), "'downhill'", "minimise", "follow")


def test_statics_pulls_a_hinged_rod_straight(device):
    """One hinge lets a rod turn, not go away: the equilibrium exists, along the load."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(line(), section=STIFFNESS)
    scene.fix(rod, [0])
    scene.add_force(rod, -1, (0.0, 1.0, 0.0))
    state = statics.solve(scene.build(device, "float64"))
    np.testing.assert_allclose(state.points()[-1], (0.0, 1.0 + 1.0 / 1e3, 0.0), atol=1e-8)


def test_spectrum_of_free_rods(device):
    """A free rod has no equilibrium under its weight, but it has modes of vibration: six rigid ones and its spin."""
    model = scene_of().build(device, "float64")
    assert spectrum(model, model.state(), 14).eigenvalues[:12] == pytest.approx(np.zeros(12), abs=1e-6)


def test_spins(device):
    model = scene_of().build(device)
    refused(lambda: model.state(spins=np.zeros(7)), "spins", "(7,)", "(10,)", error=ValueError)
    refused(lambda: model.state(spins=np.full(10, NAN)), "spins", "edge 0", "not finite", error=ValueError)


def test_snapshot_with_other_groups(device):
    model = scene_of().build(device, "float64")
    more = scene_of()
    more.add_rod(line(30), section=STIFFNESS)
    for snapshot in ({}, more.build(device, "float64").state().snapshot()):
        refused(lambda snapshot=snapshot: model.restore(snapshot), "another model", error=ValueError)


def test_state_of_another_model(device):
    model, other = scene_of().build(device), scene_of().build(device)
    refused(lambda: ddg.Integrator(model).step(other.state(), 0.01), "another model")


@pytest.mark.parametrize(("held", "axis"), [("", "x"), ("xy", "z"), ("yz", "x")])
def test_statics_without_supports(device, held, axis):
    """A rod that can be shifted as a whole is named at once; rod 0 is held."""
    scene = scene_of()
    scene.clamp(0)
    if held:
        scene.fix(1, [0, 2, 4], components=held)
    refused(lambda: statics.solve(scene.build(device)), "rod 1", f"along {axis}", "supports", "clamp")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rtol": NAN}, ("rtol", "positive")),
        ({"rtol": 0.0}, ("rtol", "positive")),
        ({"rotation_cap": -1.0}, ("rotation_cap", "positive")),
        ({"linear_rtol": float("inf")}, ("linear_rtol", "positive")),
        ({"max_iterations": 0}, ("max_iterations", "at least 1")),
        ({"max_halvings": 2.5}, ("max_halvings", "whole number")),
        ({"retry_limit": -1}, ("retry_limit", "0 for no retry")),
        ({"psd": "exact"}, ("psd", "exact", "gauss_newton", "project", "progressive", "none")),
        ({"psd": "none", "linear": "jacobi"}, ("psd", "jacobi", "chain")),
        ({"psd": "project", "solver": "projective"}, ("psd", "projective", "gauss_newton")),
    ],
)
def test_newton_options(device, options, words):
    scene = scene_of()
    scene.clamp(1)
    refused(lambda: ddg.Integrator(scene.build(device), **options), *words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rtol": NAN}, ("rtol", "positive")),
        ({"max_iterations": 0}, ("max_iterations", "at least 1")),
        ({"load_steps": 0}, ("load_steps", "at least 1")),
        ({"mode": "saddle"}, ("mode", "minimise")),
    ],
)
def test_statics_options(device, options, words):
    scene = scene_of()
    scene.clamp([0, 1])
    refused(lambda: statics.solve(scene.build(device), **options), *words)
