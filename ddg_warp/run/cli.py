"""The command line: `ddg-warp run | view | sweep | groom | list | check | gradients | bench | export | warmup | info | docs |
completion`.

Exit codes: 0 done, 1 a check or the solver failed, 2 invalid input, 130 interrupted, 141 broken pipe.
"""

import argparse
import json
import os
import shlex
import sys
from pathlib import Path

from ddg_warp.errors import MissingPackageError
from ddg_warp.run.run_directory import FULL, SUMMARY, RunDirectory, refuse_to_replace, system_error
from ddg_warp.run.scene_registry import (
    RUN_SETTINGS,
    InputError,
    add_parameters,
    load_scene,
    one_liner,
    parameters,
    refused,
    scene_files,
    scene_name,
    stored_settings,
    user_term,
)

DONE, FAILED, MISTAKE, INTERRUPTED, UNREAD = 0, 1, 2, 130, 141
PRECISIONS = ("float64", "mixed", "float32")


class Parser(argparse.ArgumentParser):
    """Argument parser that raises an InputError of one line."""

    def __init__(self, **options):
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str):
        raise InputError(message)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        chosen = parser(arguments).parse_args(arguments)
        code = chosen.command(chosen)
        sys.stdout.flush()  # inside the try: a closed pipe is expected
        return code
    except BrokenPipeError:  # the reader, such as `head`, has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD
    except (InputError, MissingPackageError, OSError) as error:
        print(f"ddg-warp: {_of_location(error)}", file=sys.stderr)
        return FAILED if getattr(error, "errno", None) in FULL else MISTAKE
    except KeyboardInterrupt:
        print("\nddg-warp: interrupted; recorded frames are kept", file=sys.stderr)
        return INTERRUPTED


def _of_location(error: Exception) -> Exception:
    """Return the error, or for an OSError one that names the path and a remedy."""
    if not isinstance(error, OSError) or isinstance(error, ValueError) or error.filename is None:
        return error
    path = Path(os.fsdecode(error.filename))
    cache = Path(os.environ.get("WARP_CACHE_PATH") or Path("~/.cache/warp").expanduser())
    if path in (cache, *cache.parents) or cache in path.parents:
        return InputError(
            f"{path}: {error.strerror}: compiled kernels are kept in {cache}, which cannot be written to; name another by the "
            "variable WARP_CACHE_PATH"
        )
    return system_error(path, error)


