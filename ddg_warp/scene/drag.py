"""Laws of drag on rods, and the coefficients per length that they give: see `kernels.drag` for the theory. NumPy only."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log, pi

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError, SolverError

# c_t and c_n of `Viscous`
THEORIES = {
    "cox": (log(2.0) - 1.5, log(2.0) - 0.5),
    "gray_hancock": (log(2.0) - 0.5, log(2.0) - 0.5),
    "lighthill": (log(0.18), log(0.18) + 0.5),
}


@dataclass(frozen=True, eq=False)
class Resistance:
    """Drag in proportion to velocity, its coefficients given outright: numbers, or arrays along rods as of `along_edges`.

    Attributes:
        tangential, normal: force per length over velocity along and across the rod [N s/m^2].
        rotational: moment per length over the spin about the tangent [N s].
    """

    tangential: float | np.ndarray
    normal: float | np.ndarray
    rotational: float | np.ndarray = 0.0

    def __post_init__(self):
        for name in ("tangential", "normal", "rotational"):
            unit = "N s" if name == "rotational" else "N s/m^2"
            object.__setattr__(self, name, _numbers(f"drag: {name}", getattr(self, name), unit))

    def spread(self, along: Callable) -> "Resistance":
        """Return this law with values on edges, which `along(name, values)` makes of those along rods."""
        names = "tangential", "normal", "rotational"
        return replace(self, **{name: along(name, getattr(self, name)) for name in names})

    def coefficients(self, where: str, radius: np.ndarray, length: np.ndarray) -> list:
        """Rows of `kernels.drag`, of edges with these radii (R, edges) of rods of these lengths (R, 1)."""
        return [self.tangential, self.normal, self.rotational, 0.0, 0.0, 0.0, 0.0, 0.0]


@arguments.called
@dataclass(frozen=True, eq=False)
class Viscous:
    """Drag of a viscous fluid on a slender rod, without inertia of the fluid, walls and neighbours.

    With the radius a of the section and a length S,

        zeta_t = 2 pi mu / (ln(S / a) + c_t) ,  zeta_n = 4 pi mu / (ln(S / a) + c_n) ,  zeta_r = 4 pi mu a^2 :

    "cox": S the length of the rod, c_t = ln 2 - 3/2, c_n = ln 2 - 1/2, of a straight cylinder (Cox, J. Fluid Mech. 44, 1970, 791);
    "gray_hancock": S the wave length, c_t = ln 2 - 1/2, and zeta_n = 2 zeta_t (Gray and Hancock, J. Exp. Biol. 32, 1955, 802);
    "lighthill": S the length of the rod within a wave, c_t = ln 0.18, c_n = ln 0.18 + 1/2 (Lighthill, SIAM Review 18, 1976, 161).

    Attributes:
        viscosity: mu [Pa s].
        theory: "cox", "gray_hancock" or "lighthill".
        scale: S [m]; of "cox" the length of the rod by default.
        radius: a [m], that of the section by default: a number, or an array along rods as of `along_edges`.
    """

    viscosity: float
    theory: str = "cox"
    scale: float | None = None
    radius: float | np.ndarray | None = None

    def __post_init__(self):
        arguments.positive("Viscous: viscosity", self.viscosity, "Pa s")
        if self.radius is not None:
            object.__setattr__(self, "radius", _numbers("Viscous: radius", self.radius, "m", "positive", np.greater))
        arguments.choice("Viscous: theory", self.theory, tuple(THEORIES))
        if self.scale is not None:
            arguments.positive("Viscous: scale", self.scale, "m")
        elif self.theory != "cox":
            raise SceneError(f"Viscous: theory {self.theory!r} needs a scale [m], the length of a wave")

    def spread(self, along: Callable) -> "Viscous":
        """As of `Resistance`."""
        return self if self.radius is None else replace(self, radius=along("radius", self.radius))

    def coefficients(self, where: str, radius: np.ndarray, length: np.ndarray) -> list:
        """As of `Resistance`.

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


