"""Constitutive laws: named parameters, damping, and user laws in scenes and in the derivative table."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_docs import FILES

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.kernels.densities.st_venant_kirchhoff import st_venant_kirchhoff
from ddg_warp.kernels.terms import ALL, CONTACT, FRICTION, MAGNETS, REGISTRY
from ddg_warp.postprocess import quantities
from ddg_warp.run import derivative_checks
from ddg_warp.run.cli import main
from ddg_warp.run.scene_registry import load_file
from ddg_warp.solve.equilibrium.statics import solve

FILE = (
    Path(tempfile.mkdtemp()) / "my_law.py"
)  # the law of the documentation, in a file, since Warp reads the source of functions
FILE.write_text(FILES["my_law.py"])
saturating = load_file(str(FILE), "law's").saturating
K, LIMIT = 2.0, 3.0
LAW = {"rod_bend_twist": ddg.Law(saturating, modulus=K, limit=LIMIT)}
SECTION = ddg.Stiffness(EA=1e5, EI1=2.0, EI2=2.0, GJ=2.0, mass_per_length=0.4, rotary_inertia=1e-3)


def line(nodes: int, end=(1.0, 0.0, 0.0)) -> np.ndarray:
    return np.linspace((0.0, 0.0, 0.0), end, nodes)


def cantilever(laws=None, viscosity: float = 0.0, gravity=(0.0, -1.0, -3.0), **options) -> ddg.Scene:
    scene = ddg.Scene(gravity=gravity)
    rod = scene.add_rod(line(13), section=replace(SECTION, viscosity=viscosity), laws=laws, **options)
    scene.clamp(rod)
    return scene


def moved(scene: ddg.Scene, device, precision: str = "float64", **options) -> tuple[np.ndarray, ddg.Integrator]:
    """Return points after 20 steps of 20 ms, and the integrator."""
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, rtol=1e-10, **options), model.state()
    for _ in range(20):
        state = integrator.step(state, 0.02)
    integrator.check(state)
    return state.points(), integrator


@pytest.mark.parametrize(
    ("couple", "curvature"),
    [(1.0, "tangent"), (4.0, "tangent"), (5.9, "tangent"), pytest.param(4.0, "angle", marks=pytest.mark.slow)],
)
def test_user_law_bends_to_its_circle(device, couple, curvature):
    """An end couple M gives uniform curvature k, with M d phi = l m(k) dk and k = 2 tan(phi / 2) / l of edges l.

    Hence M = m(k) (1 + (k l / 2)^2), m = K k / sqrt(1 + (k / c)^2), at most K c = 6. With k = phi / l it is M = m(k).
    """
    scene, length = cantilever(LAW, gravity=(0.0, 0.0, 0.0), curvature=curvature), 1.0 / 12.0
    scene.add_couple(0, -1, (0.0, couple, 0.0))
    model = scene.build(device, "float64")
    state = solve(model, load_steps=8)
    tangents = np.diff(state.points(), axis=0) / length
    angles = np.arccos(np.clip((tangents[:-1] * tangents[1:]).sum(1), -1.0, 1.0))
    k = (2.0 * np.tan(angles / 2.0) if curvature == "tangent" else angles) / length
    moment = K * k / np.sqrt(1.0 + (k / LIMIT) ** 2)
    work = 1.0 + (0.5 * k * length) ** 2 if curvature == "tangent" else 1.0
    assert moment * work == pytest.approx(couple, rel=1e-7)
    assert np.linalg.norm(model.stresses(state)["rod_bend_twist"][0], axis=1) == pytest.approx(moment, rel=1e-6)


@pytest.mark.parametrize("viscosity", [0.0, 0.05])
@pytest.mark.parametrize("psd", ["gauss_newton", "progressive"])
def test_the_quadratic_law_given_by_hand_is_the_usual_one(device, viscosity, psd):
    usual, _ = moved(cantilever(None, viscosity), device, psd=psd)
    by_hand, _ = moved(
        cantilever({"rod_bend_twist": ddg.Law(quadratic, stiffness=[2.0, 2.0, 2.0])}, viscosity), device, psd=psd
    )
    np.testing.assert_array_equal(by_hand, usual)
    assert np.abs(usual[-1] - [1.0, 0.0, 0.0]).max() > 0.05


@pytest.mark.parametrize("viscosity", [0.0, 0.05])
def test_far_from_its_limit_the_law_is_linear(device, viscosity):
    """Strains of 1e-2 of the limit: the results differ by the square of that."""
    usual, _ = moved(cantilever(None, viscosity), device)
    law = {"rod_bend_twist": ddg.Law(saturating, modulus=K, limit=300.0)}
    weak, _ = moved(cantilever(law, viscosity), device)
    assert 1e-9 < np.abs(weak - usual).max() < 1e-4
    strong, _ = moved(cantilever({"rod_bend_twist": ddg.Law(saturating, modulus=K, limit=1.0)}, viscosity), device)
    assert np.abs(strong - usual).max() > 1e-3


def test_damping_keeps_the_equilibrium(device):
    """A damped law comes to rest in the static shape without damping."""
    scene = cantilever(LAW, viscosity=0.3)
    rest = solve(cantilever(LAW).build(device, "float64"), load_steps=4).points()
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, rtol=1e-8), model.state()
    for _ in range(400):
        state = integrator.step(state, 0.05)
    np.testing.assert_allclose(state.points(), rest, atol=1e-5)


def test_a_joined_rod_keeps_its_law(device):
    """A hinge to a stub carries no moment: the rod moves as a single one; the stub keeps the quadratic law."""
    single, _ = moved(cantilever(LAW), device)
    scene = cantilever(LAW)
    stub = scene.add_rod(line(4, (0.0, 0.3, 0.0)), section=SECTION)
    scene.clamp(stub, edges=[0, 1, 2])
    scene.join([(0, 0), (stub, 0)], rigid=False)
    model = scene.build(device, "float64")
    assert len([element_set for element_set in model.coupled.sets if element_set.term.name == "rod_bend_twist"]) == 2
    names = model.parameters().keys()
    assert {"net/rod_bend_twist/limit", "net/rod_bend_twist 1/stiffness_1"} <= names
    joined, _ = moved(scene, device)
    np.testing.assert_allclose(joined[:13], single, atol=1e-8)


@pytest.mark.slow  # its command on the site runs daily
@pytest.mark.parametrize("damped", [False, True])
def test_derivatives_of_a_user_law(device, damped):
    term = replace(REGISTRY["rod_bend_twist"], density=saturating).damped(damped)
    for row in derivative_checks.table(term, "float64", device):
        assert row["passed"], row


@pytest.mark.slow
def test_the_command_line_checks_a_law_in_a_file(device, capsys):
    assert main(["check", f"{FILE}:saturating", "--device", device]) == 0
    assert "rod_bend_twist" in capsys.readouterr().out
    assert main(["check", f"{FILE}:nothing"]) == 2
    assert "no term or law 'nothing'" in capsys.readouterr().err


def test_every_law_names_its_parameters():
    for term in ALL.values():
        names = term.parameter_names
        assert len(set(names)) == len(names)
        assert all(parameter.unit and parameter.valid[0] for parameter in term.parameters)
        if term.name in {*CONTACT, *FRICTION}:
            continue
        assert names[0] == "measure"
        assert len(term.rest) == (0 if term.name in MAGNETS else len(term.measure.strains))
        assert ("viscosity" in names) == (term.density.undamped is not None)


WRONG = {
    "term": ({"rod_bend": LAW["rod_bend_twist"]}, {}, "no term 'rod_bend'"),
    "missing": ({"rod_bend_twist": ddg.Law(saturating, modulus=K)}, {}, "limit is missing"),
    "unknown": ({"rod_bend_twist": ddg.Law(quadratic, stiff=1.0)}, {}, "stiff does not fit"),
    "value": ({"rod_bend_twist": ddg.Law(saturating, modulus=K, limit=-1.0)}, {}, "limit = .* positive"),
    "shape": ({"rod_bend_twist": ddg.Law(saturating, modulus=np.ones(5), limit=1.0)}, {}, "broadcast to the 1 rods"),
    "curved": (LAW, {"natural": (1.0, 0.0, 0.0)}, "no strains at rest"),
    "no law": ({"rod_bend_twist": 3.0}, {}, r"give Law\(density"),
    "no dictionary": ("soft", {}, "dictionary"),
}


@pytest.mark.parametrize("name", WRONG)
def test_mismatched_laws_are_refused(device, name):
    laws, options, message = WRONG[name]
    with pytest.raises(ddg.SceneError, match=message):
        cantilever(laws, **options).build(device)


def test_rigid_joints_of_rods_with_laws_ask_for_one(device):
    scene = cantilever(LAW)
    second = scene.add_rod(line(4, (0.0, 0.3, 0.0)), section=SECTION)
    scene.join([(0, 0), (second, 0)])
    with pytest.raises(ddg.SceneError, match=r"law of its own.*join\(laws="):
        scene.build(device)


def elbow(joint=None, rods=None, **options) -> ddg.Scene:
    """Return a clamped rod with a second one joined rigidly to the end, along or across."""
    scene = ddg.Scene(gravity=(0.0, -1.0, -3.0))
    nodes = np.linspace((0.5, 0.0, 0.0), options.get("end", (0.5, 0.4, 0.0)), 7)
    rod = scene.add_rod(line(7, (0.5, 0.0, 0.0)), section=SECTION, laws=rods, natural=options.get("natural", "shape"))
    second = scene.add_rod(nodes, section=SECTION, laws=rods)
    scene.clamp(rod)
    scene.join([(rod, -1), (second, 0)], laws=joint)
    return scene


def test_a_joints_law_given_by_hand_is_the_usual_one(device):
    """Default law and explicit law give bitwise equal steps, equilibria and worlds."""
    by_hand = {"rigid_joint": ddg.Law(quadratic, stiffness=[2.0, 2.0, 2.0])}
    usual, same = (moved(elbow(joint), device)[0] for joint in (None, by_hand))
    np.testing.assert_array_equal(same, usual)
    usual, same = (solve(elbow(joint).build(device, "float64", worlds=2)).points() for joint in (None, by_hand))
    np.testing.assert_array_equal(same, usual)


def test_joined_rods_with_laws_bend_as_one(device):
    """Two collinear rods joined with their own law bend as one rod: both half cells form one vertex."""
    soft, along = ddg.Law(saturating, modulus=K, limit=0.3), (1.0, 0.0, 0.0)
    law, joint = {"rod_bend_twist": soft}, {"rigid_joint": soft}
    joined, stiff = (
        solve(elbow(*options, end=along, natural="straight").build(device, "float64"), load_steps=4).points()
        for options in ((joint, law), (None, None))
    )
    whole = solve(cantilever(law).build(device, "float64"), load_steps=4).points()
    error, change = np.abs(np.delete(joined, 7, 0) - whole).max(), np.abs(joined - stiff).max()
    assert change > 0.01 and error < 0.01 * change


def with_laws(name: str) -> ddg.Scene:
    """Return a scene with the saturating law at a joint or shell."""
    law = ddg.Law(saturating, modulus=0.2, limit=0.5)
    return elbow({"rigid_joint": law}) if name == "rigid_joint" else flag({name: law})


@pytest.mark.parametrize("name", ["rigid_joint", "shell_bend_dof"])
def test_parameters_of_laws_of_joints_and_shells_have_gradients(name):
    """Gradients of a step by modulus and limit equal differences."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    simulator = Simulator(with_laws(name).build("cpu", "float64"), 0.05, rtol=1e-12)
    start = simulator.world_state(simulator.model.state())
    for _ in range(2):
        start = simulator.step(start)
    for parameter in ("modulus", "limit"):
        key = f"{name}.{parameter}"
        nominal = simulator.parameter(key).clone()

        def height(value, key=key):
            return simulator.step(start, {key: value}).positions[..., 2].sum()

        tracked = nominal.clone().requires_grad_()
        (slope,) = torch.autograd.grad(height(tracked), tracked)
        difference = (height(1.01 * nominal) - height(0.99 * nominal)) / 0.02
        torch.testing.assert_close((slope * nominal).sum(), difference, rtol=1e-3, atol=1e-12)