def parser(arguments: list[str]) -> Parser:
    """Build the parser; `run SCENE`, `sweep SCENE` and `bench SCENE` add the flags of the scene."""
    from ddg_warp.data import sweep_command as command
    from ddg_warp.run import groom_command

    top = Parser(prog="ddg-warp", description="Simulate flexible slender structures on NVIDIA Warp.")
    commands = top.add_subparsers(metavar="COMMAND", required=True)

    run = commands.add_parser("run", help="run a scene and check it", description="Run a scene and check it.")
    run.set_defaults(command=run_scene)
    run.add_argument("scene", metavar="SCENE", help="a scene of `ddg-warp list`, or a Python file; comes first")
    add_settings(run)
    run.add_argument("--dt", type=float, metavar="S", help="time step [s] (default: the scene's)")
    run.add_argument(
        "--duration", type=float, metavar="S", help="end of the run [s] (default: the scene's, or the resumed run's)"
    )
    run.add_argument("--worlds", type=int, metavar="N", help="independent copies (default: 1)")
    run.add_argument("--out", type=Path, metavar="DIR", help="where results go (default: out/SCENE)")
    run.add_argument("--resume", type=Path, metavar="DIR", help="continue the run recorded in DIR")
    run.add_argument("--force", action="store_true", help="replace a run that is there already")
    run.add_argument(
        "--fields",
        metavar="NAME,...",
        help="record these too, such as velocities,directors,contacts,axial_force,shell_energy",
    )
    run.add_argument("--every", type=int, metavar="N", help="record every N-th step (default: 1)")
    run.add_argument(
        "--fps", type=float, metavar="F", help="frames per second of scene.usdc (default: of recorded steps)"
    )
    run.add_argument("--physics", action="store_true", help="write materials of deformable bodies to scene.usdc")
    run.add_argument("--json", type=Path, metavar="FILE", help="write the summary to FILE too")
    run.add_argument("--movie", type=Path, metavar="FILE", help="write a movie of the run to FILE.mp4 (extra `render`)")
    if arguments[:1] == ["run"] and len(arguments) > 1 and not arguments[1].startswith("-"):
        add_parameters(run.add_argument_group(f"parameters of {arguments[1]}"), load_scene(arguments[1]))

    view = commands.add_parser("view", help="show a run in the browser, also one that still goes on")
    view.set_defaults(command=view_run)
    view.add_argument("directory", type=Path, metavar="DIR", help="directory of a run")
    view.add_argument(
        "--port", type=int, default=8080, help="port of the page; a later one if it is taken (default: 8080)"
    )
    view.add_argument(
        "--host", default="127.0.0.1", help="address to serve; 0.0.0.0 for other machines (default: this machine)"
    )
    view.add_argument("--no-browser", action="store_true", help="print the address only")
    view.add_argument(
        "--save", type=Path, metavar="FILE", help="write FILE.html, which plays without Python, or FILE.viser"
    )
    view.add_argument("--field", default="none", metavar="NAME", help="field that colors a saved view")

    sweep = commands.add_parser("sweep", help="run a scene over ranges of its parameters, into a data set")
    sweep.set_defaults(command=command.sweep_scene)
    add_settings(sweep)
    command.add_flags(sweep)
    if arguments[:1] == ["sweep"] and len(arguments) > 1 and not arguments[1].startswith("-"):
        group = sweep.add_argument_group(f"parameters of {arguments[1]}, for all samples")
        add_parameters(group, load_scene(arguments[1]), leave=command.FLAGS)

    hair = commands.add_parser("groom", help="simulate the curves of a USD file, into a layer over it")
    hair.set_defaults(command=groom_file)
    groom_command.add_flags(hair)
    add_settings(hair)

    show = commands.add_parser("list", help="list scenes and terms")
    show.set_defaults(command=list_all)

    check = commands.add_parser("check", help="compare the derivatives of terms with automatic differentiation")
    check.set_defaults(command=check_terms)
    check.add_argument(
        "term", nargs="?", metavar="TERM", help="one term, or FILE.py:NAME of a term or law of your own (default: all)"
    )
    check.add_argument("--precision", choices=("float64", "float32"), default="float64", help="default: float64")
    check.add_argument("--device", default="cpu", help="Warp device (default: cpu)")

    gradients = commands.add_parser("gradients", help="compare gradients of steps and equilibria with differences")
    gradients.set_defaults(command=command.gradients_table)
    command.add_objects(gradients)

    bench = commands.add_parser("bench", help="measure a scene's error against its time")
    bench.set_defaults(command=bench_scene)
    bench.add_argument("scene", nargs="?", metavar="NAME", help="a scene (default: list them)")
    bench.add_argument("--all", action="store_true", help="all scenes one after the other, and an overview")
    add_settings(bench)
    bench.add_argument("--out", type=Path, default=Path("out/bench"), metavar="DIR", help="default: out/bench")
    if arguments[:1] == ["bench"] and len(arguments) > 1 and not arguments[1].startswith("-"):
        add_parameters(bench.add_argument_group(f"parameters of {arguments[1]}"), load_scene(arguments[1]))

    export = commands.add_parser("export", help="write a recorded run as USD, as a movie, or for the viewer rerun")
    export.set_defaults(command=export_run)
    export.add_argument("directory", type=Path, metavar="DIR", help="directory of a run")
    export.add_argument(
        "--to", type=Path, metavar="FILE", help="a .usdc, .usda, .mp4 or .rrd file (default: DIR/export.usdc)"
    )
    export.add_argument("--every", type=int, default=1, metavar="N", help="write every N-th frame to USD (default: 1)")
    export.add_argument("--fps", type=float, metavar="F", help="frames per second in USD (default: of the frames)")
    export.add_argument("--tube", action="store_true", help="write tube meshes, not curves")
    export.add_argument(
        "--revolve", type=int, default=0, metavar="N", help="convert meridians to surfaces of revolution of N sides"
    )

    warmup = commands.add_parser("warmup", help="compile the usual kernels once, so that first runs start at once")
    warmup.set_defaults(command=compile_kernels)
    warmup.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: CUDA if there is one)")

    info = commands.add_parser("info", help="show versions, devices and machine")
    info.set_defaults(command=show_info)

    docs = commands.add_parser(
        "docs", help="open the documentation", description="Open the documentation that `tools/site` has built."
    )
    docs.set_defaults(command=open_docs)

    completion = commands.add_parser("completion", help="print a script that completes words in a shell")
    completion.set_defaults(command=complete)
    completion.add_argument(
        "shell", choices=("bash", "zsh", "fish"), help='for bash: eval "$(ddg-warp completion bash)"'
    )
    completion.add_argument(
        "words", nargs=argparse.REMAINDER, help="print the completions of the last of these instead"
    )
    return top


