"""Flow of the fluid of drag: uniform, a function of time, or a field of position and time. NumPy only.

A field is a function `flow(points, t)` of points (n, 3) [m], or (worlds, n, 3), that returns velocities of that shape [m/s].
"""

import inspect
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.scene.field import Field
from ddg_warp.typing import Floats, Numbers, Vector

CHUNK = 2**12  # points whose modes are summed at once
SPECTRA = ("von_karman", "kraichnan")
LONGEST, SHORTEST = 0.1, 100.0  # wave numbers of the von Karman spectrum over 1 / length: 94 % of its energy
NAMES = ("velocities", "lower", "upper", "times")  # of arrays in files


def depends_on_position(flow) -> bool:
    """Return True if a flow is a function of position and time: one with two arguments without default."""
    if isinstance(flow, FlowSum):
        return any(map(depends_on_position, flow.flows))
    if not callable(flow):
        return False
    try:
        arguments = inspect.signature(flow).parameters.values()
    except (TypeError, ValueError):
        return False
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return sum(each.kind in kinds and each.default is each.empty for each in arguments) == 2


def terms_of(flow) -> tuple:
    """Return the terms of a sum of flows, or the flow itself."""
    return sum(map(terms_of, flow.flows), ()) if isinstance(flow, FlowSum) else (flow,)


def is_on_host(flow) -> bool:
    """Return True if a flow has a field that is a function of a user."""
    return any(depends_on_position(each) and not isinstance(each, Turbulence | FlowGrid) for each in terms_of(flow))


def flow_at(flow, t: float, dimension: int = 3, points: Floats | None = None, error=SolverError) -> np.ndarray:
    """Return the velocity of the fluid at t [m/s]: (3,), or of the shape of `points` if the flow depends on position.

    Raises:
        error: the flow has another shape, is not finite, or leaves the plane of a planar scene; names the function and the time.
    """
    if isinstance(flow, FlowSum):
        return sum(flow_at(each, t, dimension, points, error) for each in flow.flows)
    local = depends_on_position(flow)
    field = Field("flow", flow, None if local else 3)
    result = field.at(t, error=error, arguments=(points,) if local else ())
    shape = points.shape if local else (3,)
    if result.shape != shape:
        rule = f"at points {shape} give velocities {shape}" if local else "a function of time is uniform, give (3,)"
        raise error(f"flow has shape {result.shape} at t = {t:g}; {rule}")
    if dimension == 2 and result[..., 1].any():
        shown = (
            f"has components along y up to {np.abs(result[..., 1]).max():g}"
            if local
            else f"is {tuple(result.tolist())}"
        )
        raise error(f"flow {shown} at t = {t:g}; a scene of dimension 2 stays in the plane of x and z, give 0 along y")
    return result


class Flow:
    """Flow that can be added to others: a field, a function of time, or a velocity (3,)."""

    __array_ufunc__ = None  # so that an array leaves the sum to `__radd__`

    def __add__(self, flow) -> "FlowSum":
        return FlowSum((self, flow))

    __radd__ = __add__


@dataclass(frozen=True, eq=False)
class FlowSum(Flow):
    """Sum of flows, such as `Turbulence(...) + Gust(...)`."""

    flows: tuple

    def __post_init__(self):
        for each in self.flows:
            if not callable(each):
                argument_checks.vector("a flow that is added", each)

    def __call__(self, points: Floats, t: float) -> Floats:
        """Return velocities at points (..., 3)."""
        return np.zeros(points.shape) + flow_at(self, t, points=points)