def test_a_hinged_joint_has_no_law():
    with pytest.raises(ddg.SceneError, match="hinged joint has no energy"):
        scene = cantilever()
        second = scene.add_rod(line(4, (0.0, 0.3, 0.0)), section=SECTION)
        scene.join([(0, 0), (second, 0)], rigid=False, laws=LAW)


RUBBER = ddg.Material(1e6, 0.3, 1000.0)


def flag(laws=None, viscosity: float = 0.0, bending: str = "midedge_dof", **options) -> ddg.Scene:
    """Return a sheet clamped at one side."""
    points, triangles = meshes.rectangle(4, 3, (0.4, 0.3))
    scene = ddg.Scene(gravity=(0.0, 0.0, -3.0))
    material = replace(RUBBER, viscosity=viscosity)
    shell = scene.add_shell(points, triangles, thickness=0.01, material=material, bending=bending, laws=laws, **options)
    scene.clamp_boundary(shell, np.flatnonzero(np.asarray(points)[:, 0] < np.asarray(points)[:, 0].min() + 1e-9))
    return scene


@pytest.mark.parametrize("viscosity", [0.0, 0.05])
@pytest.mark.parametrize("bending", ["midedge_dof", "hinge"])
def test_a_shells_law_given_by_hand_is_the_usual_one(device, viscosity, bending):
    """Default law and explicit law give bitwise equal steps and equilibria."""
    by_hand = {"shell_stretch": ddg.Law(st_venant_kirchhoff)}
    by_hand |= (
        {"shell_hinge": ddg.Law(quadratic)} if bending == "hinge" else {"shell_bend_dof": ddg.Law(st_venant_kirchhoff)}
    )
    usual, same = (moved(flag(laws, viscosity, bending), device)[0] for laws in (None, by_hand))
    np.testing.assert_array_equal(same, usual)
    usual, same = (solve(flag(laws, viscosity, bending).build(device, "float64")).points() for laws in (None, by_hand))
    np.testing.assert_array_equal(same, usual)


