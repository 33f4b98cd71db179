"""Equilibria of large coupled systems: static Newton with PCG on the device, without factorisation.

The loop is the loop of a time step without inertia: energies decrease. The matrix is the Gauss-Newton matrix with the geometric
stiffness; in contact it has exact second derivatives, as in a time step. Follower loads act on every iterate and do their mean work
along a step. Their load stiffness is left out of the matrix, which costs iterations and no accuracy. PCG sees no pivots, so that a
saddle without a perturbation passes for a minimum; `ddg_warp.solve.equilibrium.stability` tests.

Friction is the friction of a quasi-static time step as long as the increment of the load parameter. It acts against slips since the
previous equilibrium; sticking contacts creep by less than `velocity` times the increment. Normal forces are lagged, at first from the
previous equilibrium, and updated until the equilibrium is consistent with its own. Slips may stem from the normal forces of a smaller
load; then these are updated after every iteration. Oscillation of this fixed point is damped by Aitken relaxation. Once updates are
small, `polish` finishes.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SolverError
from ddg_warp.geometry import polyline
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.newton import coupled_newton
from ddg_warp.model.state import Sliding, State
from ddg_warp.solve.collision.support_arcs import Arcs
from ddg_warp.solve.equilibrium.friction_newton import FrictionNewton
from ddg_warp.solve.equilibrium.support_checks import adrift
from ddg_warp.solve.forces.loads import StaticLoads
from ddg_warp.solve.linear.solver_selection import coupled_preconditioner, large_static
from ddg_warp.solve.newton.coupled_newton import CoupledNewton
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.stepping.graph_cache import Graphs

FORCING = 1e-4  # forcing term of directions: Gauss-Newton errs by more
ADRIFT = 1e3  # sizes of the system: displacement of a body that drifts away
FAR = 4.0  # rotation of a direction over the step cap at which PCG stops
POLISH = 2  # iterations of a solve that begins below the rounding floor, at most
LEAST, LEAP = 0.1, 10.0  # Aitken relaxation: smallest factor; largest growth of an update
# Iterations between updates of normal forces. Too small ones let sticking contacts slide far: `wary` solves update each time. In a
# settling pile, bodies lose contact for an iteration and friction of others carries them far: several are needed.
LAGGED = 5
NEAR = 0.01  # activation distances: displacement over which normal forces hardly change
TRIED = 4  # solves after which the monolithic friction Newton is tried from any iterate
STUCK = 30  # iterations in which new contacts stick, at most
SETTLED = 1e-4  # settled: residual over the sum of loads
UNSETTLED = "unsettled"  # outcome: no balance with the friction of the state


class StaticNewton(CoupledNewton):
    """`CoupledNewton` without inertia, in the precision of the state: no mass bounds the condition number."""

    banded = False  # products with fixed dofs are needed, too
    keeps_levels = False  # without inertia, matrices of one solve have little in common

    def __init__(self, model, options: NewtonOptions):
        super().__init__(model, options, coupled_preconditioner(model.coupled), model.types.real)
        self._whole = False  # True if directions are not cut at FAR step caps
        self.loading.gravity.zero_()  # gravity is a load like others: `begin` scales all
        self.loads = StaticLoads(model, self.coupled, midpoint=False) if self.coupled.host.followers else None
        self._base_force, self._before = wp.zeros_like(self.loading.force), wp.zeros_like(self.iterates.q)
        self.islands.substep_accepted.fill_(1)
        self._follow, self._less, self._far = coupled_newton.static_kernels(self.coupled.real, self.linear)
        if self.contact and self.rigid_bodies:
            self.rigid_bodies.resist()
        self.has_friction = self.contact is not None and self.contact.has_friction
        if self.has_friction:  # not the rate of strain-rate damping, which acts at rest
            self.contact.rate = wp.zeros_like(self.islands.inverse_step)
            self.slid = wp.zeros_like(self.iterates.q)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, self._follow, self._less, self._far, *(self.loads.kernels if self.loads else [])]

    def begin(
        self,
        q: np.ndarray,
        dead: np.ndarray,
        load_factor: float,
        scale: np.ndarray,
        before: np.ndarray | None = None,
        slid: np.ndarray | None = None,
        rate: float = 0.0,
        rotation: wp.array | None = None,
    ) -> None:
        """Start from dofs `q` under dead loads (worlds, 3 blocks) and follower loads at `load_factor`, given load scales of bodies.

        In contact, q is the proposed motion from dofs `before`. Friction counts slips from blocks `slid` over `rate`; zero means no
        friction. Rotations of rigid bodies count from orientations `rotation`.
        """
        for name in (
            "status",
            "iteration",
            "backtracks",
            "not_converged",
            "below_rounding_floor",
            "drop_compression",
            "frames_outdated",
        ):
            getattr(self.islands, name).zero_()
        self.iterates.q.assign(q.reshape(-1, 3))
        self.iterates.base.assign((q if before is None else before).reshape(-1, 3))
        if self.contact:
            wp.copy(self._before, self.iterates.base)
            self.contact.pending.clear(self.iterates, self.islands)
        if self.has_friction:
            self.contact.rate.fill_(rate)
            if slid is not None:
                self.slid.assign(slid)
        if self.rigid_bodies:
            dead = dead.reshape(self.coupled.worlds, -1, 3).copy()
            self.rigid_bodies.begin_statics(rotation, dead)
        for force in (self.loading.force, self._base_force):
            force.assign(dead.reshape(-1, 3))
        if self.user_forces:
            self.user_forces.upload(load_factor, load_factor)
            self.user_forces.start_at(self.iterates.q)
        if self.loads:
            self.loads.scale(dead.reshape(self.coupled.worlds, -1, 3), load_factor)
        wp.copy(self.islands.load_scale, self.tolerances.assign(scale.reshape(self.coupled.worlds, -1)))
        self.islands.any_active.fill_(1)

    def balance(self) -> None:
        """Assemble residuals under the loads on the iterate, which do their mean work along a step."""
        iterates, force, coupled = self.iterates, self.loading.force, self.coupled
        if self.loads:
            for q, load in ((iterates.proposed, force), (iterates.base, self._base_force)):
                self.loads.apply(coupled.points(q), coupled.points(load), coupled.angles(load))
        super().balance()
        if self.loads:
            inputs = [iterates.proposed, iterates.base, force, self._base_force, self.islands.status, coupled.blocks]
            wp.launch(self._follow, len(force), inputs, [self.norms.change], device=coupled.device)

    def search(self, state, again: bool = False) -> None:
        """Solve from the start of `begin`, with the lagged data of `state`. With `again`, slips continue. Can be captured."""
        if self.contact:
            self.contact.renew(self._before)
            if self.rigid_bodies:
                self.rigid_bodies.place(self.iterates, self.islands)
            self.contact.place(self.iterates, self.system, self.islands)
            self.contact.lag(self._before, again)
            if self.has_friction:
                wp.copy(self.contact.terms.start, self.slid)
        self.solve(state)

    def has_overflow(self) -> bool:
        """Return True if lists of pairs overflowed: the solve repeats with larger lists or shorter motions. Reads from the device.

        Without inertia a free body moves without bound, past all others. Motions of time steps are bounded.
        """
        return self.contact is not None and self.contact.has_overflow(self._before, spare=True)

    def after_cycle(self) -> None:
        """Stop PCG where the direction exceeds `FAR` step caps, since directions grow with every iteration.

        (Steihaug, SIAM J. Numer. Anal. 20, 1983.) Otherwise the first direction of a flat sheet, against bending alone, costs the
        most.
        """
        if self._whole:
            return
        self.measure_rotation()
        if self.planes:
            self.planes.into(self.system.direction, self.system.wanted)
        inputs = [self.search_state.rotation, FAR * self.options.rotation_cap]
        wp.launch(self._far, self.coupled.worlds, inputs, [self.system.wanted], device=self.coupled.device)

    def follow(self, state, step: wp.array) -> None:
        """Compute the direction of free dofs for a `step` of fixed dofs, H d = r - H step, in worlds that need it."""
        if self.sleeping:
            self.sleeping.wake(self.search_state, self.system, self.islands)
        if self.contact:
            self.contact.see(self._before)
            self.contact.lag(self._before)
        self.evaluate(state)
        self.balance()
        if self.sleeping:
            self.sleeping.leave(self.contact.terms.products, self.system)
        self.assemble()
        self.krylov.multiply_matrix(self.system, step)
        rhs = self.system.rhs
        wp.launch(self._less, len(rhs), [self.krylov.product], [rhs], device=self.coupled.device)
        self._whole = True
        self.direct()
        self._whole = False


class AitkenRelaxation:
    """Aitken relaxation of a fixed point, at most 1, with bounded growth (Irons and Tuck, Int. J. Numer. Meth. Eng. 1, 1969, 275).

    A body that only friction supports has no stiffness while all its contacts slide, under normal forces that are not yet consistent.
    """

    def __init__(self, worlds: int):
        self._part, self._last = np.ones(worlds), np.zeros((worlds, 0))

    def __call__(self, increment: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Return the relaxation factor (worlds,) of an increment (worlds, n); 1 where it is to be `whole`, which restarts the
        relaxation.
        """
        if self._last.size:
            size, last = (np.sqrt((each**2).sum(1)) for each in (increment, self._last))
            change = increment - self._last
            square = (change**2).sum(1)
            with np.errstate(divide="ignore", invalid="ignore"):
                factor = -self._part * (self._last * change).sum(1) / square
                factor = np.minimum(
                    np.where(factor > 0.0, np.clip(factor, LEAST, 1.0), 1.0), LEAP * self._part * last / size
                )
            self._part = np.where(whole | (last == 0.0) | (size == 0.0), 1.0, factor)
        self._last = np.where(whole[:, None], 0.0, increment)
        return self._part