def add_settings(command: argparse.ArgumentParser) -> None:
    """Add the flags of device and precision."""
    command.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: CUDA if there is one)")
    command.add_argument(
        "--precision", choices=PRECISIONS, help="default: the scene's, else float64 on the CPU, mixed on CUDA"
    )


def run_scene(chosen: argparse.Namespace) -> int:
    """Run a scene: simulate, record, check, summarise."""
    module, name = load_scene(chosen.scene), scene_name(chosen.scene)
    settings, run_settings = settings_of(chosen, module, name)
    require_device(chosen.device)
    if chosen.movie is not None:
        from ddg_warp.run.movie import check_packages, movie

        with refused():
            check_packages()

    from ddg_warp.run.simulate import simulate
    from ddg_warp.run.summary import write_json

    directory = chosen.resume or chosen.out or Path("out") / name
    if chosen.resume is not None:
        if chosen.force:
            raise InputError("--resume goes on with a run, and --force replaces it: give one of them")
        if ended := finished(directory, chosen.duration):
            print(ended)
            if chosen.movie is not None:
                with refused():
                    movie(directory, chosen.movie, title=name)
            return DONE
    scene = built(module, name, settings)
    with RunDirectory(directory) as run_directory:
        if chosen.resume is None and not chosen.force:
            refuse_to_replace(run_directory.path)
        with refused():
            result = simulate(
                scene,
                device=chosen.device,
                out=run_directory,
                duration=chosen.duration,
                resume=run_directory if chosen.resume is not None else None,
                force=chosen.force,
                fields=[name for name in (chosen.fields or "").split(",") if name],
                every=chosen.every,
                fps=chosen.fps,
                physics=chosen.physics,
                module=module,
                provenance={"scene": name, "parameters": settings, "command": shlex.join(["ddg-warp", *sys.argv[1:]])},
                **run_settings,
            )
        if chosen.json is not None:
            write_json(chosen.json, result.summary())
    if chosen.movie is not None:
        with refused():
            movie(directory, chosen.movie, title=name)
    say(result, directory)
    return FAILED if result.failure or any(check.failed for check in result.checks) else DONE


def groom_file(chosen: argparse.Namespace) -> int:
    """Simulate a groom, and write the layer."""
    from ddg_warp.run.groom_command import run_groom

    require_device(chosen.device)
    return run_groom(chosen)


def finished(directory: Path, duration: float | None) -> str:
    """Return a message if a run has reached `duration` [s] and has a summary, else "".

    Raises:
        InputError: There is no run in the directory.
    """
    from ddg_warp.io.hdf5 import TrajectoryReader

    with refused(), TrajectoryReader(directory / "trajectory.h5") as reader:
        end = float(reader.time[-1]) if len(reader) else 0.0
        goal = reader.provenance.get("duration", end) if duration is None else duration
        dt = reader.provenance["dt"]
    try:
        summarised = json.loads((directory / SUMMARY).read_text())["sim_time"]
    except (OSError, ValueError, LookupError, TypeError):
        return ""
    if abs(end - goal) > 0.5 * dt or summarised != end:
        return ""
    return f"the run in {directory} is finished, at {end:g} s, and stays as it is; to go on with it give a longer --duration"


def built(module, name: str, settings: dict):
    """Build the scene; errors of a scene of the package are reported with the changed parameters."""
    changed = settings.items() - parameters(module, {}).items()
    text = ", ".join(f"{key} = {value!r}" for key, value in sorted(changed))
    with refused(f"scene '{name}'{text and f' with {text}'}: "):
        try:
            return module.build(**settings)
        except (ArithmeticError, LookupError, TypeError) as error:
            if not (changed and module.__name__.startswith("ddg_warp.")):
                raise  # an error in the scene: show the traceback
            raise InputError(f"scene '{name}' cannot be built with {text} ({error}); change that") from error


