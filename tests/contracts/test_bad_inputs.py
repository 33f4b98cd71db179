"""Bad input is refused with an error that names the object, its index and the remedy; nothing is built.

The cases are data, in `bad_inputs` and its modules: 0 crashes, 0 errors of Python or NumPy, 0 silent results.
"""

import numpy as np
import pytest
from bad_inputs import CASES, NAN, RING, RUBBER, STIFFNESS, built, counts, dome, is_bare, line, model, rods, sheet

import ddg_warp as ddg
from ddg_warp.errors import SolverError

pytest.importorskip("torch")
COUNTS = counts()  # imports the modules of all cases


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", CASES, ids=str)
def test_case_is_refused(case):
    with np.errstate(all="ignore"), pytest.raises((ValueError, SolverError)) as caught:
        case.action()
    assert not is_bare(caught.value)
    missing = [word for word in case.words if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"


def test_cases_are_many_and_different():
    """There are at least 1,900 cases, all different."""
    assert sum(COUNTS.values()) == len(CASES) >= 1900
    assert len({str(case) for case in CASES}) == len(CASES)
    assert all(case.words for case in CASES)


def test_valid_inputs_build():
    """The valid objects build, so that refusals have no other reason."""
    assert model().curves.counts.tolist() == [7, 5]
    assert built(dome(), lambda s: s.hold_ring(0, 5)).points_count == 6
    assert built(sheet(), lambda s: s.hold(0, [0])).points_count == 16
    ddg.Material(1.0, 0.5, 0.0)
    ddg.Material(1.0, -0.99)
    ddg.Circle(np.array([0.1, 0.2]))


def test_refused_calls_leave_the_scene_unchanged():
    """A refused call leaves the scene unchanged."""
    scene = rods(RING, closed=True)
    for action in (
        lambda: scene.add_rod(line(), section=3.0),
        lambda: scene.add_force(1, 9, (0.0, 0.0, 1.0)),
        lambda: scene.clamp_end(1),
        lambda: scene.add_shell(np.zeros((3, 3)), [[0, 1, 2]], thickness=0.1, material=RUBBER),
    ):
        with pytest.raises(ddg.SceneError):
            action()
    assert (scene.rod_count, scene.loads, scene.supports, scene.shells) == (2, [], [], [])


def test_refused_parameters_stay_unchanged(device):
    """Refused parameters stay unchanged in rod groups and coupled systems."""
    for kind, term in (("rods", "rod_stretch"), ("net", "rod_stretch"), ("hinge", "shell_hinge")):
        made = model(kind)
        before = {name: values.copy() for name, values in made.parameters().items()}
        for value in (-1.0, NAN, np.ones(99)):
            with pytest.raises(ValueError, match=term):
                made.set_parameter(term, "stiffness", value)
        for name, values in made.parameters().items():
            np.testing.assert_array_equal(values, before[name])


@pytest.mark.parametrize(
    "chosen",
    [
        np.array([0, 3]),
        [np.int64(0), np.int32(3)],
        np.array([True, False, False, True]),
        [True, False, False, True],
        range(0, 4, 3),
        slice(None, None, 3),
        {0, 3},
        (0, -1),
    ],
    ids=repr,
)
def test_selections_of_all_forms_agree(chosen):
    """Edges 0 and 3 of four make the same clamp in every form of selection."""
    scene = rods()
    scene.clamp(np.array([False, True]), chosen)
    assert [edge % 4 for edge in scene.supports[0].edges] == [0, 3]
    assert scene.supports[0].rods.tolist() == [1]


def test_masks_indices_and_slices_agree():
    """A mask, its indices and a slice select the same vertices of a shell and of a meridian."""
    scene = sheet()
    for chosen in (scene.shells[0].points[:, 0] == 0.0, np.arange(0, 16, 4), slice(0, 16, 4)):
        scene.hold(0, chosen)
    for support in scene.shell_supports:
        assert support.vertices.tolist() == [0, 4, 8, 12]
    meridian = dome()
    meridian.hold_ring(0, np.arange(6) > 3)
    assert meridian.ring_supports[0].nodes.tolist() == [4, 5]


def test_numpy_integers_are_valid_indices():
    """NumPy integers, as of `np.flatnonzero`, are valid indices of rods and nodes."""
    scene = rods()
    scene.add_force(np.int64(1), np.int64(4), np.array([0.0, 0.0, 1.0]))
    scene.join([(np.int64(0), np.int32(0)), (1, 0)])
    assert scene.joints[0].members == ((0, 0), (1, 0))
    assert scene.loads[0].node == 4
    assert scene.add_rod(line(), section=STIFFNESS) == 2
