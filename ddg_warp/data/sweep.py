"""Parameter sweeps: runs over ranges of parameters as episodes of one folder, in this process, in several, or on a Ray cluster.

    sweep("tip_load", {"load": LogUniform(0.1, 10.0), "n": 40}, samples=100, out="out/loads")

Samples and their seeds follow from the seed of the sweep and their index (`ddg_warp.data.parameter_ranges`). Finished episodes are
    kept: the same call resumes a killed sweep and ends with the same episodes. A failed sample keeps the outcome of its
    SolverError, and the recording until then.
"""

from __future__ import annotations

import inspect
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.data.episodes import DONE, Episodes, EpisodeWriter
from ddg_warp.data.executors import KEPT, SweepError, in_processes, on_ray, one_by_one, require_ray
from ddg_warp.data.parameter_ranges import GROWING, KINDS, MOST, Range, check_kind, check_names, draw, seed_of
from ddg_warp.errors import DataError, SceneError, SolverError
from ddg_warp.io.paths import as_path
from ddg_warp.postprocess.fields import check_fields
from ddg_warp.progress import progress_bar
from ddg_warp.run.run_directory import TRAJECTORY
from ddg_warp.run.scene_registry import SHARED, load_scene, parameters, scene_name
from ddg_warp.run.summary import plain, write_json
from ddg_warp.typing import FilePath

ABOUT = "sweep.json"
REFUSED = "refused"  # outcome of parameters of which no scene can be built
NAMED = {kind.__name__: kind for kind in KINDS}  # types of parameters, as modules with postponed annotations have them
OPTIONS = ("device", "precision", "dt", "duration", "fields", "options")  # of `simulate`


@dataclass(frozen=True)
class Sample:
    """Parameters, seed and directory of one episode."""

    name: str
    parameters: dict
    seed: int
    directory: Path


@dataclass(frozen=True)
class SceneRun:
    """Simulation of a scene; `build` takes the parameters, and the seed if accepted. `simulate` takes `options`."""

    scene: str
    options: dict

    def __call__(self, sample: Sample):
        from ddg_warp.run.simulate import simulate

        module = _loaded(self.scene)
        signature = inspect.signature(module.build).parameters
        times = {name: value for name, value in (self.options | sample.parameters).items() if name in SHARED}
        arguments_of_build = {"seed": sample.seed} | times | sample.parameters
        arguments_of_build = {name: value for name, value in arguments_of_build.items() if name in signature}
        return simulate(
            module.build(**arguments_of_build),
            out=sample.directory,
            usd=False,
            progress=False,
            observe=getattr(module, "observe", None),
            provenance={"scene": scene_name(self.scene), "parameters": parameters(module, arguments_of_build)},
            **(self.options | times),
        )


@dataclass(frozen=True)
class FunctionRun:
    """Call of a user function with a directory, the parameters, and the seed if accepted."""

    function: Callable

    def __call__(self, sample: Sample):
        seed = {"seed": sample.seed} if "seed" in inspect.signature(self.function).parameters else {}
        return self.function(sample.directory, **(seed | sample.parameters))


@dataclass(frozen=True)
class Run:
    """Run of a sample, with the outcome in the form of `EpisodeWriter.add`.

    Raises:
        SweepError: An error is no outcome of a solver.
    """

    run: SceneRun | FunctionRun

    def __call__(self, sample: Sample) -> dict:
        began = time.perf_counter()
        # Ray may repeat a sample after a lost worker.
        shutil.rmtree(sample.directory, ignore_errors=True)
        sample.directory.mkdir(parents=True)
        try:
            result = self.run(sample)
            outcome, failure = getattr(result, "outcome", DONE), getattr(result, "failure", "")
        except SolverError as error:
            outcome, failure = error.outcome or "failed", str(error)
        except SceneError as error:
            outcome, failure = REFUSED, str(error)
        except Exception as error:
            message = f"sample {sample.name} of {sample.parameters}: {type(error).__name__}: {error}"
            raise SweepError(f"{message}; {KEPT}") from error
        return {"outcome": outcome, "failure": failure, "seconds": time.perf_counter() - began}