@pytest.mark.parametrize("worlds", [1, 2])
def test_hinges_with_a_law_fold_as_it_says(device, worlds):
    """The hinge of two triangles with a loaded free corner follows m(t) = K t / sqrt(1 + (t / c)^2).

    With the lever a of the free corner, the force F across it and the weight w of the hinge, F a = w m(t).
    """
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.5, -1.0, 0.0]])
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    law = ddg.Law(saturating, modulus=K, limit=LIMIT)
    shell = scene.add_shell(
        points,
        np.array([[0, 1, 2], [1, 0, 3]]),
        thickness=0.01,
        material=ddg.Material(1e9, 0.3),
        bending="hinge",
        laws={"shell_hinge": law},
    )
    scene.hold(shell, [0, 1, 3])
    scene.add_vertex_force(shell, [2], (0.0, 0.0, 1.0))
    model = scene.build(device, "float64", worlds=worlds)
    state = solve(model, load_steps=4)
    _, y, z = state.points().reshape(worlds, -1, 3)[:, 2].T
    fold = np.arctan2(z, y)
    weight = 1.0 / ((0.5 + 0.5) / 3.0)  # squared length over a third of the areas
    np.testing.assert_allclose(y, weight * K * fold / np.sqrt(1.0 + (fold / LIMIT) ** 2), rtol=1e-5)
    assert (fold > 0.1).all()


