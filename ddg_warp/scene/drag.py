"""Drag laws of rods and coefficients per length: see `kernels.forces.drag` for the theory. NumPy only."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log, pi
from typing import ClassVar

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.scene.flow import flow_at
from ddg_warp.typing import Floats, Integers, Numbers

# c_t and c_n of `Viscous`
THEORIES = {
    "cox": (log(2.0) - 1.5, log(2.0) - 0.5),
    "gray_hancock": (log(2.0) - 0.5, log(2.0) - 0.5),
    "lighthill": (log(0.18), log(0.18) + 0.5),
}


@dataclass(frozen=True, eq=False)
class Resistance:
    """Drag proportional to velocity, with coefficients as numbers, or arrays along rods (see `along_edges`).

    Attributes:
        tangential, normal: force per length over velocity along and across the rod [N s/m^2].
        rotational: moment per length over the angular velocity about the tangent [N s].
    """

    tangential: float | np.ndarray
    normal: float | np.ndarray
    rotational: float | np.ndarray = 0.0

    def __post_init__(self):
        for name in ("tangential", "normal", "rotational"):
            unit = "N s" if name == "rotational" else "N s/m^2"
            object.__setattr__(self, name, _numbers(f"drag: {name}", getattr(self, name), unit))

    def spread(self, along: Callable[[str, Floats], Floats]) -> "Resistance":
        """Return the law with values on edges, `along(name, values)` of the values along rods."""
        names = "tangential", "normal", "rotational"
        return replace(self, **{name: along(name, getattr(self, name)) for name in names})

    def coefficients(self, where: str, radius: Floats, length: Floats) -> list[float | Floats]:
        """Return rows of `kernels.forces.drag` for edges of radii (R, edges) of rods of lengths (R, 1)."""
        return [self.tangential, self.normal, self.rotational, 0.0, 0.0, 0.0, 0.0, 0.0]


@argument_checks.called
@dataclass(frozen=True, eq=False)
class Viscous:
    """Drag of a viscous fluid on a slender rod, neglecting inertia of the fluid, walls and neighbours.

    With the radius a of the section and a length S,

        zeta_t = 2 pi mu / (ln(S / a) + c_t) ,  zeta_n = 4 pi mu / (ln(S / a) + c_n) ,  zeta_r = 4 pi mu a^2 :

    "cox": S the length of the rod, c_t = ln 2 - 3/2, c_n = ln 2 - 1/2, of a straight cylinder (Cox, J. Fluid Mech. 44, 1970, 791);
    "gray_hancock": S the wave length, c_t = ln 2 - 1/2, and zeta_n = 2 zeta_t (Gray and Hancock, J. Exp. Biol. 32, 1955, 802);
    "lighthill": S the length of the rod within a wave, c_t = ln 0.18, c_n = ln 0.18 + 1/2 (Lighthill, SIAM Review 18, 1976, 161).

    Attributes:
        viscosity: mu [Pa s].
        theory: "cox", "gray_hancock" or "lighthill".
        scale: S [m]; with "cox" the length of the rod by default.
        radius: a [m], by default of the section: a number, or an array along rods (see `along_edges`).
    """

    viscosity: float
    theory: str = "cox"
    scale: float | None = None
    radius: Numbers | None = None

    def __post_init__(self):
        argument_checks.positive("Viscous: viscosity", self.viscosity, "Pa s")
        if self.radius is not None:
            object.__setattr__(self, "radius", _numbers("Viscous: radius", self.radius, "m", "positive", np.greater))
        argument_checks.choice("Viscous: theory", self.theory, tuple(THEORIES))
        if self.scale is not None:
            argument_checks.positive("Viscous: scale", self.scale, "m")
        elif self.theory != "cox":
            raise SceneError(f"Viscous: theory {self.theory!r} needs a scale [m], the length of a wave")

    def spread(self, along: Callable[[str, Floats], Floats]) -> "Viscous":
        """Return the law with values on edges, `along(name, values)` of the values along rods."""
        return self if self.radius is None else replace(self, radius=along("radius", self.radius))

    def coefficients(self, where: str, radius: Floats, length: Floats) -> list[float | Floats]:
        """Return rows of `kernels.forces.drag` for edges of radii (R, edges) of rods of lengths (R, 1).

        Raises:
            SceneError: the rod is too thick for the theory.
        """
        radius = radius if self.radius is None else self.radius
        if not np.min(radius) > 0.0:
            raise SceneError(
                f"{where}: its section has no radius, which Viscous drag goes by; give Stiffness(radius=...), "
                "Viscous(..., radius=...), or drag(tangential=..., normal=...)"
            )
        along, across = (np.log((self.scale or length) / radius) + c for c in THEORIES[self.theory])
        if np.min(along) <= 0.0:
            raise SceneError(
                f"{where}: radius {np.max(radius):g} m is too large for the slender-body theory {self.theory!r}; "
                "give drag(tangential=..., normal=...)"
            )
        return [
            2.0 * pi * self.viscosity / along,
            4.0 * pi * self.viscosity / across,
            4.0 * pi * self.viscosity * radius**2,
            *(0.0, 0.0, 0.0, 0.0, 0.0),
        ]


@argument_checks.called
@dataclass(frozen=True, eq=False)
class QuadraticDrag:
    """Drag of a fluid at large Reynolds numbers, such as wind on rods and shells (Taylor 1952); see `kernels.forces.drag`.

    The velocities v_n across and v_t along act each by themselves, with the density rho of the fluid:

        rods, per length:  rho / 2 C_n d |v_n| v_n  across, with the diameter d,  rho / 2 C_t pi d |v_t| v_t  along;
        shells, per area:  rho / 2 C_n |v_n| v_n  along the normal,  rho / 2 2 C_t |v_t| v_t  along the surface, on both sides.

    Attributes:
        density: rho [kg/m^3], of air 1.2.
        normal: C_n: 1.1 to 1.2 of cylinders and square plates, 2 of long plates.
        tangential: C_t, of skin friction on one side.
        radius: d / 2 [m] of rods, by default of the section: a number, or an array along rods (see `along_edges`).
    """

    density: float
    normal: float = 1.2
    tangential: float = 0.01
    radius: Numbers | None = None

    def __post_init__(self):
        argument_checks.positive("QuadraticDrag: density", self.density, "kg/m^3")
        for name in ("normal", "tangential"):
            _not_negative(f"QuadraticDrag: {name}", getattr(self, name), "1")
        if self.radius is not None:
            radius = _numbers("QuadraticDrag: radius", self.radius, "m", "positive", np.greater)
            object.__setattr__(self, "radius", radius)

    def spread(self, along: Callable[[str, Floats], Floats]) -> "QuadraticDrag":
        """Return the law with values on edges, `along(name, values)` of the values along rods."""
        return self if self.radius is None else replace(self, radius=along("radius", self.radius))

    def coefficients(self, where: str, radius: Floats, length: Floats) -> list[float | Floats]:
        """Return rows of `kernels.forces.drag` for edges of radii (R, edges) of rods of lengths (R, 1)."""
        from ddg_warp.kernels.forces.drag import SQUARE

        radius = radius if self.radius is None else self.radius
        if not np.min(radius) > 0.0:
            raise SceneError(
                f"{where}: its section has no radius, which QuadraticDrag goes by; give Stiffness(radius=...), or "
                "QuadraticDrag(..., radius=...)"
            )
        rows = pi * self.density * self.tangential * radius, self.density * self.normal * radius
        return [*rows, 0.0, 0.0, 0.0, 0.0, 0.0, SQUARE]

    @property
    def of_area(self) -> tuple[float, float]:
        """Coefficients of triangles along the normal and along the surface [kg/m^3]."""
        return 0.5 * self.density * self.normal, self.density * self.tangential


@argument_checks.called
@dataclass(frozen=True)
class Granular:
    """Drag of a granular medium, a function of the direction of velocity only: see `kernels.forces.drag` (Maladen et al. 2009).

    With the angle psi between velocity and rod, forces per length are C_S sin(beta) across and C_F cos(psi) + C_L (1 - sin(beta))
    along it, tan(beta) = sin(psi) / tan(gamma). The velocity is time-lagged, with a first-order error: drag is too large in the
    first step of a rod that starts abruptly.

    Attributes:
        lateral, friction, leading: C_S, C_F, C_L [N/m]; C_L may be negative, though not below -C_F.
        angle: gamma [rad], between 0 and pi / 2.
        speed: v0 [m/s], below which forces are proportional to velocity: small against velocities of interest.
    """

    lateral: float
    friction: float
    leading: float = 0.0
    angle: float = 0.2416  # 13.84 degrees
    speed: float = 1e-3

    def spread(self, along: Callable[[str, Floats], Floats]) -> "Granular":
        """Return the law itself, without values along rods."""
        return self

    def __post_init__(self):
        _not_negative("Granular: lateral", self.lateral, "N/m")
        friction = _not_negative("Granular: friction", self.friction, "N/m")
        rule = f"a number of at least -friction, {-friction:g} N/m"
        argument_checks.number("Granular: leading", self.leading, rule, lambda v: v >= -friction)
        argument_checks.number(
            "Granular: angle", self.angle, "an angle between 0 and pi / 2", lambda v: 0.0 < v < 0.5 * pi
        )
        argument_checks.positive("Granular: speed", self.speed, "m/s")

    def coefficients(self, where: str, radius: Floats, length: Floats) -> list[float | Floats]:
        """Return rows of `kernels.forces.drag` for edges of radii (R, edges) of rods of lengths (R, 1)."""
        return [0.0, 0.0, 0.0, self.lateral, self.friction, self.leading, np.tan(self.angle), self.speed]


def _not_negative(label: str, value, unit: str) -> float:
    return argument_checks.number(label, value, f"one number that is not negative [{unit}]", lambda v: v >= 0.0)


def _numbers(label: str, values, unit: str, rule: str = "not negative", holds=np.greater_equal) -> float | np.ndarray:
    """Return a number, or numbers along rods (n,) or (rods, n), compared with zero by `holds`; or refuse them, naming `label`."""
    numbers = argument_checks.floats(values) if not isinstance(values, bool) else np.array(np.nan)
    if numbers.ndim > 2 or not numbers.size or not (np.isfinite(numbers).all() and holds(numbers, 0.0).all()):
        raise SceneError(
            f"{label} is {argument_checks.shown(values)}; give a number, or numbers along the rod, finite and {rule} [{unit}]"
        )
    argument_checks.sized(label, numbers)
    return numbers.copy() if numbers.ndim else float(numbers)


def along_edges(label: str, values, rods: int, batch) -> np.ndarray:
    """Return values on edges, broadcastable to (rods, edges), from values along rods of a batch.

    Args:
        label: name of the values in messages.
        values: a number; or (n,) or (rods, n) with n the number of edges, or of nodes of open rods with linear interpolation.
        rods: number of rods.
        batch: `RodBatch` of the rods.

    Raises:
        SceneError: the shape does not fit.
    """
    values, ends = np.atleast_2d(values), not batch.closed and batch.nodes
    if values.shape[0] in (1, rods) and values.shape[1] in (1, batch.edges, ends):
        return 0.5 * (values[:, :-1] + values[:, 1:]) if values.shape[1] == ends else values
    raise SceneError(
        _misfit(label, values, rods, batch, f"{batch.edges} edges" + f" or {batch.nodes} nodes" * bool(ends))
    )


def at_nodes(values, rods: int, batch) -> np.ndarray:
    """Return drag of bodies at nodes of rods of a batch, broadcastable to (rods, nodes); see `along_edges`."""
    values = np.atleast_2d(values)
    if values.shape[0] in (1, rods) and values.shape[1] in (1, batch.nodes):
        return values
    raise SceneError(_misfit("nodes", values, rods, batch, f"{batch.nodes} nodes"))


def _misfit(label: str, values: np.ndarray, rods: int, batch, sizes: str) -> str:
    shape = values.shape[1:] if len(values) == 1 else values.shape
    return (
        f"drag: {label} has shape {shape}, and rods '{batch.name}' have {sizes}; give one number, one for each of these, or such a row "
        f"for each of the {rods} rods"
    )


@dataclass(frozen=True)
class RodDrag:
    """Drag of some rods: law, and force over velocity of bodies at nodes [N s/m]."""

    rods: np.ndarray
    law: Resistance | Viscous | QuadraticDrag | Granular
    nodes: float | np.ndarray

    def of(self, rows: np.ndarray, batch) -> "RodDrag":
        """Return the drag of the rods at `rows`, all of one batch, with values by edge and node."""

        def chosen(values: np.ndarray) -> np.ndarray:
            return values[rows] if len(values) > 1 else values

        count = len(self.rods)
        law = self.law.spread(lambda name, values: chosen(along_edges(name, values, count, batch)))
        return RodDrag(self.rods[rows], law, chosen(at_nodes(self.nodes, count, batch)))


def rod_drag(batches, rods: np.ndarray, law, tangential, normal, rotational, nodes) -> RodDrag:
    """Return the checked `RodDrag` of a call of `Scene.drag`; arguments as there."""
    bodies = 0.0 if nodes is None else _numbers("drag: nodes", nodes, "N s/m")
    has_coefficients = tangential is not None or normal is not None or np.any(rotational)
    if law is None:
        bare = nodes is not None and not has_coefficients  # bodies alone
        law = Resistance(0.0, 0.0) if bare else Resistance(tangential, normal, rotational)
    elif not isinstance(law, Resistance | Viscous | QuadraticDrag | Granular):
        raise SceneError(
            f"drag: law is {law!r}; give Viscous(viscosity), QuadraticDrag(density), Granular(...), or tangential and normal"
        )
    elif has_coefficients:
        raise SceneError("drag: a law and coefficients are given; give one of them")
    elif isinstance(law, QuadraticDrag) and np.any(bodies):
        raise SceneError("drag: nodes is force over velocity, and QuadraticDrag is not; leave nodes out")
    result = RodDrag(rods, law, bodies)
    for batch in batches:
        rows = np.flatnonzero((rods >= batch.first) & (rods < batch.first + batch.rods))
        if rows.size:
            result.of(rows, batch)  # refuses shapes that do not fit
    return result


class Laws:
    """Drag laws of all rods of a scene.

    Attributes:
        given: the laws; of_rods: index of the law of every rod in `given` (R,), -1 without a law.
        radius_powers: powers of the section radius a that `Viscous` takes, for small changes, by name of the coefficient.
        slender: coefficients k mu / (ln(S / a) + constant), whose inverses are linear in ln a.

    Raises:
        SceneError: a rod has two.
    """

    name = "drag"
    radius_powers: ClassVar[dict[str, int]] = {"tangential": 1, "normal": 1, "rotational": 2}
    slender = ("tangential", "normal")

    def __init__(self, scene):
        self._drags, self.of_rods = scene.drags, np.full(scene.rod_count, -1)
        self.given, self._row = [drag.law for drag in scene.drags], np.zeros(scene.rod_count, int)
        for index, drag in enumerate(scene.drags):
            twice = drag.rods[self.of_rods[drag.rods] >= 0]
            if twice.size:
                raise SceneError(f"drag: rod {twice[0]} has drag already; give it one law")
            self.of_rods[drag.rods] = index
            self._row[drag.rods] = np.arange(len(drag.rods))

    def coefficients(self, rods: np.ndarray, batch, radius: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Return rows of `kernels.forces.drag` (R, edges, rows) of rods (R,) of a batch with drag; zero on ghost edges (length 0)."""
        from ddg_warp.kernels.forces.drag import FIRST, LAST, ROWS

        result, laws = np.zeros((*lengths.shape, ROWS)), self.of_rods[rods]
        real = lengths[0] > 0.0
        radius = np.broadcast_to(radius, lengths.shape)[:, real]
        for index in np.unique(laws):
            chosen = laws == index
            rows = np.zeros((chosen.sum(), batch.edges, ROWS))
            length = lengths[chosen].sum(1, keepdims=True)
            drag = self._drags[index].of(self._row[rods[chosen]], batch)
            for i, values in enumerate(drag.law.coefficients(f"drag: rods '{batch.name}'", radius[chosen], length)):
                rows[..., i] = values
            bodies = np.broadcast_to(drag.nodes, (len(rows), batch.nodes))
            rows[..., FIRST] = bodies[:, : batch.edges]
            if not batch.closed:
                rows[:, -1, LAST] = bodies[:, -1]
            result[np.ix_(chosen, real)] = rows
        return result

    def radius_sensitivity(self, name: str, rods: list[int]) -> np.ndarray:
        """Return the sensitivity of a coefficient to ln a, of rods; 0 if the radius of the law is given.

        Slender: -d(1 / zeta) / d(ln a) [m^2 / N s]. Others, proportional to a power of a: 1.
        """
        k = {"tangential": 2.0 * pi, "normal": 4.0 * pi}.get(name)
        laws_of_rods = [self.given[self.of_rods[rod]] for rod in rods]
        sized = (law for law in laws_of_rods if isinstance(law, Viscous) and law.radius is None)
        sensitivity = {law: 1.0 if k is None else 1.0 / (k * law.viscosity) for law in sized}
        return np.array([sensitivity.get(law, 0.0) for law in laws_of_rods])

    @staticmethod
    def check(scene) -> None:
        """Refuse an invalid flow at t = 0, a flow without objects with drag, or laws of two kinds."""
        if not scene.drags and not scene.shell_drags and (callable(scene.flow) or np.any(scene.flow)):
            raise SceneError("flow is given, and nothing feels it; call drag(...), or leave flow out")
        points = [
            np.zeros((0, 3)),
            *(p for batch in scene.batches for p in batch.points[:1]),
            *(s.points for s in scene.shells),
        ]
        flow_at(scene.flow, 0.0, scene.dimension, np.concatenate(points), SceneError)
        shells = [drag.shell for drag in scene.shell_drags]
        for shell in shells:
            if shells.count(shell) > 1:
                raise SceneError(
                    f"drag: shell {shell} ('{scene.shells[shell].name}') has drag already; give it one law"
                )
        kinds = {isinstance(drag.law, QuadraticDrag) for drag in (*scene.drags, *scene.shell_drags)}
        if len(kinds) > 1:
            raise SceneError(
                "drag: some laws are QuadraticDrag, and some are not; a scene has one fluid, give laws of one kind"
            )

    @staticmethod
    def holds(coefficients: np.ndarray) -> np.ndarray:
        """Return masks of first and last nodes of edges (2, ...) with drag in all directions, by coefficients (rows, ...)."""
        tangential, normal, _, lateral, friction, _, _, speed, first, last = coefficients
        along = (tangential + friction > 0.0) & (normal + lateral > 0.0) & (speed >= 0.0)
        return np.stack([along | (first > 0.0), along | (last > 0.0)])

    @staticmethod
    def least(coefficients: np.ndarray) -> np.ndarray:
        """Return the smallest drag per length and velocity [N s/m^2] of rods (R,) by coefficients (R, edges, rows).

        0 if granular or quadratic.
        """
        return np.where((coefficients[..., 7] < 0.0).any(1), 0.0, coefficients[..., :2].mean(1).min(1))


