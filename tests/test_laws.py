"""Constitutive laws: named parameters, damping, and user laws in scenes and in the derivative table."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_readme import BLOCKS

import ddg_warp as ddg
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.kernels.terms import ALL, CONTACT, FRICTION, MAGNETS, REGISTRY
from ddg_warp.run import derivatives
from ddg_warp.run.catalog import load_file
from ddg_warp.run.cli import main
from ddg_warp.solve.statics import solve

FILE = Path(tempfile.mkdtemp()) / "my_law.py"  # the README's law, in a file, since Warp reads the source of functions
FILE.write_text(dict(BLOCKS)["my_law.py"])
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
    assert len([element_set for element_set in model.net.sets if element_set.term.name == "rod_bend_twist"]) == 2
    names = model.parameters().keys()
    assert {"net/rod_bend_twist/limit", "net/rod_bend_twist 1/stiffness_1"} <= names
    joined, _ = moved(scene, device)
    np.testing.assert_allclose(joined[:13], single, atol=1e-8)


@pytest.mark.slow  # the README's command runs daily
@pytest.mark.parametrize("damped", [False, True])
def test_derivatives_of_a_user_law(device, damped):
    term = replace(REGISTRY["rod_bend_twist"], density=saturating).damped(damped)
    for row in derivatives.table(term, "float64", device):
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


def test_rigid_joints_refuse_other_laws(device):
    scene = cantilever(LAW)
    second = scene.add_rod(line(4, (0.0, 0.3, 0.0)), section=SECTION)
    scene.join([(0, 0), (second, 0)])
    with pytest.raises(ddg.SceneError, match="law of its own"):
        scene.build(device)


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
