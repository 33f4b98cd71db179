"""Who may launch while others capture.

While Warp captures on the CPU device, it records the launches and copies of every thread of the process (Warp 1.19). So a capture,
and whatever compiles or loads kernels, waits until no other thread is inside of this package, and keeps them out meanwhile; all else
runs side by side, but for calls of one object that works in memory of its own, such as an `Integrator`. On CUDA all threads share the
current stream of a device, which Warp replaces while it reads an array: two that read at once can leave it replaced for good
("unknown stream"), and memory or a graph that a thread frees ends the capture of another. So where there is CUDA every call is alone,
and so is every collection of garbage; what is launched runs on. Launches that a user makes in threads of his own are his to keep
apart.
"""

import gc
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps

from ddg_warp.errors import SceneError


class _Turns:
    """Many threads that launch, or one that captures; a thread may enter again, and may capture while it launches."""

    def __init__(self):
        self._changed = threading.Condition()
        self._inside, self._capturing = 0, False
        self._own, self._collection = threading.local(), ExitStack()
        self.shared: bool | None = None  # whether threads share a stream; found out by the first call

    @property
    def inside(self) -> bool:
        """Whether this thread launches, or captures, once it is known whether threads share a stream."""
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
        """Acquire a lock that another thread holds, which may wait for this one to leave its turn meanwhile."""
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
        """Collections take their turn, too; but for one that starts while its thread is about to take or leave a turn."""
        if phase == "stop":
            self._collection.close()
        elif not getattr(self._own, "changing", False):
            self._collection.enter_context(self.launching())


def _cuda() -> bool:
    import warp as wp

    return wp.is_cuda_available()


_turns = _Turns()
launching, capturing = _turns.launching, _turns.capturing


def launches(what):
    """Decorate what launches: a function, or a class, whose constructor may load kernels and whose other methods launch.

    Where threads share a stream, what an object of such a class holds is freed in its turn, too.
    """
    if not isinstance(what, type):
        return _within(launching, what)
    for name, member in list(vars(what).items()):
        if callable(member) and not isinstance(member, type | staticmethod | classmethod):
            if name == "__init__":
                setattr(what, name, _within(capturing, member))
            elif not name.startswith("_"):
                setattr(what, name, _within(launching, member))
    what.__del__ = _release
    return what


def lock_of(owner) -> threading.RLock:
    """Return the lock of an object whose memory one call at a time may use."""
    lock = owner.__dict__.get("_lock")
    return owner.__dict__.setdefault("_lock", threading.RLock()) if lock is None else lock


def _acquired(owner) -> threading.RLock:
    """Return the lock of an object once this thread holds it."""
    lock = lock_of(owner)
    if not lock.acquire(blocking=False):
        _turns.await_lock(lock)
    return lock


@contextmanager
def alone(owner) -> Iterator[None]:
    """Keep other threads out of an object's memory."""
    lock = _acquired(owner)
    try:
        yield
    finally:
        lock.release()


def one_at_a_time(method):
    """Decorate a method that works in memory of its object, so that threads which share the object call it one after the other."""

    @wraps(method)
    def entered(self, *args, **kwargs):
        lock = _acquired(self)  # as `alone`, which takes a hundredth of a small step
        try:
            return method(self, *args, **kwargs)
        finally:
            lock.release()

    return entered


def stays_here(cls):
    """Decorate a class whose objects hold captured launches and scratch memory of a device: threads that share an object call its
    public methods one after the other, and no copy can take it over.
    """
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
    if _turns.shared:
        with launching():
            vars(self).clear()


def _within(turn, function):
    @wraps(function)
    def entered(*args, **kwargs):
        if turn is launching and _turns.inside:  # in this very turn, which takes less than to take it anew
            return function(*args, **kwargs)
        with turn():
            return function(*args, **kwargs)

    return entered
