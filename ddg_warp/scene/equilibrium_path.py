"""Equilibrium paths of a continuation, with watched displacements and termination criteria."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.typing import Axis, Bools, Floats, Integers

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ddg_warp.model.state import State
    from ddg_warp.solve.equilibrium.tangent import Tangent

REGULAR, LIMIT_POINT, BIFURCATION = "regular", "limit point", "bifurcation"
MARKERS = {LIMIT_POINT: "o", BIFURCATION: "s"}  # of `Path.plot`


@argument_checks.called
@dataclass(frozen=True)
class Displacement:
    """Displacement from rest [m] of a point along an axis, or a weighted sum of several.

    Attributes:
        terms: (point, axis "x", "y" or "z", weight) of each term. A point is (rod, node), (shell, vertex), or a row of
            `State.points`; rods by index, handle or name, shells by handle or name.
    """

    terms: tuple[tuple[int | tuple[int | str, int], Axis, float], ...]

    def __post_init__(self):
        terms = self.terms if isinstance(self.terms, tuple | list) else [self.terms]
        if not terms:
            raise SceneError("Displacement: there are no terms; give (point, axis, weight) each, one at least")
        for term in terms:
            if not isinstance(term, tuple | list) or len(term) != 3:
                raise SceneError(
                    f"Displacement: {argument_checks.shown(term)} is no term; give (point, axis, weight) each"
                )
            if is_node(term[0]):
                argument_checks.index("Displacement: node", term[0][1])
            else:
                argument_checks.index("Displacement: point", term[0])
            argument_checks.choice("Displacement: axis", term[1], ("x", "y", "z"))
            argument_checks.number("Displacement: weight", term[2])

    @classmethod
    def of(cls, point: int | tuple[int | str, int], axis: Axis, weight: float = 1.0) -> "Displacement":
        """Return the displacement of one point, (rod, node) or a row of `State.points`; weight -1 reverses the axis."""
        return cls(((point, axis, weight),))

    def vector(self, tangent: "Tangent") -> Floats:
        """Return the derivative with respect to all dofs (size,).

        Raises:
            SceneError: an unknown point or axis.
        """
        dofs, result = tangent.point_dofs(), np.zeros(tangent.size)
        for point, axis, weight in self.terms:
            row = tangent.model.order.row(point) if is_node(point) else point
            if not -len(dofs) <= row < len(dofs) or axis not in ("x", "y", "z"):
                raise SceneError(
                    f"displacement of point {row} along {axis!r}: there are {len(dofs)} points, axes x, y and z"
                )
            dof = dofs[row, "xyz".index(axis)]
            if dof < 0:
                raise SceneError(f"displacement of point {row} along {axis!r}: the scene is planar")
            result[dof] += weight
        return tangent.into(result)


def is_node(value) -> bool:
    """Return True for (rod, node) or (shell, vertex)."""
    return isinstance(value, tuple | list) and len(value) == 2 and not np.iterable(value[1])


def watched_displacements(call: str, watch, planar: bool) -> dict[str, Displacement]:
    """Return displacements by name; (rod, node) under a name "d" becomes "d.x", "d.y" and "d.z".

    Raises:
        SceneError: no mapping of names to displacements or nodes.
    """
    if not isinstance(watch, Mapping):
        raise SceneError(f"{call}: watch is {argument_checks.shown(watch)}; give displacements by name")
    result = {}
    for name, value in watch.items():
        argument_checks.text(f"{call}: a name in watch", name)
        if is_node(value):
            result |= {f"{name}.{axis}": Displacement.of(value, axis) for axis in ("xz" if planar else "xyz")}
        elif isinstance(value, Displacement):
            result[name] = value
        else:
            shown = argument_checks.shown(value)
            raise SceneError(
                f"{call}: watch[{name!r}] is {shown}; give (rod, node) or Displacement.of((rod, node), axis)"
            )
    return result


@dataclass(eq=False, repr=False)
class Point:
    """Equilibrium of a path.

    Attributes:
        state: the equilibrium, with the load parameter as time.
        load: load parameter.
        arclength: arc length from the start, in the metric of the continuation.
        values: watched displacements by name [m].
        negative: number of negative eigenvalues of the tangent stiffness (inertia count): 0 for stable equilibria. The zero
            eigenvalue of a limit point or bifurcation is not counted.
        kind: "regular", "limit point" (the load is stationary) or "bifurcation" (another path crosses).
        direction: unit tangent of the path: dofs (size,) and load parameter at the end.
        mode: critical eigenvector of a bifurcation (size,), of unit length in the metric; else None.
        iterations: number of Newton iterations.
        mode_displacements: the mode by node (P, 3), in the order of `State.points`; None without a mode.
    """

    state: "State"
    load: float
    arclength: float
    values: dict[str, float]
    negative: int
    kind: str
    direction: Floats
    mode: Floats | None = None
    iterations: int = 0
    mode_displacements: Floats | None = None

    def __repr__(self) -> str:
        watched = "".join(f", {name} {value:.6g} m" for name, value in self.values.items())
        stability = "stable" if self.stable else f"{self.negative} negative eigenvalues"
        return f"<{self.kind.capitalize()} at load {self.load:.6g}{watched}, {stability}>"

    @property
    def stable(self) -> bool:
        """True if the second variation of the potential is positive."""
        return self.negative == 0


@dataclass(eq=False, repr=False)
class Path:
    """Equilibria in order along a path.

    Attributes:
        points: see `Point`.
        outcome: why the path ends: "load", "displacement", "limit_points", "steps" or "values".
    """

    points: list[Point] = field(default_factory=list)
    outcome: str = ""

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        between = f" from load {self.points[0].load:.6g} to {self.points[-1].load:.6g}" if self.points else ""
        return f"<Path of {len(self)} equilibria{between}; ended by {self.outcome or 'nothing yet'}>"

    @property
    def load(self) -> Floats:
        """Load parameters (points,)."""
        return np.array([point.load for point in self.points])

    @property
    def negative(self) -> Integers:
        """Numbers of negative eigenvalues (points,)."""
        return np.array([point.negative for point in self.points])

    @property
    def stable(self) -> Bools:
        """Stability of each point (points,) bool."""
        return self.negative == 0

    @property
    def kinds(self) -> list[str]:
        """Kind of each point: "regular", "limit point" or "bifurcation"."""
        return [point.kind for point in self.points]

    @property
    def arclength(self) -> Floats:
        """Arc lengths (points,)."""
        return np.array([point.arclength for point in self.points])

    def values(self, name: str) -> Floats:
        """Return a watched displacement (points,) [m]; names are the keys of `points[0].values`."""
        return np.array([point.values[name] for point in self.points])

    def plot(self, name: str, axes: "Axes | None" = None) -> "Axes":
        """Draw the load parameter over a watched displacement; return the axes of matplotlib.

        Lines are full where equilibria are stable, else broken. Limit points and bifurcations are marked.

        Args:
            name: watched displacement.
            axes: axes to draw into, for paths of several branches; by default a new figure.
        """
        import matplotlib.pyplot as plt

        axes = plt.figure().add_subplot(xlabel=f"{name} [m]", ylabel="load parameter") if axes is None else axes
        values, load = self.values(name), self.load
        (line,) = axes.plot(values, load, "--", linewidth=1.0)
        axes.plot(np.where(self.stable, values, np.nan), load, color=line.get_color(), linewidth=2.0)
        for kind, marker in MARKERS.items():
            marked = self.of_kind(kind)
            axes.plot([point.values[name] for point in marked], [point.load for point in marked], marker, color="k")
        return axes

    def of_kind(self, kind: str) -> list[Point]:
        """Return the points of a kind: "regular", "limit point" or "bifurcation"."""
        return [point for point in self.points if point.kind == kind]

    @property
    def limit_points(self) -> list[Point]:
        """Points with stationary load."""
        return self.of_kind(LIMIT_POINT)

    @property
    def bifurcations(self) -> list[Point]:
        """Points with a crossing path."""
        return self.of_kind(BIFURCATION)


@argument_checks.called
@dataclass(frozen=True)
class StopCriterion:
    """Termination criteria of a path; the first met counts, and the last point lies exactly on that bound.

    Attributes:
        steps: accepted steps.
        load: (lowest, highest) load parameter.
        displacement: (name of a watched displacement, lowest, highest value [m]).
        limit_points: number of limit points passed.
    """

    steps: int = 200
    load: tuple[float, float] = (-np.inf, np.inf)
    displacement: tuple[str, float, float] | None = None
    limit_points: int | None = None

    def __post_init__(self):
        argument_checks.count("StopCriterion: steps", self.steps)
        if self.limit_points is not None:
            argument_checks.count("StopCriterion: limit_points", self.limit_points)
        bounds = {"load": self.load}
        if self.displacement is not None:
            entry = self.displacement
            if not (isinstance(entry, tuple | list) and len(entry) == 3 and isinstance(entry[0], str)):
                shown = argument_checks.shown(entry)
                raise SceneError(
                    f"StopCriterion: displacement is {shown}; give (name of a watched displacement, lowest, highest value)"
                )
            bounds["displacement"] = entry[1:]
        for name, bound in bounds.items():
            limits = argument_checks.floats(bound)
            if limits.shape != (2,) or not limits[0] < limits[1]:
                shown = argument_checks.shown(getattr(self, name))
                raise SceneError(f"StopCriterion: {name} is {shown}; its lowest value comes before a higher one")
