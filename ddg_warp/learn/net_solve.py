"""The linear system of the reverse of a net, by what suits it."""

from functools import cached_property
from types import SimpleNamespace

import numpy as np
import warp as wp

from ddg_warp.compile.storage import FREE
from ddg_warp.errors import SolverError
from ddg_warp.kernels.adjoint.solve import chain_kernel
from ddg_warp.learn.solve import HostSolve
from ddg_warp.solve.net.exact import ExactSystem
from ddg_warp.solve.net.tangent import NetTangent


class NetSolve:
    """(H + c M - dL/dq)^T w = g: of steps on the device; of equilibria, whose loads L follow, by sparse factors on the host.

    Args:
        drag: `NetDragAdjoint`, None without drag.
        contact: `ExactContact`, which is where the solution of a step is; None without contact.
        steps: whether of steps.

    Attributes:
        system: `ExactSystem`; None of equilibria.
        failed: as of that; None of equilibria.
        held: of the last solve on the host, what loads that follow held dofs add to derivatives by these (W N,); None where none do.
    """

    def __init__(self, model, drag, contact, steps: bool):
        net = self.net = model.net
        self.model, self.drag = model, drag
        self.system = ExactSystem(model, drag and drag.inertia, contact) if steps else None
        self.failed = self.system and self.system.failed
        self.held = None
        self._rate = wp.zeros(net.worlds, dtype=net.real, device=net.device)
        self._chain = chain_kernel(net.real)
        self._left_out = self.system and self.system.bits(~net.host.fixed | _moved(net.host))

    @cached_property
    def tangent(self) -> NetTangent:
        """Of solves on the host."""
        return NetTangent(self.model, 0)

    @cached_property
    def _host(self) -> HostSolve:
        return HostSolve(self.tangent)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.system.kernels, self._chain] if self.system else []

    def __call__(
        self, state, rate: float, time: float, right: wp.array, w: wp.array, factors: bool = False, rubbing=None
    ) -> None:
        """Write w (W N,), zero at held dofs.

        Args:
            state: the solution with its lagged data and the strains of the last step.
            rate: of the implicit Euler step [1/s], zero for an equilibrium, of which `time` is the load parameter.
            right: g (W N,).
            factors: solve on the host, as conjugate gradients have failed.
            rubbing: what friction adds to H in an equilibrium (3 W N, 3 W N), see `ContactAdjoint.rubbing`; None without.

        Raises:
            SolverError: H is singular; on the host alone, see `failed`. Or it is of a step in contact, which
                the host knows not.
        """
        coefficient = rate * (rate + self.model.scene.mass_damping)
        if self.system and not factors:
            self._rate.fill_(rate)
            self.system.solve(state, coefficient, self._rate, right, w)
            return
        if self.system and self.system.contact:
            raise SolverError(
                "contact: conjugate gradients have not solved the reverse of the step: no gradient goes through it; take a smaller dt",
                outcome="no_gradient",
            )
        tangent, host = self.tangent, self._host
        more = self.drag.matrix if self.drag else None
        given = tangent.into(right.numpy().astype(float).ravel())
        found = host(SimpleNamespace(net=state), rate, coefficient, None if rate else time, given, more, rubbing)
        w.assign(tangent.back(found).reshape(-1, 3))
        if host.held is not None:
            self.held = wp.empty_like(w)
            self.held.assign(tangent.back(host.held).reshape(-1, 3))

    def chain(self, by_lagged: wp.array, by_q: wp.array) -> None:
        """Turn derivatives by a solution (W N,) into g of the solve that led to what it lags, by which they are `by_lagged`: zeroed."""
        wp.launch(
            self._chain, len(by_q), [self.system.fixed, self.net.blocks], [by_lagged, by_q], device=self.net.device
        )

    def stays(self, by_q: wp.array, out: wp.array) -> None:
        """Write the part of derivatives by held dofs (W N,) that goes to where a step starts: of those that no motion moves."""
        self.system.part(by_q, self._left_out, out)


def _moved(host) -> np.ndarray:
    """Which dofs of a world motions put in place (blocks, 3)."""
    moved = np.zeros((host.blocks, 3), bool)
    moved[host.moving[:, 0]] = host.moving[:, 1:] > FREE
    moved[host.turning[:, 0], 0] = True
    return moved
