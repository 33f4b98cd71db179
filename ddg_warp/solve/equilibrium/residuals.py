"""Convergence test of equilibria on the host: load scales, tolerances and messages."""

import numpy as np


class Residuals:
    """Convergence test of a `Tangent` by the tolerances of a static solve.

    Args:
        rtol: see `ddg_warp.compile.residual_tolerance`.
        rounding: rounding floor of a dof, over its force contributions.
    """

    def __init__(self, tangent, rtol: float, rounding: float):
        self.tangent, self.rtol, self.rounding = tangent, rtol, rounding

    def load_scale(self, outer: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return load scales of bodies [N]: sum of external forces, or largest support force if larger.

        A body without either takes the mean of all.
        """
        tangent = self.tangent
        loads = np.concatenate(
            [part.body_loads(tangent.of(part, outer), tangent.of(part, gradient)) for part in tangent.parts]
        )
        return np.where(loads > 0.0, loads, loads.mean())

    def first_scale(self, outer: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the load scales of the start of a search [N], or its residual without loads.

        Tests use this or the load scale of the iterate, not the larger forces of earlier iterates.
        """
        scale = self.load_scale(outer, gradient)
        return scale if scale.any() else scale + np.abs((outer - gradient)[self.tangent.free]).max(initial=0.0)

    def allowed(self, scale: np.ndarray) -> np.ndarray:
        """Return residual limits of all dofs at rtol = 1 (size,) [N, N m]; see `ddg_warp.compile.residual_tolerance`."""
        return np.concatenate([part.allowed(part_scale) for part, part_scale in self._by_part(scale)])

    def _by_part(self, scale: np.ndarray):
        """Yield the tangent blocks, each with the load scales of its bodies."""
        first = 0
        for part in self.tangent.parts:
            yield part, scale[first : first + part.body_count]
            first += part.body_count

    def scaled(self, residual: np.ndarray) -> np.ndarray:
        """Return residuals with moments divided by an edge length, comparable with forces."""
        return np.where(self.tangent.angle, residual / self.tangent.edge_length(), residual)

    def excess(self, residual, gradient, hessian, q, scale: np.ndarray) -> tuple[float, str]:
        """Return the largest excess of residuals or subset sums over limits, and the outcome if not positive.

        `scale`: load scales of the bodies.
        """
        excess, small = self.by_island(residual, gradient, hessian, q, scale)
        return float(excess.max()), "converged" if small.all() else "converged_to_rounding"

    def by_island(self, residual, gradient, hessian, q, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the excess of every island (islands,), and the mask of islands below the tolerance itself."""
        tangent, rtol = self.tangent, self.rtol
        free, islands = tangent.free, tangent.island[tangent.free]
        rounding_floor = self.rounding * (abs(hessian) @ self.magnitude(q) + np.abs(gradient))
        limit, size = rtol * self.allowed(scale), np.abs(residual)
        masked = np.where(free, residual, 0.0)
        sums = [
            part.sums(part_scale, rtol, tangent.of(part, masked), tangent.of(part, rounding_floor))
            for part, part_scale in self._by_part(scale)
        ]
        small, excess = (np.concatenate(values) for values in zip(*sums, strict=True))
        small = small & (np.bincount(islands, (size > limit)[free], tangent.islands) == 0)
        np.maximum.at(excess, islands, (size - np.maximum(limit, rounding_floor))[free])
        return excess, small

    def magnitude(self, q: np.ndarray) -> np.ndarray:
        """Return magnitudes for the rounding of dofs: largest coordinate of the island, at least a radian for angles."""
        tangent = self.tangent
        magnitude = np.zeros(tangent.islands)
        np.maximum.at(magnitude, tangent.island[~tangent.angle], np.abs(q[~tangent.angle]))
        return np.where(tangent.angle, np.maximum(1.0, np.abs(q)), magnitude[tangent.island])

    def unbalanced(self, residual: np.ndarray, outer: np.ndarray) -> np.ndarray:
        """Return the largest fraction of loads that supports and obstacles do not balance, per world (worlds,).

        Residuals of free nodes sum to the missing force on a connected component. Components without loads count as balanced.
        """
        tangent = self.tangent
        worst = np.zeros(tangent.model.worlds)
        for part in tangent.parts:
            points = tangent.of(part, tangent.free) & part.balances
            missing, loads = (np.where(points, tangent.of(part, v), 0.0) for v in (residual, outer))
            count, axes = part.component.max() + 1, part.axis
            sums = np.zeros((count, 3))
            np.add.at(sums, (part.component, axes), part.back(missing))
            total = np.bincount(part.component, np.abs(loads), count)
            ratio = np.divide(np.abs(sums).max(1), total, out=np.zeros(count), where=total > 0.0)
            world = np.zeros(count, int)
            world[part.component] = np.arange(part.size) // (part.size // part.worlds)
            np.maximum.at(worst, world, ratio)
        return worst

    def where(self, outcome: str, residual: np.ndarray, load_factor: float, details: str = "") -> str:
        """Return the message on a failed search, with `details` of contact; for remedies see `ddg_warp.solve.equilibrium.remedies`."""
        masked = np.where(self.tangent.free, np.abs(self.scaled(residual)), -1.0)
        worst = int(np.argmax(np.where(np.isfinite(masked), masked, np.inf)))
        details = details.rstrip("; ,")
        return (
            f"no equilibrium at load parameter {load_factor:g}: {outcome}, largest residual {residual[worst]:.3g} at "
            f"{self.tangent.where(worst)}{details and '; ' + details}"
        )
