"""Pages of the viewer in headless Chromium; skipped where playwright, Chromium or viser is missing."""

import os
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

import ddg_warp as ddg

pytest.importorskip("viser", reason="needs viser: pip install -e .[view]")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if CHROMIUM is None:
    pytest.skip("needs Chromium: apt-get install chromium", allow_module_level=True)
pytestmark = pytest.mark.slow
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
BACKGROUND = 250  # brightness above which a pixel is background
SIZE = {"width": 1000, "height": 600}
PANEL = 640  # column where the panel of controls begins


@pytest.fixture(scope="module")
def browser():
    """Start Chromium with software rendering."""
    with playwright.sync_playwright() as tools:
        chromium = tools.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser):
    page = browser.new_page(viewport=SIZE)
    page.errors = []
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    yield page
    page.close()


def screenshot(page, name: str) -> np.ndarray:
    """Return RGB of the page without panels (height, width, 3); keep the picture in the folder of DDG_WARP_SCREENSHOTS."""
    from io import BytesIO

    from matplotlib.image import imread

    data = page.screenshot()
    if folder := os.environ.get("DDG_WARP_SCREENSHOTS"):
        (Path(folder) / f"{name}.png").write_bytes(data)
    return np.round(255 * imread(BytesIO(data))[150:, :PANEL, :3]).astype(int)


def drawn(picture: np.ndarray) -> int:
    """Return the number of pixels that are no background."""
    return int((picture.min(-1) < BACKGROUND).sum())


def in_thread(function):
    """Run a function in a daemon thread; return the thread."""
    thread = threading.Thread(target=function, daemon=True)
    thread.start()
    return thread