@argument_checks.called
@dataclass(frozen=True, eq=False)
class FlowGrid(Flow):
    """Velocities on a regular grid in a box, trilinear between grid points and linear in time.

    Beyond the box and the times the nearest values hold.

    Attributes:
        velocities: (nx, ny, nz, 3), or (times, nx, ny, nz, 3) [m/s]. The flow is uniform along an axis of one point.
        lower, upper: corners of the box, the first and the last grid point (3,) [m].
        times: ascending times (times,) [s]; None for a steady flow.

    Raises:
        SceneError: shapes do not fit, values are not finite, or the box is empty.
    """

    velocities: Numbers
    lower: Vector
    upper: Vector
    times: Numbers | None = None

    def __post_init__(self):
        lower, upper = (
            np.array(argument_checks.vector(f"FlowGrid: {name}", getattr(self, name))) for name in ("lower", "upper")
        )
        steady = self.times is None
        rule = "give (nx, ny, nz, 3)" if steady else "give (times, nx, ny, nz, 3)"
        values = argument_checks.array("FlowGrid: velocities", self.velocities, rule).copy()
        if values.ndim != 4 + (not steady) or values.shape[-1] != 3 or not values.size:
            raise SceneError(f"FlowGrid: velocities have shape {values.shape}; {rule}")
        if not np.isfinite(values).all():
            raise SceneError("FlowGrid: velocities are not all finite; give finite numbers")
        argument_checks.sized("FlowGrid: velocities", values, least=0.0)
        counts = np.array(values.shape[-4:-1])
        for axis in np.flatnonzero((counts > 1) & ~(upper > lower)):
            raise SceneError(
                f"FlowGrid: upper is {upper[axis]:g} along {'xyz'[axis]}, lower {lower[axis]:g}; give a larger one"
            )
        object.__setattr__(self, "velocities", values)
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)
        if not steady:
            times = argument_checks.array(
                "FlowGrid: times", self.times, f"give ascending numbers ({len(values)},)"
            ).copy()
            if times.shape != values.shape[:1] or not np.isfinite(times).all() or (np.diff(times) <= 0.0).any():
                shown = argument_checks.shown(times)
                raise SceneError(f"FlowGrid: times are {shown}; give ascending numbers ({len(values)},), one a grid")
            object.__setattr__(self, "times", times)

    def __call__(self, points: Floats, t: float) -> Floats:
        """Return velocities at points (..., 3)."""
        values = self.velocities if self.times is not None else self.velocities[None]
        counts = np.array(values.shape[:4])
        indices = np.concatenate(
            [np.full((*points.shape[:-1], 1), self.instant(t)), (points - self.lower) * self.cells_per_length], axis=-1
        )
        indices = np.clip(indices, 0.0, counts - 1)
        first = np.minimum(indices.astype(int), np.maximum(counts - 2, 0))
        fractions, result = indices - first, np.zeros(points.shape)
        for corner in np.ndindex(2, 2, 2, 2):
            weight = np.prod(np.where(corner, fractions, 1.0 - fractions), axis=-1, keepdims=True)
            i, x, y, z = np.moveaxis(np.minimum(first + corner, counts - 1), -1, 0)
            result += weight * values[i, x, y, z]
        return result

    @property
    def cells_per_length(self) -> Floats:
        """Inverse distances of grid points (3,) [1/m], zero along an axis of one point."""
        cells = np.array(self.velocities.shape[-4:-1]) - 1
        return np.where(cells > 0, cells / np.where(cells > 0, self.upper - self.lower, 1.0), 0.0)

    def instant(self, t: float) -> float:
        """Return the index of a time among the times, with its fraction."""
        return 0.0 if self.times is None else float(np.interp(t, self.times, np.arange(len(self.times))))

    def __repr__(self) -> str:
        size = " x ".join(map(str, np.shape(self.velocities)[:-1]))
        return f"<FlowGrid of {size} velocities from {self.lower} to {self.upper} m>"

    def save(self, path: str | Path) -> None:
        """Write a file for `load`: HDF5 (.h5, .hdf5), or NumPy's .npz.

        Raises:
            SceneError: another suffix.
        """
        if not str(path).endswith((".npz", ".h5", ".hdf5")):
            raise SceneError(
                f"FlowGrid.save: {path}: a grid of flow is a .npz, .h5 or .hdf5 file; give one of these suffixes"
            )
        arrays = {name: getattr(self, name) for name in NAMES if getattr(self, name) is not None}
        if _is_hdf5(path):
            import h5py

            with h5py.File(path, "w") as file:
                file.update(arrays)
        else:
            np.savez(path, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "FlowGrid":
        """Read a grid from a file of arrays "velocities", "lower", "upper" and, unless steady, "times": .npz or HDF5.

        Raises:
            SceneError: there is no file, an array is missing, or another one is there; the message names it.
        """
        if not Path(path).is_file():
            raise SceneError(f"FlowGrid.load: {path}: there is no such file; check the path")
        if _is_hdf5(path):
            import h5py

            with h5py.File(path, "r") as file:
                arrays = {name: np.asarray(file[name]) for name in file}
        else:
            with np.load(path) as file:
                arrays = {name: file[name] for name in file.files}
        for name in NAMES[:3]:
            if name not in arrays:
                raise SceneError(f"{path}: there is no array '{name}'; a flow has {', '.join(NAMES[:3])}, and times")
        for name in arrays:
            if name not in NAMES:
                raise SceneError(f"{path}: array '{name}' is not of a flow{argument_checks.meant(name, NAMES)}")
        return cls(**arrays)


def _is_hdf5(path: str | Path) -> bool:
    return str(path).endswith((".h5", ".hdf5"))


@argument_checks.called
@dataclass(frozen=True, eq=False)
class Turbulence(Flow):
    """Mean wind with homogeneous isotropic turbulence, a sum of random Fourier modes without divergence (Kraichnan 1970).

    With unit vectors a_n across the wave vectors k_n, and random phases phi_n and frequencies omega_n (Phys. Fluids 13, 1970, 22),

        u = U + s sqrt(6 / N) sum over n of a_n cos(k_n . (x - U t) + omega_n t + phi_n) .

    Eddies drift with the mean U (Taylor's frozen turbulence) and decorrelate at the rate s / length, s = intensity |U|. Energy
    spectra, of the longitudinal correlation f(r) with the integral length:

    "von_karman", of the atmosphere: E ~ k^4 / (1 + (k b)^2)^(17/6), b = 1.339 length. Modes have k from 0.1 to 100 over the length.

    "kraichnan", of eddies of one size: E ~ k^4 exp(-(k length)^2 / pi), f = exp(-pi r^2 / (4 length^2)).

    The flow is the same on every device and machine, up to rounding: modes are functions of the seed alone.

    Attributes:
        mean: U (3,) [m/s].
        intensity: standard deviation of a component over |U|.
        length: integral length of the longitudinal correlation [m].
        seed: whole number from 0.
        modes: number N of modes.
        waves, amplitudes: k_n and s sqrt(6 / N) a_n (N, 3) [1/m, m/s].
        spectrum: "von_karman" or "kraichnan".

    Raises:
        SceneError: an invalid argument; names it.
    """

    mean: Vector
    intensity: float
    length: float
    seed: int = 0
    modes: int = 256
    spectrum: str = "von_karman"

    def __post_init__(self):
        mean = np.array(argument_checks.vector("Turbulence: mean", self.mean))
        speed = float(np.linalg.norm(mean))
        if speed == 0.0:
            raise SceneError("Turbulence: mean is zero, and the intensity is relative to it; give a wind")
        argument_checks.number("Turbulence: intensity", self.intensity, "a number from 0", lambda v: v >= 0.0)
        length = argument_checks.positive("Turbulence: length", self.length, "m")
        argument_checks.count("Turbulence: seed", self.seed, 0)
        count = argument_checks.count("Turbulence: modes", self.modes)
        argument_checks.choice("Turbulence: spectrum", self.spectrum, SPECTRA)
        deviation = self.intensity * speed
        draws = np.random.default_rng(self.seed).random((6, count))  # uniform numbers: their stream is fixed
        waves, amplitudes = _modes(draws[:3], self.spectrum)
        normal = np.sqrt(-2.0 * np.log1p(-draws[3])) * np.cos(2.0 * np.pi * draws[4])
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "waves", waves / length)
        object.__setattr__(self, "amplitudes", deviation * np.sqrt(6.0 / count) * amplitudes)
        rates = deviation / length * normal - (waves / length) @ mean
        object.__setattr__(self, "_rates", rates)
        object.__setattr__(self, "_phases", 2.0 * np.pi * draws[5])

    def __call__(self, points: Floats, t: float) -> Floats:
        """Return velocities at points (..., 3)."""
        flat, phases = points.reshape(-1, 3), self.phases(t)
        result = np.empty_like(flat)
        for first in range(0, len(flat), CHUNK):
            some = slice(first, first + CHUNK)
            result[some] = self.mean + np.cos(flat[some] @ self.waves.T + phases) @ self.amplitudes
        return result.reshape(points.shape)

    def phases(self, t: float) -> Floats:
        """Return the phases of the modes at the origin at t (N,), from 0 to 2 pi."""
        return np.mod(self._rates * t + self._phases, 2.0 * np.pi)


