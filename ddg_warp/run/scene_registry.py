"""Catalog of scenes: modules of `ddg_warp.scenes` or a file of the user; parameters become flags."""

import argparse
import ast
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType

RUN_SETTINGS = ("dt", "precision", "worlds")  # fixed in a resumed run, like the scene's parameters
RENAMED = {"lags": "friction_iterations"}  # scene parameters of runs recorded by 0.1.0
RESERVED = ("command", "scene", "device", "out", "resume", "json", "force", "fields", "every", "fps", "physics", "help")
RESERVED += RUN_SETTINGS
SHARED = ("dt", "duration")  # flags of `run` that a scene's build may take too, to fit its motions to them


class InputError(ValueError):
    """Error in the user's input; the message gives the remedy in one line."""


@contextmanager
def refused(where: str = "") -> Iterator[None]:
    """Convert a ValueError of the package to an InputError that begins with `where`."""
    try:
        yield
    except (InputError, OSError):
        raise
    except ValueError as error:
        raise InputError(f"{where}{error}") from error


def scene_files() -> dict[str, Path]:
    """Return the files of all scenes by name, without importing them."""
    import ddg_warp.scenes

    files = (path for folder in ddg_warp.scenes.__path__ for path in sorted(Path(folder).glob("[!_]*.py")))
    return {path.stem: path for path in files}


def one_liner(path: Path) -> str:
    """Return the first line of a file's docstring."""
    return (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0]


def load_scene(name: str) -> ModuleType:
    """Import a scene, given by name or as the path of a Python file.

    Raises:
        InputError: There is no such scene, or it has no `build`.
    """
    if name.endswith(".py"):
        module = load_file(name)
    else:
        scenes = scene_files()
        if name not in scenes:
            near = get_close_matches(name, scenes, 1)
            hint = f"did you mean {near[0]}?" if near else "`ddg-warp list` shows them"
            raise InputError(f"there is no scene '{name}'; {hint}")
        module = importlib.import_module(f"ddg_warp.scenes.{name}")
    if not hasattr(module, "build"):
        raise InputError(f"scene '{name}' has no build(**parameters) -> Scene")
    return module


def load_file(name: str, kind: str = "scene") -> ModuleType:
    """Import a Python file.

    Raises:
        InputError: There is no such file.
    """
    path = Path(name)
    if not path.is_file():
        raise InputError(f"there is no {kind} file {name}")
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)  # its folder can be imported from, like a script's
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def user_term(file: str, name: str):
    """Return a user's term or potential from a file, or a term of rods with the user's density.

    Raises:
        InputError: There is no such file or name, or the object is no Term, Potential or Density.
    """
    from ddg_warp.kernels.densities import Density
    from ddg_warp.kernels.terms import REGISTRY, Potential, Term

    law = getattr(load_file(file, "law's"), name, None)
    if isinstance(law, Term | Potential):
        return law
    if not isinstance(law, Density):
        raise InputError(f"{file} has no term or law {name!r}; give the name of a Term, a Potential or a Density")
    for term in ("rod_bend_twist", "rod_stretch"):
        if law.strains in (None, len(REGISTRY[term].measure.strains)):
            return replace(REGISTRY[term], density=law)
    raise InputError(f"{file}:{name} is of {law.strains} strains, rods have 3 of bending and 1 of stretch; give a Term")


def scene_name(name: str) -> str:
    """Return the name of a scene for results: the stem of its file."""
    return Path(name).stem


def add_parameters(parser: argparse.ArgumentParser, module: ModuleType, leave: tuple[str, ...] = ()) -> None:
    """Add a flag for every parameter of the scene's `build` except names in `leave`; unset flags are absent.

    Raises:
        InputError: A parameter has no default, an unknown type, or the name of an option of `run`.
    """
    texts = parameter_texts(module.build)
    for name, parameter in inspect.signature(module.build, eval_str=True).parameters.items():
        kind, default = parameter.annotation, parameter.default
        where = f"build({name}) of {module.__name__}"
        if kind not in (bool, int, float, str) or default is parameter.empty:
            raise InputError(f"{where} needs a default, and a type of int, float, str or bool")
        if name in SHARED or name in leave:
            continue
        if name in RESERVED:
            raise InputError(f"{where} has the name of an option of `run`; rename it")
        options = {"dest": name, "default": argparse.SUPPRESS, "help": f"{texts.get(name, '')} (default: {default})"}
        if kind is bool:
            options["action"] = argparse.BooleanOptionalAction
        else:
            options |= {"type": kind, "metavar": kind.__name__}
        parser.add_argument(f"--{name.replace('_', '-')}", **options)


def parameter_texts(build) -> dict[str, str]:
    """Return the texts of the `Args:` section of a Google docstring by parameter."""
    section = (inspect.getdoc(build) or "").partition("Args:\n")[2].partition("\n\n")[0]
    lines = (line.strip().partition(":") for line in section.splitlines())
    # argparse formats percent signs; %% is a literal one
    return {name: text.strip().replace("%", "%%") for name, colon, text in lines if colon and name.isidentifier()}


def parameters(module: ModuleType, settings: dict) -> dict:
    """Return all parameters of a scene's `build`: defaults updated by `settings`."""
    defaults = {name: p.default for name, p in inspect.signature(module.build).parameters.items()}
    return {**defaults, **settings}


def stored_settings(directory: Path, scene: str, settings: dict) -> dict:
    """Return scene parameters, dt, precision and worlds of the run in `directory`, to resume it.

    Raises:
        InputError: The directory holds no run of this scene, or its settings differ from `settings`.
    """
    from ddg_warp.io.hdf5 import TrajectoryReader

    path = Path(directory) / "trajectory.h5"
    if not path.is_file():
        raise InputError(f"there is no run to resume in {directory}: {path} is missing")
    with refused(), TrajectoryReader(path) as reader:
        provenance = reader.provenance
    if not {"scene", "parameters", *RUN_SETTINGS} <= provenance.keys():
        raise InputError(f"{path} is not of `ddg-warp run`: resume it where it was made, with Recorder(resume=True)")
    if provenance["scene"] != scene:
        raise InputError(f"{directory} holds a run of '{provenance.get('scene')}', not of '{scene}'")
    parameters_of_run = {RENAMED.get(name, name): value for name, value in provenance["parameters"].items()}
    stored = parameters_of_run | {name: provenance[name] for name in RUN_SETTINGS}
    for name, value in settings.items():
        if stored.get(name) != value:
            raise InputError(f"the run in {directory} has {name} = {stored.get(name)}; resume it without --{name}")
    return stored