def ball_run(path) -> ddg.Model:
    """Record a hanging rod that swings against a ball; return the model."""
    points = np.zeros((12, 3))
    points[:, 0] = np.linspace(0.0, 1.0, 12)
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    rod = scene.add_rod(points, section=ddg.Circle(0.02), material=ddg.Material(young=1e6, density=1000.0))
    scene.clamp(rod, edges=[0])
    scene.add_obstacle(ddg.Sphere((0.6, 0.0, -0.35), 0.2))
    scene.contact()
    model = scene.build(device="cpu")
    integrator, state = ddg.Integrator(model), model.state()
    with ddg.Recorder(model, path, velocities=True, fields=["curvature_2"], contacts=True, usd=False) as recorder:
        recorder.record(state)
        for _ in range(60):
            state = integrator.step(state, 0.01)
            recorder.record(state)
    return model


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a recorded run."""
    path = tmp_path_factory.mktemp("run")
    ball_run(path)
    return path


def test_a_recorded_run_plays(run, page):
    from ddg_warp.view.player import Player
    from ddg_warp.view.recording import Recording

    player = Player(Recording(run), port=8160)
    thread = in_thread(lambda: player.run(60.0))
    page.goto(player.stage.url)
    page.wait_for_timeout(4000)
    first = screenshot(page, "player_first")
    assert drawn(first) > 1000
    page.get_by_role("button", name="play").click()
    page.wait_for_timeout(700)
    page.get_by_role("button", name="pause").click()
    page.wait_for_timeout(500)
    moved = screenshot(page, "player_moved")
    assert 0 < player._line.value < 60
    assert drawn(np.where(np.abs(moved - first).max(-1, keepdims=True) > 20, 0, 255)) > 300
    assert not page.errors
    player._line.value = 60
    page.wait_for_timeout(1000)
    grey = screenshot(page, "player_last")
    player._field.value = "speed [m/s]"
    page.wait_for_timeout(1500)
    colored = screenshot(page, "player_field")
    assert np.abs(colored - grey).max() > 60
    assert "speed [m/s]" in page.content()
    assert "arrows: force on the first object" in page.content()
    assert thread.is_alive()
    player.stage.close()


def test_a_run_that_goes_on_is_followed(run, tmp_path):
    """A file that grows has further frames after a refresh."""
    from ddg_warp.io.hdf5 import TrajectoryReader
    from ddg_warp.view.recording import Recording

    points = np.zeros((4, 3))
    points[:, 0] = np.arange(4)
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    scene.clamp(scene.add_rod(points, section=ddg.Circle(0.02), material=ddg.Material(1e7, density=1000.0)))
    model = scene.build(device="cpu")
    integrator, state = ddg.Integrator(model), model.state()
    with ddg.Recorder(model, tmp_path, usd=False, block=2) as recorder:
        recording = Recording(tmp_path)
        assert len(recording) == 0 and recording.drawing is None
        counts = []
        for _ in range(6):
            recorder.record(state)
            state = integrator.step(state, 0.01)
            recording.refresh()
            counts.append(len(recording))
    assert counts == [0, 2, 2, 4, 4, 6]
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        assert np.array_equal(recording.frame(5).points, reader.points[5])


@pytest.mark.parametrize("failures", [3, 100])
def test_a_file_in_the_middle_of_a_write_is_opened_again(run, monkeypatch, failures):
    from ddg_warp.view import recording as module

    recording = module.Recording(run)
    before, opened, attempts = recording.frame(3).points, module.TrajectoryReader, iter(range(failures))

    def busy(path):
        if next(attempts, None) is not None:
            raise module.TrajectoryError("cut short")
        return opened(path)

    monkeypatch.setattr(module, "TrajectoryReader", busy)
    monkeypatch.setattr(module, "WAIT", 0.0)
    recording._version = None
    for _ in range(failures // (module.TRIES + 1)):
        with pytest.raises(module.TrajectoryError, match="cut short"):
            recording.refresh()
        with pytest.raises(module.TrajectoryError):
            recording.frame(3)
    assert recording.refresh() is False
    assert np.array_equal(recording.frame(3).points, before)


def test_a_saved_page_plays_without_python(run, page, tmp_path):
    from ddg_warp.run.cli import main

    target = tmp_path / "run.html"
    assert main(["view", str(run), "--save", str(target), "--field", "curvature_2"]) == 0
    assert target.stat().st_size < 5e6
    page.goto(target.as_uri())
    page.wait_for_timeout(4000)
    first = screenshot(page, "saved_first")
    assert drawn(first) > 1000
    assert "curvature_2 [1/m]" in page.content()
    page.wait_for_timeout(400)
    assert np.abs(screenshot(page, "saved_later") - first).max() > 60
    assert not page.errors


def test_a_view_is_saved_as_viser(run, tmp_path, capsys):
    from ddg_warp.run.cli import main

    assert main(["view", str(run), "--save", str(tmp_path / "run.viser")]) == 0
    assert (tmp_path / "run.viser").stat().st_size > 1000
    assert main(["view", str(run), "--save", str(tmp_path / "run.gif")]) == 2
    assert "ends in .viser or .html" in capsys.readouterr().err
    assert main(["view", str(run), "--save", str(tmp_path / "run.html"), "--field", "heat"]) == 2
    assert "recorded are speed [m/s], curvature_2 [1/m]" in capsys.readouterr().err
    assert main(["view", str(tmp_path)]) == 2
    assert "there is no run in" in capsys.readouterr().err


def test_a_running_model_is_pulled_and_reset(page):
    base = np.zeros((2, 11, 3))
    base[:, :, 0], base[1, :, 1] = np.linspace(0.0, 1.0, 11), 0.3
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), mass_damping=1.0)
    rods = scene.add_rods(base, section=ddg.Circle(0.02), material=ddg.Material(young=1e6, density=1000.0))
    scene.clamp(rods, edges=[0], motion=ddg.Grip())
    model = scene.build(device="cpu")
    integrator, state = ddg.Integrator(model), model.state()
    viewer = ddg.Viewer(model, port=8170, pace=0.0)
    slider = viewer.slider("0/rod_bend_twist/stiffness_1")
    states, running = [], [True]

    def loop():
        current = state
        while running[0]:
            current = viewer.show(integrator.step(current, 0.01, viewer.controls()))
            states.append((current.time, current.points().copy()))

    thread = in_thread(loop)
    try:
        page.goto(viewer.stage.url)
        page.wait_for_timeout(4000)
        at_rest = screenshot(page, "live_rest")
        assert drawn(at_rest) > 1000

        spring = viewer._springs.attach(10)  # tip of the first rod
        spring.position = np.array([1.0, 0.0, 0.4])
        page.wait_for_timeout(2000)
        assert states[-1][1][10, 2] > 0.2
        assert np.abs(screenshot(page, "live_spring") - at_rest).max() > 60

        before = model.parameters()["0/rod_bend_twist/stiffness_1"].copy()
        slider.value = 1.0
        page.wait_for_timeout(500)
        assert np.allclose(model.parameters()["0/rod_bend_twist/stiffness_1"], 10.0 * before)
        viewer._springs.release()

        (gizmo,) = viewer._grips._gizmos
        gizmo.position = gizmo.position + np.array([0.0, 0.0, 0.2])
        page.wait_for_timeout(1000)
        assert states[-1][1][0, 2] == pytest.approx(0.2)
        screenshot(page, "live_grip")

        viewer._pause.value = True
        page.wait_for_timeout(500)
        count = len(states)
        page.wait_for_timeout(500)
        assert len(states) == count
        page.get_by_role("button", name="step", exact=True).click()
        page.wait_for_timeout(500)
        assert len(states) == count + 1
        page.get_by_role("button", name="reset", exact=True).click()
        page.wait_for_timeout(500)
        page.get_by_role("button", name="step", exact=True).click()
        page.wait_for_timeout(500)
        assert states[-1][0] == pytest.approx(0.01)
        assert np.abs(states[-1][1] - base.reshape(-1, 3)).max() < 1e-12
        assert not page.errors
    finally:
        running[0] = viewer._pause.value = False
        thread.join(10.0)
        viewer.close()


def test_a_click_attaches_a_spring_and_the_mouse_pulls(page):
    points = np.zeros((11, 3))
    points[:, 0] = np.linspace(0.0, 1.0, 11)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), mass_damping=1.0)
    rod = scene.add_rod(points, section=ddg.Circle(0.03), material=ddg.Material(young=1e6, density=1000.0))
    scene.clamp(rod, edges=[0])
    model = scene.build(device="cpu")
    integrator, state = ddg.Integrator(model), model.state()
    viewer = ddg.Viewer(model, port=8180)
    viewer._springs._pick.value = True
    last, running = [state], [True]

    def loop():
        while running[0]:
            last[0] = viewer.show(integrator.step(last[0], 0.01, viewer.controls()))

    thread = in_thread(loop)
    try:
        page.goto(viewer.stage.url)
        page.wait_for_timeout(4000)
        picture = screenshot(page, "click_before")
        rows, columns = np.nonzero((picture.max(-1) - picture.min(-1)) > 60)
        left, right = np.percentile(columns, [5, 60])
        x = int(0.5 * (left + right))
        y = int(np.median(rows[np.abs(columns - x) < 4])) + 150
        page.mouse.click(x, y)
        page.wait_for_timeout(1000)
        assert len(viewer._springs._gizmos) == 1
        ((row, gizmo),) = viewer._springs._gizmos.items()
        assert 0 < row < 10
        screenshot(page, "click_gizmo")
        start = np.array(gizmo.position)
        for reach in range(20, 60, 5):  # the upward arrow of the gizmo
            page.mouse.move(x, y - reach)
            page.mouse.down()
            page.mouse.move(x, y - reach - 60, steps=8)
            page.mouse.up()
            page.wait_for_timeout(300)
            if np.linalg.norm(np.array(gizmo.position) - start) > 0.01:
                break
        assert np.array(gizmo.position)[2] > start[2] + 0.01
        page.wait_for_timeout(1500)
        screenshot(page, "click_pulled")
        assert last[0].points()[row, 2] > 1e-3
    finally:
        running[0] = False
        thread.join(10.0)
        viewer.close()


def test_a_loop_is_saved(run, tmp_path):
    model = ball_run(tmp_path)
    integrator, state = ddg.Integrator(model), model.state()
    viewer = ddg.Viewer(model, port=8190, pace=0.0)
    with pytest.raises(ddg.SceneError, match="no state was shown"):
        viewer.save(tmp_path / "none.html")
    for _ in range(10):
        state = viewer.show(integrator.step(state, 0.01, viewer.controls()))
    viewer.save(tmp_path / "loop.viser")
    assert (tmp_path / "loop.viser").stat().st_size > 1000
    assert viewer.stage.url in viewer._repr_html_()
    viewer.close()


def test_a_result_is_a_page_in_notebooks(page, tmp_path):
    from ddg_warp.run.simulate import Result

    model = ball_run(tmp_path)
    text = Result(model.scene, model, model.state())._repr_html_()
    (tmp_path / "cell.html").write_text(f"<html><body>{text}</body></html>")
    page.goto((tmp_path / "cell.html").as_uri())
    page.wait_for_timeout(4000)
    assert drawn(screenshot(page, "notebook")) > 500
    assert not page.errors
