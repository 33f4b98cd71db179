"""A time step of a net: predictor, prescribed motion and loads, Newton, end update, retries. See `kernels.step`."""

from dataclasses import replace

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.integrate.energy import NetEnergy
from ddg_warp.integrate.net_prescribed import NetField, NetLoads, NetMotion
from ddg_warp.integrate.prescribed import jump_between
from ddg_warp.kernels import outcome, step
from ddg_warp.kernels.net import elements, frames, newton
from ddg_warp.linear.choice import net_preconditioner
from ddg_warp.net_model import NetState
from ddg_warp.net_newton import PRECONDITIONERS, NetNewton
from ddg_warp.tangent import Tangent


class NetStep:
    """Steps all worlds of a model's net; the same methods as `_ChainStep`."""

    def __init__(self, integrator, model, linear=None, counts_of=None):
        self.integrator, self.model, self.net = integrator, model, model.net
        host, device, real = model.net.host, model.wp_device, model.types.real
        options = integrator.options
        for name, value, only in (
            ("solver", integrator.solver, ("newton",)),
            ("linear", integrator.linear, ("auto", *PRECONDITIONERS)),
            ("psd", options.psd, ("auto",)),
        ):
            if value not in only:
                raise SceneError(f"{name} = {value!r} is of rods on their own; with a net it is {' or '.join(only)}")
        bare = np.flatnonzero(((host.mass <= 0.0) & ~host.fixed)[: host.nodes].any(1))
        if bare.size:
            raise SceneError(
                f"{Tangent(model).parts[-1].where(3 * int(bare[0]))} is free and has no mass; "
                "give the material a density, or the section a mass_per_length"
            )
        preconditioner = net_preconditioner(model.net) if integrator.linear == "auto" else integrator.linear
        self.newton = NetNewton(model, options, preconditioner, linear)
        self.midpoint = integrator.scheme == "implicit_midpoint"
        self._begin, self._finish = newton.step_kernels(real, self.midpoint)
        self._start, self._advance = step.start_kernel(real), step.advance_kernel(real)
        worlds = model.worlds
        self.progress, self.portion = (wp.zeros(worlds, dtype=real, device=device) for _ in range(2))
        self.cautious, self.retries, self.reason, self.moved = (
            wp.zeros(worlds, dtype=int, device=device) for _ in range(4)
        )
        self.middle = model.net.empty() if self.midpoint and model.net.edges else None
        self.remaining = wp.zeros(1, dtype=int, device=device)
        self.rounded = outcome.CONVERGED_TO_ROUNDING  # how solves that rounding ends are counted
        self.tally = wp.zeros(len(outcome.NAMES) + 1, dtype=wp.int64, device=device)
        self.work = wp.zeros(5, dtype=wp.int64, device=device)
        if counts_of is not None:
            self.tally, self.work, self.reason = counts_of.tally, counts_of.work, counts_of.reason
            self.newton.status, self.newton.pcg_work = counts_of.newton.status, counts_of.newton.pcg_work
        self.energy = NetEnergy(self, counts_of and counts_of.energy) if integrator.energy_bound else None
        self.damping = wp.array([model.scene.mass_damping], dtype=real, device=device)
        self.motion = NetMotion(model, self.midpoint) if host.moving else None
        self.loads, self.field = NetLoads(model, self.midpoint), NetField(model, self.midpoint)
        self._data = (self.motion.data if self.motion else {}) | self.field.data

    def prescribe(self, t0: float, t1: float) -> None:
        """Hand the device what supports and loads do between t0 and t1."""
        if self.motion:
            self.motion.upload(t0, t1)
        self.loads.upload(t0, t1)
        self.field.upload(t0, t1)

    def step(self, before, after) -> None:
        """Launch a whole step from one state to another; only launches, so that it can be captured."""
        self._launch(
            self._start,
            self.model.worlds,
            [self.newton.status],
            [self.progress, self.portion, self.cautious, self.retries],
        )
        self._attempt(before, after)
        wp.capture_while(self.remaining, lambda: self._attempt(after, after))

    def _attempt(self, before, after) -> None:
        """One solve of every world that has not finished the step."""
        solver, blocks = self.newton, self.net.blocks
        self._launch(
            self._begin,
            solver.all,
            [
                before.q,
                before.v,
                solver.held,
                solver.mass,
                self.integrator._dt,
                self.damping,
                self.newton.outer,
                self.progress,
            ]
            + [self.portion, self.cautious, blocks],
            [solver.q, solver.base, solver.target, solver.coefficient, solver.rate, solver.status, solver.iteration]
            + [
                solver.halvings,
                solver.unbalanced,
                solver.drowned,
                solver.load_scale,
                solver.projected,
                self.moved,
                solver.active,
            ],
        )
        start = self._start_frames(before)
        if self.motion:
            self.motion.apply(self.progress, self.portion, solver.q, start.frame)
        self.loads.apply(solver.q, solver.load)
        solver.solve(start)
        if self.energy:
            self.energy.judge(before, start)
        self._launch(
            self._finish,
            solver.all,
            [solver.q, before.q, before.v, solver.status, self.progress, solver.rate, blocks],
            [after.q, after.v, self.moved],
        )
        self.net.carry(start, after, kept=before, moved=self.moved)
        if self.motion:
            self.motion.turn(self.progress, self.portion, self.moved, before, after)
        self.field.finish(self.moved, before, after)
        self.net.update_strains(after)
        self.remaining.zero_()
        self._launch(
            self._advance,
            self.model.worlds,
            [solver.iteration, solver.lost, self.integrator.retry_limit, 0.5 ** (self.integrator.retry_limit // 2)]
            + [self.rounded],
            [solver.status, self.progress, self.portion, self.cautious, self.retries, self.reason]
            + [self.tally, self.work, self.remaining],
        )

    def _start_frames(self, before):
        """The state whose lagged data serve the solve: for the midpoint rule carried to the predicted midpoint.

        Frames lagged at the start of the step would spin about their edges by O(h) at the midpoint, unseen by the rotary
        inertia: the rule would be of first order. Rotations of joints have no inertia and are not predicted, so that those
        found are of the whole half step. Normals that supports turn, and the magnetic field, are those that the solve is about.
        """
        if not (self.midpoint and self.net.edges):
            return replace(before, data=self._data)
        middle = NetState(self.newton.q, before.v, self.middle.frame, self.middle.lag, before.last, self._data)
        self.net.carry(before, middle, moved=self.moved)
        return middle

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)

    def load_modules(self) -> None:
        """Compile and load every kernel before a capture."""
        real, device = self.model.types.real, self.model.wp_device
        kernels = [self._begin, self._finish, self._start, self._advance, *self.newton.kernels]
        kernels += [*(self.motion.kernels if self.motion else []), *self.loads.kernels, *self.field.kernels]
        kernels += self.energy.kernels if self.energy else []
        kernels += [frames.edge_kernel(real)] if self.net.edges else []
        kernels += [frames.reset_kernel(real)] if self.net.host.spins else []
        for part in self.net.sets:
            measure = part.term.measure
            if len(part.host.lag):
                kernels.append(frames.lag_kernel(measure, real))
            if part.term.density.lagged:
                kernels.append(elements.term_kernels(part.term, real)[3])
        arrays.load_kernels(kernels, device)

    def raise_failures(self, state) -> None:
        """Raise for worlds that were given up."""
        if not int(self.tally.numpy()[outcome.MAX_ITERATIONS :].sum()):
            return
        failed = np.flatnonzero(self.newton.status.numpy() == outcome.GIVEN_UP)
        if not failed.size:
            return
        world = int(failed[0])
        name = outcome.NAMES[int(self.reason.numpy()[world])]
        if self.energy and name == "energy_drift":
            what = self.energy.failure(world)
        else:
            sizes = np.abs(self.newton.right.numpy().reshape(self.model.worlds, -1))[world]
            part, dt = Tangent(self.model).parts[-1], self.integrator._dt_host
            jump = jump_between(self.model, state.time - dt, state.time)
            worst = int(np.argmax(np.where(np.isfinite(sizes), sizes, np.inf)))
            what = f"largest residual {sizes[worst]:.3g} N at {part.where(worst)}; "
            what += jump or "take a smaller dt, a looser rtol, or check its loads and supports"
        raise SolverError(
            f"the net (world {world}) could not be stepped to t = {state.time:g} s: {name} within "
            f"{self.integrator.retry_limit} retries, {what}",
            state=state,
            outcome=name,
        )