def sweep(
    what: str | Callable[..., object],
    ranges: Mapping[str, object],
    samples: int,
    *,
    out: FilePath,
    design: Literal["random", "latin_hypercube", "sobol", "grid"] = "random",
    seed: int = 0,
    fractions: tuple[float, float, float] | None = None,
    options: Mapping[str, object] | None = None,
    workers: int | None = None,
    ray: bool = False,
    gpus: float = 0.0,
    progress: bool = True,
) -> Episodes:
    """Run the samples over ranges of parameters that `out` does not have yet.

    Args:
        what: A scene of `ddg-warp list`, or the path of a scene file; or a function `run(directory, **parameters)` that records
            directory/trajectory.h5, and may return the `Result` of `simulate`. A parameter `seed` of the function, or of the
            scene's `build`, takes the seed of the sample, unless it has a range.
        ranges: Range of each parameter by name, `Uniform`, `LogUniform` or `Choice`; anything else is a value for all samples.
        samples: Number of samples; with design "grid" the number along each range.
        out: Folder of the episodes, see `ddg_warp.data.episodes`. On a cluster all machines must see it.
        design: "random", "latin_hypercube", "sobol" or "grid".
        seed: Seed of samples, of seeds in samples, and of splits.
        fractions: Fractions of train, validation and test; by default 0.8, 0.1 and 0.1.
        options: Of `simulate`, for scenes: device, precision, dt, duration, fields, options.
        workers: Number of processes, by default this one alone; on Ray the number of concurrent samples, by default as many as the
            cluster has room for.
        ray: True to work on Ray, in the cluster that this process has joined (`ray.init`) or in one of this machine.
        gpus: Fraction of a GPU for a sample on Ray, which hides all others.
        progress: True to show progress.

    Returns:
        The episodes.

    Raises:
        SceneError: A range is invalid, has values of another type than the parameter, or the scene has no such parameter.
        DataError: `out` is no folder, has the episodes of another sweep, or its index or sweep.json is damaged.
        InputError: There is no such scene.
        SweepError: A sample met an error that is no outcome of a solver, or workers were lost.
        ModuleNotFoundError: `ray` is True, but not installed.
    """
    out, options = as_path("sweep: out", out), {} if options is None else options
    check_names(ranges)
    if not isinstance(options, Mapping):
        raise SceneError(f"options = {options!r}; give a dict with {', '.join(OPTIONS)}")
    options = dict(options)
    ray, progress = (
        argument_checks.flag(f"sweep: {name}", value) for name, value in (("ray", ray), ("progress", progress))
    )
    run = Run(_runner(what, ranges, options))
    if workers is not None:
        argument_checks.count("workers", workers)
    argument_checks.number("gpus", gpus, "a number that is not negative", lambda v: v >= 0.0)
    if ray:
        require_ray()
    elif gpus:
        raise SceneError(f"gpus = {gpus}: Ray hands out GPUs; give ray=True, or options={{'device': 'cuda:0'}}")
    values = draw(ranges, samples, design, seed)
    about = {"what": _name_of(what), "ranges": _written(ranges), "samples": samples, "design": design, "seed": seed}
    about["options"] = {name: value for name, value in options.items() if name != "device"}
    with EpisodeWriter(out, fractions=fractions, seed=seed) as writer:
        about["samples"] = max(samples, _refuse_other(out / ABOUT, plain(about), len(writer)))
        write_json(out / ABOUT, about)
        names = [f"{index:06d}" for index in range(len(values))]
        todo = [index for index, name in enumerate(names) if name not in writer]
        # A scratch directory is made when its sample is submitted; its absolute path is valid in other processes.
        samples_to_run = (
            Sample(names[index], values[index], seed_of(seed, index), writer.scratch(names[index]).resolve())
            for index in todo
        )
        with (
            progress_bar(len(values), len(values) - len(todo), progress, "sample", "") as bar,
            closing(_finished(run, samples_to_run, workers, ray, gpus)) as finished,
        ):
            for sample, ended in finished:
                kept = {"parameters": plain(sample.parameters), "seed": sample.seed}
                writer.add(sample.name, sample.directory / TRAJECTORY, **kept, **ended)
                shutil.rmtree(sample.directory)
                bar.update()
    return Episodes(out)


def _finished(run: Run, samples: Iterator[Sample], workers: int | None, ray: bool, gpus: float) -> Iterator[tuple]:
    """Yield (sample, outcome) of all samples, as they finish."""
    if ray:
        return on_ray(run, samples, workers, gpus)
    return in_processes(run, samples, min(workers, MOST)) if workers and workers > 1 else one_by_one(run, samples)