def _modes(draws: np.ndarray, spectrum: str) -> tuple[np.ndarray, np.ndarray]:
    """Return wave vectors (N, 3), times the integral length, and unit vectors across (N, 3), from uniform numbers (3, N).

    Wave numbers are at equal steps of the energy, in a random order, with directions on a lattice over the sphere.
    """
    count = draws.shape[1]
    if spectrum == "von_karman":
        k = np.geomspace(LONGEST, SHORTEST, 4001)
        density = k**4 / (1.0 + (1.339 * k) ** 2) ** (17.0 / 6.0)
    else:
        k = np.linspace(0.0, 10.0, 4001)
        density = k**4 * np.exp(-(k**2) / np.pi)
    energy = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(k))])
    ranks = np.argsort(np.argsort(draws[0]))
    size = np.interp((ranks + 0.5) / count, energy / energy[-1], k)
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count) + 2.0 * np.pi * draws[1, 0]
    across = np.sqrt(1.0 - z * z)
    direction = np.stack([across * np.cos(angle), across * np.sin(angle), z], -1)
    first = np.stack([-np.sin(angle), np.cos(angle), np.zeros(count)], -1)
    turn = 2.0 * np.pi * draws[2][:, None]
    return size[:, None] * direction, np.cos(turn) * first + np.sin(turn) * np.cross(direction, first)


@argument_checks.called
@dataclass(frozen=True, eq=False)
class Gust(Flow):
    """Uniform gust, (1 - cos(2 pi (t - start) / duration)) / 2 times its peak, as of EASA CS 25.341; zero before and after.

    Attributes:
        peak: velocity at the peak (3,) [m/s].
        start: time at which it begins [s].
        duration: its length [s]: 2 H / U with the gradient distance H and the wind U.
    """

    peak: Vector
    start: float = 0.0
    duration: float = 1.0

    def __post_init__(self):
        object.__setattr__(self, "peak", np.array(argument_checks.vector("Gust: peak", self.peak)))
        argument_checks.number("Gust: start", self.start)
        argument_checks.positive("Gust: duration", self.duration, "s")

    def __call__(self, t: float) -> Floats:
        """Return the velocity (3,) at t."""
        phase = np.clip((t - self.start) / self.duration, 0.0, 1.0)
        return self.peak * (0.5 - 0.5 * np.cos(2.0 * np.pi * phase))
