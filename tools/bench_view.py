"""Time the viewer in headless Chromium with software rendering: frames a second at play, and seconds until a large scene is drawn.

    python tools/bench_view.py [--out DIR]       view.csv and view.json in DIR (default: tools/results)

`shown`: states drawn a second at play, of 64 strands of 32 nodes, recorded at 60 states a second. `rendered`: frames that the page
renders a second meanwhile. `open`: seconds from opening the recorded run to the first picture of the page, with Chromium started.
States are synthetic: the drawn shapes in a shear wave.
"""

import argparse
import io
import os
import shutil
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.view.player import Player
from ddg_warp.view.recording import Recording

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE = {"width": 1000, "height": 600}
NODES, PLAY = 32, 8.0  # nodes of a strand; seconds of play
COUNT = """async (milliseconds) => {
    let count = 0, end = performance.now() + milliseconds;
    while (performance.now() < end) { await new Promise(requestAnimationFrame); count += 1; }
    return count * 1000 / milliseconds;
}"""


def strands(count: int) -> ddg.Scene:
    """Return straight strands of NODES nodes on a square grid."""
    side = int(np.ceil(np.sqrt(count)))
    roots = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:count] / side
    points = np.zeros((count, NODES, 3))
    points[:, :, :2] = roots[:, None]
    points[:, :, 2] = -np.linspace(0.0, 0.5, NODES)
    scene = ddg.Scene()
    scene.clamp(scene.add_rods(points, section=ddg.Circle(1e-3), material=ddg.Material(young=1e7, density=1000.0)))
    return scene


def sheet(cells: int) -> ddg.Scene:
    """Return a square sheet of cells x cells x 2 triangles."""
    scene = ddg.Scene()
    material = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
    scene.add_shell(*meshes.rectangle(cells, cells), thickness=1e-3, material=material)
    return scene


def record(scene: ddg.Scene, path: Path, frames: int) -> None:
    """Record a shear wave of the scene at 60 states a second."""
    model = scene.build(device="cpu")
    rest = model.state().points()
    with ddg.Recorder(model, path, usd=False, velocities=True) as recorder:
        for k in range(frames):
            phase = 4.0 * k / 60.0 + 6.0 * rest[:, 2] + 6.0 * rest[:, 0]
            depth = np.ptp(rest[:, 2])
            points, velocities = rest.copy(), np.zeros_like(rest)
            axis, weight = (0, -rest[:, 2]) if depth else (2, np.full(len(rest), 0.1))
            points[:, axis] += 0.5 * weight * np.sin(phase)
            velocities[:, axis] = 2.0 * weight * np.cos(phase)
            state = model.state(points=points, velocities=velocities)
            state.time = k / 60.0
            recorder.record(state)


def pixels(page) -> int:
    """Return the number of colored pixels of the page without panels."""
    from matplotlib.image import imread

    picture = imread(io.BytesIO(page.screenshot()))[150:, :620, :3]
    return int((np.ptp(picture, axis=-1) > 0.2).sum())


def measure(browser, scene: ddg.Scene, frames: int, played: bool, picture: Path | None = None) -> dict:
    """Return time to open, drawn numbers, and rates at play of a scene."""
    with tempfile.TemporaryDirectory() as folder:
        record(scene, Path(folder), frames)
        page = browser.new_page(viewport=SIZE)
        began = time.perf_counter()
        player = Player(Recording(folder))
        thread = threading.Thread(target=player.run, args=(PLAY + 15.0 if played else 15.0,), daemon=True)
        thread.start()
        page.goto(player.stage.url)
        while pixels(page) < 200:
            time.sleep(0.05)
        row = {"open_s": time.perf_counter() - began, "shown_per_s": np.nan, "rendered_per_s": np.nan}
        if played:
            count, show = [0], player.stage.show

            def counted(frame):
                count[0] += 1
                show(frame)

            player.stage.show = counted
            page.get_by_role("button", name="play").click()
            page.wait_for_timeout(1000)
            count[0], began = 0, time.perf_counter()
            row["rendered_per_s"] = page.evaluate(COUNT, 1e3 * PLAY)
            row["shown_per_s"] = count[0] / (time.perf_counter() - began)
        if picture is not None:
            page.screenshot(path=picture)
        page.close()
        player.stage.close()
        thread.join()
        return row | {"drawn": player.stage.drawing.note}


def main() -> None:
    """Measure all scenes and write the table."""
    from playwright.sync_api import sync_playwright

    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments.add_argument("--pictures", type=Path, help="folder for a screenshot of each scene")
    chosen = arguments.parse_args()
    scenes = {
        "64 strands of 32 nodes": (lambda: strands(64), 120, True),
        "10,000 strands of 32 nodes": (lambda: strands(10_000), 3, False),
        "sheet of 512 x 512 cells": (lambda: sheet(512), 3, False),
    }
    rows = []
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        for name, (build, frames, played) in scenes.items():
            picture = chosen.pictures and chosen.pictures / f"{name.replace(' ', '_')}.png"
            rows.append({"scene": name, **measure(browser, build(), frames, played, picture)})
            print(table(rows[-1:]), flush=True)
        version = browser.version
        browser.close()
    origin = {
        "command": "python tools/bench_view.py",
        "machine": machine(),
        "load_average": os.getloadavg()[0],
        "browser": f"Chromium {version}, SwiftShader",
    }
    write_table(chosen.out / "view", rows, origin)


if __name__ == "__main__":
    main()
