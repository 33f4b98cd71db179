"""The linear systems of adjoints: the exact Hessian of a solve, transposed, without anything that makes it definite."""

from types import SimpleNamespace

import numpy as np
import warp as wp
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp import arrays
from ddg_warp.errors import SolverError
from ddg_warp.kernels.adjoint import step
from ddg_warp.solve.chains.assembled import AssembledNewton
from ddg_warp.solve.chains.newton import ChainNewton, NewtonOptions
from ddg_warp.solve.chains.tangent import ChainTangent
from ddg_warp.solve.choice import automatic
from ddg_warp.solve.direct import SingularError, regular
from ddg_warp.solve.reduction import CyclicReduction

CLOSE = 1e-5  # relative error of float32 solutions up to which gradients take them: from 3e-5 on roll-outs err by 1e-4
SINGULAR = 1e-6  # part of a right-hand side that a solution may miss; a singular matrix, which has been made regular, misses more


class HostSolve:
    """(H + c M - dL/dq)^T w = g of a part of a model, by sparse factors on the host.

    Attributes:
        held: of the last solution, what loads that follow held dofs add to derivatives by these (size,); None where none do.
    """

    def __init__(self, tangent):
        self.tangent = tangent
        self.held = None

    def __call__(
        self, state, rate: float, coefficient: float, factor: float | None, given: np.ndarray, more=None
    ) -> np.ndarray:
        """w (size,), zero at held dofs.

        Args:
            state: the solution with its lagged frames, as a state has its parts.
            rate: of the implicit Euler step [1/s], zero for an equilibrium, over which strain-rate damping counts.
            coefficient: c, zero for an equilibrium [1/s^2].
            factor: load parameter of an equilibrium, whose loads L follow the dofs q; None in a step, where they do not.
            given: g (size,).
            more: matrix that H has beside these, of drag; None for none.

        A singular matrix, of what can move without stiffness, serves a loss that does not depend on that motion.

        Raises:
            SolverError: the loss does.
        """
        tangent, following = self.tangent, None
        tangent.rate = wp.full(len(tangent.rate), rate, dtype=tangent.rate.dtype, device=tangent.rate.device)
        matrix = tangent.hessian(state) + sparse.diags(coefficient * tangent.mass)
        if more is not None:
            matrix = matrix + tangent.matrix(more)
        if factor is not None:
            following = _total(tangent.load_stiffness(factor, tangent.dofs(state)), self._spun(state, factor))
        free = np.flatnonzero(tangent.free)
        own, given = sparse.csc_matrix(matrix if following is None else matrix + following)[free][:, free], given[free]
        try:
            solve = regular(own, tangent.mass[free])[0].solve if following is None else _transposed(own)
            found = solve(given)
        except (SingularError, RuntimeError) as error:
            raise self._singular(free) from error
        missed = np.abs(own.T @ found - given)
        if not missed.max(initial=0.0) <= SINGULAR * np.abs(given).max(initial=0.0):
            raise self._singular(free[int(np.argmax(missed))])
        w = np.zeros(tangent.size)
        w[free] = found
        self.held = None if following is None else np.where(tangent.free, 0.0, -(following.T @ w))
        return w

    def _spun(self, state, factor: float) -> sparse.csc_matrix | None:
        """What frames that an equilibrium carries along do, where the tangent holds them still; None where nothing twists an edge.

        A moment M on the angle of an edge e turns with its frame, which spins about t by t . (t x de) / 2 |e| less than one that is
        held still: it adds the force M [t] de / 2 |e|^2 across the edge, [t] the matrix of t x. M is what loads and supports put there.
        """
        tangent, rows, columns, values = self.tangent, [], [], []
        q = tangent.dofs(state)
        moments = np.where(tangent.free, tangent.loads(factor, q), tangent.gradient(state))
        for body in tangent.bodies():
            if len(body.angles) and (body.nodes >= 0).all():
                ends = body.nodes[body.ends]  # (edges, 2, 3)
                felt = moments[body.angles] * tangent.free[ends].any((1, 2)) != 0.0
                ends, moment = ends[felt], moments[body.angles][felt]
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
        data, *places = (np.concatenate(parts) for parts in (values, rows, columns))
        return sparse.csc_matrix((data, places), shape=(tangent.size, tangent.size))

    def _singular(self, dof: np.ndarray | int) -> SolverError:
        place = self.tangent.where(int(np.ravel(dof)[0]))
        return SolverError(
            f"no gradient goes through the solution: {place} can move without any stiffness, along what the loss depends on; hold it, "
            "or stay off limit points and bifurcations",
            outcome="singular",
        )


def _total(*matrices: sparse.csc_matrix | None) -> sparse.csc_matrix | None:
    """Sum of the matrices that there are."""
    return sum(m for m in matrices if m is not None) if any(m is not None for m in matrices) else None


def _transposed(matrix: sparse.csc_matrix):
    """The solution of the transposed system, for a matrix that is not symmetric."""
    factors = splu(matrix)
    return lambda given: factors.solve(given, trans="T")


