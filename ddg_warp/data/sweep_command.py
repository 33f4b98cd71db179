"""Command line: `ddg-warp sweep SCENE` runs a scene over ranges of parameters; `ddg-warp gradients` tabulates gradient checks."""

import argparse
import inspect
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from ddg_warp.errors import MissingPackageError
from ddg_warp.run.scene_registry import SHARED, InputError, load_scene, parameters, refused, scene_name

FLAGS = (
    "range",
    "samples",
    "design",
    "seed",
    "workers",
    "ray",
    "gpus",
)  # a scene parameter with one of these names can only be given by --range


class Once(argparse.Action):
    """Action that stores the value of a flag and refuses a repeated flag."""

    def __call__(self, parser, namespace, values, option_string=None):
        given_flags = namespace.__dict__.setdefault("_once", set())
        if self.dest in given_flags:
            raise argparse.ArgumentError(self, "is given twice; give it once")
        given_flags.add(self.dest)
        setattr(namespace, self.dest, values)


def add_flags(command: argparse.ArgumentParser) -> None:
    """Add the flags of `sweep`; flags of the scene give values common to all samples."""
    command.register("action", None, Once)
    command.add_argument("scene", metavar="SCENE", help="a scene of `ddg-warp list`, or a Python file; comes first")
    command.add_argument(
        "--range",
        action="append",
        default=[],
        metavar="NAME=RANGE",
        help="of a parameter: LOW:HIGH, LOW:HIGH:log, or values A,B,C; for several parameters, several times",
    )
    command.add_argument("--samples", type=int, default=1, metavar="N", help="how many; on a grid along each range")
    command.add_argument("--design", default="random", help="random, latin_hypercube, sobol or grid (default: random)")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random numbers (default: 0)")
    command.add_argument("--dt", type=float, metavar="S", help="time step [s] (default: the scene's)")
    command.add_argument("--duration", type=float, metavar="S", help="end of each run [s] (default: the scene's)")
    command.add_argument("--fields", metavar="NAME,...", help="record these too, such as velocities,directors")
    command.add_argument("--out", type=Path, metavar="DIR", help="folder of the episodes (default: out/sweep/SCENE)")
    command.add_argument("--workers", type=int, metavar="N", help="processes at work at once (default: this one)")
    command.add_argument("--ray", action="store_true", help="work on Ray")
    command.add_argument(
        "--gpus", type=float, default=0.0, metavar="N", help="fraction of a GPU for each sample on Ray"
    )


def sweep_scene(chosen: argparse.Namespace) -> int:
    """Run the samples of `sweep` that are not recorded yet; fail if every sample failed."""
    from ddg_warp.data.sweep import OPTIONS, SweepError, sweep
    from ddg_warp.run.cli import DONE, FAILED, require_device

    module, name = load_scene(chosen.scene), scene_name(chosen.scene)
    require_device(chosen.device)
    requested = {key: value for key, value in vars(chosen).items() if value is not None}
    options = {key: requested[key] for key in OPTIONS if key in requested}
    if "fields" in options:
        options["fields"] = [field for field in chosen.fields.split(",") if field]
    signature = inspect.signature(module.build, eval_str=True).parameters
    ranges = {
        key: requested[key] for key in parameters(module, {}) if key in requested and key not in (*FLAGS, *SHARED)
    }
    directory = chosen.out or Path("out/sweep") / name
    with refused():
        for text in chosen.range:
            key, range_ = _named(text, signature)
            if key in ranges or key in options:
                raise InputError(f"--range {text}: {key} is given twice; give it once")
            ranges[key] = range_
        try:
            episodes = sweep(
                chosen.scene,
                ranges,
                chosen.samples,
                out=directory,
                options=options,
                **{key: requested[key] for key in ("design", "seed", "workers", "ray", "gpus") if key in requested},
            )
        except ModuleNotFoundError as error:
            if error.name != "ray":
                raise
            raise InputError(str(error)) from error
        except SweepError as error:
            print(f"ddg-warp: {error}", file=sys.stderr)
            return FAILED
    outcomes = Counter(episode.outcome for episode in episodes)
    print(f"{name}: {len(episodes)} episodes: {', '.join(f'{n} {outcome}' for outcome, n in outcomes.most_common())}")
    print(f"they are in {directory}")
    return FAILED if all(episode.failed for episode in episodes) else DONE


def add_objects(command: argparse.ArgumentParser) -> None:
    """Add the flags of `gradient_check`."""
    command.register("action", None, Once)
    command.add_argument("objects", nargs="*", metavar="OBJECT", help="which, such as 'planar rod' (default: all)")
    command.add_argument(
        "--analysis",
        action="append",
        metavar="NAME",
        help="implicit_euler, implicit_midpoint or statics (default: all)",
    )
    command.add_argument("--device", default="cpu", help="Warp device (default: cpu)")
    command.add_argument("--out", type=Path, metavar="STEM", help="write all rows to STEM.csv and STEM.json, too")


def gradients_table(chosen: argparse.Namespace) -> int:
    """Print the table of gradient checks; fail if a gradient is wrong, or zero without a reason."""
    from ddg_warp.run.cli import DONE, FAILED, require_device
    from ddg_warp.run.summary import machine, table, write_table

    require_device(chosen.device)
    try:
        from ddg_warp.torch import gradient_check
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise MissingPackageError("gradients need", error, "torch") from error
    requested = {
        "objects": (chosen.objects, gradient_check.OBJECTS),
        "--analysis": (chosen.analysis or [], gradient_check.ANALYSES),
    }
    for option, (names, choices) in requested.items():
        for name in names:
            if name not in choices:
                raise InputError(f"gradients: {option}: there is no {name!r}; there are {', '.join(choices)}")
            if names.count(name) > 1:
                raise InputError(f"gradients: {option}: {name!r} is named twice; name it once")
    objects, analyses = (names or choices for names, choices in requested.values())
    rows = list(gradient_check.table(objects, analyses, chosen.device))
    print(table(gradient_check.gathered(rows)))
    if chosen.out:
        write_table(chosen.out, rows, {"command": "ddg-warp gradients", "machine": machine()})
    faulty = [row for row in rows if row["result"] in (gradient_check.WRONG, gradient_check.SILENT)]
    print(
        f"{len(rows)} gradients: {len(faulty)} wrong; {sum(row['result'] == gradient_check.REFUSED for row in rows)} refused by name"
    )
    return FAILED if faulty else DONE


def _named(text: str, signature: Mapping) -> tuple:
    """Return name and range of a `--range` argument; `signature` maps parameter names to their signatures."""
    from ddg_warp.data.parameter_ranges import parsed

    name, sign, range_ = text.partition("=")
    name = name.strip().replace("-", "_")
    if not sign or not name or not range_.strip():
        raise InputError(f"--range {text}: it is NAME=LOW:HIGH, NAME=LOW:HIGH:log, or NAME=A,B,C")
    with refused(f"--range {text}: "):
        return name, parsed(range_, signature[name].annotation if name in signature else None)
