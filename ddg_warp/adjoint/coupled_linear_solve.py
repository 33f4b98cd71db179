"""Adjoint linear solve of the coupled system."""

from functools import cached_property
from types import SimpleNamespace

import numpy as np
import warp as wp

from ddg_warp.adjoint.linear_solve import HostSolve
from ddg_warp.compile.dof_map import FREE
from ddg_warp.errors import SolverError
from ddg_warp.kernels.adjoint.coupled_linear_solve import chain_rule_kernel
from ddg_warp.solve.equilibrium.coupled_tangent import CoupledTangent
from ddg_warp.solve.linear.exact_system import ExactSystem
from ddg_warp.solve.linear.linear_system import mask


class CoupledLinearSolve:
    """Solver of (H + c M - dL/dq)^T w = g, on the device for steps, on the host for equilibria.

    Host solves use sparse factors; dL/dq is the load stiffness of equilibria.

    Args:
        quadratic: adjoint of the force with a quadratic potential, see `adjoint.forces`; None without.
        contact: `ExactContact`, evaluated at the solution of a step; None without contact.
        steps: True for steps.
        user_forces: `UserForces` at the solution; None without.

    Attributes:
        system: `ExactSystem`; None for equilibria.
        failed: failure flags of `system`; None for equilibria.
        held: of the last host solve, the load-stiffness term of the gradient by fixed dofs (W N,); None without follower loads.
    """

    def __init__(self, model, quadratic, contact, steps: bool, user_forces=None):
        coupled = self.coupled = model.coupled
        self.model, self._quadratic, self._user_forces = model, quadratic, user_forces
        inertia = quadratic and quadratic.inertia
        self.system = ExactSystem(model, inertia, contact, user_forces) if steps else None
        self.failed = self.system and self.system.failed
        self.held = None
        self._rate = wp.zeros(coupled.worlds, dtype=coupled.real, device=coupled.device)
        self._chain = chain_rule_kernel(coupled.real)
        left_out = mask(~coupled.host.fixed | _moved(coupled.host))
        self._left_out = wp.array(left_out, dtype=wp.uint8, device=coupled.device)

    @cached_property
    def tangent(self) -> CoupledTangent:
        """Tangent of host solves."""
        return CoupledTangent(self.model, 0)

    @cached_property
    def _host(self) -> HostSolve:
        return HostSolve(self.tangent)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.system.kernels, self._chain] if self.system else []

    def __call__(
        self, state, rate: float, time: float, rhs: wp.array, w: wp.array, factors: bool = False, friction_jacobian=None
    ) -> None:
        """Write w (W N,), zero at fixed dofs.

        Args:
            state: the solution with its lagged data and the strains of the last step.
            rate: inverse step of implicit Euler [1/s], zero for an equilibrium with the load parameter `time`.
            rhs: g (W N,).
            factors: True to solve on the host, after conjugate gradients have failed.
            friction_jacobian: friction term of H in an equilibrium (3 W N, 3 W N), see `ContactAdjoint.friction_jacobian`; None
                without.

        Raises:
            SolverError: H is singular (host only; see `failed`), or the host is to solve a step in contact or with rigid bodies,
                which it cannot.
        """
        coefficient = rate * (rate + self.model.scene.mass_damping)
        if self.system and not factors:
            self._rate.fill_(rate)
            self.system.solve(state, coefficient, self._rate, rhs, w)
            return
        if self.system and (self.system.contact or self.system.rigid_bodies):
            part = "contact" if self.system.contact else "rigid bodies"
            raise SolverError(
                f"{part}: conjugate gradients have not solved the reverse of the step: no gradient goes through it; take a smaller dt",
                outcome="no_gradient",
            )
        tangent, host = self.tangent, self._host
        more = self._quadratic.matrix if self._quadratic else None
        if self._user_forces and rate:  # the tangent of an equilibrium has their stiffness
            friction_jacobian = self._user_forces.matrix()
        rhs = tangent.into(rhs.numpy().astype(float).ravel())
        solution = host(
            SimpleNamespace(coupled=state), rate, coefficient, None if rate else time, rhs, more, friction_jacobian
        )
        w.assign(tangent.back(solution).reshape(-1, 3))
        if host.held is not None:
            self.held = wp.empty_like(w)
            self.held.assign(tangent.back(host.held).reshape(-1, 3))

    def vjp_by_lagged(self, by_lagged: wp.array, grad_q: wp.array) -> None:
        """Overwrite free entries of `grad_q` (W N,) with the gradient `by_lagged`, and add `by_lagged` to its fixed entries.

        The result is the right-hand side g of the friction iteration before; `by_lagged` is zeroed.
        """
        wp.launch(
            self._chain,
            len(grad_q),
            [self.system.system.masks.fixed, self.coupled.blocks],
            [by_lagged, grad_q],
            device=self.coupled.device,
        )

    def stays(self, grad_q: wp.array, out: wp.array) -> None:
        """Write the entries of a gradient by fixed dofs (W N,) that belong to the start of a step: dofs without prescribed motion."""
        self.system.part(grad_q, self._left_out, out)


def _moved(host) -> np.ndarray:
    """Return the dofs of a world with prescribed motion (blocks, 3)."""
    moved = np.zeros((host.blocks, 3), bool)
    moved[host.moving[:, 0]] = host.moving[:, 1:] > FREE
    moved[host.turning[:, 0], 0] = True
    return moved
