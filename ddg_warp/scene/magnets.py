"""Magnetism of a scene: magnetised rods, the applied field, and dipole pairs."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.scene.field import Field
from ddg_warp.typing import Numbers, Selection, Vector


@dataclass(frozen=True)
class Magnet:
    """Magnetisation (E, 3) [A/m] of edges (E,) of some rods, along first director, second director and tangent."""

    rods: np.ndarray
    edges: np.ndarray
    magnetisation: np.ndarray


@dataclass(frozen=True)
class MagneticField:
    """Applied field B(x, t) = value + gradient (x - origin) [T]: constants, or functions of time."""

    value: Field
    gradient: Field
    origin: np.ndarray
    planar: bool  # whether the field must lie in the plane of x and z

    def at(self, t: float, otherwise: float, error=SolverError) -> np.ndarray:
        """Return B at the origin of space and the rows of the gradient (12,) at t; constants are scaled by `otherwise`.

        Raises:
            SolverError: a function is not finite, or no magnetic field; names the function and the time.
        """
        value, gradient = (field.at(t, otherwise, error) for field in (self.value, self.gradient))
        self._check(value, gradient, t, error)
        return np.concatenate([value - gradient @ self.origin, gradient.ravel()])

    def over(self, points: np.ndarray, t: float, otherwise: float) -> np.ndarray:
        """Return B at points (n, 3) [T]; see `at`."""
        field, gradient = np.split(self.at(t, otherwise), [3])
        return field + points @ gradient.reshape(3, 3).T

    def _check(self, value: np.ndarray, gradient: np.ndarray, t: float, error) -> None:
        wrong = ""
        if value.shape != (3,) or gradient.shape != (3, 3):
            wrong = f"have the shapes {value.shape} and {gradient.shape}; give (3,) and (3, 3)"
        elif self.planar and np.any(np.append(gradient[[0, 2, 1, 1], [1, 1, 0, 2]], value[1]) != 0.0):
            wrong = "leave the plane of x and z, in which a scene of dimension 2 stays; give 0 along y"
        elif abs(np.trace(gradient)) > 1e-9 * np.abs(gradient).max():
            wrong = f"have a divergence of {np.trace(gradient):g} T/m, and no field has one; the trace of the gradient is zero"
        elif np.abs(gradient - gradient.T).max() > 1e-9 * np.abs(gradient).max():
            wrong = "have a curl, which no field has away from its currents; the gradient is symmetric"
        if wrong:
            text = f"magnetic_field: value and gradient at t = {t:g} {wrong}"
            raise error(text, outcome=argument_checks.PRESCRIBED) if error is SolverError else error(text)


@dataclass(frozen=True)
class Dipoles:
    """Point-dipole pairs of all edges of some magnetised rods (None: all) within `cutoff` [m] at rest."""

    rods: np.ndarray | None
    cutoff: float


@argument_checks.called
@dataclass(kw_only=True, repr=False, eq=False)
class Magnets:
    """Magnetism of a scene."""

    magnets: list[Magnet] = field(default_factory=list, init=False)
    dipoles: list[Dipoles] = field(default_factory=list, init=False)
    applied_field: MagneticField | None = field(default=None, init=False)

    def magnetize(self, rods: Selection, magnetisation: Numbers, edges: Selection | None = None) -> None:
        """Add a magnetisation of rods, fixed in the material frame of edges (hard-magnetic elastomer).

        The dipole moment of an edge is the magnetisation times its volume at rest; a `Stiffness` needs an `area`. Magnetised rods
        belong to the coupled system. Several calls add up.

        Args:
            rods: one rod or several.
            magnetisation: along the tangent, a number [A/m]; or along first director, second director and tangent, (3,) or (E, 3)
                by edge. In dimension 2 the first director is across the plane, and the second is the tangent rotated by 90
                degrees from x towards z. Rods without twist have only a tangent.
            edges: magnetised edges; all by default.

        Raises:
            SceneError: an edge that does not exist, or a component that the rod has no director for.
        """
        rods, added = argument_checks.once("magnetize: rods", self._rods(rods)), []
        vector = argument_checks.floats(magnetisation)
        vector = vector * [0.0, 0.0, 1.0] if vector.ndim == 0 else vector
        for batch in self._batches(rods):
            batch_rods = rods[(rods >= batch.first) & (rods < batch.first + batch.rods)]
            where = f"magnetize: rod {batch_rods[0]} ('{batch.name}')"
            _, chosen = self._on_rods("magnetize", batch_rods, "edge", slice(None) if edges is None else edges)
            chosen = argument_checks.once(f"{where}: edges", np.array(chosen) % batch.edges)
            each = argument_checks.broadcast(f"{where}: magnetisation", vector, (len(chosen), 3))
            if not batch.twist and self.dimension == 3 and each[:, :2].any():
                raise SceneError(
                    f"{where} has no twist, and so no directors; give the component along its tangent alone"
                )
            if self.dimension == 2 and (each[:, 0].any() or (not batch.bend and each[:, 1].any())):
                raise SceneError(
                    f"{where} is magnetised across the plane, or has no bending and so no directors; give 0 along these directors"
                )
            if not np.all(np.asarray(batch.section.area) > 0.0):
                raise SceneError(f"{where}: its section has no area; give Stiffness(..., area=...) [m^2]")
            added.append(Magnet(batch_rods, chosen, each))
        self.magnets += added

    def magnetic_field(
        self,
        value: Vector | Callable[[float], Vector],
        gradient: Numbers | Callable[[float], Numbers] | None = None,
        origin: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        """Apply the magnetic field B = value + gradient (x - origin) to magnetised rods.

        The energy of an edge is -V M . B at its midpoint. The field is evaluated at the end of a step of implicit Euler, or the middle
        of a step of the midpoint rule. In statics constants grow with the load parameter, which is the time of functions. All worlds
        have the same field; magnetisations may differ (`Model.set_parameter`).

        Args:
            value: B at the origin (3,) [T], or a function of time [s] that returns it.
            gradient: dB_i/dx_j (3, 3) [T/m], or a function of time; zero by default. Symmetric (no curl), with zero trace (no
                divergence).
            origin: (3,) [m].

        Raises:
            SceneError: no such field, or a second one.
        """
        if self.applied_field is not None:
            raise SceneError("magnetic_field: the scene has a field; give one that is the sum of both")
        origin = np.array(argument_checks.vector("magnetic_field: origin", origin))
        value = value if callable(value) else np.array(argument_checks.vector("magnetic_field: value", value))
        if not callable(gradient):
            gradient = np.zeros((3, 3)) if gradient is None else gradient
            gradient = argument_checks.broadcast("magnetic_field: gradient", gradient, (3, 3), own=2)
        value, gradient = Field("the magnetic field", value, 3), Field("the magnetic field's gradient", gradient, 3)
        applied = MagneticField(value, gradient, origin, self.dimension == 2)
        applied.at(0.0, 1.0, SceneError)
        self.applied_field = applied

    def add_dipoles(self, rods: Selection | None = None, cutoff: float | None = None) -> None:
        """Add dipole-dipole interaction of magnetised edges, as point dipoles at their midpoints.

        All pairs with midpoints within `cutoff` at rest are listed once, except edges with a common node: n edges have n^2 / 2 pairs
        without a cutoff. The attraction of close edges is unbounded.

        Args:
            rods: magnetised rods; by default all magnetised rods.
            cutoff: [m]; none by default.
        """
        rods = None if rods is None else argument_checks.once("add_dipoles: rods", self._rods(rods))
        cutoff = np.inf if cutoff is None else argument_checks.positive("add_dipoles: cutoff", cutoff, "m")
        self.dipoles.append(Dipoles(rods, cutoff))