def settings_of(chosen: argparse.Namespace, module, name: str) -> tuple[dict, dict]:
    """Return scene parameters, and dt, precision and worlds if set by flags or the run to resume."""
    defaults = parameters(module, {})
    flags = {key: value for key, value in vars(chosen).items() if value is not None}
    settings = {key: value for key, value in flags.items() if key in defaults or key in RUN_SETTINGS}
    duration = {"duration": settings.pop("duration")} if "duration" in settings else {}
    if chosen.resume is not None:
        if chosen.out is not None:
            raise InputError("a resumed run stays in its directory: give --resume or --out")
        settings = stored_settings(chosen.resume, name, settings)
    if settings.get("worlds", 1) < 1:
        raise InputError(f"--worlds {chosen.worlds}: there must be at least one")
    run_settings = {key: settings.pop(key) for key in RUN_SETTINGS if key in settings}
    shared = {"dt": run_settings["dt"]} if "dt" in defaults and "dt" in run_settings else {}
    return parameters(module, settings | duration | shared), run_settings


def say(result, directory: Path) -> None:
    """Print report, counts, checks and failure of a run."""
    from ddg_warp.run.summary import checks_table, contact_line

    content, checks = result.summary(), result.checks
    print(result.model.report(), end="\n\n")
    steps = f"{content['steps']} steps of {content['ms_per_step']:.3g} ms"
    print(
        f"{content['scene']}: {content['sim_time']:g} s in {steps}; "
        f"{content['wall_time']:.3g} s in all, {content['compile_time']:.3g} s to build and compile"
    )
    if "counted_from" in content:
        print(
            f"counts and times are of the steps after {content['counted_from']:g} s: the resumed file stores neither earlier counts "
            "nor the energy at the start"
        )
    if result.choice is not None:
        print(result.choice.line())
    if "contact" in content:
        print(contact_line(content["contact"]))
    if "stable" in content:
        verdicts = {
            True: "stable",
            False: "UNSTABLE",
            None: "stability not computed: use ddg_warp.solve.equilibrium.stability.spectrum, except with friction",
        }
        print(f"last equilibrium: {verdicts[content['stable']]}")
    if checks:
        print(checks_table(checks))
    print(f"results are in {directory}")
    if result.failure:
        print(f"ddg-warp: the solver failed: {result.failure}", file=sys.stderr)


def list_all(chosen: argparse.Namespace) -> int:
    """Print scenes and terms, each with a description of one line."""
    from ddg_warp.kernels.terms import ALL

    listed = {
        "scenes": {name: one_liner(path) for name, path in scene_files().items()},
        "terms": {name: term.text for name, term in ALL.items()},
    }
    for title, entries in listed.items():
        width = max(map(len, entries), default=0)
        print(f"{title}:")
        for name, text in entries.items():
            print(f"  {name:{width}}  {text}")
    return DONE


def check_terms(chosen: argparse.Namespace) -> int:
    """Print the derivative table of a term, or of all."""
    from ddg_warp.kernels.terms import ALL
    from ddg_warp.run.summary import table

    term = chosen.term
    if term is not None and ".py:" in term:
        term = user_term(*term.rsplit(":", 1))
    elif term is not None and term not in ALL:
        raise InputError(f"there is no term '{term}'; there are {', '.join(ALL)}; or give FILE.py:NAME of your own")

    require_device(chosen.device)
    from ddg_warp.run import derivative_checks

    with refused():
        rows = derivative_checks.table(term, chosen.precision, chosen.device)
    print(table([{**row, "passed": "passed" if row["passed"] else "FAILED"} for row in rows]))
    return DONE if all(row["passed"] for row in rows) else FAILED


