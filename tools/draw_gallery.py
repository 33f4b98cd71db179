"""Pictures of the gallery: run scenes and store each picture, made smaller, in tools/results/gallery.

python tools/draw_gallery.py [--limit SECONDS] [SCENE ...]    by default all scenes; scenes that take longer are left out
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from ddg_warp.run.scene_registry import scene_files

GALLERY = Path(__file__).parent / "results" / "gallery"
WIDTH = 560  # pixels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE")
    parser.add_argument("--limit", type=float, default=120.0, help="longest run of a scene [s]")
    arguments = parser.parse_args()
    GALLERY.mkdir(exist_ok=True)
    for scene in arguments.scenes or scene_files():
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "ddg_warp", "run", scene, "--out", folder, "--force"]
            try:
                done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=arguments.limit)
            except subprocess.TimeoutExpired:
                print(f"{scene}: takes longer than {arguments.limit:g} s")
                continue
            picture = Path(folder) / "picture.png"
            if not picture.exists():
                print(f"{scene}: no picture: {done.stderr[-300:]}")
                continue
            with Image.open(picture) as image:
                size = WIDTH, round(image.height * WIDTH / image.width)
                small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
                small.quantize(64).save(GALLERY / f"{scene}.png", optimize=True)
            print(f"{scene}: {'its checks pass' if done.returncode == 0 else 'A CHECK FAILS'}", flush=True)


if __name__ == "__main__":
    main()
