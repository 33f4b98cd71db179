"""Linear systems of adjoints: the transposed exact Hessian of a solve, without any projection to SPD."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import warp as wp
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp import device_arrays
from ddg_warp.errors import SolverError
from ddg_warp.solve.equilibrium.rigid_modes import rigid_modes
from ddg_warp.solve.equilibrium.rod_tangent import RodTangent
from ddg_warp.solve.linear.cyclic_reduction import CyclicReduction, Elimination
from ddg_warp.solve.linear.solver_selection import automatic
from ddg_warp.solve.linear.sparse_direct import SingularError, regular
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.newton.rod_newton_assembled import AssembledNewton

SINGULAR = 1e-6  # Accepted relative residual; a singular matrix that was regularised leaves more


class HostSolve:
    """Solver of (H + c M - dL/dq)^T w = g of a subsystem, by sparse factors on the host.

    Attributes:
        held: load-stiffness term of the gradient by fixed dofs (size,), of the last solution; None without follower loads.
    """

    def __init__(self, tangent):
        self.tangent = tangent
        self.held = None

    def __call__(
        self,
        state,
        rate: float,
        coefficient: float,
        factor: float | None,
        rhs: np.ndarray,
        more=None,
        friction_jacobian=None,
    ) -> np.ndarray:
        """Return w (size,), zero at fixed dofs.

        Args:
            state: the solution with its lagged frames, in the layout of a state.
            rate: inverse step of implicit Euler [1/s], used in strain-rate damping; zero for an equilibrium.
            coefficient: c, zero for an equilibrium [1/s^2].
            factor: load parameter of an equilibrium, which has load stiffness dL/dq; None in a step, where loads are lagged.
            rhs: g (size,).
            more: additional matrix, of a quadratic potential; None without.
            friction_jacobian: additional matrix, unsymmetric, of friction in an equilibrium; None without.

        A singular matrix, with zero stiffness along a motion, is accepted if g has no component along the motion.

        Raises:
            SolverError: g has such a component.
        """
        tangent, following = self.tangent, None
        tangent.rate = wp.full(len(tangent.rate), rate, dtype=tangent.rate.dtype, device=tangent.rate.device)
        hessian = (
            tangent.hessian(state)
            if friction_jacobian is None
            else tangent.potential_hessian(state) + tangent.matrix(friction_jacobian)
        )
        if coefficient == 0.0 and tangent.model.touch is None:
            self._require_stiff(state, hessian)
        matrix = hessian + sparse.diags(coefficient * tangent.mass)
        if more is not None:
            matrix = matrix + tangent.matrix(more)
        if factor is not None:
            spun = self._spun(state, factor, friction_jacobian is not None)
            following = _total(tangent.load_stiffness(factor, tangent.dofs(state)), spun)
        free = np.flatnonzero(tangent.free)
        free_matrix, rhs = (
            sparse.csc_matrix(matrix if following is None else matrix + following)[free][:, free],
            rhs[free],
        )
        try:
            symmetric = following is None and friction_jacobian is None
            solve = regular(free_matrix, tangent.mass[free])[0].solve if symmetric else _transposed(free_matrix)
            solution = solve(rhs)
        except (SingularError, RuntimeError) as error:
            raise self._singular(free) from error
        missed = np.abs(free_matrix.T @ solution - rhs)
        if not missed.max(initial=0.0) <= SINGULAR * np.abs(rhs).max(initial=0.0):
            raise self._singular(free[int(np.argmax(missed))])
        w = np.zeros(tangent.size)
        w[free] = solution
        self.held = None if following is None else np.where(tangent.free, 0.0, -(following.T @ w))
        return w

    def _require_stiff(self, state, hessian: sparse.csc_matrix) -> None:
        """Refuse an equilibrium with a neutral rigid-body mode, such as the spin of a rod without torsional support.

        Loads along the mode make the equilibrium jump under any change of parameters, which g does not reveal.
        """
        tangent = self.tangent
        neutral = rigid_modes(tangent, state, hessian)
        if neutral.shape[1]:
            mode = neutral[:, 0]
            spins = np.abs(mode[~tangent.angle]).max(initial=0.0) <= 1e-6 * np.abs(mode).max() / tangent.edge_length()
            kind = "the spin of" if spins else "a motion of"
            where = tangent.where(int(np.argmax(np.abs(mode))))
            raise SolverError(
                f"no gradient goes through the equilibrium: {kind} {where} is neutral, as no support restrains it: it would jump "
                f"with parameters; {'fix it by scene.fix_twist(...)' if spins else 'support it'}",
                outcome="neutral",
            )

    def _spun(self, state, factor: float, has_friction: bool) -> sparse.csc_matrix | None:
        """Return the stiffness from transport of frames, which the tangent keeps fixed; None if no moment acts on an edge.

        A moment M on the twist angle of an edge e rotates with its frame. The transported frame spins about the tangent t by
        t . (t x de) / 2 |e| less than a fixed one. This adds the force M [t] de / 2 |e|^2 across the edge, with [t] the matrix of t
        x. M is the sum of loads, reactions and, if `has_friction`, friction; together they balance the elastic moment.
        """
        tangent, rows, columns, values = self.tangent, [], [], []
        q = tangent.dofs(state)
        moments = np.where(tangent.free & (not has_friction), tangent.loads(factor, q), tangent.gradient(state))
        for body in tangent.bodies():
            if len(body.angles) and (body.nodes >= 0).all():
                ends = body.nodes[body.ends]  # (edges, 2, 3)
                acting = moments[body.angles] * tangent.free[ends].any((1, 2)) != 0.0
                ends, moment = ends[acting], moments[body.angles][acting]
                e = q[ends[:, 1]] - q[ends[:, 0]]
                size = moment / (2.0 * np.linalg.norm(e, axis=1) ** 3)
                across = size[:, None, None] * np.swapaxes(np.cross(e[:, None], np.eye(3)), 1, 2)
                sign = np.array([[1.0, -1.0], [-1.0, 1.0]])
                row, column = np.broadcast_arrays(ends[:, :, None, :, None], ends[:, None, :, None, :])
                rows.append(row.ravel())
                columns.append(column.ravel())
                values.append((sign[None, :, :, None, None] * across[:, None, None]).ravel())
        if not sum(map(len, values)):
            return None
        data, *indices = (np.concatenate(parts) for parts in (values, rows, columns))
        return sparse.csc_matrix((data, indices), shape=(tangent.size, tangent.size))

    def _singular(self, dof: np.ndarray | int) -> SolverError:
        where = self.tangent.where(int(np.ravel(dof)[0]))
        return SolverError(
            f"no gradient goes through the solution: {where} can move without any stiffness, in a direction that changes the "
            "loss; support it, or stay off limit points and bifurcations",
            outcome="singular",
        )


def _total(*matrices: sparse.csc_matrix | None) -> sparse.csc_matrix | None:
    """Return the sum of the matrices that are not None; None if all are."""
    return sum(m for m in matrices if m is not None) if any(m is not None for m in matrices) else None


def _transposed(matrix: sparse.csc_matrix):
    """Return the solver of a transposed system, for unsymmetric matrices."""
    factors = splu(matrix)
    return lambda rhs: factors.solve(rhs, trans="T")


class DirectSolve:
    """Device solver of H w = g of a rod group, by assembled blocks and their elimination or cyclic reduction.

    Measured (H100, 100,000 rods of 24 nodes): the reverse pass took 6.4 ms. By the sweep of Newton's method it took 8.3 ms, as
    second derivatives in float64 keep 2 kB a thread in local memory. By float32 factors and two refined solutions it took 7.5 ms.

    Alternative: blocks formed in registers, without assembly. The kernel spills 0.7 kB a thread. It takes as long for 100,000 rods, and
    twice as long for 2,560.

    Attributes:
        failed: nonzero for rods with an H that is not positive definite (columns,), where w is meaningless.
    """

    def __init__(self, model, group):
        kind, device, real, size = group.kind, model.wp_device, model.types.real, (group.nodes, group.columns)
        self._count, self._wanted = group.count, wp.full(group.columns, 1, dtype=int, device=device)
        self.system = AssembledNewton(model, group, NewtonOptions(psd="none"), real)
        if automatic(group) == "cyclic_reduction":
            self.solver = CyclicReduction(kind.block, *size, real, device)
        else:
            self.solver = Elimination(kind, *size, real, device, once=True)
        self.failed = self.system.islands.lost_pivots

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [(self.system._evaluate, 128), self.system._assemble, *self.solver.kernels]

    def __call__(self, solved, last: wp.array, rate: float, coefficient: float, rhs: wp.array, w: wp.array, resisted):
        """Write w; launches only. Arguments as of `RodLinearSolve`, `coefficient` that of inertia [1/s^2]."""
        system, loading = self.system, self.system.loading
        system.iterates = replace(system.iterates, x=solved.x, theta=solved.theta, frame=solved.frame)
        islands = system.islands
        islands.arrays[0].zero_()
        islands.inertia_coefficient.fill_(coefficient)
        islands.inverse_step.fill_(rate)
        islands.not_converged.fill_(1)  # assemble the matrices of all rods
        if resisted:
            adjoint, *states = resisted
            adjoint.force.resist(*states, loading.mass, loading.rotary, system.iterates.target_angle, islands)
        system.evaluate(last)
        system.assemble_blocks()
        self.solver.solve(system.blocks, rhs, self._count, self._wanted, w, self.failed)


class RodLinearSolve:
    """Solver of H w = g of a rod group, in the precision of its state; of equilibria on the host.

    Attributes:
        tangent: tangent of host solves.
        held: see `HostSolve`, of the last host solve, in the layout of w.
        direct: the `DirectSolve`; failed: of its last solve.
    """

    def __init__(self, model, group):
        self.model, self.group = model, group
        self.host, self.direct = HostSolve(RodTangent(model, group, 0)), DirectSolve(model, group)
        self.tangent, self.held = self.host.tangent, None
        self.failed = self.direct.failed

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return self.direct.kernels

    def __call__(self, solved, last: wp.array, s: float, rhs: wp.array, w: wp.array, resisted=None) -> None:
        """Write w (block, n, R), zero at fixed dofs, for a right-hand side that is zero there.

        Args:
            solved: the solution `x`, `theta` and its lagged `frame`.
            last: strains of the last step.
            s: length of the implicit Euler step [s]; infinite for an equilibrium with the load parameter `solved.time`.
            resisted: with a quadratic potential, the adjoint of its force, the state before, and the nodes of the tangents.

        Raises:
            SolverError: H is singular (host only; see `failed`).
        """
        rate = 1.0 / s
        coefficient = rate * (rate + self.model.scene.mass_damping)
        if rate:
            self.direct(solved, last, rate, coefficient, rhs, w, resisted)
            return
        data = SimpleNamespace(x=solved.x, theta=solved.theta, frame=solved.frame, last=last)
        groups = [data if each is self.group else None for each in self.model.groups]
        b = device_arrays.download(rhs).astype(float).transpose(2, 1, 0).ravel()
        solution = self.host(SimpleNamespace(groups=groups), rate, coefficient, solved.time, b)
        device_arrays.assign(w, self.tangent.blocks(solution).transpose(2, 1, 0))
        by_fixed = self.host.held
        self.held = None if by_fixed is None else self.tangent.blocks(by_fixed).transpose(2, 1, 0)
