"""Time step of the coupled system: predictor, prescribed motion, loads, Newton, retries. See `kernels.stepping.time_step`.

Why not shared with `ddg_warp.solve.stepping.rod_step`: phases and retries are, in `StepDriver`, and so are kernels over nodes.
Data of element sets, substeps of arcs, contact and decoupled steps exist in the coupled system alone.
"""

from dataclasses import replace

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.compile.precision import largest_carried
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.elements import coupled_frames, element_path
from ddg_warp.kernels.elements.coupled_element import coupled_storage
from ddg_warp.kernels.stepping import time_step
from ddg_warp.scene.edge_forces import HOLD, holds
from ddg_warp.solve.collision.support_arcs import Arcs
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.forces.control_loads import ControlledLoads, CoupledScale
from ddg_warp.solve.forces.force_list import forces_of
from ddg_warp.solve.forces.prescribed_element_data import CoupledField, CoupledMotion
from ddg_warp.solve.linear.solver_selection import coupled_preconditioner
from ddg_warp.solve.newton.coupled_newton import PRECONDITIONERS, CoupledNewton
from ddg_warp.solve.stepping.decoupled_step import DecoupledStep, is_decoupled, rods_of, uncoupled
from ddg_warp.solve.stepping.energy_drift import CoupledEnergy
from ddg_warp.solve.stepping.rigid_bodies import RigidBodyStep
from ddg_warp.solve.stepping.step_driver import USUAL, StepDriver
from ddg_warp.solve.stepping.warm_start import WarmStart
from ddg_warp.timers import timer

RUNS, TREES = 1, 2  # rebuilt before some steps: BVHs of rod culling alone, or all BVHs
# Steps between rebuilds of BVHs on CUDA, with refits in between; also the culling queries between rebuilds of the culling BVHs.
# Measured: rebuilding the broad-phase BVHs of 100 rods takes a tenth of a step without contact.
RENEWAL = 8


