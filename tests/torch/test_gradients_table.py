"""The table of gradients: every input is right or refused by name; output of the command, and past defects."""

import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from ddg_warp.run.cli import main
from tests.adjoint.differences import TIGHT, built
from tests.adjoint.test_adjoint import CURVE, DT, SCENES

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator, gradient_check, gradient_check_scenes  # noqa: E402
from tests.pairwise import chosen  # noqa: E402

# Objects that no other test of gradients differentiates, and one of each analysis.
FAST = [
    ("rod", "statics"),
    ("planar rod", "implicit_euler"),
    ("shell of revolution", "implicit_euler"),
    ("shell clamped by a grip", "implicit_euler"),
    ("gripped rod", "statics"),
    ("shell clamped in a motion", "implicit_midpoint"),
    ("gripped rod that rolls another", "implicit_euler"),
    ("held rod on a gripped ball", "statics"),
    ("rod on a gripped ball", "implicit_midpoint"),
    ("rod with bodies", "implicit_euler"),
    ("rod with bodies", "statics"),
    ("rod on a rigid box", "implicit_euler"),
]
FALLING = ("rods in contact", "gripped rod that rolls another", "rod on a gripped ball")  # which have no equilibrium
HELD = [f"held rod {how} a gripped ball" for how in ("on", "that rubs", "that rolls on")]
IN_CONTACT = (*FALLING, *HELD, "rod on a rigid box", "shell on a plane")  # which the midpoint rule refuses
WORDS = ("no gradient goes", "does not differentiate", "serves statics and spectra")  # of which refusals have one


def right(rows: list[dict]) -> None:
    wrong = [
        row for row in rows if row["result"] not in (gradient_check.RIGHT, gradient_check.NONE, gradient_check.REFUSED)
    ]
    assert rows
    assert not wrong
    for row in rows:
        assert row["result"] != gradient_check.REFUSED or any(word in row["reason"] for word in WORDS), row


@chosen(FAST, name=gradient_check.OBJECTS, analysis=gradient_check.ANALYSES)
def test_every_input_is_right_or_refused(device, name, analysis):
    rows = list(gradient_check.table([name], [analysis], device))
    refusing = {"implicit_euler": (), "implicit_midpoint": IN_CONTACT, "statics": FALLING}
    if name in refusing[analysis]:
        assert [row["result"] for row in rows] == [gradient_check.REFUSED]
        assert rows[0]["reason"].startswith(
            ("no equilibrium", "statics with") if analysis == "statics" else "contact: "
        )
        return
    right(rows)
    if (name, analysis) in (("rod with bodies", "implicit_midpoint"), ("rod on a rigid box", "statics")):
        assert {row["result"] for row in rows} == {gradient_check.REFUSED}
        return
    if "curved" not in name or analysis == "statics":  # whose dynamics is refused
        refused = [row["input"] for row in rows if row["result"] == gradient_check.REFUSED]
        assert set(refused) <= ({"positions", "angles"} if analysis == "statics" else {"time step"})


@chosen(["implicit_euler"], analysis=("implicit_euler", "statics"))
def test_a_user_defined_law(device, analysis, monkeypatch):
    from tests.test_laws import saturating

    law = {"rod_bend_twist": ddg.Law(saturating, modulus=1e-4, limit=5.0)}

    def add(scene, material):
        scene.clamp(scene.add_rod(CURVE, section=ddg.Circle(0.004), material=material, laws=law, natural="straight"))

    monkeypatch.setitem(gradient_check_scenes.OBJECTS, "own", (3, add))
    rows = list(gradient_check.table(["own"], [analysis], device))
    right(rows)
    assert {"rod_bend_twist.modulus", "rod_bend_twist.limit"} <= {r["input"] for r in rows if r["result"] == "right"}


def test_the_command_prints_it(tmp_path, capsys, device):
    assert (
        main(
            [
                "gradients",
                "planar rod",
                "--analysis",
                "implicit_euler",
                "--device",
                device,
                "--out",
                str(tmp_path / "table"),
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert "planar_bend.stiffness" in printed
    assert "0 wrong" in printed
    assert (tmp_path / "table.csv").read_text().startswith("object,analysis,input,result,error,reason")
    assert main(["gradients", "balloon"]) == 2
    assert "there is no 'balloon'; there are rod" in capsys.readouterr().err


def test_wrong_gradients_fail(monkeypatch, capsys, device):
    """A gradient that is lost, and one that is off."""
    usual = gradient_check.derivatives
    spoilt = {"velocities": 0.0, "gravity": 1.01}

    def off(case, inputs):
        return [value * spoilt.get(each.name, 1.0) for each, value in zip(inputs, usual(case, inputs), strict=True)]

    monkeypatch.setattr(gradient_check, "derivatives", off)
    assert main(["gradients", "planar rod", "--analysis", "implicit_euler", "--device", device]) == 1
    printed = capsys.readouterr().out
    assert "SILENT ZERO" in printed
    assert "WRONG" in printed
    assert "2 wrong" in printed


def test_parameters_of_several_tables_one_after_the_other():
    """Shells have a table for each term; values of one table end with the step, also if another follows."""
    simulator = Simulator(built(SCENES["sheet"]()), DT, **TIGHT)
    state = simulator.step(simulator.step(simulator.initial_state()))
    usual = simulator.step(state).positions
    stretch, bend = (
        next(n for n in simulator.engine(1).tables.names() if n.startswith(k)) for k in ("shell_stretch", "shell_bend")
    )
    simulator.step(state, {stretch: 2.0 * simulator.parameter(stretch)})
    bent = simulator.step(state, {bend: simulator.parameter(bend)}).positions
    torch.testing.assert_close(bent, usual, rtol=0.0, atol=0.0)


def test_an_equilibrium_refuses_a_history():
    simulator = Simulator(built(SCENES["planar"]()), DT)
    points = torch.tensor(simulator.model.state().points()).requires_grad_()
    state = simulator.initial_state(positions=points)
    with pytest.raises(SceneError, match=r"no gradient goes to the initial state of the search.*detach"):
        simulator.equilibrium(state=state)
    assert torch.isfinite(simulator.equilibrium(state=state.detach()).positions).all()
