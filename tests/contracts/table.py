"""Table of contracts, every object against every question: each cell works, or is refused with a reason.

python tests/contracts/table.py [--device cuda:0]     # prints the table with its counts
"""

import argparse
import io
import itertools
import sys
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from contact_questions import CONTACT_QUESTIONS
from objects import OBJECTS
from questions import QUESTIONS as OTHERS
from questions import Variant

import ddg_warp as ddg

QUESTIONS = {**OTHERS, **CONTACT_QUESTIONS}
VARIANTS = [(worlds, precision) for worlds in (1, 3) for precision in ("float64", "mixed")]
RODS = (
    "rod",
    "rod clamped at its end",
    "planar rod",
    "rod without twist",
    "rod without bending",
    "closed rod",
    "rod with a body",
    "magnetised rod",
)
JOINED = ("rods joined rigidly", "rods joined by a hinge", "planar rods joined rigidly")
MANY_RODS = ("rods alone and joined", "rods by the turning angle")
RODS_IN_CONTACT = ("rod in contact", "rods in contact, joined")
IN_CONTACT = (*RODS_IN_CONTACT, "shell in contact")
SHELLS = (*(name for name in OBJECTS if name.startswith("shell,")), "shell in contact")

# Refused cells: question -> objects -> words of the message.
REFUSED = {
    "total twist": {
        **dict.fromkeys(
            ("planar rod", "rod without twist", "rod without bending", "planar rods joined rigidly"),
            ("rod 0", "no twist"),
        ),
        **dict.fromkeys((*SHELLS, "shell of revolution", "shells of both kinds"), ("rod 0", "does not exist")),
    },
    "fields": dict.fromkeys((*RODS, *JOINED, "shell of revolution", *MANY_RODS, *RODS_IN_CONTACT), ("no surfaces",)),
    "set rest": {
        **dict.fromkeys(
            (*RODS, *JOINED, "shell of revolution", *MANY_RODS, *RODS_IN_CONTACT), ("shell 0", "does not exist")
        ),
        "shell, isometric": ("'isometric'", "flat rest shape", "use"),
    },
    "pressure": dict.fromkeys((*RODS, *JOINED, *MANY_RODS, *RODS_IN_CONTACT), ("shell 0", "does not exist")),
    "couple": dict.fromkeys((*SHELLS, "shell of revolution", "shells of both kinds"), ("rod 0", "does not exist")),
    "drag": {
        **dict.fromkeys(("shell of revolution", "shells of both kinds"), ("shell of revolution 0", "name the rods")),
        "shell, curved membrane": ("shell 0", "'curved'", "statics", "membrane='flat'"),
    },
    "continuation": {"rod without bending": ("singular_start", "support dofs that move without any stiffness")},
}
for _question in (
    *("turned clamp", "load", "pressure", "mass damping", "strain rate damping"),
    *("implicit euler", "implicit midpoint", "record", "export", "failure", "grip", "controls", "reset"),
):
    REFUSED.setdefault(_question, {})["shell, curved membrane"] = ("shell 0", "'curved'", "statics", "membrane='flat'")
for _question in ("contact", "moved obstacle"):
    REFUSED[_question] = {
        **dict.fromkeys(("planar rod", "planar rods joined rigidly"), ("dimension 3", "leave dimension=2")),
        **dict.fromkeys(("shell of revolution", "shells of both kinds"), ("shell of revolution 0", "has no contact")),
        **dict.fromkeys(IN_CONTACT, ("has contact already", "use contact_between")),
        "shell, curved membrane": ("shell 0", "'curved'", "statics", "membrane='flat'"),
    }
REFUSED["rolls"] = dict.fromkeys(SHELLS, ("contact: rolling", "no rod is in contact", "leave rolling out")) | {
    name: words for name, words in REFUSED["contact"].items() if name != "shell, curved membrane"
}
for _name in ("rod without twist", "rod without bending"):
    REFUSED["rolls"][_name] = ("rolling, and rod 0", "has no twist", "leave rolling out")
REFUSED["rests"] = {name: words for name, words in REFUSED["contact"].items() if name != "shell, curved membrane"}
REFUSED["spectrum"] = dict.fromkeys(IN_CONTACT, ("contact: stability", "friction", "set friction=0", "statics.solve"))
REFUSED["continuation"] |= dict.fromkeys(
    IN_CONTACT, ("contact: ", "paths", "friction", "set friction=0", "statics.solve")
)
REFUSED["path onto a ball"] = REFUSED["rests"] | {"rod without bending": REFUSED["continuation"]["rod without bending"]}
REFUSED["implicit midpoint"] |= dict.fromkeys(IN_CONTACT, ("contact: ", "use 'implicit_euler'"))
REFUSED["failure"] |= dict.fromkeys(IN_CONTACT, ("contact: ", "'ball'", "overlap", "separate them"))
# questions refused for several worlds, and objects with an earlier refusal
ALONE = {"continuation": {}, "path onto a ball": REFUSED["rests"]}


def answer(name: str, question: str, variant: Variant) -> str:
    """Return the refusal of a cell, empty if the cell works; other errors are raised."""
    try:
        with np.errstate(over="raise", invalid="raise", divide="raise"), redirect_stdout(io.StringIO()):
            QUESTIONS[question](OBJECTS[name], variant)
    except (ddg.SceneError, ddg.SolverError, ValueError) as error:
        return str(error) or repr(error)
    return ""


def expected(name: str, question: str, variant: Variant) -> tuple[str, ...]:
    """Return words of the expected refusal of a cell; none where the cell works."""
    if variant.worlds > 1 and name not in ALONE.get(question, OBJECTS):
        return ("one world",)
    return REFUSED.get(question, {}).get(name, ())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cpu")
    device = parser.parse_args().device
    wide = max(map(len, OBJECTS))
    counts = {"works": 0, "refused": 0, "broken": 0}
    for number, question in enumerate(QUESTIONS, 1):
        print(f"{number:3d}  {question}")
    print(" " * wide, *(f"{number:3d}" for number in range(1, len(QUESTIONS) + 1)))
    broken = []
    for name in OBJECTS:
        cells = []
        for question in QUESTIONS:
            marks = set()
            for worlds, precision in VARIANTS:
                variant = Variant(device, precision, worlds)
                try:
                    refused, words = answer(name, question, variant), expected(name, question, variant)
                    good = all(word in refused for word in words) and bool(words) == bool(refused)
                    mark = ("refused" if refused else "works") if good else "broken"
                except Exception as error:
                    refused, mark = repr(error), "broken"
                counts[mark] += 1
                marks.add(mark)
                if mark == "broken":
                    broken.append(f"{name} / {question} / {worlds} / {precision}: {refused.splitlines()[0]}")
            cells.append("!" if "broken" in marks else "+" if "works" in marks else "-")
        print(name.ljust(wide), *(f"{cell:>3}" for cell in cells), flush=True)
    print(*broken, sep="\n")
    total = len(OBJECTS) * len(QUESTIONS) * len(VARIANTS)
    print(
        f"{total} cells: {counts['works']} work (+), {counts['refused']} are refused by name (-), {counts['broken']} broken (!)"
    )
    return 1 if counts["broken"] else 0


def cells():
    """Return all cells of the table: object, question, worlds, precision."""
    return [(name, question, *variant) for name, question, variant in itertools.product(OBJECTS, QUESTIONS, VARIANTS)]


if __name__ == "__main__":
    sys.exit(main())