def test_shells_with_and_without_a_law_are_two_sets(device):
    """Rest shapes of two shells change separate element sets."""
    scene = flag({"shell_bend_dof": ddg.Law(replace(st_venant_kirchhoff, name="other"))})
    points, triangles = meshes.rectangle(4, 3, (0.4, 0.3))
    scene.add_shell(np.asarray(points) + [0.0, 1.0, 0.0], triangles, thickness=0.01, material=RUBBER)
    model = scene.build(device, "float64")
    assert len([part for part in model.coupled.sets if part.term.name == "shell_bend_dof"]) == 2
    start = model.state().points()
    for shell in (0, 1):
        model.set_rest(shell, metric=1.1 * model.coupled.host.shells[shell].plate.abar)
    model.set_rest(0, curvature=0.01 * np.ones((len(triangles), 3)))
    half = len(start) // 2
    integrator, state = ddg.Integrator(model, rtol=1e-8), model.state()
    after = integrator.step(state, 0.02).points()
    assert np.abs(after - start)[:half].max() > 1e-4 and np.abs(after - start)[half:].max() > 1e-4


def test_fields_of_triangles_know_the_law_of_the_material_alone(device):
    model = with_laws("shell_bend_dof").build(device, "float64")
    with pytest.raises(ValueError, match=r"triangle_fields: shell_bend_dof of shell 0 .* has the law 'saturating'"):
        quantities.triangle_fields(model, model.state())
    assert quantities.energies(model, model.state())


