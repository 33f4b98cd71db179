"""Paths of equilibria: what a continuation leaves behind, and what it may be told to watch."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError

REGULAR, LIMIT_POINT, BIFURCATION = "regular", "limit point", "bifurcation"


@arguments.called
@dataclass(frozen=True)
class Displacement:
    """A displacement from rest [m]: that of a point along an axis, or a weighted sum of several.

    Attributes:
        terms: (row of `State.points`, axis "x", "y" or "z", weight) each.
    """

    terms: tuple[tuple[int, str, float], ...]

    def __post_init__(self):
        terms = self.terms if isinstance(self.terms, tuple | list) else [self.terms]
        if not terms:
            raise SceneError(
                "Displacement: there are no terms; give (row of the points, axis, weight) each, one at least"
            )
        for term in terms:
            if not isinstance(term, tuple | list) or len(term) != 3:
                raise SceneError(
                    f"Displacement: {arguments.shown(term)} is no term; give (row of the points, axis, weight) each"
                )
            arguments.index("Displacement: point", term[0])
            arguments.choice("Displacement: axis", term[1], ("x", "y", "z"))
            arguments.number("Displacement: weight", term[2])

    @classmethod
    def of(cls, row: int, axis: str, weight: float = 1.0) -> "Displacement":
        """Of one point; with weight -1 along the axis backwards."""
        return cls(((row, axis, weight),))

    def vector(self, tangent) -> np.ndarray:
        """Its derivative with respect to all dofs (size,).

        Raises:
            SceneError: there is no such point or axis.
        """
        dofs, result = tangent.point_dofs(), np.zeros(tangent.size)
        for row, axis, weight in self.terms:
            if not -len(dofs) <= row < len(dofs) or axis not in ("x", "y", "z"):
                raise SceneError(
                    f"displacement of point {row} along {axis!r}: there are {len(dofs)} points, axes x, y and z"
                )
            dof = dofs[row, "xyz".index(axis)]
            if dof < 0:
                raise SceneError(f"displacement of point {row} along {axis!r}: the scene is planar")
            result[dof] += weight
        return tangent.into(result)


@dataclass(eq=False)
class Point:
    """An equilibrium of a path.

    Attributes:
        state: the equilibrium; its time is the load parameter.
        load: load parameter.
        arclength: along the path from its start, in the metric of the continuation.
        values: watched displacements by name [m].
        negative: number of negative eigenvalues of the tangent stiffness: 0 where the equilibrium is stable. At
            a limit point or bifurcation without the one that vanishes.
        kind: "regular", "limit point" (the load is stationary) or "bifurcation" (another path crosses).
        direction: unit tangent of the path: dofs (size,) and load parameter at the end.
        mode: of a bifurcation, the critical eigenvector (size,) of unit length in the metric; None elsewhere.
        iterations: Newton iterations it took.
        mode_displacements: the mode by node (P, 3), in the order of `State.points`; None where there is none.
    """

    state: Any
    load: float
    arclength: float
    values: dict[str, float]
    negative: int
    kind: str
    direction: np.ndarray
    mode: np.ndarray | None = None
    iterations: int = 0
    mode_displacements: np.ndarray | None = None

    @property
    def stable(self) -> bool:
        """Whether the second variation of the potential is positive."""
        return self.negative == 0


@dataclass(eq=False)
class Path:
    """Equilibria in the order in which the path runs through them.

    Attributes:
        points: see `Point`.
        outcome: why the path ends: "load", "displacement", "limit_points", "steps" or "values".
    """

    points: list[Point] = field(default_factory=list)
    outcome: str = ""

    def __len__(self) -> int:
        return len(self.points)

    @property
    def load(self) -> np.ndarray:
        """Load parameters (points,)."""
        return np.array([point.load for point in self.points])

    @property
    def negative(self) -> np.ndarray:
        """Numbers of negative eigenvalues (points,)."""
        return np.array([point.negative for point in self.points])

    @property
    def stable(self) -> np.ndarray:
        """Whether each point is stable (points,) bool."""
        return self.negative == 0

    @property
    def kinds(self) -> list[str]:
        """Kind of each point: "regular", "limit point" or "bifurcation"."""
        return [point.kind for point in self.points]

    @property
    def arclength(self) -> np.ndarray:
        """Arc lengths (points,)."""
        return np.array([point.arclength for point in self.points])

    def values(self, name: str) -> np.ndarray:
        """A watched displacement (points,) [m]; their names are the keys of `points[0].values`."""
        return np.array([point.values[name] for point in self.points])

    def of_kind(self, kind: str) -> list[Point]:
        """The points of a kind: "regular", "limit point" or "bifurcation"."""
        return [point for point in self.points if point.kind == kind]

    @property
    def limit_points(self) -> list[Point]:
        """Where the load is stationary."""
        return self.of_kind(LIMIT_POINT)

    @property
    def bifurcations(self) -> list[Point]:
        """Where another path crosses."""
        return self.of_kind(BIFURCATION)


@arguments.called
@dataclass(frozen=True)
class Stop:
    """Where a path ends; what comes first counts, and the last point lies exactly on a bound that it met.

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
        arguments.count("Stop: steps", self.steps)
        if self.limit_points is not None:
            arguments.count("Stop: limit_points", self.limit_points)
        bounds = {"load": self.load}
        if self.displacement is not None:
            given = self.displacement
            if not (isinstance(given, tuple | list) and len(given) == 3 and isinstance(given[0], str)):
                shown = arguments.shown(given)
                raise SceneError(
                    f"Stop: displacement is {shown}; give (name of what is watched, lowest, highest value)"
                )
            bounds["displacement"] = given[1:]
        for name, bound in bounds.items():
            found = arguments.floats(bound)
            if found.shape != (2,) or not found[0] < found[1]:
                shown = arguments.shown(getattr(self, name))
                raise SceneError(f"Stop: {name} is {shown}; its lowest value comes before a higher one")
