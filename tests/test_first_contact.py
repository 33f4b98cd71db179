"""First contact: names, messages, reports and notices that a newcomer meets."""

import subprocess
import sys

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import kernels, meshes, statics
from ddg_warp.io.mesh_read import read_mesh
from ddg_warp.run import warmup


def cable(device, analysis=None):
    scene = ddg.Scene(**({"analysis": analysis} if analysis else {}))
    rod = scene.add_rod(
        np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5),
        section=ddg.Circle(0.02),
        material=ddg.Material(young=1e7, density=1000.0),
    )
    scene.clamp(rod)
    return scene.build(device)


def test_load_parameters_are_no_seconds(device):
    model = cable(device)
    assert repr(model.state()).startswith("<State at t = 0 s: 1 world of 5 points")
    assert repr(statics.solve(model)).startswith("<State at load parameter 1: 1 world of 5 points")
    assert repr(cable(device, ddg.Statics()).state()).startswith("<State at load parameter 0:")


def test_objects_show_themselves_in_a_line(device):
    model = cable(device)
    assert repr(model) == f"<Model of 1 rod: 1 world of 5 points on {model.device} in {model.precision}>"
    integrator = ddg.Integrator(model, "implicit_midpoint")
    assert repr(integrator) == f"<Integrator by implicit_midpoint, solver newton, of {model!r}>"
    result = ddg.simulate(model.scene, device=device, duration=0.02, progress=False)
    assert repr(result).startswith(f"<Result: 3 states on {model.device}, times 0 to 0.02, ")


def test_models_and_states_move_to_devices(device):
    """States stay with models, and say how to copy both."""
    model = cable(device)
    state = ddg.Integrator(model).step(model.state(), 0.01)
    assert model.to(device) is model
    assert state.to(device) is state
    with pytest.raises(ddg.SceneError, match="device is 'abacus'; there is"):
        model.to("abacus")
    with pytest.raises(ddg.SceneError, match="device is 'abacus'; there is"):
        state.to("abacus")
    target = model.to("cpu")
    copy = target.restore(state.snapshot())
    np.testing.assert_array_equal(copy.points(), state.points())
    if target is not model:
        with pytest.raises(ddg.SceneError, match=r"a state lives with its model, .*restore"):
            state.to("cpu")


def test_report_lists_absent_terms_on_request_only(device):
    model = cable(device)
    assert "rod_bend_twist: 3 elements" in model.report()
    assert "not in this scene" not in model.report()
    assert "not in this scene: " in model.report(absent=True)


def test_mesh_takes_the_result_of_read_mesh(tmp_path):
    points, triangles = meshes.sphere(1, 0.1)
    lines = [f"v {x} {y} {z}" for x, y, z in points] + ["f {} {} {}".format(*(t + 1)) for t in triangles]
    (tmp_path / "post.obj").write_text("\n".join(lines))
    mesh = ddg.Mesh(read_mesh(tmp_path / "post.obj"), radius=0.01)
    np.testing.assert_allclose(mesh.points, points)
    np.testing.assert_array_equal(mesh.cells, triangles)
    assert mesh.radius == 0.01
    with pytest.raises(ddg.SceneError, match=r"there are no triangles; give points .* or what read_mesh returns"):
        ddg.Mesh(points)


def test_unknown_names_are_refused_with_the_nearest(device):
    with pytest.raises(AttributeError, match=r"no attribute 'Recordr'; did you mean 'Recorder'\?"):
        _ = ddg.Recordr
    model = cable(device)
    with pytest.raises(
        ValueError, match=r"the term 'rod_strech'; did you mean 'rod_stretch'\? this model has rod_bend_twist"
    ):
        model.set_parameter("rod_strech", "stiffness", 1.0)
    with pytest.raises(ValueError, match=r"no parameter 'stifness'; did you mean 'stiffness'\? it has"):
        model.set_parameter("rod_stretch", "stifness", 1.0)


def test_help_names_every_public_name_in_a_section():
    for name in ddg.__all__:
        assert f"`{name}`" in ddg.__doc__, name


def test_warp_starts_without_a_warning_of_a_missing_driver():
    code = "import ddg_warp as ddg; from ddg_warp import kernels; import warp; warp.get_devices()"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "CUDA" not in result.stderr


def test_long_compilation_is_announced_once(monkeypatch, caplog):
    class Build:
        build_cpu = staticmethod(lambda seconds: seconds)

    clock = iter([0.0, 3.0, 3.0, 3.5, 3.5, 4.0])
    monkeypatch.setattr(kernels.time, "monotonic", lambda: next(clock))
    kernels.announce_compilation(Build)
    with caplog.at_level("WARNING", "ddg_warp"):
        assert [Build.build_cpu(n) for n in range(3)] == [0, 1, 2]
    assert [record.getMessage().split(",")[0] for record in caplog.records] == [
        "ddg_warp: kernels compile for the first time"
    ]


def test_warmup_runs_every_usual_scene(device):
    assert [name for name, seconds in warmup.warm_up(device) if seconds > 0.0] == list(warmup.SCENES)


def test_a_missing_install_names_the_remedy(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name="ddg_warp.kernels")

    monkeypatch.setattr(ddg, "import_module", missing)
    with pytest.raises(ModuleNotFoundError, match="pip install -e"):
        _ = ddg.Integrator
