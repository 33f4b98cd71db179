"""Tasks done in turn by this process, by several, or by a Ray cluster; results come as they are finished.

Each way takes a function and tasks, one after the other, and yields (task, result). It holds few tasks at a time, so that there may
be very many. An error of the function goes on to the caller; tasks under way are then given up.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator
from functools import partial

from ddg_warp.errors import SceneError

KEPT = "what is finished is kept, and the same call goes on from there"
AHEAD = 2  # tasks handed out for each worker, so that none waits for the next


class SweepError(RuntimeError):
    """A sweep ended early: a sample met an error that is no outcome of a solver, or workers were lost. What is finished is kept."""


def in_turn(function: Callable, tasks: Iterable) -> Iterator[tuple]:
    """Done here, one after the other."""
    for task in tasks:
        yield task, function(task)


def in_processes(function: Callable, tasks: Iterable, workers: int) -> Iterator[tuple]:
    """Done by processes of this machine; a script that calls it needs `if __name__ == "__main__":`.

    Raises:
        SceneError: The function cannot be sent to another process.
        SweepError: A process was killed.
    """
    from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    try:
        pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise SceneError(
            f"{function} cannot be sent to another process ({error}): define it at the top of a module, or leave workers out"
        ) from error
    # Processes are spawned: a copy of this one would share its CUDA context and the threads of its libraries.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        submit, wait_for = partial(pool.submit, function), partial(wait, return_when=FIRST_COMPLETED)
        try:
            finished = _flow(tasks, submit, lambda futures: wait_for(futures)[0], Future.cancel, AHEAD * workers)
            for task, future in finished:
                yield task, future.result()
        except BrokenProcessPool as error:
            told = 'A process was killed, or could not start (memory? a script needs `if __name__ == "__main__":`)'
            raise SweepError(f"{told}; {KEPT}") from error


def require_ray():
    """The module `ray`.

    Raises:
        ModuleNotFoundError: It is not installed.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "Ray is not installed: `pip install 'ddg-warp[ray]'`, or leave ray out to work here", name="ray"
        ) from error
    return ray


def on_ray(function: Callable, tasks: Iterable, workers: int | None = None, gpus: float = 0.0) -> Iterator[tuple]:
    """Done by a Ray cluster: the one that this process has joined, or one of this machine, which ends with the work.

    Args:
        workers: Tasks under way at once; by default as many as the cluster has processors, and as many waiting.
        gpus: Share of a GPU for each task.

    Raises:
        SweepError: Ray lost its workers, or they lack a module.
    """
    ray = require_ray()
    own = not ray.is_initialized()
    if own:
        ray.init(include_dashboard=False, log_to_driver=False)
    try:
        remote = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=1)(lambda function, task: function(task))
        submit, give_up = partial(remote.remote, ray.put(function)), partial(ray.cancel, force=True)
        limit = workers or AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
        finished = _flow(tasks, submit, lambda references: ray.wait([*references])[0], give_up, limit)
        for task, reference in finished:
            yield task, ray.get(reference)
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", error)
        if not isinstance(cause, ray.exceptions.RayError):
            raise cause from error  # as the function has raised it
        told = f"Ray cannot go on: {str(error).strip().splitlines()[-1]}"
        raise SweepError(f"{told} (its machines need ddg_warp and the module of the function); {KEPT}") from error
    finally:
        if own:
            ray.shutdown()


def _flow(tasks: Iterable, submit: Callable, wait: Callable, give_up: Callable, limit: int) -> Iterator[tuple]:
    """Hands out tasks, at most `limit` at a time, and yields (task, what `submit` returned) as they are finished."""
    under_way: dict = {}
    try:
        for task in tasks:
            while len(under_way) >= limit:
                yield from ((under_way.pop(done), done) for done in wait(under_way))
            under_way[submit(task)] = task
        while under_way:
            yield from ((under_way.pop(done), done) for done in wait(under_way))
    finally:
        for each in under_way:
            give_up(each)
