"""Residuals of equilibria on the host: what they are compared with, and what to tell of one that is too large."""

import numpy as np


class Residuals:
    """Of a model's `Tangent`, by the tolerances of a static solve.

    Args:
        rtol: see `ddg_warp.compile.tolerance`.
        rounding: what counts as rounding, over the forces that meet at a dof.
    """

    def __init__(self, tangent, rtol: float, rounding: float):
        self.tangent, self.rtol, self.rounding = tangent, rtol, rounding

    def load_scale(self, outer: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """What residuals of the bodies are compared with [N]: sums of their outer forces, or the largest support force if more.

        A body without either is compared with the mean of all.
        """
        tangent = self.tangent
        loads = np.concatenate(
            [part.body_loads(tangent.of(part, outer), tangent.of(part, gradient)) for part in tangent.parts]
        )
        return np.where(loads > 0.0, loads, loads.mean())

    def first_scale(self, outer: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """The load scales of the state that a search starts from, or its residual where there are no loads [N].

        A residual is compared with this or with the present load scale: forces of iterates on the way, however large, excuse nothing.
        """
        scale = self.load_scale(outer, gradient)
        return scale if scale.any() else scale + np.abs((outer - gradient)[self.tangent.free]).max(initial=0.0)

    def allowed(self, scale: np.ndarray) -> np.ndarray:
        """Residuals of all dofs at rtol = 1 (size,) [N, N m], for such load scales; see `ddg_warp.compile.tolerance`."""
        return np.concatenate([part.allowed(own) for part, own in self._by_part(scale)])

    def _by_part(self, scale: np.ndarray):
        """The parts of the tangent, each with the scales of its bodies."""
        at = 0
        for part in self.tangent.parts:
            yield part, scale[at : at + part.body_count]
            at += part.body_count

    def scaled(self, residual: np.ndarray) -> np.ndarray:
        """Moments over an edge length, so that they compare with forces."""
        return np.where(self.tangent.angle, residual / self.tangent.edge_length(), residual)

    def excess(self, residual, gradient, hessian, q, scale: np.ndarray) -> tuple[float, str]:
        """How far the worst dof, or sum of residuals, is from equilibrium, not positive when all are; and the outcome if it is.

        `scale` is of the bodies.
        """
        excess, small = self.by_island(residual, gradient, hessian, q, scale)
        return float(excess.max()), "converged" if small.all() else "converged_to_rounding"

    def by_island(self, residual, gradient, hessian, q, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same of every island (islands,); and whether its residuals are below the tolerance, not only below rounding."""
        tangent, rtol = self.tangent, self.rtol
        free, islands = tangent.free, tangent.island[tangent.free]
        floor = self.rounding * (abs(hessian) @ self.magnitude(q) + np.abs(gradient))
        limit, size = rtol * self.allowed(scale), np.abs(residual)
        masked = np.where(free, residual, 0.0)
        sums = [
            part.sums(own, rtol, tangent.of(part, masked), tangent.of(part, floor))
            for part, own in self._by_part(scale)
        ]
        small, excess = (np.concatenate(values) for values in zip(*sums, strict=True))
        small = small & (np.bincount(islands, (size > limit)[free], tangent.islands) == 0)
        np.maximum.at(excess, islands, (size - np.maximum(limit, floor))[free])
        return excess, small

    def magnitude(self, q: np.ndarray) -> np.ndarray:
        """Size of the numbers whose rounding moves dofs: of positions the largest coordinate of their island, of angles a radian."""
        tangent = self.tangent
        reach = np.zeros(tangent.islands)
        np.maximum.at(reach, tangent.island[~tangent.angle], np.abs(q[~tangent.angle]))
        return np.where(tangent.angle, np.maximum(1.0, np.abs(q)), reach[tangent.island])

    def unbalanced(self, residual: np.ndarray, outer: np.ndarray) -> np.ndarray:
        """What of the loads supports and obstacles do not carry, over the loads, at worst in each world (worlds,).

        Residuals of free nodes add up to what is missing in the sum of all forces on a connected component. A component without loads
        has nothing to carry.
        """
        tangent = self.tangent
        worst = np.zeros(tangent.model.worlds)
        for part in tangent.parts:
            points = tangent.of(part, tangent.free) & part.balances
            own, loads = (np.where(points, tangent.of(part, v), 0.0) for v in (residual, outer))
            count, axes = part.component.max() + 1, part.axis
            left = np.zeros((count, 3))
            np.add.at(left, (part.component, axes), part.back(own))
            total = np.bincount(part.component, np.abs(loads), count)
            ratio = np.divide(np.abs(left).max(1), total, out=np.zeros(count), where=total > 0.0)
            world = np.zeros(count, int)
            world[part.component] = np.arange(part.size) // (part.size // part.worlds)
            np.maximum.at(worst, world, ratio)
        return worst

    def where(self, outcome: str, residual: np.ndarray, at: float, told: str = "") -> str:
        """What to tell of a search that failed, with what is `told` of contact; see `ddg_warp.solve.remedies` for what would help."""
        masked = np.where(self.tangent.free, np.abs(self.scaled(residual)), -1.0)
        worst = int(np.argmax(np.where(np.isfinite(masked), masked, np.inf)))
        told = told.rstrip("; ,")
        return (
            f"no equilibrium at load parameter {at:g}: {outcome}, largest residual {residual[worst]:.3g} at "
            f"{self.tangent.where(worst)}{told and '; ' + told}"
        )
