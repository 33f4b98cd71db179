"""Scenes use only needed features: no twist in springs, no heavy package on import."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.compile import memory
from ddg_warp.postprocess import model_report

TWIST = ("transport(", "reference_twist(", "rotate(", "relag", "atan2(")
HEAVY = ("warp", "torch", "pxr", "h5py", "scipy", "matplotlib")


@pytest.fixture
def launched(monkeypatch) -> list:
    """Return kernels launched during the test."""
    kernels, launch = [], wp.launch

    def record(kernel, *arguments, **options):
        kernels.append(kernel)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", record)
    return kernels


def run(device, steps=3, **options):
    """Return model, integrator and state of a hanging rod after some steps."""
    scene = ddg.Scene(dimension=options.pop("dimension", 3))
    points = np.zeros((6, 3))
    points[:, 0] = np.arange(6.0)
    section = ddg.Stiffness(EA=50.0, EI1=1.0, GJ=1.0, mass_per_length=1.0, rotary_inertia=0.1)
    rod = scene.add_rod(points, section=section, **options)
    scene.fix(rod, [0, 1])
    if options.get("twist", options.get("bend", True)) and scene.dimension == 3:
        scene.fix_twist(rod, [0])
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(steps):
        state = integrator.step(state, 0.01)
    return model, integrator, state


def sources(kernels) -> dict[str, str]:
    """Return generated code of kernels by name."""
    result = {}
    for kernel in kernels:
        threads = next(threads for _, threads in kernel.module.execs)  # in a block
        folder = Path(wp.config.kernel_cache_dir) / kernel.module.get_module_identifier(threads)
        (code,) = (f.read_text() for f in folder.iterdir() if f.suffix in (".cpp", ".cu"))
        result[kernel.key] = code
    return result


def test_springs_have_no_angles_and_no_frames(device):
    model, integrator, state = run(device, bend=False)
    (group,) = model.groups
    assert [term.name for term in group.kind.terms] == ["rod_stretch"]
    assert (group.kind.block, group.kind.window, group.kind.factor_rows) == (3, 3, 4)
    (data,) = state.groups
    for name in ("theta", "omega", "frame", "last"):
        assert getattr(data, name).size == 1, name  # a placeholder for kernel signatures
    assert data.x.shape == data.v.shape == (6, 1)
    newton = integrator._rod_steps[0].newton
    assert newton.direction.shape[0] == 3
    assert newton.elimination.shape[0] == 9
    assert newton.iterates.theta.size == newton.iterates.target_angle.size == 1
    assert state.points()[-1, 2] < 0.0  # it falls


def test_rods_of_two_nodes_are_springs_with_a_warning(device):
    """Two nodes neither bend nor twist, with any options; a ring of two nodes is refused."""
    scene = ddg.Scene()
    options = {"section": ddg.Circle(0.01), "material": ddg.Material(1e6), "name": "hair"}
    strands = np.array([[[0.0, y, 0.0], [0.1, y, 0.0]] for y in (0.0, 1.0)])
    with pytest.warns(ddg.SceneWarning, match="'hair' have 2 nodes each, and no vertex"):
        scene.add_rods(strands, **options)
    scene.fix(0, [0])
    model = scene.build(device=device)
    assert [term.name for group in model.groups for term in group.kind.terms] == ["rod_stretch"]
    state = ddg.Integrator(model).step(model.state(), 0.01)
    z = state.points()[:, 2]
    assert z[0] == 0.0 and (z[1:] < 0.0).all()
    with pytest.raises(ddg.SceneError, match=r"rod 2 .* has 2 nodes; it needs at least 3"):
        scene.add_rods(strands, closed=True, **options)
        scene.build(device=device)


@pytest.mark.parametrize(
    ("options", "block"),
    [({}, 4), ({"twist": False}, 3), ({"bend": False}, 3), ({"dimension": 2}, 2), ({"dimension": 2, "bend": False}, 2)],
    ids=["full", "untwisted", "stretch", "planar", "planar stretch"],
)
def test_twist_kernels_are_launched_only_for_rods_with_twist(device, launched, options, block):
    model, _, state = run(device, **options)
    code = sources(launched)
    words = {word for text in code.values() for word in TWIST if word in text}
    names = {key.split("_kernel")[0] for key in code}
    assert model.groups[0].kind.block == block
    assert {"evaluate", "sweep", "begin", "finish", "advance"} <= names
    if block == 4:
        assert words == set(TWIST)
        assert "finish_frames" in names
        assert state.angles().shape == (5,)
    else:
        assert not words
        assert not names & {"finish_frames", "motion", "load", "strain"}
        assert state.angles() is None


@pytest.mark.parametrize("options", [{"twist": False}, {"bend": False}, {"dimension": 2}])
def test_no_directors_without_twist(device, options):
    _, _, state = run(device, steps=0, **options)
    assert state.directors() is None


def test_no_bending_kernels_for_springs(device, launched):
    """The element kernel of springs reads one edge."""
    run(device, bend=False)
    springs = sources(launched)
    launched.clear()
    run(device, twist=False)
    bending = sources(launched)
    evaluate = "evaluate_kernel__locals__evaluate"
    assert "cross" in bending[evaluate]
    assert "cross" not in springs[evaluate]
    assert len(springs[evaluate]) < 0.7 * len(bending[evaluate])


def test_import_is_light_and_fast():
    """`import ddg_warp` in a fresh interpreter takes under half a second, best of three, without heavy packages."""
    program = (
        "import sys, time\n"
        "before = set(sys.modules)\n"
        "start = time.perf_counter()\n"
        "import ddg_warp\n"
        "print(time.perf_counter() - start)\n"
        "print(*{name.split('.')[0] for name in set(sys.modules) - before})\n"
    )
    times = []
    for _ in range(3):
        output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
        seconds, names = output.splitlines()
        times.append(float(seconds))
        assert "ddg_warp" in names.split()
        assert not set(names.split()) & set(HEAVY)
    assert min(times) < 0.5


def test_describing_a_scene_needs_no_warp():
    """Describing a scene needs NumPy only; Warp comes with `build`."""
    program = (
        "import sys, numpy as np, ddg_warp as ddg\n"
        "scene = ddg.Scene()\n"
        "rod = scene.add_rod(np.eye(3), section=ddg.Circle(0.01), material=ddg.Material(1e6))\n"
        "scene.clamp(rod)\n"
        "print(*sys.modules)\n"
    )
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert not {name.split(".")[0] for name in output.split()} & set(HEAVY)


@pytest.mark.parametrize("options", [{}, {"twist": False}, {"bend": False}, {"dimension": 2}], ids=str)
@pytest.mark.parametrize("precision", ["float64", "mixed"])
def test_report_states_the_memory_of_a_node(device, options, precision):
    """The report states the bytes of all arrays of states and solver, and no build is refused that would fit."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), dimension=options.get("dimension", 3))
    points = np.zeros((5, 16, 3))
    points[..., 0] = np.linspace(0.0, 1.0, 16)
    kind = {"section": ddg.Circle(2e-3), "material": ddg.Material(young=1e7, poisson=0.5, density=1000.0)}
    scene.clamp(
        scene.add_rods(points, **kind, **{key: value for key, value in options.items() if key != "dimension"}),
        edges=[0],
    )
    model = scene.build(device, precision)
    integrator = ddg.Integrator(model)
    state = integrator.step(model.state(), 1e-3)
    (step,), (group,) = integrator._rod_steps, model.groups
    newton = step.newton
    arrays = [group.mass, group.rotary, group.fixed, newton.rhs, newton.direction, newton.elimination]
    arrays += [*newton.islands.arrays, step._predicted, step._predicted_angle]
    arrays += [*vars(newton.iterates).values(), *vars(newton.elements).values()]
    sizes = {array.ptr: array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays if array.size > 1}
    of_state = [array for array in state.groups[0].arrays().values() if array.size > 1]
    sizes["states"] = 2 * sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in of_state)
    stated = model_report.bytes_per_node(model, group)
    assert f"memory: {stated} bytes a node" in model.report()
    assert sum(sizes.values()) / points[..., 0].size == pytest.approx(stated, abs=2.0)
    assert memory._rod_bytes(scene, precision) <= stated * points[..., 0].size
