"""Executors of tasks: serial, by several processes, or by a Ray cluster.

Each executor takes a function and an iterable of tasks, and yields (task, result) as tasks finish. Only a few tasks are in flight,
so that there may be very many. An error of the function is raised; tasks in flight are then cancelled.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator
from functools import partial

from ddg_warp.errors import MissingPackageError, SceneError

KEPT = "finished runs are kept, and the same call continues from there"
AHEAD = 2  # tasks in flight per worker, so that none is inactive between tasks


class SweepError(RuntimeError):
    """Error that ends a sweep early: a sample failed for no reason of a solver, or workers were lost. Finished episodes are kept."""


def one_by_one(function: Callable, tasks: Iterable) -> Iterator[tuple]:
    """Execute tasks in this process, one after the other."""
    for task in tasks:
        yield task, function(task)


def in_processes(function: Callable, tasks: Iterable, workers: int) -> Iterator[tuple]:
    """Execute tasks by processes of this machine; a calling script needs `if __name__ == "__main__":`.

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
    # Processes are spawned, since a fork would inherit the CUDA context and threads of libraries.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        submit, wait_for = partial(pool.submit, function), partial(wait, return_when=FIRST_COMPLETED)
        try:
            finished = _flow(tasks, submit, lambda futures: wait_for(futures)[0], Future.cancel, AHEAD * workers)
            for task, future in finished:
                yield task, future.result()
        except BrokenProcessPool as error:
            message = 'A process was killed, or could not start (memory? a script needs `if __name__ == "__main__":`)'
            raise SweepError(f"{message}; {KEPT}") from error


def require_ray():
    """Import and return the module `ray`.

    Raises:
        MissingPackageError: Ray is not installed.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise MissingPackageError("work on a cluster needs", error, "ray") from error
    return ray


def on_ray(function: Callable, tasks: Iterable, workers: int | None = None, gpus: float = 0.0) -> Iterator[tuple]:
    """Execute tasks by a Ray cluster: the one that this process has joined, or a temporary one of this machine.

    Args:
        workers: Tasks in flight; by default as many as the cluster has processors, and as many waiting.
        gpus: Fraction of a GPU for each task.

    Raises:
        SweepError: Ray lost its workers, or a module is missing on a worker.
    """
    ray = require_ray()
    is_temporary = not ray.is_initialized()
    if is_temporary:
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
            raise cause from error  # the error of the function
        message = f"Ray cannot go on: {str(error).strip().splitlines()[-1]}"
        raise SweepError(f"{message} (its machines need ddg_warp and the module of the function); {KEPT}") from error
    finally:
        if is_temporary:
            ray.shutdown()


def _flow(tasks: Iterable, submit: Callable, wait: Callable, give_up: Callable, limit: int) -> Iterator[tuple]:
    """Submit tasks, at most `limit` at a time, and yield (task, future) as they finish."""
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