def bench_scene(chosen: argparse.Namespace) -> int:
    """Run the benchmark of a scene, or of all."""
    from ddg_warp.run.bench import benchmark
    from ddg_warp.run.bench_overview import overview
    from ddg_warp.run.summary import table

    if chosen.scene is None and not chosen.all:
        print("\n".join(scene_files()))
        return DONE
    if chosen.scene is not None and chosen.all:
        raise InputError(f"bench --all measures every scene; leave out '{chosen.scene}', or --all")
    require_device(chosen.device)
    done = True
    for name in scene_files() if chosen.all else [chosen.scene]:
        print(f"== {name}", flush=True)
        names = () if chosen.all else parameters(load_scene(name), {})
        settings = {key: value for key, value in vars(chosen).items() if key in names}
        done &= benchmark(name, chosen.out, device=chosen.device, precision=chosen.precision, given=settings)
    if chosen.all:
        print(table(overview(chosen.out)))
    return DONE if done else FAILED


def export_run(chosen: argparse.Namespace) -> int:
    """Write trajectory.h5 as USD, as a movie, or for rerun."""
    from ddg_warp.run.recorder import export_usd

    source = chosen.directory / "trajectory.h5"
    if not source.is_file():
        raise InputError(f"there is no run in {chosen.directory}: {source} is missing")
    target = chosen.to or chosen.directory / "export.usdc"
    if target.suffix not in (".usda", ".usdc", ".mp4", ".rrd"):
        raise InputError(f"--to {target}: the file must end in .usdc, .usda, .mp4 or .rrd")
    if target.suffix in (".mp4", ".rrd") and (chosen.every != 1 or chosen.fps is not None):
        raise InputError(f"--to {target}: --every and --fps are for USD; leave them out")
    if chosen.revolve and chosen.revolve < 3:
        raise InputError(f"--revolve {chosen.revolve}: a surface of revolution has 3 sides at least")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise system_error(target, error) from error
    with refused():
        if target.suffix == ".mp4":
            from ddg_warp.run.movie import movie

            movie(source, target, title=chosen.directory.name)
        elif target.suffix == ".rrd":
            from ddg_warp.run.rerun_export import export_rerun

            export_rerun(source, target)
        else:
            export_usd(source, target, tube=chosen.tube, revolve=chosen.revolve, every=chosen.every, fps=chosen.fps)
    print(f"wrote {target}")
    return DONE


def compile_kernels(chosen: argparse.Namespace) -> int:
    """Compile the kernels of usual scenes into the cache."""
    from ddg_warp.run.warmup import warm_up

    require_device(chosen.device)
    for name, seconds in warm_up(chosen.device):
        print(f"{name}: {seconds:.3g} s", flush=True)
    return DONE


def view_run(chosen: argparse.Namespace) -> int:
    """Show a run in the browser, or save a view of it."""
    from ddg_warp.view import player

    with refused():
        if chosen.save is None:
            player.view(chosen.directory, port=chosen.port, host=chosen.host, browser=not chosen.no_browser)
            return DONE
        player.save(chosen.directory, chosen.save, field=chosen.field)
    print(f"wrote {chosen.save}")
    return DONE


def open_docs(chosen: argparse.Namespace) -> int:
    """Open the built site in a browser."""
    import webbrowser

    import ddg_warp

    page = Path(ddg_warp.__file__).parents[1] / "out" / "site" / "index.html"
    if not page.exists():
        raise InputError(f'there is no {page}; build it in a clone: pip install -e ".[docs]", then bash tools/site')
    print(page)
    webbrowser.open(page.as_uri())
    return DONE


def complete(chosen: argparse.Namespace) -> int:
    """Print the completion script of a shell, or the completions of a command line."""
    from ddg_warp.run.completion import SCRIPTS, completions

    print("\n".join(completions(chosen.words)) if chosen.words else SCRIPTS[chosen.shell])
    return DONE


def show_info(chosen: argparse.Namespace) -> int:
    """Print versions, devices and machine."""
    from ddg_warp.run.summary import machine

    require_device(None)
    for name, value in machine().items():
        items = [f"{key} {item}" for key, item in value.items()] if isinstance(value, dict) else value
        print(f"{name + ':':11} {', '.join(items) if isinstance(items, list) else items}")
    return DONE


def require_device(name: str | None) -> None:
    """Start Warp quietly; refuse an unknown device."""
    import warp as wp

    import ddg_warp.kernels  # noqa: F401, quietens Warp

    if name is None:
        return
    devices = [device.alias for device in wp.get_devices()]
    if name not in devices and name != "cuda":
        raise InputError(f"there is no device '{name}' here; there is {', '.join(devices)}")