def is_square(scene) -> bool:
    """Return True if the drag of a scene is quadratic; all its laws are of one kind."""
    return any(isinstance(drag.law, QuadraticDrag) for drag in (*scene.drags, *scene.shell_drags))


@dataclass(frozen=True)
class ShellDrag:
    """Drag of a shell: law, and coefficients of triangles (2, triangles) along the normal and along the surface.

    Coefficients are of linear drag [N s/m^3], or of quadratic drag [kg/m^3]; both sides are included.
    """

    shell: int
    law: Resistance | QuadraticDrag
    coefficients: np.ndarray


def shell_drag(shells, chosen: Integers, law, tangential, normal, rotational, nodes) -> list[ShellDrag]:
    """Return the checked drags of shells by index in a call of `Scene.drag`; arguments as there."""
    if nodes is not None or np.any(rotational):
        raise SceneError("drag: nodes and rotational are of rods; leave them out for shells")
    if law is None:
        law = Resistance(tangential, normal)
    elif not isinstance(law, QuadraticDrag):
        raise SceneError(f"drag: law of shells is {law!r}; give QuadraticDrag(density), or tangential and normal")
    elif tangential is not None or normal is not None:
        raise SceneError("drag: a law and coefficients are given; give one of them")
    result = []
    for index in chosen:
        count = len(shells[index].triangles)
        values = law.of_area if isinstance(law, QuadraticDrag) else (law.normal, law.tangential)
        for name, each in zip(("normal", "tangential"), values, strict=True):
            if np.shape(each) not in ((), (count,)):
                raise SceneError(
                    f"drag: {name} has shape {np.shape(each)}, and shell '{shells[index].name}' has {count} triangles; give one "
                    "number, or one for each"
                )
        result.append(ShellDrag(index, law, np.stack([np.broadcast_to(each, count) for each in values])))
    return result
