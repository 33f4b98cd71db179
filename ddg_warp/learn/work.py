"""Tasks done in turn by this process, by several, or by a Ray cluster; results come as they are finished.

Each way takes a function and tasks, one after the other, and yields (task, result). It holds few tasks at a time, so that there may
be very many. An error of the function goes on to the caller; tasks under way are then given up.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator

from ddg_warp.errors import SceneError

AHEAD = 2  # tasks handed out for each worker, so that none waits for the next


def in_turn(function: Callable, tasks: Iterable) -> Iterator[tuple]:
    """Done here, one after the other."""
    for task in tasks:
        yield task, function(task)


def in_processes(function: Callable, tasks: Iterable, workers: int) -> Iterator[tuple]:
    """Done by processes of this machine; a script that calls it needs `if __name__ == "__main__":`.

    Raises:
        SceneError: The function cannot be sent to another process.
    """
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
    from multiprocessing import get_context

    try:
        pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise SceneError(
            f"{function} cannot be sent to another process ({error}): define it at the top of a module, or leave workers out"
        ) from error
    # Processes are spawned: a copy of this one would share its CUDA context and the threads of its libraries.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        try:
            finished = _flow(
                tasks,
                lambda task: pool.submit(function, task),
                lambda under_way: wait(under_way, None, FIRST_COMPLETED)[0],
                AHEAD * workers,
            )
            yield from ((task, future.result()) for task, future in finished)
        finally:
            pool.shutdown(cancel_futures=True)


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
    """
    ray = require_ray()
    own = not ray.is_initialized()
    if own:
        ray.init(include_dashboard=False, log_to_driver=False)
    try:
        remote = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=1)(lambda function, task: function(task))
        function = ray.put(function)
        limit = workers or AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
        finished = _flow(
            tasks, lambda task: remote.remote(function, task), lambda under_way: ray.wait(list(under_way))[0], limit
        )
        try:
            for task, reference in finished:
                yield task, ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error  # as it was raised by the function
    finally:
        if own:
            ray.shutdown()


def _flow(tasks: Iterable, submit: Callable, wait: Callable, limit: int) -> Iterator[tuple]:
    """Hands out tasks, at most `limit` at a time, and yields (task, what `submit` returned) as they are finished."""
    under_way: dict = {}
    for task in tasks:
        while len(under_way) >= limit:
            yield from ((under_way.pop(done), done) for done in wait(under_way))
        under_way[submit(task)] = task
    while under_way:
        yield from ((under_way.pop(done), done) for done in wait(under_way))