class ChainSolve:
    """H w = g of a group of rods, in the precision of its state: by the sweep or cyclic reduction, as steps are made; on the host of
    closed rods and of equilibria.

    Attributes:
        guess: where solves are in another precision than the state, the kernel that w starts from; see `guess_kernels`.
        tangent: of solves on the host; held: of the last of these, see `HostSolve`, as w is laid out.
        failed: not zero of rods whose H is not positive definite (columns,), so that w means nothing; None on the host.
    """

    def __init__(self, model, group):
        self.model, self.group = model, group
        self.host = HostSolve(ChainTangent(model, group, 0))
        self.tangent, self.held = self.host.tangent, None
        self.system = self.reduction = self.failed = self.guess = self._cast = self._for = None
        if group.kind.closed:
            return
        self._built(model.types.linear)

    def suit(self, s: float) -> bool:
        """From now on solve by what suits steps of s [s], too, in the precision of the model's linear algebra where that leaves w right
        to `CLOSE`; whether that is another solver."""
        real = self.model.types.real
        if self.system is None or self.system.linear is real or self._for == (s, self.model.version):
            return False
        self._for = s, self.model.version
        if not self.group.kind.drag and self.group.float32_errors(s).max() <= CLOSE:
            return False
        self._built(real)
        return True

    def _built(self, linear) -> None:
        model, group, kind, device = self.model, self.group, self.group.kind, self.model.wp_device
        given = model, group, NewtonOptions(psd="none"), linear
        self.guess = self._cast = None
        if linear is not model.types.real:
            self.guess, *self._cast = step.guess_kernels(kind, model.types.real, linear)
        if automatic(group) == "sweep":
            self.system = ChainNewton(*given)
            self._moved = self.system.x, self.system.theta  # what the sweep moves along w
            self.failed = self.system.islands.status
        else:
            self.system = AssembledNewton(*given)
            self.reduction = CyclicReduction(kind.block, group.nodes, group.columns, linear, device)
            self._wanted = wp.full(group.columns, 1, dtype=int, device=device)
            self.failed = self.system.islands.bad

        self._right, self._found = self.system.right, self.system.direction

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        if self.system is None:
            return []
        around = [(self.system._evaluate, 128), *([self.guess, *self._cast] if self._cast else [])]
        if self.reduction is None:
            return [*around, (self.system._sweep, self.system._threads)]
        return [*around, self.system._assemble, *self.reduction.kernels]

    def __call__(self, solved, last: wp.array, s: float, right: wp.array, w: wp.array, resisted=None) -> None:
        """Write w (block, n, R), zero at held dofs, for a right-hand side that is zero there; with `guess`, add it to what w holds.

        Args:
            solved: the solution `x`, `theta` and its lagged `frame`.
            last: strains of the last step.
            s: length of the implicit Euler step [s]; infinite for an equilibrium, of which `solved.time` is the load parameter.
            resisted: with drag, its `ChainDragAdjoint`, the state before the step, and the nodes that tangents were taken from.

        Raises:
            SolverError: H is singular; on the host alone, see `failed`.
        """
        rate = 1.0 / s
        coefficient = rate * (rate + self.model.scene.mass_damping)
        if self.system is None or not rate:
            more = resisted[0].matrix(*resisted[1:], rate) if resisted else None
            self._on_host(solved, last, rate, coefficient, right, w, more)
            return
        system = self.system
        system.x, system.theta, system.frame = solved.x, solved.theta, solved.frame
        islands = system.islands
        islands.arrays[0].zero_()
        islands.coefficient.fill_(coefficient)
        islands.rate.fill_(rate)
        islands.unbalanced.fill_(1)  # every rod wants its matrix
        if resisted:
            resisted[0].resist(*resisted[1:], system, islands)
        system.evaluate(last)
        found = w
        if self._cast:
            wp.launch(self._cast[0], right.shape, [right, self.group.fixed], [self._right], device=system.device)
            right, found = self._right, self._found
        if self.reduction is None:
            islands.stale.zero_()  # frames are as they were in the step
            (system.x, system.theta), system.right, system.direction = self._moved, right, found
            arrays.copy(system.x, solved.x)
            arrays.copy(system.theta, solved.theta)
            system.eliminate()
        else:
            system.assemble_blocks()
            self.reduction.solve(system.blocks, right, self.group.count, self._wanted, found, islands.bad)
        if self._cast:
            wp.launch(self._cast[1], w.shape, [found], [w], device=system.device)

    def _on_host(self, solved, last, rate: float, coefficient: float, right: wp.array, w: wp.array, more) -> None:
        data = SimpleNamespace(x=solved.x, theta=solved.theta, frame=solved.frame, last=last)
        groups = [data if each is self.group else None for each in self.model.groups]
        factor = None if rate else solved.time
        b = arrays.download(right).astype(float).transpose(2, 1, 0).ravel()
        found = self.host(SimpleNamespace(groups=groups), rate, coefficient, factor, b, more)
        arrays.assign(w, self.tangent.blocks(found).transpose(2, 1, 0))
        held = self.host.held
        self.held = None if held is None else self.tangent.blocks(held).transpose(2, 1, 0)
