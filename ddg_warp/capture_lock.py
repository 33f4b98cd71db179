"""Thread safety: mutual exclusion of launches, graph captures and kernel loading.

While Warp captures on the CPU device, it records the launches and copies of every thread of the process (Warp 1.19). So captures,
compilation and loading of kernels exclude all other threads in this package. Other calls run concurrently, except calls of one object
with scratch memory, such as an `Integrator`.

On CUDA all threads use the current stream of a device, which Warp replaces while it reads an array. Two concurrent reads can leave the
stream replaced ("unknown stream"), and memory or graphs freed by one thread end the capture of another. So with CUDA every call and
every garbage collection excludes all others, while launched work runs on. Launches in a user's threads are not protected.
"""

import gc
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import TypeVar

from ddg_warp.errors import SceneError

Target = TypeVar("Target", bound=Callable)  # a function or class


class _Turns:
    """Reentrant shared/exclusive lock: many threads launch, or one captures; a launching thread may capture."""

    def __init__(self):
        self._changed = threading.Condition()
        self._inside, self._capturing = 0, False
        self._own, self._collection = threading.local(), ExitStack()
        self.shared: bool | None = None  # True if threads use one stream; set by the first call

    @property
    def inside(self) -> bool:
        """True if this thread is launching or capturing, once `shared` is known."""
        return self.shared is not None and getattr(self._own, "depth", 0) > 0

    @contextmanager
    def launching(self) -> Iterator[None]:
        depth = getattr(self._own, "depth", 0)
        with self._changing():
            if self.shared is None:
                self.shared = _cuda()
                if self.shared:
                    gc.callbacks.append(self._collecting)
            if not depth:
                self._changed.wait_for(lambda: not self._capturing and not (self.shared and self._inside))
                self._inside += 1
            self._own.depth = depth + 1
        try:
            yield
        finally:
            with self._changing():
                self._inside -= not depth
                self._own.depth = depth

    @contextmanager
    def capturing(self) -> Iterator[None]:
        if getattr(self._own, "alone", False):
            yield
            return
        depth = getattr(self._own, "depth", 0)
        with self._changing():
            self._inside -= depth > 0
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._capturing and not self._inside)
            self._capturing = self._own.alone = True
            self._own.depth = depth + 1
        try:
            yield
        finally:
            with self._changing():
                self._capturing = self._own.alone = False
                self._inside += depth > 0
                self._own.depth = depth

    def await_lock(self, lock) -> None:
        """Acquire a lock that another thread holds; leave the shared section meanwhile, to avoid deadlock."""
        depth = getattr(self._own, "depth", 0)
        with self._changing():
            self._inside -= depth > 0
        lock.acquire()
        with self._changing():
            if depth:
                self._changed.wait_for(lambda: not self._capturing and not (self.shared and self._inside))
                self._inside += 1

    @contextmanager
    def _changing(self) -> Iterator[None]:
        self._own.changing = True
        try:
            with self._changed:
                yield
                self._changed.notify_all()
        finally:
            self._own.changing = False

    def _collecting(self, phase: str, _info: dict) -> None:
        """Run garbage collections as launches, except in a thread that is entering or leaving a section."""
        if phase == "stop":
            self._collection.close()
        elif not getattr(self._own, "changing", False):
            self._collection.enter_context(self.launching())


def _cuda() -> bool:
    import warp as wp

    return wp.is_cuda_available()


_serialise = _Turns()
launching, capturing = _serialise.launching, _serialise.capturing


def launches(target: Target) -> Target:
    """Decorate a function that launches, or a class: its constructor loads kernels, its public methods launch.

    If threads use one stream, the attributes of such an object are freed in a launching section, too.
    """
    if not isinstance(target, type):
        return _within(launching, target)
    for name, member in list(vars(target).items()):
        if callable(member) and not isinstance(member, type | staticmethod | classmethod):
            if name == "__init__":
                setattr(target, name, _within(capturing, member))
            elif not name.startswith("_"):
                setattr(target, name, _within(launching, member))
    target.__del__ = _release
    return target


def lock_of(owner) -> threading.RLock:
    """Return the lock that guards the scratch memory of an object."""
    lock = owner.__dict__.get("_lock")
    return owner.__dict__.setdefault("_lock", threading.RLock()) if lock is None else lock


def _acquired(owner) -> threading.RLock:
    """Acquire and return the lock of an object."""
    lock = lock_of(owner)
    if not lock.acquire(blocking=False):
        _serialise.await_lock(lock)
    return lock


@contextmanager
def alone(owner) -> Iterator[None]:
    """Exclude other threads from the scratch memory of an object."""
    lock = _acquired(owner)
    try:
        yield
    finally:
        lock.release()


def one_at_a_time(method: Target) -> Target:
    """Decorate a method that uses scratch memory of the object: calls of several threads are serialised."""

    @wraps(method)
    def entered(self, *args, **kwargs):
        lock = _acquired(self)  # like `alone`, which costs a hundredth of a small step
        try:
            return method(self, *args, **kwargs)
        finally:
            lock.release()

    return entered


def stays_here(cls: Target) -> Target:
    """Decorate a class with captured launches and scratch memory: serialise public methods, refuse copies and pickling."""
    for name, member in list(vars(cls).items()):
        if not name.startswith("_") and callable(member) and not isinstance(member, type | staticmethod | classmethod):
            setattr(cls, name, one_at_a_time(member))

    def refuse(self, *_):
        raise SceneError(
            f"{cls.__name__}: its captured launches and device memory can be neither copied nor saved; copy or save the model and "
            f"the states (pickle, torch.save, copy.deepcopy), and make another {cls.__name__} of the model"
        )

    cls.__reduce_ex__ = refuse
    return cls


def _release(self) -> None:
    if _serialise.shared:
        with launching():
            vars(self).clear()


def _within(section, function):
    @wraps(function)
    def entered(*args, **kwargs):
        if section is launching and _serialise.inside:  # already in a section; entering again would cost more
            return function(*args, **kwargs)
        with section():
            return function(*args, **kwargs)

    return entered
