"""Rest strains with which rods stay where they are drawn: closed forms of beams, rods of all kinds in one scene, and named refusals."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.ask.sag_free import least_stiffness, rest_strains
from ddg_warp.geometry import meshes
from ddg_warp.model.rest_shapes import set_rest_strains
from ddg_warp.solve.stability import spectrum
from ddg_warp.solve.statics import solve

LENGTH, EDGES = 0.5, 20
SECTION = ddg.Stiffness(EA=800.0, EI1=0.03, EI2=0.05, GJ=0.02, mass_per_length=0.04, rotary_inertia=1e-6)
WEIGHT = 9.81 * SECTION.mass_per_length
LEVEL = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), EDGES + 1)
INSIDE = LEVEL[1:-1, 0]  # inner nodes
UP = (0.0, 0.0, 1.0)  # the first director, towards which curvature 1 is positive


def one(points=LEVEL, hold="clamp", dimension=3, load=None, **options) -> ddg.Scene:
    """A rod that is held by its first edge or end."""
    scene = ddg.Scene(dimension=dimension)
    director = {} if dimension == 2 else {"director": UP}
    rod = scene.add_rod(points, **({"section": SECTION} | director | options))
    getattr(scene, hold)(rod)
    if load:
        load(scene, rod)
    return scene


def curve(n: int, turns: float = 0.6, level: float = 0.0) -> np.ndarray:
    """A curl in space of n nodes, with curvature and torsion everywhere."""
    t = np.linspace(0.0, 1.0, n)
    angle = 2.0 * np.pi * turns * t
    return np.stack([0.2 * t + 0.02 * t**2, 0.05 * np.cos(angle), level + 0.06 * np.sin(angle)], 1)


def given(model, found: dict):
    """The model, with those rest strains."""
    set_rest_strains(model, found)
    return model


def off(model) -> float:
    """How far the equilibrium under the loads, which grow in steps, is from where rods are drawn [m]."""
    return float(np.abs(solve(model, load_steps=3).points() - model.state().points()).max())


@pytest.mark.parametrize("hold", ["clamp", "clamp_end"])
@pytest.mark.parametrize("curvature", ["tangent", "angle"])
def test_a_straight_cantilever(hold, curvature):
    """k0 = w (L - s)^2 / 2 EI towards the sky, exact as nodes halve the weight of their edges."""
    model = one(hold=hold, curvature=curvature).build("cpu")
    found = rest_strains(model)
    ghosts = 1 if hold == "clamp_end" else 0
    known = WEIGHT * (LENGTH - INSIDE) ** 2 / (2.0 * SECTION.EI1)
    np.testing.assert_allclose(found["rod_bend_twist.rest_1"][0, ghosts:], known, rtol=1e-9)
    if ghosts:
        assert found["rod_bend_twist.rest_1"][0, 0] == pytest.approx(WEIGHT * LENGTH**2 / (2.0 * SECTION.EI1), rel=1e-9)
    for name in ("rod_bend_twist.rest_2", "rod_bend_twist.rest_3"):
        assert np.abs(found[name]).max() < 1e-12 * known.max()
    np.testing.assert_allclose(found["rod_stretch.rest"], 1.0, rtol=1e-13)
    assert off(given(model, found)) < 1e-12


def test_in_a_plane():
    """The same, positive from x towards z."""
    model = one(dimension=2).build("cpu")
    found = rest_strains(model)
    known = WEIGHT * (LENGTH - INSIDE) ** 2 / (2.0 * SECTION.EI1)
    np.testing.assert_allclose(found["planar_bend.rest"][0], known, rtol=1e-9)
    assert off(given(model, found)) < 1e-12


def test_a_hanging_rod_is_shorter_at_rest():
    """1 - w (L - s) / EA at the middle of every edge that is free to stretch; no curvature."""
    model = one(points=-LEVEL[:, ::-1], director=(1.0, 0.0, 0.0)).build("cpu")
    found = rest_strains(model)
    middle = 0.5 * (LEVEL[1:, 0] + LEVEL[:-1, 0])
    shorter = WEIGHT * (LENGTH - middle) / SECTION.EA
    shorter[0] = 0.0  # held at both ends, it has the stress that it is drawn with
    np.testing.assert_allclose(1.0 - found["rod_stretch.rest"][0], shorter, rtol=1e-8, atol=1e-15)
    assert max(np.abs(found[f"rod_bend_twist.rest_{k}"]).max() for k in (1, 2, 3)) < 1e-12


def test_loads_at_the_tip():
    """A force P across: k0 = P (L - s) / EI; a moment M about the rod: twist at rest -M / GJ; both of no weight, at half the load."""

    def load(scene, rod):
        scene.gravity = (0.0, 0.0, 0.0)
        scene.add_force(rod, -1, (0.0, 0.3, 0.0))
        scene.add_twisting_moment(rod, -1, 2e-3)

    model = one(load=load).build("cpu")
    found = rest_strains(model, load=0.5)
    across = -0.5 * 0.3 * (LENGTH - INSIDE) / SECTION.EI2
    # the second director is x cross z = -y: against the force is towards it
    np.testing.assert_allclose(found["rod_bend_twist.rest_2"][0], -across, rtol=1e-9)
    np.testing.assert_allclose(found["rod_bend_twist.rest_3"], -0.5 * 2e-3 / SECTION.GJ, rtol=1e-9)


def test_of_several_answers_that_of_least_energy():
    """Both ends clamped: M = w (L^2 - 6 L s + 6 s^2) / 12, as of a beam with no strain in the mean, to second order in the spacing."""
    errors = []
    for n in (20, 40):
        points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1)
        model = one(points=points, hold="clamp_end", load=lambda scene, rod: scene.clamp_end(rod, "last")).build("cpu")
        found = rest_strains(model)["rod_bend_twist.rest_1"][0]
        s = points[:, 0]
        known = WEIGHT * (LENGTH**2 - 6.0 * LENGTH * s + 6.0 * s**2) / (12.0 * SECTION.EI1)
        errors.append(np.abs(found - known).max() / known.max())
    assert errors[0] < 0.01 and errors[1] < 0.27 * errors[0]


def scene_of_all() -> ddg.Scene:
    """Curled rods of different lengths and kinds, in groups that are not in the order of the scene; damped, some loaded."""
    scene, stiff = ddg.Scene(), ddg.Material(5e7, density=1000.0, viscosity=0.01)
    long = scene.add_rods([curve(33), curve(33, 1.1, 0.3)], section=ddg.Ellipse(0.003, 0.002), material=stiff)
    scene.clamp(long)
    short = scene.add_rod(curve(12, 0.4, 0.6), section=ddg.Circle(0.003), material=stiff, natural="straight")
    scene.clamp_end(short, "last")
    both = scene.add_rod(curve(24, 0.8, 0.9), section=SECTION, curvature="angle")
    scene.clamp(both, edges=[0, -1])
    middle = scene.add_rod(curve(30, 0.7, 1.2), section=ddg.Circle(0.003), material=stiff)
    scene.clamp(middle, edges=[14])
    scene.add_force(middle, -1, (0.0, 0.02, 0.0))
    scene.add_couple(middle, 3, (1e-4, 0.0, 2e-4))
    return scene


def test_rods_of_all_kinds_stay_as_they_are(device):
    """Where they are drawn, and at another state; found again as stresses that the statics of the state knows alone."""
    model = scene_of_all().build(device, "float64")
    before = off(model)
    assert before > 1e-3
    assert off(given(model, rest_strains(model))) < 1e-11
    swayed = solve(model, controls=ddg.Controls(gravity=(2.0, 1.0, -9.0)))
    stays = solve(given(model, rest_strains(model, swayed)), swayed, start=1.0)
    assert np.abs(swayed.points() - model.state().points()).max() > 1e-3
    assert np.abs(stays.points() - swayed.points()).max() < 1e-11


def test_every_world_has_its_own():
    """Stiffnesses of worlds: natural curvatures beside those drawn are in inverse proportion."""
    model = one(points=curve(20)).build("cpu", worlds=2)
    drawn = model.parameters()["0/rod_bend_twist/rest_1"].T
    name = "stiffness_1"
    first = float(model.parameters()[f"0/rod_bend_twist/{name}"][0, 0])
    model.set_parameter("rod_bend_twist", name, [first, 4.0 * first])
    found = rest_strains(model)["rod_bend_twist.rest_1"]
    change = found - drawn[:, : found.shape[1]]
    np.testing.assert_allclose(change[0], 4.0 * change[1], rtol=1e-9, atol=1e-12)
    assert off(given(model, rest_strains(model))) < 1e-12


def test_a_long_rod():
    """3,000 edges, 1e7 times as stiff along as across."""
    section = ddg.Stiffness(EA=2e6, EI1=0.02, GJ=0.02, mass_per_length=0.04)  # EA L^2 / EI
    model = one(points=curve(3001), section=section).build("cpu")
    assert off(given(model, rest_strains(model))) < 1e-11


ROUND = ddg.Material(1e7, density=1000.0)


@pytest.mark.parametrize("n", [40, 200])
def test_a_column_may_be_as_soft_as_greenhill_found(n):
    """Upright under its weight: stable where w L^3 < 7.8373 EI (Greenhill 1881), whatever its stretch was made to be."""
    points = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, LENGTH), n + 1)
    section = ddg.Stiffness(EA=1e5, EI1=0.03, EI2=0.05, GJ=0.02, mass_per_length=SECTION.mass_per_length)
    scene = one(points=points, hold="clamp_end", section=section, director=(1.0, 0.0, 0.0))
    scene.clamp_end(scene.add_rod(-points, section=section))  # hangs
    model = scene.build("cpu")
    given(model, rest_strains(model))
    ((standing, hanging),) = least_stiffness(model, model.state())
    assert standing == pytest.approx(WEIGHT * LENGTH**3 / (7.8373 * section.EI1), rel=2.0 / n**2 + 1e-4)
    assert hanging < 1e-12


def test_least_stiffness_is_where_stability_is_lost():
    """Curled rods of any kind: stable as they are a per cent above it, and not a per cent below; it says so of both alike."""
    model = scene_of_all().build("cpu", "float64")
    given(model, rest_strains(model))
    (least,) = least_stiffness(model, model.state())
    assert (least > 0.0).all() and (least < 1.0).all()
    worst = least.max()
    for factor, stable in ((1.01 * worst, True), (0.99 * worst, False)):
        softer = scene_of_all().build("cpu", "float64")
        for group in softer.groups:
            group.parameters.set(**{n: factor * v for n, v in group.parameters.values.items() if "stiffness" in n})
        given(softer, rest_strains(softer))
        assert spectrum(softer, softer.state(), 1, "unit", load=1.0).stable is stable
        np.testing.assert_allclose(least_stiffness(softer, softer.state())[0] * factor, least, rtol=1e-6)


REFUSED = {
    "closed": (
        lambda s: s.clamp(s.add_rod(curve(12), section=SECTION, closed=True, name="ring")),
        "rod 0 .'ring'. is closed",
    ),
    "without twist": (
        lambda s: s.clamp(s.add_rod(LEVEL, section=ddg.Circle(0.01), material=ROUND, twist=False)),
        "rod 0 .* no twist",
    ),
    "ribbon": (
        lambda s: s.clamp(s.add_rod(LEVEL, section=ddg.Ribbon(0.02, 1e-3), material=ddg.Material(1e7, 0.3))),
        "rod 0 .* has the law",
    ),
    "joined": (
        lambda s: s.join([(rod, 0) for rod in s.add_rods([LEVEL, LEVEL[:, ::-1]], section=SECTION)]),
        "rod 0 .* joined",
    ),
    "shell": (
        lambda s: s.add_shell(*meshes.rectangle(2, 2), thickness=1e-3, material=ddg.Material(1e6), name="sheet"),
        "shell 0 .'sheet'.",
    ),
    "hinged": (
        lambda s: s.fix(s.add_rod(LEVEL, section=SECTION), [0]),
        "nothing balances the loads at node 1 of rod 0",
    ),
    "free": (lambda s: s.add_rod(LEVEL, section=SECTION), "nothing balances the loads at node 0 of rod 0"),
    "chain": (
        lambda s: s.clamp(s.add_rod(LEVEL, section=SECTION, bend=False)),
        "nothing balances the loads at node 2 of rod 0",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_such_rest_shape_is_named(name):
    make, said = REFUSED[name]
    scene = ddg.Scene()
    make(scene)
    with pytest.raises(ddg.SceneError, match=f"rest_strains: .*{said}"):
        rest_strains(scene.build("cpu"))


def test_mistakes_are_named():
    model = one().build("cpu")
    for arguments, said in (
        ((None,), "the model is"),
        ((model, 1), "the state is"),
        ((model, None, "x"), "load is 'x'"),
    ):
        with pytest.raises(ddg.SceneError, match=f"rest_strains: {said}"):
            rest_strains(*arguments)
    free = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    free.fix(free.add_rod(LEVEL, section=SECTION), [0, -1])
    unclamped = free.build("cpu")
    with pytest.raises(ddg.SceneError, match=r"least_stiffness: supports leave a rigid motion of .* rod 0"):
        least_stiffness(unclamped, unclamped.state())
    with pytest.raises(ddg.SceneError, match="least_stiffness: the state is of another model"):
        least_stiffness(model, unclamped.state())
    with pytest.raises(ddg.SceneError, match="float32"):
        rest_strains(one().build("cpu", "float32"))
    found, before = rest_strains(model), model.parameters()
    for wrong, said in (
        ({"rod_bend_twist.stiffness_1": 1.0}, "is no rest strain"),
        ({"rod_stretch.rest": np.ones(3)}, "has shape"),
        ({"rod_bend_twist.rest_1": found["rod_bend_twist.rest_1"] + np.nan}, "value 0 is nan"),
    ):
        with pytest.raises(ValueError, match=said):
            set_rest_strains(model, found | wrong)
    for name, values in model.parameters().items():
        np.testing.assert_array_equal(values, before[name])
