"""Pictures of the site: run scenes and tutorials, and store their pictures, made smaller, in tools/results/gallery.

python tools/draw_gallery.py [--limit SECONDS] [NAME ...]    by default all scenes; scenes that take longer are left out
python tools/draw_gallery.py --tutorials [NAME ...]
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from ddg_warp.run.scene_registry import scene_files

GALLERY = Path(__file__).parent / "results" / "gallery"
TUTORIALS = Path(__file__).parent / "docs" / "tutorials"
WIDTH = 640  # pixels
COLORS = 128  # of a picture; this way few pixels of a color, such as arrows, keep it


def store(picture: Path, name: str) -> None:
    """Store a picture under a name, made smaller."""
    with Image.open(picture) as image:
        size = WIDTH, round(image.height * WIDTH / image.width)
        small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
        small.quantize(COLORS, Image.Quantize.MAXCOVERAGE).save(GALLERY / f"{name}.png", optimize=True)


def draw_scene(scene: str, limit: float) -> str:
    """Run a scene for `limit` [s] at most, store a picture, and return how the run ended."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "ddg_warp", "run", scene, "--out", folder, "--force"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=limit)
        except subprocess.TimeoutExpired:
            return f"takes longer than {limit:g} s"
        picture = Path(folder) / "picture.png"
        if not picture.exists():
            return f"no picture: {done.stderr[-300:]}"
        store(picture, scene)
        return "its checks pass" if done.returncode == 0 else "A CHECK FAILS"


def draw_tutorial(page: Path) -> str:
    """Run the examples of a page and store the saved pictures."""
    blocks = re.findall(r"^```python(?: file=(\S+))?\n(.*?)^```", page.read_text(), re.M | re.S)
    with tempfile.TemporaryDirectory() as folder:
        for file, text in blocks:
            if file:
                (Path(folder) / file).write_text(text)
        script = "\n".join(text for file, text in blocks if not file)
        plain = os.environ | {"MPLBACKEND": "agg"}
        subprocess.run([sys.executable, "-c", script], cwd=folder, env=plain, capture_output=True, check=True)
        pictures = {picture.stem: picture for picture in Path(folder).glob("*.png")}
        pictures |= {f"{picture.parent.name}_run": picture for picture in Path(folder).glob("out/*/picture.png")}
        shown = [name for name in sorted(pictures) if f"tutorial_{name}.png" in page.read_text()]
        for name in shown:
            store(pictures[name], f"tutorial_{name}")
    return f"{len(shown)} pictures"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="*", metavar="NAME")
    parser.add_argument("--limit", type=float, default=120.0, help="longest run of a scene [s]")
    parser.add_argument("--tutorials", action="store_true", help="the tutorials, or those named, not scenes")
    arguments = parser.parse_args()
    GALLERY.mkdir(exist_ok=True)
    if arguments.tutorials:
        for page in sorted(TUTORIALS.glob("*.md")):
            if arguments.scenes and page.stem not in arguments.scenes:
                continue
            print(f"{page.stem}: {draw_tutorial(page)}", flush=True)
        return
    for scene in arguments.scenes or scene_files():
        print(f"{scene}: {draw_scene(scene, arguments.limit)}", flush=True)


if __name__ == "__main__":
    main()