@arguments.called
@dataclass(frozen=True)
class Granular:
    """Drag of a granular medium, by the direction of the velocity and not by its size: see `kernels.drag` (Maladen et al. 2009).

    With the angle psi between velocity and rod, forces per length are C_S sin(beta) across and C_F cos(psi) + C_L (1 - sin(beta))
    along it, tan(beta) = sin(psi) / tan(gamma). A step takes the velocity that its start has, with an error of first order: a rod that
    is set in motion at once is held back too much in its first step.

    Attributes:
        lateral, friction, leading: C_S, C_F, C_L [N/m]; C_L may be negative, though not below -C_F.
        angle: gamma [rad], between 0 and pi / 2.
        speed: v0 [m/s], below which forces go to zero with the velocity: small against velocities of interest.
    """

    lateral: float
    friction: float
    leading: float = 0.0
    angle: float = 0.2416  # 13.84 degrees
    speed: float = 1e-3

    def spread(self, along: Callable) -> "Granular":
        """As of `Resistance`."""
        return self

    def __post_init__(self):
        _not_negative("Granular: lateral", self.lateral, "N/m")
        friction = _not_negative("Granular: friction", self.friction, "N/m")
        rule = f"a number of at least -friction, {-friction:g} N/m"
        arguments.number("Granular: leading", self.leading, rule, lambda v: v >= -friction)
        arguments.number("Granular: angle", self.angle, "an angle between 0 and pi / 2", lambda v: 0.0 < v < 0.5 * pi)
        arguments.positive("Granular: speed", self.speed, "m/s")

    def coefficients(self, where: str, radius: np.ndarray, length: np.ndarray) -> list:
        """As of `Resistance`."""
        return [0.0, 0.0, 0.0, self.lateral, self.friction, self.leading, np.tan(self.angle), self.speed]


def flow_at(scene, t: float, error=SolverError) -> np.ndarray:
    """Velocity (3,) [m/s] of the fluid at t.

    Raises:
        error: it is not finite, or leaves the plane of a planar scene; names the function and the time.
    """
    flow = arguments.value_at("flow", scene.flow, t, 3, error) if callable(scene.flow) else np.array(scene.flow, float)
    if flow.shape != (3,):
        raise error(f"flow has shape {flow.shape} at t = {t:g}; it is uniform, give (3,)")
    if scene.dimension == 2 and flow[1] != 0.0:
        raise error(
            f"flow is {tuple(flow.tolist())} at t = {t:g}; a scene of dimension 2 stays in the plane of x and z, give 0 along y"
        )
    return flow


def check_flow(scene) -> None:
    """Refuse a flow at t = 0 that is none, or that no rod feels."""
    flow_at(scene, 0.0, SceneError)
    if not scene.drags and (callable(scene.flow) or any(scene.flow)):
        raise SceneError("flow is given, and no rod feels it; call drag(...), or leave flow out")


def _not_negative(what: str, value, unit: str) -> float:
    return arguments.number(what, value, f"one number that is not negative [{unit}]", lambda v: v >= 0.0)


def _numbers(what: str, values, unit: str, rule: str = "not negative", holds=np.greater_equal) -> float | np.ndarray:
    """A number, or numbers along rods (n,) or (rods, n), for which a rule holds against zero; or a refusal that names `what`."""
    found = arguments.floats(values) if not isinstance(values, bool) else np.array(np.nan)
    if found.ndim > 2 or not found.size or not (np.isfinite(found).all() and holds(found, 0.0).all()):
        raise SceneError(
            f"{what} is {arguments.shown(values)}; give a number, or numbers along the rod, finite and {rule} [{unit}]"
        )
    arguments.sized(what, found)
    return found.copy() if found.ndim else float(found)


def along_edges(what: str, values, rods: int, batch) -> np.ndarray:
    """Return values on edges, each broadcastable to (rods, edges), of rods of a batch from what is given along them.

    Args:
        what: named by refusals.
        values: a number; or (n,) or (rods, n) with n the number of edges, or of nodes of open rods, between which they are linear.
        rods: how many rods they are given for.
        batch: whose nodes and edges the rods have.

    Raises:
        SceneError: they do not fit.
    """
    values, ends = np.atleast_2d(values), not batch.closed and batch.nodes
    if values.shape[0] in (1, rods) and values.shape[1] in (1, batch.edges, ends):
        return 0.5 * (values[:, :-1] + values[:, 1:]) if values.shape[1] == ends else values
    raise SceneError(
        _misfit(what, values, rods, batch, f"{batch.edges} edges" + f" or {batch.nodes} nodes" * bool(ends))
    )


def at_nodes(values, rods: int, batch) -> np.ndarray:
    """Return drag of bodies at nodes, broadcastable to (rods, nodes), of rods of a batch; see `along_edges`."""
    values = np.atleast_2d(values)
    if values.shape[0] in (1, rods) and values.shape[1] in (1, batch.nodes):
        return values
    raise SceneError(_misfit("nodes", values, rods, batch, f"{batch.nodes} nodes"))


