"""State of Newton's method on a rod group, grouped by meaning as in `ddg_warp.solve.newton.coupled_state`.

Captured graphs keep pointers, so that all arrays are allocated once. n, R: nodes and columns of the group; twist angles and frames
have one entry without twist.
"""

from dataclasses import dataclass

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.elements import element_path, rod_layout


@dataclass
class RodIterates:
    """Positions of a solve.

    Attributes:
        x, theta, frame: trial iterate (n, R) and its lagged frames (7, n, R).
        base: accepted positions, from which a line search starts.
        target: minimum of the inertial potential, coefficient * m |x - target|^2 / 2; for twist angles `target_angle`.
    """

    x: wp.array
    theta: wp.array
    frame: wp.array
    base: wp.array
    target: wp.array
    target_angle: wp.array

    @classmethod
    def of(cls, group, real) -> "RodIterates":
        """Return zero iterates."""
        nodes, vector = (group.nodes, group.columns), wp.types.vector(group.kind.dim, real)
        twisted = nodes if group.kind.twist else (1, 1)
        x, base, target = (device_arrays.allocate(nodes, vector, group.device) for _ in range(3))
        theta, angle = (device_arrays.allocate(twisted, real, group.device) for _ in range(2))
        return cls(x, theta, device_arrays.allocate((7, *twisted), real, group.device), base, target, angle)


@dataclass
class RodLoading:
    """Inertia and external forces of a solve.

    Attributes:
        mass, rotary: inertia of nodes and of twist; own arrays with a quadratic potential, see `kernels.core.inertia`.
        force, moment: forces on nodes and moments about edges, if `loaded`.
    """

    mass: wp.array
    rotary: wp.array
    force: wp.array
    moment: wp.array
    loaded: bool

    @classmethod
    def of(cls, group, iterates: RodIterates) -> "RodLoading":
        """Return the constant loads of a group."""
        mass, rotary = group.mass, group.rotary
        if group.kind.quadratic:
            inertia = rod_layout.inertia_type(group.kind, iterates.theta.dtype)
            mass = device_arrays.allocate(iterates.x.shape, inertia, group.device)
            rotary = device_arrays.allocate(iterates.theta.shape, iterates.theta.dtype, group.device)
        return cls(mass, rotary, group.load, group.load_angle, group.host.loaded)


@dataclass
class RodElements:
    """Energies and Hessian factors of elements at an iterate (rows, n, R).

    Attributes:
        factor: Gauss-Newton factors, and tensions in the mixed axial-force formulation. A sweep may overwrite it by the data of
            eliminated nodes.
        geometric: second derivatives, one entry if not computed.
        energy: of this iterate and of the accepted one.
        stiffness: (n, R) stiffness sums, for rounding bounds.
    """

    factor: wp.array
    geometric: wp.array
    energy: wp.array
    stiffness: wp.array

    @classmethod
    def of(cls, group, real, linear, exact: bool, mixed_axial: bool, rows: int) -> "RodElements":
        """Return zeros, with room for second derivatives if `exact`, and for `rows` at least where factors are."""
        kind, nodes = group.kind, (group.nodes, group.columns)
        second = (kind.geometric_rows, *nodes) if exact else (1, 1, 1)
        shapes = (max(kind.factor_rows + mixed_axial, rows), *nodes), second, (2, *nodes), nodes
        dtypes = linear, linear, real, linear
        layouts = zip(shapes, dtypes, strict=True)
        return cls(*(device_arrays.allocate(shape, dtype, group.device) for shape, dtype in layouts))

    def results(self):
        """Return the arrays by columns, for the kernel of an iteration."""
        result = element_path.results_type(self.energy.dtype, self.factor.dtype)()
        result.factor = result.tension = device_arrays.columns(self.factor)
        result.second, result.energy = device_arrays.columns(self.geometric), device_arrays.columns(self.energy)
        result.stiffness = device_arrays.columns(self.stiffness)
        return result


@dataclass
class RodResidualNorms:
    """Sums over runs of nodes of an iterate (runs, R), for the line search.

    Attributes:
        change: change of the energy [J]; rounding_error: its rounding bound over the unit roundoff.
    """

    change: wp.array
    rounding_error: wp.array

    @classmethod
    def of(cls, group, runs: int, real, linear) -> "RodResidualNorms":
        """Return zero norms."""
        shape = runs, group.columns
        return cls(*(device_arrays.allocate(shape, dtype, group.device) for dtype in (real, linear)))