class CoupledStep(StepDriver):
    """Time step of a model's coupled system in all worlds, one island each. Arguments: see `RodStep`."""

    def __init__(self, integrator, model, means=USUAL, counts_of=None):
        self.coupled = model.coupled
        host, real = model.coupled.host, model.types.real
        options = integrator.options
        for name, value, only in (
            ("linear", integrator.linear, ("auto", *PRECONDITIONERS)),
            ("psd", options.psd, ("auto", "gauss_newton", "progressive", "none")),
        ):
            if value not in only:
                raise SceneError(
                    f"{name} = {value!r} is for uncoupled rods; with a coupled system it is {' or '.join(only)}"
                )
        bare = ((host.mass <= 0.0) & ~host.fixed)[: host.nodes].any(1)
        if host.coefficients:
            ends, _ = host.forced_edges
            bare[ends[holds(host.coefficients)]] = False
        bare = np.flatnonzero(bare)
        if bare.size:
            raise SceneError(f"{Tangent(model).parts[-1].where(3 * int(bare[0]))} is free and has no mass; {HOLD}")
        preconditioner = coupled_preconditioner(model.coupled) if integrator.linear == "auto" else integrator.linear
        reuse = integrator.solver == "projective"
        if options.psd == "auto" and means.stiff and not reuse:
            options = replace(options, psd="progressive")
        solver = CoupledNewton(model, options, preconditioner, means.linear, host.quadratic, reuse, means.mixed_axial)
        super().__init__(integrator, model, solver, means, counts_of)
        self.contact = solver.contact
        if counts_of is not None:
            self.newton.search_state.pcg_work = counts_of.newton.pcg_work
            if solver.contact:
                solver.contact.tally.go_on(counts_of.newton.contact.tally)
        if solver.contact:
            tally = solver.contact.search.counters.more[: len(self.tally)]
            wp.copy(tally, self.tally)
            self.tally = tally
        self._counts = [*self.islands.arrays, self.tally, self.work, self.newton.pcg_work]
        self._kept = [wp.zeros_like(array) for array in self._counts] if solver.contact else []
        self._foresight = WarmStart(solver)
        nodes, quadratic = model.coupled.nodes, host.quadratic
        self.inertia = solver.loading.mass.transpose((1, 0)) if quadratic else None
        self._begin = time_step.begin_kernel(nodes, real, self.midpoint)
        self._finish = time_step.finish_kernel(nodes, real, self.midpoint, quadratic, solver.contact is not None)
        if solver.contact and self.midpoint:
            raise SceneError(
                "contact: by the midpoint rule steps overshoot equilibrium and end in overlaps; use 'implicit_euler'"
            )
        if solver.user_forces and self.midpoint:
            raise SceneError("user-defined forces: the midpoint rule does not evaluate them; use 'implicit_euler'")
        self._lagged = model.coupled.lagged() if model.coupled.edges or host.rigid_bodies else None
        self._take = coupled_frames.take_kernel(real)
        self.motion = CoupledMotion(model, self.midpoint) if host.moves else None
        loads = None
        if (controls := integrator.given) is not None:
            scale = CoupledScale(model, self.coupled, solver)
            loads = ControlledLoads(model, self.coupled, self.midpoint, controls, scale)
        self.forces = forces_of(model, self.coupled, self.midpoint, loads)
        if solver.user_forces:
            self.forces.append(solver.user_forces)
        self.bodies = RigidBodyStep(solver, self.midpoint) if solver.rigid_bodies else None
        self.energy = CoupledEnergy(self, counts_of and counts_of.energy) if integrator.energy_bound else None
        self.arcs = self._resolve_arcs()
        self.field = CoupledField(model, self.midpoint, integrator.field)
        self._data = (self.motion.data if self.motion else {}) | self.field.data
        self.decoupled, self._groups = None, counts_of and counts_of._groups
        # steps since the last outside state; broad-phase and culling queries until the last rebuild of their BVHs
        self._since_renewal, self._sought = 0, (0, 0)

    def _resolve_arcs(self) -> Arcs | None:
        """Return the substep resolution of prescribed motions for contact; None if no surface is prescribed."""
        arcs = Arcs(self.model) if self.newton.contact and self.motion else None
        if not (arcs and arcs.moved):
            return None
        for parts in (self.islands.substep, self.islands.interval):
            parts.fill_(1.0)
        self.motion.resolve_grips([*arcs.of_grips, *self.islands.arrays, self.tally])
        return arcs

    def arrive(self) -> None:
        """Note that the next step begins from an outside state."""
        self._since_renewal = 0

    def outdated(self, anew: bool) -> int:
        """Return the BVHs to rebuild before a step, see `renew`: BVHs used since the last rebuild, every `RENEWAL` steps or
        queries.
        """
        if self.newton.contact is None or self.model.wp_device.is_cpu:
            return 0  # on the CPU every search makes its own
        due = anew or self._since_renewal % RENEWAL == 0
        fresh = anew or self._since_renewal == 0
        self._since_renewal += 1
        (searches, looks), before = self.newton.contact.search.counters.sought, self._sought
        if due and (fresh or searches != before[0]):
            self._sought = searches, looks
            return TREES
        if looks - before[1] >= RENEWAL:
            self._sought = before[0], looks
            return RUNS
        return 0

    def renew(self, before, level: int) -> None:
        """Rebuild all BVHs from a state for `TREES`, or the culling BVHs alone for `RUNS`; launches only."""
        if level == TREES:
            self.newton.contact.renew(before.q)
        if self.decoupled:
            self.decoupled.renew()

    def step(self, before, after) -> None:
        """Launch a whole step from one state to another."""
        if self.decoupled is None or self.coupled.worlds > 1:
            self._keep()
        if len(before.rate):
            wp.copy(after.rate, before.rate)
        if self.decoupled is None:
            super().step(before, after)
            return
        self.decoupled.step(before, after)

    def _keep(self) -> None:
        """Save the counts before a step that may be repeated."""
        if not self.newton.contact:
            return
        for kept, array in zip(self._kept, self._counts, strict=True):
            wp.copy(kept, array)
        self.newton.contact.tally.begin()

    def go_on(self, before, after) -> None:
        """Step the worlds that `decoupled` left to the coupled system; finished worlds stay unchanged."""
        if self.coupled.worlds == 1:  # nothing is counted yet
            self._keep()
        else:
            self.integrator._worlds.take_part(self.decoupled.left, before, after, self.coupled.worlds)
            wp.copy(self.newton.iterates.q, after.q)
            before = after
        self._try(before, after)
        wp.capture_while(self.remaining, lambda: self._try(after, after))

    def prescribe(self, t0: float, t1: float) -> None:
        """Upload supports, loads, magnetic field and flow between t0 and t1."""
        super().prescribe(t0, t1)
        if self.decoupled:
            self.decoupled.prescribe(t0, t1)
        if self.arcs:
            self._cut(self.arcs.levels(t0, t1), t0, t1)

    def _cut(self, levels: np.ndarray, t0: float, t1: float) -> None:
        """Divide the step into 2^levels substeps (worlds,); grips may require shorter ones."""
        if not (levels.any() or self.motion.levels.any()):
            return
        if self.motion.divide(levels, t0, t1):
            for rod_step in self._rods:
                if rod_step.motion:
                    rod_step.motion.go_by(self.motion)
            self.integrator._graphs.clear()
        self.islands.interval.assign(0.5**levels)
        self.islands.substep.assign(0.5**levels)

    def load_modules(self) -> None:
        """Compile and load every kernel before a capture."""
        super().load_modules()
        if self.decoupled is None:
            return
        device_arrays.load_kernels(self.decoupled.kernels, self.model.wp_device)
        for rod_step in self._rods:
            rod_step.load_modules()
        if self.coupled.worlds > 1:
            self.integrator._worlds.load_modules()

    @property
    def _rods(self) -> list:
        """Uncoupled steps of the rods; empty without `decoupled`."""
        return self.decoupled.rod_steps if self.decoupled else []

    def adapt(self, s: float, parameters_changed: bool = False) -> bool:
        """Select uncoupled stepping of rods out of contact, and solvers for s [s]; return True if the selection changed.

        `parameters_changed`: see `StepDriver.choose_solver`.
        """
        before = self.decoupled
        if not (uncoupled(self.model) and is_decoupled(self.integrator)):
            self.decoupled = None
        elif self.decoupled is None:
            self._groups = self._groups or rods_of(self.model)
            self.decoupled = DecoupledStep(self, self._groups)
        return self.decoupled is not before or (
            self.decoupled is not None and self.decoupled.adapt(s, parameters_changed)
        )

    @timer("capacity check")
    def has_overflow(self, before) -> bool:
        """Return True if the last step, from the state `before`, overflowed the pair lists and must be repeated.

        The lists are then enlarged, and all counts restored. Reads from the device with contact.
        """
        if self.newton.contact is None or not self.newton.contact.has_overflow(before.q):
            return False
        for kept, array in zip(self._kept, self._counts, strict=True):
            wp.copy(array, kept)
        return True

    def _counted(self) -> np.ndarray:
        """`tally` after the last step; with contact, as read by `has_overflow`."""
        contact = self.newton.contact
        return contact.search.counters.more_read[: len(self.tally)] if contact else super()._counted()

    def predict(self, before):
        """Launch the predictor, with supports at their prescribed positions; return the state of `_start_frames`."""
        coupled, solver, islands = self.coupled, self.newton, self.islands
        iterates, system, points = solver.iterates, solver.system, coupled.points
        if self.contact:
            self.contact.brace(self.integrator._dt, islands)
        wp.launch(
            self._begin,
            coupled.node_threads,
            [coupled.node_state(before), None, coupled.common(system.masks.kept), coupled.count, coupled.world]
            + [self.integrator._dt, self.damping, solver.loading.scale, *islands.arrays],
            [points(iterates.q), None, None, points(iterates.base), points(iterates.target), None],
            device=self.model.wp_device,
        )
        if self.motion:
            self.motion.place(islands, iterates.q)
        if self.bodies:
            self.bodies.predict(before)
        if solver.edge_rotations:
            solver.edge_rotations.predict(before.v, not self.midpoint, iterates, system, islands)
        start = self._start_frames(before)
        if self.motion:
            self.motion.direct(islands, iterates.q, start.frame)
        if self.bodies and self.contact:
            self.bodies.depart(before)
        return start

    def warm_start(self, before) -> None:
        """Warm-start from the predictor by the last correction, and store the start."""
        self._foresight.start(before)
        if self.bodies:
            self.newton.rigid_bodies.place(self.newton.iterates, self.islands)

    def solve(self, start) -> None:
        """Launch Newton's method."""
        self.newton.solve(start)

    def finish(self, before, after) -> None:
        """Launch positions and rates at the end of accepted substeps."""
        coupled, points, q = self.coupled, self.coupled.points, self.newton.iterates.q
        self._foresight.weigh(before)
        rate = self.contact.terms.law.rate if self.contact else after.rate
        wp.launch(
            self._finish,
            coupled.node_threads,
            [points(q), None, coupled.node_state(before), points(before.a), None]
            + [points(self._foresight.predicted), None, self._foresight.trust, rate]
            + [coupled.mass.transpose((1, 0)), None, self.inertia, coupled.count]
            + self.islands.arrays,
            [coupled.node_state(after), points(after.a), None, after.rate],
            device=self.model.wp_device,
        )
        if self.bodies:
            self.bodies.finish(before, after)

    def complete(self, start, before, after) -> None:
        """Update frames, magnetic field and strains to the positions."""
        accepted = self.islands.substep_accepted
        self.coupled.carry(start, after, kept=before, moved=accepted)
        if self.motion:
            self.motion.turn(self.islands, before, after)
        self.field.finish(accepted, before, after)
        self.coupled.update_strains(after)

    def _start_frames(self, before):
        """Return the state with the time-lagged data of the solve, carried to the predicted midpoint for the midpoint rule.

        Frames lagged at the start of the step would spin about their edges by O(h) at the midpoint, unseen by the rotary inertia:
        the rule would be of first order. Joint rotations have no inertia and are not predicted: the solve finds their change over
        the whole half step. Rotating support normals and the magnetic field belong to the solve. Finished worlds keep the frames of
        their solve, from which gradients detect a frame update.
        """
        if self._lagged is None:
            return replace(before, data=self._data)
        frame, lag = self._lagged
        iterate = {"q": self.newton.iterates.q, "frame": frame, "lag": lag, "data": self._data}
        start = replace(before, **iterate)
        if self.midpoint:
            if self.bodies:
                self.bodies.turn(before)
            self.coupled.carry(before, start, kept=start, moved=self.islands.substep_accepted)
            return start
        inputs = [self.islands.substep_accepted, self.coupled.edges, before.frame]
        edges = self.coupled.edges and frame.shape[1]
        wp.launch(self._take, edges, inputs, [frame], device=self.model.wp_device)
        for part, target, source in zip(self.coupled.sets, lag, before.lag, strict=True):
            if part.term.measure.advance:
                wp.copy(target, source)
        if self.bodies:
            self.bodies.turn_ghosts(before, start)
        return start

    @property
    def own_kernels(self) -> list:
        """Kernels of an attempt, without the solver's."""
        real, coupled = self.model.types.real, self.coupled
        kernels = [self._begin, self._finish, self._take, *([] if self.midpoint else self._foresight.kernels)]
        kernels += self.bodies.kernels if self.bodies else []
        for part in coupled.sets:
            if part.term.density.lagged:
                kernels.append(element_path.strain_kernel(coupled_storage(part.term, real), real))
        return kernels

    @property
    def stiffness_version(self) -> int:
        """Version of the stiffnesses behind `limits` and float32 errors; zero for the stiffnesses of the scene."""
        return self.coupled.version

    def float32_errors(self, s: float) -> np.ndarray:
        """Return the largest float32 error of a rod (1,); see `precision.float32_error`."""
        return self.coupled.rod_errors(s).max(initial=0.0, keepdims=True)

    def split_errors(self, s: float) -> np.ndarray:
        """Return float32 errors over s [s] in the mixed axial-force formulation; infinite if unavailable."""
        substructuring = self.newton.substructuring
        if not (substructuring and substructuring.allows_mixed_axial) or self.newton.frozen:
            return super().split_errors(s)
        return self.coupled.split_errors(s).max(initial=0.0, keepdims=True)

    def limit(self, s: float) -> None:
        """Set the limits of the islands for solves over s [s]."""
        super().limit(s)
        for rod_step in self._rods:
            rod_step.limit(s)

    def _find_limits(self, s: float) -> dict[str, np.ndarray]:
        """Return the limits of islands by name, with the largest edge stiffness that float32 carries for the softest rod."""
        limits = super()._find_limits(s)
        if any(self.newton.elements.mixed_axial):
            softest = self.coupled.rod_stiffnesses(s)[2].min()
            limits["max_edge_stiffness"] = np.full(len(self.islands), largest_carried(softest))
        return limits

    def island_label(self, world: int) -> str:
        """Return the label of the coupled system of a world."""
        return f"the coupled system (world {world})"

    def rods_of(self, worlds: np.ndarray) -> list[int]:
        """Return an empty list: a failure belongs to no single rod."""
        return []

    def failure(self, state, island: int) -> tuple[str, str]:
        """Return the outcome of a failed island, and the message."""
        if int(self.islands.failure_status.numpy()[island]) == outcome.ROTATED_TOO_FAR:
            return outcome.NAMES[outcome.ROTATED_TOO_FAR], self.arcs.failure(island)
        return super().failure(state, island)

    def where(self, state, world: int) -> str:
        """Return the location of the largest residual, and the remedy."""
        sizes = np.abs(self.newton.system.rhs.numpy().reshape(self.model.worlds, -1))[world]
        worst = int(np.argmax(np.where(np.isfinite(sizes), sizes, np.inf)))
        place = Tangent(self.model).parts[-1].where(worst)
        return f"largest residual {sizes[worst]:.3g} N at {place}; {self._remedy(state, world)}"

    def _remedy(self, state, world: int) -> str:
        """Return the remedy for a failed world: degenerate edges of its last good state, or advice."""
        x = state.coupled.q.numpy().reshape(self.model.worlds, -1, 3)[world]
        dead_ends = (
            self.dead_end(x[r.all_nodes], r.first, r.piece.kind, f" of rod {r.rod}") for r in self.coupled.host.rods
        )
        return next(filter(None, dead_ends), "") or self._tightest(state, world)

    def _tightest(self, state, world: int) -> str:
        """Return the closest pair of the last good state as a possible cause, with its remedy; and advice.

        Without room, or with a motion that drives two prescribed bodies into each other, a smaller dt or a looser rtol does not
        help.
        """
        if not self.newton.contact:
            return self.advice(state)
        reason = int(self.islands.failure_status.numpy()[world])
        begin = state.time - self.integrator._dt_host
        message = self.newton.contact.diagnosis.blocked(Tangent(self.model), state, begin, state.time)
        message = message or self.newton.contact.diagnosis.closest_pair(state.coupled.q, reason)
        helped = message.endswith(", ")
        return message + ("or check its loads and supports" if helped else self.advice(state))
