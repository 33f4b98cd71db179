"""Laws of drag on rods, and the coefficients per length that they give: see `kernels.drag` for the theory. NumPy only."""

from dataclasses import dataclass
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


@dataclass(frozen=True)
class Resistance:
    """Drag in proportion to velocity, its coefficients given outright.

    Attributes:
        tangential, normal: force per length over velocity along and across the rod [N s/m^2].
        rotational: moment per length over the spin about the tangent [N s].
    """

    tangential: float
    normal: float
    rotational: float = 0.0

    def __post_init__(self):
        for name in ("tangential", "normal", "rotational"):
            _not_negative(f"drag: {name}", getattr(self, name), "N s" if name == "rotational" else "N s/m^2")

    def coefficients(self, where: str, radius: np.ndarray, length: np.ndarray) -> list:
        """Rows of `kernels.drag`, of edges with these radii (R, edges) of rods of these lengths (R, 1)."""
        return [self.tangential, self.normal, self.rotational, 0.0, 0.0, 0.0, 0.0, 0.0]


@dataclass(frozen=True)
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
    """

    viscosity: float
    theory: str = "cox"
    scale: float | None = None

    def __post_init__(self):
        arguments.positive("Viscous: viscosity", self.viscosity, "Pa s")
        arguments.choice("Viscous: theory", self.theory, tuple(THEORIES))
        if self.scale is not None:
            arguments.positive("Viscous: scale", self.scale, "m")
        elif self.theory != "cox":
            raise SceneError(f"Viscous: theory {self.theory!r} needs a scale [m], the length of a wave")

    def coefficients(self, where: str, radius: np.ndarray, length: np.ndarray) -> list:
        """As of `Resistance`.

        Raises:
            SceneError: the rod is too thick for the theory.
        """
        if np.min(radius) <= 0.0:
            raise SceneError(f"{where}: its section has no radius; give it one, or drag(tangential=..., normal=...)")
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


class Laws:
    """Which law of drag every rod of a scene has.

    Attributes:
        given: the laws; of_rods: place of its law among them, of every rod (R,); -1 without.

    Raises:
        SceneError: a rod has two.
    """

    def __init__(self, scene):
        self.given, self.of_rods = [law for _, law in scene.drags], np.full(scene.rod_count, -1)
        for place, (rods, _) in enumerate(scene.drags):
            twice = rods[self.of_rods[rods] >= 0]
            if twice.size:
                raise SceneError(f"drag: rod {twice[0]} has drag already; give it one law")
            self.of_rods[rods] = place

    def coefficients(self, rods: np.ndarray, name: str, radius: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Rows of `kernels.drag` (R, edges, rows) of rods (R,) with drag; none on edges without length, which are ghosts."""
        from ddg_warp.kernels.drag import ROWS

        result, radius, laws = (
            np.zeros((*lengths.shape, ROWS)),
            np.broadcast_to(radius, lengths.shape),
            self.of_rods[rods],
        )
        for place in np.unique(laws):
            chosen = laws == place
            own, length = radius[chosen], lengths[chosen].sum(1, keepdims=True)
            rows = self.given[place].coefficients(f"drag: rods '{name}'", own, length)
            result[chosen] = np.stack([np.broadcast_to(row, own.shape) for row in rows], -1)
        result[lengths == 0.0] = 0.0
        return result


def holds(coefficients: np.ndarray) -> np.ndarray:
    """Which edges (...) are held back in all directions, by coefficients (rows, ...)."""
    tangential, normal, _, lateral, friction, *_ = coefficients
    return (tangential + friction > 0.0) & (normal + lateral > 0.0)


def least(coefficients: np.ndarray) -> np.ndarray:
    """The smallest drag per length and velocity [N s/m^2] of rods (R,), by coefficients (R, edges, rows); none of what is granular."""
    return coefficients[..., :2].mean(1).min(1)
