"""Rest strains that make drawn shapes equilibria: closed forms of beams, mixed scenes, and named refusals."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.model.rest_shapes import set_rest_strains
from ddg_warp.postprocess.sag_free import least_stiffness, rest_strains
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import solve

LENGTH, EDGES = 0.5, 20
SECTION = ddg.Stiffness(EA=800.0, EI1=0.03, EI2=0.05, GJ=0.02, mass_per_length=0.04, rotary_inertia=1e-6)
WEIGHT = 9.81 * SECTION.mass_per_length
LEVEL = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), EDGES + 1)
INSIDE = LEVEL[1:-1, 0]  # inner nodes
UP = (0.0, 0.0, 1.0)  # the first director, towards which curvature 1 is positive


def single_rod(points=LEVEL, hold="clamp", dimension=3, load=None, **options) -> ddg.Scene:
    """Return a rod clamped at the first edge or end."""
    scene = ddg.Scene(dimension=dimension)
    director = {} if dimension == 2 else {"director": UP}
    rod = scene.add_rod(points, **({"section": SECTION} | director | options))
    getattr(scene, hold)(rod)
    if load:
        load(scene, rod)
    return scene


def curve(n: int, revolutions: float = 0.6, level: float = 0.0) -> np.ndarray:
    """Return a space curve of n nodes with curvature and torsion everywhere."""
    t = np.linspace(0.0, 1.0, n)
    angle = 2.0 * np.pi * revolutions * t
    return np.stack([0.2 * t + 0.02 * t**2, 0.05 * np.cos(angle), level + 0.06 * np.sin(angle)], 1)


def with_rest_strains(model, strains: dict):
    """Set rest strains and return the model."""
    set_rest_strains(model, strains)
    return model


def largest_displacement(model) -> float:
    """Return the largest distance of the equilibrium, loaded in steps, from the drawn shape [m]."""
    return float(np.abs(solve(model, load_steps=3).points() - model.state().points()).max())


@pytest.mark.parametrize("hold", ["clamp", "clamp_end"])
@pytest.mark.parametrize("curvature", ["tangent", "angle"])
def test_a_straight_cantilever(hold, curvature):
    """k0 = w (L - s)^2 / 2 EI upwards, exact as nodes have half the weight of each edge."""
    model = single_rod(hold=hold, curvature=curvature).build("cpu")
    strains = rest_strains(model)
    ghosts = 1 if hold == "clamp_end" else 0
    exact = WEIGHT * (LENGTH - INSIDE) ** 2 / (2.0 * SECTION.EI1)
    np.testing.assert_allclose(strains["rod_bend_twist.rest_1"][0, ghosts:], exact, rtol=1e-9)
    if ghosts:
        assert strains["rod_bend_twist.rest_1"][0, 0] == pytest.approx(
            WEIGHT * LENGTH**2 / (2.0 * SECTION.EI1), rel=1e-9
        )
    for name in ("rod_bend_twist.rest_2", "rod_bend_twist.rest_3"):
        assert np.abs(strains[name]).max() < 1e-12 * exact.max()
    np.testing.assert_allclose(strains["rod_stretch.rest"], 1.0, rtol=1e-13)
    assert largest_displacement(with_rest_strains(model, strains)) < 1e-12


def test_planar_cantilever():
    """k0 = w (L - s)^2 / 2 EI, positive from x towards z."""
    model = single_rod(dimension=2).build("cpu")
    strains = rest_strains(model)
    exact = WEIGHT * (LENGTH - INSIDE) ** 2 / (2.0 * SECTION.EI1)
    np.testing.assert_allclose(strains["planar_bend.rest"][0], exact, rtol=1e-9)
    assert largest_displacement(with_rest_strains(model, strains)) < 1e-12


def test_a_hanging_rod_is_shorter_at_rest():
    """1 - w (L - s) / EA at the midpoint of every edge that may stretch; no curvature."""
    model = single_rod(points=-LEVEL[:, ::-1], director=(1.0, 0.0, 0.0)).build("cpu")
    strains = rest_strains(model)
    middle = 0.5 * (LEVEL[1:, 0] + LEVEL[:-1, 0])
    shorter = WEIGHT * (LENGTH - middle) / SECTION.EA
    shorter[0] = 0.0  # with both ends fixed, the edge keeps the stress of the drawn shape
    np.testing.assert_allclose(1.0 - strains["rod_stretch.rest"][0], shorter, rtol=1e-8, atol=1e-15)
    assert max(np.abs(strains[f"rod_bend_twist.rest_{k}"]).max() for k in (1, 2, 3)) < 1e-12


def test_loads_at_the_tip():
    """A transverse force P gives k0 = P (L - s) / EI, a twisting moment M the rest twist -M / GJ; weightless, at half the load."""

    def load(scene, rod):
        scene.gravity = (0.0, 0.0, 0.0)
        scene.add_force(rod, -1, (0.0, 0.3, 0.0))
        scene.add_twisting_moment(rod, -1, 2e-3)

    model = single_rod(load=load).build("cpu")
    strains = rest_strains(model, load=0.5)
    across = -0.5 * 0.3 * (LENGTH - INSIDE) / SECTION.EI2
    # the second director is x cross z = -y, against the force
    np.testing.assert_allclose(strains["rod_bend_twist.rest_2"][0], -across, rtol=1e-9)
    np.testing.assert_allclose(strains["rod_bend_twist.rest_3"], -0.5 * 2e-3 / SECTION.GJ, rtol=1e-9)


def test_redundant_supports_give_least_energy():
    """Clamps at both ends: M = w (L^2 - 6 L s + 6 s^2) / 12, as in a beam of zero mean strain, to second order."""
    errors = []
    for n in (20, 40):
        points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1)
        model = single_rod(points=points, hold="clamp_end", load=lambda scene, rod: scene.clamp_end(rod, "last")).build(
            "cpu"
        )
        strain = rest_strains(model)["rod_bend_twist.rest_1"][0]
        s = points[:, 0]
        exact = WEIGHT * (LENGTH**2 - 6.0 * LENGTH * s + 6.0 * s**2) / (12.0 * SECTION.EI1)
        errors.append(np.abs(strain - exact).max() / exact.max())
    assert errors[0] < 0.01 and errors[1] < 0.27 * errors[0]


def scene_of_all() -> ddg.Scene:
    """Return curled rods of different lengths and kinds, grouped out of scene order; damped, some loaded."""
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
    """The drawn shape and another state become equilibria; stresses follow from statics alone."""
    model = scene_of_all().build(device, "float64")
    before = largest_displacement(model)
    assert before > 1e-3
    assert largest_displacement(with_rest_strains(model, rest_strains(model))) < 1e-11
    swayed = solve(model, controls=ddg.Controls(gravity=(2.0, 1.0, -9.0)))
    stays = solve(with_rest_strains(model, rest_strains(model, swayed)), swayed, start=1.0)
    assert np.abs(swayed.points() - model.state().points()).max() > 1e-3
    assert np.abs(stays.points() - swayed.points()).max() < 1e-11


def test_rest_strains_differ_between_worlds():
    """Changes of natural curvature are inversely proportional to the stiffness of each world."""
    model = single_rod(points=curve(20)).build("cpu", worlds=2)
    drawn = model.parameters()["0/rod_bend_twist/rest_1"].T
    name = "stiffness_1"
    first = float(model.parameters()[f"0/rod_bend_twist/{name}"][0, 0])
    model.set_parameter("rod_bend_twist", name, [first, 4.0 * first])
    strains = rest_strains(model)["rod_bend_twist.rest_1"]
    change = strains - drawn[:, : strains.shape[1]]
    np.testing.assert_allclose(change[0], 4.0 * change[1], rtol=1e-9, atol=1e-12)
    assert largest_displacement(with_rest_strains(model, rest_strains(model))) < 1e-12


def test_a_long_rod():
    """A rod of 3,000 edges is 1e7 times as stiff axially as in bending."""
    section = ddg.Stiffness(EA=2e6, EI1=0.02, GJ=0.02, mass_per_length=0.04)  # EA L^2 / EI
    model = single_rod(points=curve(3001), section=section).build("cpu")
    assert largest_displacement(with_rest_strains(model, rest_strains(model))) < 1e-11


ROUND = ddg.Material(1e7, density=1000.0)


@pytest.mark.parametrize("n", [40, 200])
def test_least_stiffness_of_a_column_is_greenhills(n):
    """An upright column is stable where w L^3 < 7.8373 EI (Greenhill 1881), with any rest stretch."""
    points = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, LENGTH), n + 1)
    section = ddg.Stiffness(EA=1e5, EI1=0.03, EI2=0.05, GJ=0.02, mass_per_length=SECTION.mass_per_length)
    scene = single_rod(points=points, hold="clamp_end", section=section, director=(1.0, 0.0, 0.0))
    scene.clamp_end(scene.add_rod(-points, section=section))  # hangs
    model = scene.build("cpu")
    with_rest_strains(model, rest_strains(model))
    ((standing, hanging),) = least_stiffness(model, model.state())
    assert standing == pytest.approx(WEIGHT * LENGTH**3 / (7.8373 * section.EI1), rel=2.0 / n**2 + 1e-4)
    assert hanging < 1e-12


def test_least_stiffness_is_the_limit_of_stability():
    """Curled rods are stable one per cent above the least stiffness and not one per cent below; both give the same value."""
    model = scene_of_all().build("cpu", "float64")
    with_rest_strains(model, rest_strains(model))
    (least,) = least_stiffness(model, model.state())
    assert (least > 0.0).all() and (least < 1.0).all()
    worst = least.max()
    for factor, stable in ((1.01 * worst, True), (0.99 * worst, False)):
        softer = scene_of_all().build("cpu", "float64")
        for group in softer.groups:
            group.parameters.set(**{n: factor * v for n, v in group.parameters.values.items() if "stiffness" in n})
        with_rest_strains(softer, rest_strains(softer))
        assert spectrum(softer, softer.state(), 1, "unit", load=1.0).stable is stable
        np.testing.assert_allclose(least_stiffness(softer, softer.state())[0] * factor, least, rtol=1e-6)


def with_body(scene) -> None:
    """Add a clamped rod that carries a body."""
    rod = scene.add_rod(LEVEL + [0.0, 0.1, 0.0], section=SECTION)
    scene.clamp(rod)
    scene.attach(rod, -1, scene.add_body(ddg.Sphere((LENGTH, 0.1, 0.0), 0.01), mass=0.02))


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
        "no rest strains balance the loads at node 1 of rod 0",
    ),
    "bodies apart": (lambda s: (with_body(s), s.clamp(s.add_rod(LEVEL, section=SECTION))), "rigid bodies, and other"),
    "free": (lambda s: s.add_rod(LEVEL, section=SECTION), "no rest strains balance the loads at node 0 of rod 0"),
    "chain": (
        lambda s: s.clamp(s.add_rod(LEVEL, section=SECTION, bend=False)),
        "no rest strains balance the loads at node 2 of rod 0",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_scenes_without_such_a_rest_shape_are_refused(name):
    make, message = REFUSED[name]
    scene = ddg.Scene()
    make(scene)
    with pytest.raises(ddg.SceneError, match=f"rest_strains: .*{message}"):
        rest_strains(scene.build("cpu"))


def with_payload(mass: float = 0.02, arm: float = 0.05) -> ddg.Scene:
    """Return a straight cantilever that carries a body at an arm beyond the end."""
    scene = single_rod(hold="clamp_end")
    scene.attach(0, -1, scene.add_body(ddg.Box((LENGTH + arm, 0.0, 0.0), (arm, 0.01, 0.01)), mass=mass, name="payload"))
    return scene


def test_a_cantilever_with_a_payload():
    """k0 = (w (L - s)^2 / 2 + W (L + a - s)) / EI upwards, for a weight W at the arm a; the shape stays, in time, too."""
    mass, arm = 0.02, 0.05
    model = with_payload(mass, arm).build("cpu", worlds=2)
    start, strains = model.state(), rest_strains(model)
    exact = (0.5 * WEIGHT * (LENGTH - INSIDE) ** 2 + mass * 9.81 * (LENGTH + arm - INSIDE)) / SECTION.EI1
    natural = strains["rod_bend_twist.rest_1"]
    assert natural.shape[0] == 2
    near = np.abs(natural[0][:, None] - exact).min(0)  # elements are numbered by the coupled system
    np.testing.assert_allclose(near, 0.0, atol=1e-9 * exact.max())
    with_rest_strains(model, strains)
    assert np.abs(solve(model).points() - start.points()).max() < 1e-12
    state, integrator = start, ddg.Integrator(model)
    for _ in range(5):
        state = integrator.step(state, 1e-2)
    assert np.abs(state.points() - start.points()).max() < 1e-12
    with pytest.raises(ValueError, match="has shape"):
        set_rest_strains(model, {"rod_stretch.rest": np.ones(3)})
    with pytest.raises(ddg.SceneError, match=r"least_stiffness: body 0 .*'payload'.* rigid; take"):
        least_stiffness(model, state)


def test_mistakes_are_named():
    model = single_rod().build("cpu")
    for arguments, message in (
        ((None,), "the model is"),
        ((model, 1), "the state is"),
        ((model, None, "x"), "load is 'x'"),
    ):
        with pytest.raises(ddg.SceneError, match=f"rest_strains: {message}"):
            rest_strains(*arguments)
    free = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    free.fix(free.add_rod(LEVEL, section=SECTION), [0, -1])
    unclamped = free.build("cpu")
    with pytest.raises(ddg.SceneError, match=r"least_stiffness: supports leave a rigid motion of .* rod 0"):
        least_stiffness(unclamped, unclamped.state())
    with pytest.raises(ddg.SceneError, match="least_stiffness: the state is of another model"):
        least_stiffness(model, unclamped.state())
    with pytest.raises(ddg.SceneError, match="float32"):
        rest_strains(single_rod().build("cpu", "float32"))
    strains, before = rest_strains(model), model.parameters()
    for wrong, message in (
        ({"rod_bend_twist.stiffness_1": 1.0}, "is no rest strain"),
        ({"rod_stretch.rest": np.ones(3)}, "has shape"),
        ({"rod_bend_twist.rest_1": strains["rod_bend_twist.rest_1"] + np.nan}, "value 0 is nan"),
    ):
        with pytest.raises(ValueError, match=message):
            set_rest_strains(model, strains | wrong)
    for name, values in model.parameters().items():
        np.testing.assert_array_equal(values, before[name])
