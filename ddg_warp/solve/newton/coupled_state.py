"""State of Newton's method on the coupled system, grouped by meaning.

Solver components of `CoupledNewton` get the groups that they read and write as arguments. Captured graphs keep pointers, so that
all arrays are allocated once. W: worlds; N: dof blocks of a world. See also `Islands` and `LinearSystem`.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp.compile.residual_tolerance import outer_forces
from ddg_warp.kernels.core.inertia import block_inertia


@dataclass
class Iterates:
    """Positions of a solve, dof blocks (W N,).

    Attributes:
        q: trial iterate; base: accepted iterate, from which a line search starts.
        target: minimum of the inertial potential.
        proposed: end of the proposed motion where contact has limited it, otherwise `q`: all terms but contact are evaluated there.
    """

    q: wp.array
    base: wp.array
    target: wp.array
    proposed: wp.array

    @classmethod
    def of(cls, coupled) -> "Iterates":
        """Return iterates at rest positions in contact, where search trees need them, otherwise at zero."""
        q, base, target = (
            wp.zeros(coupled.worlds * coupled.blocks, dtype=coupled.vector, device=coupled.device) for _ in range(3)
        )
        if coupled.host.contact_parameters:
            q.assign(np.tile(coupled.host.rest, (coupled.worlds, 1)))
        return cls(q, base, target, wp.zeros_like(q) if coupled.host.contact_parameters else q)


@dataclass
class Loading:
    """Inertia and external forces of a solve.

    Attributes:
        mass: (W, N) masses, or inertia with a quadratic potential, see `kernels.core.inertia`.
        gravity: (1,) [m/s^2]; force: (W N,) other forces on dof blocks [N, N m].
        scale: (W,) load scale, relative to the loads that residual tolerances count.
    """

    mass: wp.array
    gravity: wp.array
    force: wp.array
    scale: wp.array

    @classmethod
    def of(cls, coupled, gravity, quadratic: bool, tolerances) -> "Loading":
        """Return the constant loads; assigns the loads of bodies to the residual tolerances."""
        host, worlds, device = coupled.host, coupled.worlds, coupled.device
        mass = coupled.mass
        if quadratic:
            mass = wp.zeros((worlds, coupled.blocks), dtype=block_inertia(coupled.real), device=device)
        gravity = np.asarray(gravity, float)
        scale = tolerances.assign(tolerances.bodies.loads(outer_forces(host, gravity))[None])
        force = np.tile(host.constant_loads(), (worlds, 1))
        return cls(mass, *(wp.array(v, dtype=coupled.vector, device=device) for v in (gravity[None], force)), scale)


@dataclass
class ResidualNorms:
    """Norms of the residual of an iterate.

    Attributes:
        of_blocks: (3, W, N) change of the energy [J], its rounding bound over the unit roundoff, and squared residual of blocks.
        of_worlds: (3, W) sums of `of_blocks`.
        worst: (W,) largest residual over its tolerance.
    """

    of_blocks: wp.array
    of_worlds: wp.array
    worst: wp.array

    @classmethod
    def of(cls, coupled) -> "ResidualNorms":
        """Return zero norms."""
        shapes = (3, coupled.worlds, coupled.blocks), (3, coupled.worlds), coupled.worlds
        return cls(*(wp.zeros(shape, dtype=coupled.real, device=coupled.device) for shape in shapes))

    @property
    def change(self) -> wp.array:
        """Change of the energy of blocks."""
        return self.of_blocks[0]

    @property
    def rounding_error(self) -> wp.array:
        """Rounding bound of the change of the energy of blocks."""
        return self.of_blocks[1]

    @property
    def square(self) -> wp.array:
        """Squared residual of blocks."""
        return self.of_blocks[2]


@dataclass
class SearchState:
    """State of the line searches (W,).

    Attributes:
        decrease: predicted decrease of a full step; rotation: its largest squared rotation [rad^2].
        best: smallest squared residual while energy changes are below the rounding floor; stalled: iterations since then.
        pcg_work: (1,) PCG iterations of all accepted directions so far.
    """

    decrease: wp.array
    rotation: wp.array
    best: wp.array
    stalled: wp.array
    pcg_work: wp.array

    @classmethod
    def of(cls, coupled) -> "SearchState":
        """Return the state before a first search."""
        worlds, dtypes = coupled.worlds, (*(coupled.real,) * 3, int)
        arrays = (wp.zeros(worlds, dtype=dtype, device=coupled.device) for dtype in dtypes)
        return cls(*arrays, wp.zeros(1, dtype=wp.int64, device=coupled.device))
