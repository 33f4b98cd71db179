"""Settings of the site; blocks of its pages are filled by `expand`, from results, scenes and docstrings."""

import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parent))

from expand import expand, played

import ddg_warp

project = "ddg_warp"
release = version = ddg_warp.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"ddg_warp {release}"
myst_heading_anchors = 3
default_role = "literal"
autodoc_member_order = "bysource"
napoleon_use_ivar = True


def setup(app) -> None:
    """Fill blocks of pages, and make docstrings valid reStructuredText."""
    app.connect("source-read", lambda _app, _page, source: source.__setitem__(0, expand(source[0])))
    app.connect("autodoc-process-docstring", escape)
    app.connect("build-finished", play)


def play(app, error: Exception | None) -> None:
    """Run the scenes that the gallery plays, and write their pages to `play/` of the site; pages that exist stay."""
    for name in [] if error else played():
        page = Path(app.outdir) / "play" / f"{name}.html"
        if page.exists():
            continue
        page.parent.mkdir(exist_ok=True)
        with TemporaryDirectory() as run:
            for command in (["run", name, "--out", run, "--force"], ["view", run, "--save", page]):
                subprocess.run([sys.executable, "-m", "ddg_warp", *command], check=True, stdout=subprocess.DEVNULL)


def escape(_app, _kind, _name, _object, _options, lines: list[str]) -> None:
    """Make a docstring reStructuredText, in place: mark blocks of code, set deeper lines apart, and escape signs of mathematics."""
    result, above, code = [], "", False
    for line in lines:
        depth, depth_above = (len(text) - len(text.lstrip()) for text in (line, above))
        field = above.startswith((":", ".."))
        if line and not depth:
            code = False
        if line and depth and above and not depth_above and not field and not result[-1]:
            code = True
            result += ["::", ""]
        if not code:
            if line and result and result[-1] and depth != depth_above and not field:
                result.append("")
            pieces = re.split(r"(`[^`]*`)", line)
            line = "".join(p if p.startswith("`") else re.sub(r"([*_|\\])", r"\\\1", p) for p in pieces)
        result.append(line)
        above = line or above
    lines[:] = result