def test_parameters_of_shells_are_of_the_law_of_their_material():
    pytest.importorskip("torch")
    from ddg_warp.torch import ShellParameters, Simulator

    model = with_laws("shell_bend_dof").build("cpu", "float64")
    with pytest.raises(ddg.SceneError, match=r"shell 0 \('shell'\) has a law of its own"):
        ShellParameters(Simulator(model, 0.02))


WRONG_OF_SHELLS = {
    "term": ({"shell_hinge": ddg.Law(quadratic)}, "shell 'shell': laws: it has no term 'shell_hinge'"),
    "rest": ({"shell_stretch": ddg.Law(saturating, modulus=K, limit=LIMIT)}, "no strains at rest, and the shell has"),
    "missing": ({"shell_bend_dof": ddg.Law(saturating, modulus=K)}, "limit is missing"),
    "shape": ({"shell_bend_dof": ddg.Law(saturating, modulus=np.ones(5), limit=1.0)}, "broadcast to 24 triangles"),
    "no law": ({"shell_bend_dof": 3.0}, r"give Law\(density"),
}


@pytest.mark.parametrize("name", WRONG_OF_SHELLS)
def test_what_does_not_fit_a_shell_is_refused(device, name):
    laws, words = WRONG_OF_SHELLS[name]
    with pytest.raises(ddg.SceneError, match=words):
        flag(laws).build(device)


def test_parameters_of_a_law_change_by_name(device):
    model = cantilever(LAW).build(device, "float64")
    assert float(model.parameters()["0/rod_bend_twist/limit"].flat[0]) == LIMIT
    model.set_parameter("rod_bend_twist", "limit", 300.0)
    with pytest.raises(ValueError, match="positive"):
        model.set_parameter("rod_bend_twist", "limit", 0.0)
    integrator, state = ddg.Integrator(model, rtol=1e-10), model.state()
    for _ in range(20):
        state = integrator.step(state, 0.02)
    expected, _ = moved(cantilever({"rod_bend_twist": ddg.Law(saturating, modulus=K, limit=300.0)}), device)
    np.testing.assert_allclose(state.points(), expected, atol=1e-10)