def _misfit(what: str, values: np.ndarray, rods: int, batch, there: str) -> str:
    shape = values.shape[1:] if len(values) == 1 else values.shape
    return (
        f"drag: {what} has shape {shape}, and rods '{batch.name}' have {there}; give one number, one for each of these, or such a row "
        f"for each of the {rods} rods"
    )


@dataclass(frozen=True)
class RodDrag:
    """Drag of some rods: their law, and force over velocity of bodies at their nodes [N s/m]."""

    rods: np.ndarray
    law: Resistance | Viscous | Granular
    nodes: float | np.ndarray

    def of(self, rows: np.ndarray, batch) -> "RodDrag":
        """Return the drag of some of its rods, those at `rows`, which are of a batch: laws by edge, bodies by node."""

        def chosen(values: np.ndarray) -> np.ndarray:
            return values[rows] if len(values) > 1 else values

        count = len(self.rods)
        law = self.law.spread(lambda name, values: chosen(along_edges(name, values, count, batch)))
        return RodDrag(self.rods[rows], law, chosen(at_nodes(self.nodes, count, batch)))


def rod_drag(batches, rods: np.ndarray, law, tangential, normal, rotational, nodes) -> RodDrag:
    """Return what `Scene.drag` is given for rods of a scene's batches, checked; arguments as there."""
    bodies = 0.0 if nodes is None else _numbers("drag: nodes", nodes, "N s/m")
    given = tangential is not None or normal is not None or np.any(rotational)
    if law is None:
        bare = nodes is not None and not given  # bodies alone
        law = Resistance(0.0, 0.0) if bare else Resistance(tangential, normal, rotational)
    elif not isinstance(law, Resistance | Viscous | Granular):
        raise SceneError(f"drag: law is {law!r}; give Viscous(viscosity), Granular(...), or tangential and normal")
    elif given:
        raise SceneError("drag: a law and coefficients are given; give one of them")
    result = RodDrag(rods, law, bodies)
    for batch in batches:
        rows = np.flatnonzero((rods >= batch.first) & (rods < batch.first + batch.rods))
        if rows.size:
            result.of(rows, batch)  # refuses what does not fit
    return result


class Laws:
    """Which law of drag every rod of a scene has.

    Attributes:
        given: the laws; of_rods: place of its law among them, of every rod (R,); -1 without.

    Raises:
        SceneError: a rod has two.
    """

    def __init__(self, scene):
        self._drags, self.of_rods = scene.drags, np.full(scene.rod_count, -1)
        self.given, self._row = [given.law for given in scene.drags], np.zeros(scene.rod_count, int)
        for place, given in enumerate(scene.drags):
            twice = given.rods[self.of_rods[given.rods] >= 0]
            if twice.size:
                raise SceneError(f"drag: rod {twice[0]} has drag already; give it one law")
            self.of_rods[given.rods] = place
            self._row[given.rods] = np.arange(len(given.rods))

    def coefficients(self, rods: np.ndarray, batch, radius: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Rows of `kernels.drag` (R, edges, rows) of rods (R,) of a batch with drag; none on edges without length, which are ghosts."""
        from ddg_warp.kernels.drag import FIRST, LAST, ROWS

        result, laws = np.zeros((*lengths.shape, ROWS)), self.of_rods[rods]
        real = lengths[0] > 0.0
        radius = np.broadcast_to(radius, lengths.shape)[:, real]
        for place in np.unique(laws):
            chosen = laws == place
            found = np.zeros((chosen.sum(), batch.edges, ROWS))
            length = lengths[chosen].sum(1, keepdims=True)
            given = self._drags[place].of(self._row[rods[chosen]], batch)
            for i, values in enumerate(given.law.coefficients(f"drag: rods '{batch.name}'", radius[chosen], length)):
                found[..., i] = values
            bodies = np.broadcast_to(given.nodes, (len(found), batch.nodes))
            found[..., FIRST] = bodies[:, : batch.edges]
            if not batch.closed:
                found[:, -1, LAST] = bodies[:, -1]
            result[np.ix_(chosen, real)] = found
        return result


def holds(coefficients: np.ndarray) -> np.ndarray:
    """Which first and last nodes of edges (2, ...) are held back in all directions, by coefficients (rows, ...)."""
    tangential, normal, _, lateral, friction, _, _, _, first, last = coefficients
    along = (tangential + friction > 0.0) & (normal + lateral > 0.0)
    return np.stack([along | (first > 0.0), along | (last > 0.0)])


def least(coefficients: np.ndarray) -> np.ndarray:
    """The smallest drag per length and velocity [N s/m^2] of rods (R,), by coefficients (R, edges, rows); none of what is granular."""
    return coefficients[..., :2].mean(1).min(1)