class CoupledEquilibrium:
    """Equilibria of a model with a coupled system alone, for `Equilibrium`, whose tangent and load scale it uses.

    Attributes:
        wary: True if slipped contacts are solved again with normal forces updated after every iteration.
        polish: monolithic friction Newton; None without friction, or where factors are too large.
    """

    def __init__(self, owner):
        model, options, contact_parameters = owner.model, owner.options, owner.model.coupled.host.contact_parameters
        self.owner, self.model, self.coupled, self.tangent = owner, model, model.coupled, owner.tangent
        self.newton = StaticNewton(
            model,
            NewtonOptions(
                rtol=options.rtol,
                floor_factor=options.floor_factor,
                max_iterations=options.max_iterations,
                rotation_cap=options.rotation_cap,
                linear_rtol=FORCING,
                psd="progressive" if contact_parameters or model.coupled.user_forces else "gauss_newton",
            ),
        )
        self._carried = self.tangent.parts[-1].carried
        self.arcs = Arcs(model) if contact_parameters and model.motions else None
        self._rest = self.tangent.dofs(model.state())
        self._size = float(np.ptp(model.coupled.host.rest[: model.coupled.host.nodes], axis=0).max())
        self._start = model.coupled.empty()  # lagged data of a solve
        self._step = wp.zeros_like(self.newton.system.rhs)
        self._graphs = Graphs(model, lambda: device_arrays.load_kernels(self.newton.kernels, model.wp_device))
        self.wary = True
        self.polish = None
        if self.newton.has_friction and not large_static(model) and not self._carried:
            self.polish = FrictionNewton(model, owner.residuals, self.share, self.newton.contact.search.search_distance)
        self._least, self._active_pairs, self._friction_work = math.inf, [], 0.0

    def pcg_iterations(self) -> int:
        """Return the number of PCG iterations so far, without the iterations of `following`."""
        return self.newton.pcg_iterations()

    def count(self, state: State, increment: float) -> None:
        """Count contacts of an equilibrium, and its friction work over the time `increment`."""
        touch = self.model.touch
        touch.evaluate(state.coupled.q)
        gap = float(touch.terms.gap.numpy().min())
        self._least = min(self._least, gap if gap < touch.search.search_distance else math.inf)
        self._active_pairs.append(int(touch.terms.active_pairs.numpy().sum()))
        if self.newton.has_friction:
            touch.evaluate_friction(state.coupled.q, state.slip_velocity)
            self._friction_work += increment * float(touch.terms.dissipated.numpy().sum())

    def contact_statistics(self) -> dict:
        """Return statistics of the counted equilibria, as `ContactStatistics.statistics`.

        Without interpenetrations: iterates do not lead to an equilibrium along a straight motion.
        """
        pairs = self._active_pairs or [0]
        result = {
            "searches": int(self.newton.contact.search.counters.searches.numpy()[0]),
            "smallest_gap": self._least,
            "contacts": {"mean": float(np.mean(pairs)), "last": pairs[-1]},
        }
        return result | ({"friction_work": self._friction_work} if self.newton.has_friction else {})

    def following(self, state: State, step: np.ndarray, load_factor: float) -> np.ndarray | None:
        """Return the tangent displacement of free dofs for a `step` (size,) of fixed dofs; None if there is no answer."""

        def begin():
            self._begin(state, load_factor)
            system = self.newton.system
            system.wanted.fill_(1)
            system.forcing.fill_(FORCING)
            system.goal.fill_(math.inf)

        self._step.assign(step.reshape(-1, 3))
        self._replay("follow", begin, lambda: self.newton.follow(self._start, self._step))
        direction = self.newton.system.direction.numpy().astype(np.float64).ravel()
        return direction if np.isfinite(direction).all() else None

    def solve(self, state: State, load_factor: float, before: State, increment: float) -> State:
        """Return the equilibrium at `load_factor` from a state with the supports in position.

        In contact, bodies move there from the state `before`, as far as CCD allows; with friction in the time `increment`.

        Raises:
            SolverError: no equilibrium was found; names the outcome.
        """
        if self.newton.has_friction and self._untouched(before):
            with suppress(SolverError):  # contacts that can not stick
                equilibrium, certain = self._search(state, load_factor, before, increment, sticking=True)
                if certain:
                    return equilibrium
        try:
            equilibrium, certain = self._search(state, load_factor, before, increment)
        except SolverError:
            if not (self.newton.has_friction and self.wary):
                raise
        else:
            if certain or not self.wary:
                return equilibrium
        return self._search(state, load_factor, before, increment, warily=True)[0]

    def _search(
        self,
        state: State,
        load_factor: float,
        before: State,
        increment: float,
        warily: bool = False,
        sticking: bool = False,
    ) -> tuple[State, bool]:
        """Search the equilibrium of `solve`.

        Args:
            `warily`: True to update normal forces after every iteration.
            sticking: True if new contacts stick at first, until their normal forces are known.

        Returns:
            The equilibrium; and True if the history of normal forces does not matter. That is: forces balance with friction of
            consistent normal forces, to more than the rounding floor, and all contacts stick, or nodes have hardly moved.
        """
        state, owner, first = state.copy(), self.owner, before
        has_friction, rate = self.newton.has_friction, 1.0 / increment if self.newton.has_friction else 0.0
        repeats = self.coupled.edges or self.model.motions  # test the result with its own frames and support forces
        start = self.tangent.dofs(state)
        relaxation, settled = (
            AitkenRelaxation(self.coupled.worlds) if has_friction else None,
            np.zeros(self.coupled.worlds, bool),
        )
        if has_friction:
            loads = np.where(self.tangent.angle, 0.0, self.tangent.loads(load_factor, start)).reshape(
                self.coupled.worlds, -1
            )
            self.newton.contact.terms.more.assign(sticking * np.abs(loads).sum(1))
        later = 0  # next solve to polish
        for solves in range(owner.options.max_iterations if has_friction else 1 + bool(repeats)):
            on = solves > 0 and has_friction
            if on and not self.arrived:
                state = state.copy()
                self.tangent.assign(state, np.where(self.tangent.free, self.tangent.dofs(state), start))
            name = "slide on" if on else "solve"
            if has_friction:
                often = warily or sticking
                self.newton.options = replace(self.newton.options, max_iterations=1 if often else LAGGED)
                name += " warily" if often else ""
            self._replay(
                name,
                partial(
                    self._begin, state, load_factor, before, self._slid(first, state) if has_friction else None, rate
                ),
                partial(self.newton.search, self._start, on),
            )
            before, iterations, ends = state, self.newton.islands.iteration.numpy(), self.newton.islands.status.numpy()
            owner.iterations += int(iterations.sum())
            begun = state.coupled.q.numpy().copy()
            wp.copy(state.coupled.q, self.newton.iterates.q)
            near = on and self.arrived and self._near(begun, state)
            if on:
                self._relax(relaxation, state, begun)
            for name in ("frame", *(f"lag_{i}" for i in range(len(self.coupled.sets)))):
                wp.copy(state.coupled.arrays()[name], self._start.arrays()[name])  # the solve may have updated these
            if self._carried:
                self._carried.turn(state.coupled, state.coupled.q.numpy().astype(float).ravel())
            self.model.carry_frames(state)
            # Converged with the friction of its own normal forces; later solves move such a world within rounding.
            settled |= on and iterations <= np.where(ends == outcome.CONVERGED_TO_ROUNDING, POLISH, 0)
            q = self.tangent.dofs(state)
            if self.newton.contact:
                self._refuse_drifting(state, q, load_factor)
            if sticking:
                sticking = solves < STUCK and not settled.all()
                if not sticking:
                    settled[:] = False
                    self.newton.contact.terms.more.zero_()
                continue
            status = int(np.where(settled, np.minimum(ends, outcome.CONVERGED_TO_ROUNDING), ends).max())
            if status > outcome.CONVERGED_TO_ROUNDING and not (has_friction and status == outcome.MAX_ITERATIONS):
                break
            if (near or solves >= TRIED) and solves >= later and self.polish and not settled.all():
                if polished := self.polish(state, load_factor, partial(self._slides, first, increment)):
                    status = next(k for k, name in outcome.NAMES.items() if name == polished)
                    break
                later = 2 * solves
            if settled.all():
                break
        else:
            status = outcome.MAX_ITERATIONS if has_friction else status
        outer = self.tangent.loads(load_factor, self.tangent.dofs(state))
        residual = outer - self.tangent.gradient(state)
        certain, name = True, outcome.NAMES[status]
        if has_friction:
            self._slides(first, increment, state)
            residual += self.tangent.friction(state)
            free, points = self.tangent.free, ~self.tangent.angle
            unbalanced = np.abs(residual[free & points]).max(initial=0.0)
            loads, supports = (
                np.abs(forces).sum() for forces in (outer[free & points], (outer - residual)[~free & points])
            )
            certain = unbalanced <= SETTLED * loads
            certain &= self._near(first.coupled.q.numpy(), state) or not self.model.touch.slides()
            if warily and unbalanced > SETTLED * (loads + supports):
                name = UNSETTLED
        if status > outcome.CONVERGED_TO_ROUNDING or name == UNSETTLED:
            remedy = self.newton.contact.diagnosis.closest_pair(state.coupled.q, status) if self.newton.contact else ""
            if has_friction:
                remedy += "sliding bodies may have no equilibrium"
            message = owner.residuals.where(name, residual, load_factor, remedy)
            raise SolverError(message, state=state, outcome=name, gaining=name == "max_iterations")
        # In contact the last matrix may be projected without a trial of the exact one, which is no sign of instability.
        indefinite = self.newton.contact is None and self.newton.islands.drop_compression.numpy().any()
        state.stable = False if indefinite else None
        small = (ends == outcome.CONVERGED) | (status == outcome.CONVERGED)
        return owner.found(state, outer, residual, load_factor, small), certain

    def _near(self, begun: np.ndarray, state: State) -> bool:
        """Return True if nodes moved so little from blocks (W N, 3) that normal forces hardly changed."""
        displacement = np.abs(state.coupled.q.numpy() - begun).reshape(self.coupled.worlds, -1, 3)[
            :, : self.coupled.host.nodes
        ]
        return bool(displacement.max() <= NEAR * self.newton.contact.search.search_distance)

    def _slides(self, first: State, increment: float, state: State) -> None:
        """Write the slip of a state since the first one."""
        velocity = (state.coupled.q.numpy() - self._slid(first, state)) / increment
        state.sliding = Sliding(wp.array(velocity, dtype=self.coupled.vector, device=self.coupled.device), increment)

    def _untouched(self, before: State) -> bool:
        """Return True if the previous equilibrium had no contact forces, so that normal forces are unknown."""
        self.model.touch.evaluate(before.coupled.q)
        return not self.model.touch.terms.active_pairs.numpy().any()

    def _slid(self, first: State, state: State) -> np.ndarray:
        """Return blocks (W N, 3) from which slips of a state count: the `first` ones, twist angles about the frames of the state.

        Frames were transported by way of iterates, and so rotated about their tangents against directly transported ones.
        """
        q, coupled = first.coupled.q.numpy().copy(), self.coupled
        if self.newton.contact.terms.rolls:
            (u, t), (v, end) = (
                np.split(np.moveaxis(each.coupled.frame.numpy().reshape(6, coupled.worlds, -1), 0, -1), 2, axis=-1)
                for each in (first, state)
            )
            turned = polyline.signed_angle(polyline.transport(u, t, end), v, end)
            q.reshape(coupled.worlds, -1, 3)[:, coupled.angle_start :][:, : coupled.edges, 0] -= turned
        if self._carried:
            q = self._carried.rotated(q.ravel(), first.coupled, state.coupled).reshape(-1, 3)
        return q

    def _refuse_drifting(self, state: State, q: np.ndarray, load_factor: float) -> None:
        """Refuse bodies that loads carry away, since neither supports nor contact stop them."""
        displacement = np.where(self.tangent.angle, 0.0, np.abs(q - self._rest))
        farthest = int(np.argmax(displacement))
        if displacement[farthest] > ADRIFT * self._size:
            raise adrift(self.tangent.where(farthest), load_factor, state)

    def _relax(self, relaxation, state: State, begun: np.ndarray) -> None:
        """Relax the displacement under new normal forces, in worlds whose supports did not move.

        The full displacement is kept if the relaxed one would collide: iterates do not move straight.
        """
        displacement = (state.coupled.q.numpy() - begun).reshape(self.coupled.worlds, -1)
        fixed = ~self.tangent.free.reshape(self.coupled.worlds, -1)
        factor = relaxation(displacement, (displacement * fixed).any(1))
        if (factor < 1.0).any():
            relaxed = begun + (factor[:, None] * displacement).reshape(begun.shape)
            if self._carried:
                relaxed = self._carried.place(begun.astype(float).ravel(), relaxed.ravel()).reshape(begun.shape)
            if self.newton.contact.limit.fraction(begun, relaxed) == 1.0:
                state.coupled.q.assign(relaxed)

    @property
    def arrived(self) -> bool:
        """True if all supports have arrived at the end of the prescribed motion."""
        return not self.newton.islands.support_motion_pending.numpy().any()

    def share(self, before: np.ndarray, after: np.ndarray) -> float:
        """Return the CCD step fraction of the motion from dofs `before` to `after`."""
        return self.newton.contact.limit.fraction(
            self.tangent.back(before), self.tangent.back(self._beside(before, after))
        )

    def _replay(self, name: str, begin: Callable[[], None], launch: Callable[[], None]) -> None:
        """Replay the launches captured under a name, again from the beginning while lists of pairs overflow."""
        while True:
            begin()
            self._graphs.replay(name, launch)
            if not self.newton.has_overflow():
                return
            self._graphs.clear()

    def _begin(
        self, state: State, load_factor: float, before: State | None = None, slid: np.ndarray | None = None, rate=0.0
    ) -> None:
        tangent, tangent_block = self.tangent, self.tangent.parts[-1]
        q = tangent.dofs(state)
        start = q if before is None else self._beside(q, tangent.dofs(before))
        if self._carried and before is not None:
            start = self._carried.rotated(start, before.coupled, state.coupled)
        outer, gradient = tangent.loads(load_factor, q), tangent_block.elastic_gradient(state)
        scale = self.owner.residuals.load_scale(outer, gradient)
        self.newton.begin(
            tangent.back(q),
            tangent_block.dead_loads(load_factor),
            load_factor,
            scale,
            tangent.back(start),
            slid,
            rate,
            state.coupled.rotation,
        )
        for name, array in self._start.arrays().items():
            wp.copy(array, state.coupled.arrays()[name])

    def _beside(self, q: np.ndarray, source: np.ndarray) -> np.ndarray:
        """Return dofs q with the positions of `source`; twist angles, which are about other frames, stay."""
        return np.where(self.tangent.angle, q, source)
