"""Memory check before allocation: bytes that a model and an integrator need against free bytes of the device."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ddg_warp.errors import SceneError, SolverError

# Least bytes of a node of uncoupled rods, constant arrays, states and solver together: planar, without twist, and with twist. The least
# have rods that only stretch, or with twist straight rods; see `postprocess.model_report.bytes_per_node`.
ROD_NODE = {"float64": (260, 400, 810), "mixed": (225, 335, 660), "float32": (130, 200, 400)}
# Least bytes of a dof block of the coupled system in float64. Measured: 1340 (joined rods) to 3360 (contact).
COUPLED = 1300
# Fraction of these bytes by precision; measured: 0.58 to 0.81 in mixed precision.
LESS = {"float64": 1.0, "mixed": 0.6, "float32": 0.5}
MOST = 2**31 - 1  # largest index on a device


def require(scene, is_coupled: bool, worlds: int, precision: str, device) -> None:
    """Refuse more worlds than the memory or the index range of a device allows.

    Raises:
        SceneError: names the bytes needed, the bytes free and the largest number of worlds.
    """
    blocks = _blocks(scene)
    if worlds * blocks > MOST:
        raise SceneError(
            f"worlds = {worlds}: indices on a device count to {MOST}, and each world has {blocks} nodes and angles; build "
            f"{MOST // blocks} worlds at most, in several models if need be"
        )
    each = blocks * COUPLED * LESS[precision] if is_coupled else _rod_bytes(scene, precision)
    free = free_bytes(device)
    if worlds * each > free:
        fits = int(free // each)
        fewer = f"build {fits} worlds at most" if fits else "coarsen the scene"
        raise SceneError(
            f"worlds = {worlds}: the model and an integrator of it need {_size(worlds * each)} at least, and {device} has "
            f"{_size(free)} left; {fewer}, take precision 'mixed' or 'float32', or free other arrays"
        )


@contextmanager
def named(label: str, device) -> Iterator[None]:
    """Name the allocation that runs out of memory, and the free bytes.

    Raises:
        SceneError: an allocation failed.
    """
    try:
        yield
    except SolverError:
        raise
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate" not in str(error):
            raise
        raise SceneError(
            f"{label}: out of memory ({error}); {device} has {_size(free_bytes(device))} left; build fewer worlds, take precision "
            "'mixed' or 'float32', or free other arrays"
        ) from error


def free_bytes(device) -> float:
    """Return the bytes of memory that a device has left; infinite if unknown."""
    if device.is_cuda:
        return float(device.free_memory)
    group = "/sys/fs/cgroup/memory"
    limit, used, cached = _number(f"{group}.max"), _number(f"{group}.current"), _entry(f"{group}.stat", "inactive_file")
    of_group = limit - used + cached if max(limit, used, cached) < float("inf") else float("inf")
    return min(1024.0 * _entry("/proc/meminfo", "MemAvailable:"), of_group)


def _blocks(scene) -> int:
    """Return the number of nodes and twist angles in a world."""
    rods = sum(batch.rods * batch.nodes * (2 if batch.twist else 1) for batch in scene.batches)
    return rods + sum(len(shell.points) for shell in (*scene.shells, *scene.axisymmetric_shells))


def _rod_bytes(scene, precision: str) -> int:
    """Return the least bytes of the uncoupled rods of a world."""
    planar, untwisted, twisted = ROD_NODE[precision]
    straight = planar if scene.dimension == 2 else untwisted
    return sum(batch.rods * batch.nodes * (twisted if batch.twist else straight) for batch in scene.batches)


def _entry(path: str, name: str) -> float:
    try:
        lines = Path(path).read_text().splitlines()
    except OSError:
        return float("inf")
    return next((float(line.split()[1]) for line in lines if line.startswith(name)), float("inf"))


def _number(path: str) -> float:
    try:
        return float(Path(path).read_text())
    except (OSError, ValueError):  # "max" without a limit
        return float("inf")


def _size(count: float) -> str:
    return f"{count / 2**30:.3g} GiB"