def _runner(subject: str | Callable, ranges: Mapping, options: Mapping) -> SceneRun | FunctionRun:
    """Return the run of a sample; refuse unknown ranges and options."""
    if callable(subject):
        if options:
            raise SceneError(f"options = {options!r} are of `simulate`, for scenes; a function gives them itself")
        try:
            signature = [*inspect.signature(subject).parameters.items()]
        except ValueError:
            raise SceneError(
                f"sweep: {subject!r} has no signature; write a function run(directory, **parameters)"
            ) from None
        signature_parameters = dict(signature[1:])
        if not signature:
            raise SceneError(
                f"{_name_of(subject)} takes no directory to record in; write it as run(directory, **parameters)"
            )
    else:
        subject = _scene(subject)
        signature_parameters = inspect.signature(_loaded(subject).build, eval_str=True).parameters
    names = {*signature_parameters, *(() if callable(subject) else SHARED)}
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in signature_parameters.values()):
        for name in ranges:
            if name not in names:
                raise SceneError(
                    f"ranges: there is no parameter {name!r}; there are {', '.join(sorted(names)) or 'none'}"
                )
    for name, range_ in ranges.items():
        kind = getattr(signature_parameters.get(name), "annotation", None)
        kind = NAMED.get(kind) if isinstance(kind, str) else kind
        check_kind(name, range_, float if name in SHARED and not callable(subject) else kind)
    for name, parameter in signature_parameters.items():
        several = parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        if parameter.default is parameter.empty and not several and name not in ranges and name != "seed":
            raise SceneError(f"ranges: {name} has neither a range nor a default; give it either")
    _check_options(options, ranges)
    return FunctionRun(subject) if callable(subject) else SceneRun(subject, options)


def _scene(subject) -> str:
    """Return a scene's name, or the absolute path of a scene file."""
    if not isinstance(subject, str | os.PathLike):
        raise SceneError(
            f"sweep: {subject!r} is no scene; give the name of a scene, the path of its file, or a function"
        )
    subject = os.fspath(subject)
    return str(Path(subject).resolve()) if subject.endswith(".py") else subject


def _check_options(options: Mapping, ranges: Mapping) -> None:
    """Refuse options that `simulate` does not have, or that have a range."""
    if unknown := options.keys() - set(OPTIONS):
        raise SceneError(f"options: {', '.join(sorted(map(str, unknown)))}: there are {', '.join(OPTIONS)}")
    for name in SHARED:
        if name in options and name in ranges:
            raise SceneError(f"{name} is given by options and by ranges; give it once")
        if options.get(name) is not None:
            argument_checks.positive(f"options: {name}", options[name], "s")
    fields = options.get("fields", ())
    if isinstance(fields, str) or not np.iterable(fields) or not all(isinstance(name, str) for name in fields):
        raise SceneError(f"options: fields = {fields!r}; give a list of names")
    check_fields([name for name in fields if name not in ("velocities", "directors", "contacts")])


@cache
def _loaded(scene: str):
    """Return the module of a scene, loaded once a process."""
    return load_scene(scene)


def _name_of(subject: str | Callable) -> str:
    """Return the name of the subject of a sweep, for its folder."""
    if not callable(subject):
        return scene_name(subject)
    return f"{subject.__module__}.{getattr(subject, '__qualname__', type(subject).__name__)}"


def _written(ranges: Mapping) -> dict:
    """Return ranges in JSON form."""
    return {
        name: {type(range_).__name__: asdict(range_)} if isinstance(range_, Range) else range_
        for name, range_ in ranges.items()
    }


def _refuse_other(path: Path, about: dict, episodes: int) -> int:
    """Return the number of samples that a folder was made for, 0 for a new one.

    For designs in `GROWING`, more or fewer samples belong to the same sweep.

    Raises:
        DataError: The folder has the episodes of another sweep, or of none.
    """
    if not path.exists():
        if episodes:
            raise DataError(f"{path.parent} holds {episodes} episodes of no sweep; take another folder")
        return 0
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(old, dict) or "samples" not in old:
            raise ValueError("it does not describe a sweep")
        argument_checks.count("samples", old["samples"])
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is damaged ({error}); take a copy of it, or another folder") from error
    for name, value in about.items():
        if old.get(name) != value and not (name == "samples" and about["design"] in GROWING):
            difference = f"{path.parent} holds a sweep with {name} = {old.get(name)}, not {value}"
            raise DataError(f"{difference}; go on with that, or take another folder")
    return old["samples"]
