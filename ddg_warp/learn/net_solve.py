"""The linear system of the reverse of a net, by what suits it."""

from types import SimpleNamespace

import numpy as np
import warp as wp

from ddg_warp.compile.storage import FREE
from ddg_warp.learn.solve import HostSolve
from ddg_warp.solve.net.exact import ExactSystem, suits
from ddg_warp.solve.net.tangent import NetTangent


class NetSolve:
    """(H + c M - dL/dq)^T w = g: of steps on the device or, without CUDA, by sparse factors where those are faster, see `suits`; of
    equilibria, whose loads L follow, by these.

    Args:
        drag: `NetDragAdjoint`, None without drag.

    Attributes:
        system: `ExactSystem`, which solves on the device; None where all is solved on the host.
        tangent: of solves on the host.
        held: of the last of these, what loads that follow held dofs add to derivatives by these (W N,); None where none do.
        failed: as of `ExactSystem`; None on the host.
    """

    def __init__(self, model, drag, steps: bool):
        net = self.net = model.net
        self.model, self.drag = model, drag
        self.system = ExactSystem(model, drag and drag.inertia) if steps and suits(net) else None
        self.failed = self.system and self.system.failed
        self._host, self.tangent, self.held = None, None, None
        self._rate = wp.zeros(net.worlds, dtype=net.real, device=net.device)
        left_out = ~net.host.fixed | _moved(net.host)
        if self.system:
            self._left_out = self.system.bits(left_out)
        else:
            self._unmoved = np.tile(~left_out.ravel(), net.worlds)
            self._on_host()

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return self.system.kernels if self.system else []

    def __call__(self, state, rate: float, time: float, right: wp.array, w: wp.array, factors: bool = False) -> None:
        """Write w (W N,), zero at held dofs.

        Args:
            state: the solution with its lagged data and the strains of the last step.
            rate: of the implicit Euler step [1/s], zero for an equilibrium, of which `time` is the load parameter.
            right: g (W N,).
            factors: solve on the host, as conjugate gradients have failed.

        Raises:
            SolverError: H is singular; on the host alone, see `failed`.
        """
        coefficient = rate * (rate + self.model.scene.mass_damping)
        if self.system and not factors:
            self._rate.fill_(rate)
            self.system.solve(state, coefficient, self._rate, right, w)
            return
        tangent = self._on_host()
        more = self.drag.matrix if self.drag else None
        given = tangent.into(right.numpy().astype(float).ravel())
        found = self._host(SimpleNamespace(net=state), rate, coefficient, None if rate else time, given, more)
        self._assign(w, found)
        self.held = None if self._host.held is None else self._assign(wp.empty_like(w), self._host.held)

    def stays(self, by_q: wp.array, out: wp.array) -> None:
        """Write the part of derivatives by held dofs (W N,) that goes to where the step starts: of those that no motion moves."""
        if self.system:
            self.system.part(by_q, self._left_out, out)
        else:
            values = self.tangent.into(by_q.numpy().astype(float).ravel())
            self._assign(out, np.where(self._unmoved, values, 0.0))

    def _on_host(self) -> NetTangent:
        if self._host is None:
            self.tangent = NetTangent(self.model, 0)
            self._host = HostSolve(self.tangent)
        return self.tangent

    def _assign(self, blocks: wp.array, values: np.ndarray) -> wp.array:
        blocks.assign(self.tangent.back(values).reshape(-1, 3))
        return blocks


def _moved(host) -> np.ndarray:
    """Which dofs of a world motions put in place (blocks, 3)."""
    moved = np.zeros((host.blocks, 3), bool)
    moved[host.moving[:, 0]] = host.moving[:, 1:] > FREE
    moved[host.turning[:, 0], 0] = True
    return moved
