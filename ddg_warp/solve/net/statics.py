"""Equilibria of large nets: Newton by preconditioned conjugate gradients on the device, without any factorisation.

The loop is that of a time step without its inertia: energies fall, and the matrix is Gauss-Newton's with the stiffness of the
stresses; in contact with second derivatives, too, as in a time step. Loads follow every iterate and do the work of their mean along a
step; their own stiffness is left out of the matrix, which costs iterations and no accuracy. No pivot is seen, so that a saddle on which
nothing pushes off is not told from a minimum: `ddg_warp.solve.stability` tells.

Friction is that of a step in time without inertia, as long as the increment of the load parameter: it acts against slips since the
equilibrium before, and what sticks creeps by less than `velocity` times the increment. Normal forces are lagged, at first those of the
equilibrium before, and taken anew from what is found until that is in equilibrium with its own. Where something has slid, that may be
as normal forces were those of a smaller load: then they are taken anew after every iteration. What swings about an equilibrium, as
normal forces come of friction elsewhere and that of theirs, goes less than the whole way. Once ways are short `polish` goes the rest.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SolverError
from ddg_warp.geometry import polyline
from ddg_warp.kernels import outcome
from ddg_warp.kernels.net import newton
from ddg_warp.model.state import Sliding, State
from ddg_warp.solve.chains.newton import NewtonOptions
from ddg_warp.solve.choice import large_static, net_preconditioner
from ddg_warp.solve.graphs import Graphs
from ddg_warp.solve.loads import StaticLoads
from ddg_warp.solve.net.arcs import Arcs
from ddg_warp.solve.net.newton import NetNewton
from ddg_warp.solve.net.polish import Polish

FORCING = 1e-4  # smallest reduction of the residual that a direction is solved to: Gauss-Newton errs by more
ADRIFT = 1e3  # of the size of the net, from which on what moves goes nowhere
FAR = 4.0  # turns of a direction, over the cap of a step, at which it is far enough
POLISH = 2  # iterations of a solve that begins within rounding, at most
LEAST, LEAP = 0.1, 10.0  # part of a way with other normal forces that is taken, and the longest one over the one before
# Iterations with the same normal forces. By too small ones what would stick slides far off: a wary search takes one. In a crowd that
# falls into place bodies lose touch for an iteration, and are carried far by the friction of others: it takes some without.
LAGGED = 5
NEAR = 0.01  # of the range of contact: ways on which normal forces hardly change
TRIED = 4  # solves after which Newton's method with consistent normal forces is tried wherever the iterate is
STUCK = 30  # iterations in which what meets for the first time sticks, at most
SETTLED = 1e-4  # residuals over all loads, of what has
UNSETTLED = "unsettled"  # outcome where forces do not balance with the friction that the state has


class StaticNewton(NetNewton):
    """`NetNewton` without inertia, in the precision of the state: no mass bounds the condition of its matrix."""

    banded = False  # also what held dofs do to others is asked for

    def __init__(self, model, options: NewtonOptions):
        super().__init__(model, options, net_preconditioner(model.net), model.types.real)
        self._whole = False  # whether directions may go as far as they like
        self.gravity.zero_()  # a load like others: `begin` scales them all
        self.loads = StaticLoads(model, self.net, midpoint=False) if self.net.host.followers else None
        self._there, self._before = wp.zeros_like(self.load), wp.zeros_like(self.q)
        self.islands.moved.fill_(1)
        self._follow, self._less, self._far = newton.static_kernels(self.real, self.linear)
        self.rubs = self.contact is not None and self.contact.rubs
        if self.rubs:  # another than that of strain-rate damping, which counts at rest
            self.contact.rate = wp.zeros_like(self.islands.rate)
            self.slid = wp.zeros_like(self.q)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, self._follow, self._less, self._far, *(self.loads.kernels if self.loads else [])]

    def begin(
        self,
        q: np.ndarray,
        dead: np.ndarray,
        at: float,
        scale: np.ndarray,
        before: np.ndarray | None = None,
        slid: np.ndarray | None = None,
        rate: float = 0.0,
    ) -> None:
        """Set out from dofs `q` under dead loads (worlds, 3 blocks), with those that follow at `at`; load scales of bodies.

        In contact q is what is proposed to what is at dofs `before`; friction counts slips from blocks `slid` on over `rate`, without
        which there is none.
        """
        for name in ("status", "iteration", "halvings", "unbalanced", "drowned", "clamped", "stale"):
            getattr(self.islands, name).zero_()
        self.q.assign(q.reshape(-1, 3))
        self.base.assign((q if before is None else before).reshape(-1, 3))
        if self.contact:
            wp.copy(self._before, self.base)
            self.contact.rest()
        if self.rubs:
            self.contact.rate.fill_(rate)
            if slid is not None:
                self.slid.assign(slid)
        for load in (self.load, self._there):
            load.assign(dead.reshape(-1, 3))
        if self.loads:
            self.loads.scale(dead.reshape(self.worlds, -1, 3), at)
        wp.copy(self.islands.load_scale, self.allowed.assign(scale.reshape(self.worlds, -1)))
        self.islands.active.fill_(1)

    def balance(self) -> None:
        """Residuals under the loads on the iterate, which do the work of their mean along a step."""
        if self.loads:
            for q, load in ((self.here, self.load), (self.base, self._there)):
                self.loads.apply(self.net.points(q), self.net.points(load), self.net.angles(load))
        super().balance()
        if self.loads:
            wp.launch(
                self._follow,
                self.all,
                [self.here, self.base, self.load, self._there, self.islands.status, self.net.blocks],
                [self.change],
                device=self.device,
            )

    def search(self, state, again: bool = False) -> None:
        """From where `begin` has set out, with the lagged data of `state`; can be captured. Slips of one `again` go on."""
        if self.contact:
            self.contact.renew(self._before)
            self.contact.place()
            self.contact.lag(self._before, again)
            if self.rubs:
                wp.copy(self.contact.terms.start, self.slid)
        self.solve(state)

    def outgrown(self) -> bool:
        """Whether pairs did not fit, so that all is to be done again, with room or by shorter ways. Reads from the device.

        Without inertia what nothing holds goes as far as it likes, past all else; steps in time end somewhere.
        """
        return self.contact is not None and self.contact.outgrown(self._before, spare=True)

    def watch(self) -> None:
        """Directions grow with every iteration: one that would be cut to a fraction is far enough.

        (Steihaug, SIAM J. Numer. Anal. 20, 1983.) Else a flat sheet's first direction, which knows bending alone, costs the most.
        """
        if self._whole:
            return
        self.measure_turns()
        if self.planes:
            self.planes.into(self.direction, self.islands.wanted)
        wp.launch(
            self._far,
            self.worlds,
            [self.turn, FAR * self.options.rotation_cap],
            [self.islands.wanted],
            device=self.device,
        )

    def follow(self, state, step: wp.array) -> None:
        """The direction of the free dofs where held ones make a `step`: H d = r - H step, in worlds that want it."""
        if self.resting:
            self.resting.wake()
        if self.contact:
            self.contact.see(self._before)
            self.contact.lag(self._before)
        self.evaluate(state)
        self.balance()
        if self.resting:
            self.resting.leave(self.contact.terms.products)
        self.assemble()
        self.krylov.multiply_matrix(step)
        wp.launch(self._less, self.all, [self.krylov.product], [self.right], device=self.device)
        self._whole = True
        self.direct()
        self._whole = False


class Relaxation:
    """Aitken's relaxation of a fixed point, at most 1 (Irons and Tuck, Int. J. Numer. Meth. Eng. 1, 1969, 275), with no leaps.

    What is held by friction alone has no stiffness where all of it slides, by normal forces that are not yet those of its equilibrium.
    """

    def __init__(self, worlds: int):
        self._part, self._last = np.ones(worlds), np.zeros((worlds, 0))

    def __call__(self, way: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Part (worlds,) of a way (worlds, n) that is to be taken; all of it where it is to be `whole`, after which all begins anew."""
        if self._last.size:
            size, last = (np.sqrt((each**2).sum(1)) for each in (way, self._last))
            turn = way - self._last
            square = (turn**2).sum(1)
            with np.errstate(divide="ignore", invalid="ignore"):
                part = -self._part * (self._last * turn).sum(1) / square
                part = np.minimum(np.where(part > 0.0, np.clip(part, LEAST, 1.0), 1.0), LEAP * self._part * last / size)
            self._part = np.where(whole | (last == 0.0) | (size == 0.0), 1.0, part)
        self._last = np.where(whole[:, None], 0.0, way)
        return self._part


class NetEquilibrium:
    """Equilibria of a model that is a net alone, for `Equilibrium`, whose tangent and load scale it uses.

    Attributes:
        wary: whether what has slid is searched for again with normal forces that are taken anew after every iteration.
        polish: what finds the last part of the way with friction; None without, or where factors are too large.
    """

    def __init__(self, owner):
        model, options, touching = owner.model, owner.options, owner.model.net.host.touching
        self.owner, self.model, self.net, self.tangent = owner, model, model.net, owner.tangent
        self.newton = StaticNewton(
            model,
            NewtonOptions(
                rtol=options.rtol,
                floor_factor=options.floor_factor,
                max_iterations=options.max_iterations,
                rotation_cap=options.rotation_cap,
                linear_rtol=FORCING,
                psd="progressive" if touching else "gauss_newton",
            ),
        )
        self.arcs = Arcs(model) if touching and model.motions else None
        self._rest = self.tangent.dofs(model.state())
        self._size = float(np.ptp(model.net.host.rest[: model.net.host.nodes], axis=0).max())
        self._start = model.net.empty()  # lagged data of a solve
        self._step = wp.zeros(self.newton.all, dtype=self.newton.right.dtype, device=model.wp_device)
        self._graphs = Graphs(model, lambda: arrays.load_kernels(self.newton.kernels, model.wp_device))
        self.wary = True
        self.polish = None
        if self.newton.rubs and not large_static(model):
            self.polish = Polish(model, owner.residuals, self.share, self.newton.contact.search.reach)
        self._least, self._touching, self._friction_work = math.inf, [], 0.0

    def pcg_iterations(self) -> int:
        """Iterations of conjugate gradients so far, without those that let the free dofs follow supports."""
        return self.newton.pcg_iterations()

    def count(self, state: State, increment: float) -> None:
        """Count what touches in an equilibrium that was found, and what friction took on its way, in the time `increment`."""
        touch = self.model.touch
        touch.at(state.net.q)
        gap = float(touch.terms.gap.numpy().min())
        self._least = min(self._least, gap if gap < touch.search.reach else math.inf)
        self._touching.append(int(touch.terms.touching.numpy().sum()))
        if self.newton.rubs:
            touch.rub(state.net.q, state.rubbing)
            self._friction_work += increment * float(touch.terms.dissipated.numpy().sum())

    def contact_statistics(self) -> dict:
        """Of the equilibria that were counted, as of `NetContact.statistics`; no straight way leads to them for pairs to cross on."""
        pairs = self._touching or [0]
        result = {
            "searches": int(self.newton.contact.search.searches.numpy()[0]),
            "smallest_gap": self._least,
            "contacts": {"mean": float(np.mean(pairs)), "last": pairs[-1]},
        }
        return result | ({"friction_work": self._friction_work} if self.newton.rubs else {})

    def following(self, state: State, step: np.ndarray, at: float) -> np.ndarray | None:
        """How the free dofs follow held ones that make a `step` (size,), by the tangent; None if there is no answer."""

        def begin():
            self._begin(state, at)
            self.newton.islands.wanted.fill_(1)
            self.newton.forcing.fill_(FORCING)
            self.newton.goal.fill_(math.inf)

        self._step.assign(step.reshape(-1, 3))
        self._replay("follow", begin, lambda: self.newton.follow(self._start, self._step))
        direction = self.newton.direction.numpy().astype(np.float64).ravel()
        return direction if np.isfinite(direction).all() else None

    def solve(self, state: State, at: float, before: State, increment: float) -> State:
        """The equilibrium at load parameter `at` from a state with its supports in place.

        In contact things go there from the state `before`, as far as nothing is in their way; with friction in the time `increment`.

        Raises:
            SolverError: it was not found; names the outcome.
        """
        if self.newton.rubs and self._untouched(before):
            with suppress(SolverError):  # that of what can not stick
                found, certain = self._search(state, at, before, increment, sticking=True)
                if certain:
                    return found
        try:
            found, certain = self._search(state, at, before, increment)
        except SolverError:
            if not (self.newton.rubs and self.wary):
                raise
        else:
            if certain or not self.wary:
                return found
        return self._search(state, at, before, increment, warily=True)[0]

    def _search(
        self, state: State, at: float, before: State, increment: float, warily: bool = False, sticking: bool = False
    ) -> tuple[State, bool]:
        """See `solve`; `warily` with normal forces that are taken anew after every iteration; `sticking`: what meets does so at first,
        until it is known what pushes it.

        Returns:
            The equilibrium; and whether it is one however normal forces were taken: forces balance with friction of their own normal
            forces, and not only to what rounding leaves of a search, and all sticks, or has not moved so far that they would change.
        """
        state, owner, first = state.copy(), self.owner, before
        rubs, rate = self.newton.rubs, 1.0 / increment if self.newton.rubs else 0.0
        again = self.net.edges or self.model.motions  # what is found is judged by its own frames and forces on supports
        held = self.tangent.dofs(state)
        relaxation, settled = Relaxation(self.net.worlds) if rubs else None, np.zeros(self.net.worlds, bool)
        if rubs:
            loads = np.where(self.tangent.angle, 0.0, self.tangent.loads(at, held)).reshape(self.net.worlds, -1)
            self.newton.contact.terms.more.assign(sticking * np.abs(loads).sum(1))
        later = 0  # when to polish next
        for solves in range(owner.options.max_iterations if rubs else 1 + bool(again)):
            on = solves > 0 and rubs
            if on and not self.arrived:
                state = state.copy()
                self.tangent.assign(state, np.where(self.tangent.free, self.tangent.dofs(state), held))
            name = "slide on" if on else "solve"
            if rubs:
                often = warily or sticking
                self.newton.options = replace(self.newton.options, max_iterations=1 if often else LAGGED)
                name += " warily" if often else ""
            self._replay(
                name,
                partial(self._begin, state, at, before, self._slid(first, state) if rubs else None, rate),
                partial(self.newton.search, self._start, on),
            )
            before, iterations, ends = state, self.newton.islands.iteration.numpy(), self.newton.islands.status.numpy()
            owner.iterations += int(iterations.sum())
            begun = state.net.q.numpy().copy()
            wp.copy(state.net.q, self.newton.q)
            near = on and self.arrived and self._near(begun, state)
            if on:
                self._relax(relaxation, state, begun)
            for name in ("frame", *(f"lag_{i}" for i in range(len(self.net.sets)))):
                wp.copy(state.net.arrays()[name], self._start.arrays()[name])  # renewed on the way, perhaps
            self.model.carry_frames(state)
            # in equilibrium with the friction of its own normal forces; what comes later moves such a world within rounding
            settled |= on and iterations <= np.where(ends == outcome.CONVERGED_TO_ROUNDING, POLISH, 0)
            q = self.tangent.dofs(state)
            if self.newton.contact:
                self._refuse_drifting(state, q, at)
            if sticking:
                sticking = solves < STUCK and not settled.all()
                if not sticking:
                    settled[:] = False
                    self.newton.contact.terms.more.zero_()
                continue
            status = int(np.where(settled, np.minimum(ends, outcome.CONVERGED_TO_ROUNDING), ends).max())
            if status > outcome.CONVERGED_TO_ROUNDING and not (rubs and status == outcome.MAX_ITERATIONS):
                break
            if (near or solves >= TRIED) and solves >= later and self.polish and not settled.all():
                if found := self.polish(state, at, partial(self._slides, first, increment)):
                    status = next(k for k, name in outcome.NAMES.items() if name == found)
                    break
                later = 2 * solves
            if settled.all():
                break
        else:
            status = outcome.MAX_ITERATIONS if rubs else status
        outer = self.tangent.loads(at, self.tangent.dofs(state))
        residual = outer - self.tangent.gradient(state)
        certain, name = True, outcome.NAMES[status]
        if rubs:
            self._slides(first, increment, state)
            residual += self.tangent.friction(state)
            free, points = self.tangent.free, ~self.tangent.angle
            unbalanced = np.abs(residual[free & points]).max(initial=0.0)
            loads, supports = (np.abs(of).sum() for of in (outer[free & points], (outer - residual)[~free & points]))
            certain = unbalanced <= SETTLED * loads
            certain &= self._near(first.net.q.numpy(), state) or not self.model.touch.slides()
            if warily and unbalanced > SETTLED * (loads + supports):
                name = UNSETTLED
        if status > outcome.CONVERGED_TO_ROUNDING or name == UNSETTLED:
            told = self.newton.contact.tightest(state.net.q, status) if self.newton.contact else ""
            if rubs:
                told += "what slides may come to no rest"
            message = owner.residuals.where(name, residual, at, told)
            raise SolverError(message, state=state, outcome=name, gaining=name == "max_iterations")
        # in contact the last matrix may be the projected one without a trial of the exact one, which tells nothing
        indefinite = self.newton.contact is None and self.newton.islands.clamped.numpy().any()
        state.stable = False if indefinite else None
        small = (ends == outcome.CONVERGED) | (status == outcome.CONVERGED)
        return owner.found(state, outer, residual, at, small), certain

    def _near(self, begun: np.ndarray, state: State) -> bool:
        """Whether nodes have moved from blocks (W N, 3) by so little that normal forces have hardly changed."""
        way = np.abs(state.net.q.numpy() - begun).reshape(self.net.worlds, -1, 3)[:, : self.net.host.nodes]
        return bool(way.max() <= NEAR * self.newton.contact.search.reach)

    def _slides(self, first: State, increment: float, state: State) -> None:
        """Write the way of a state from the first one."""
        velocity = (state.net.q.numpy() - self._slid(first, state)) / increment
        state.sliding = Sliding(wp.array(velocity, dtype=self.net.vector, device=self.net.device), increment)

    def _untouched(self, before: State) -> bool:
        """Whether nothing pushed anything in the equilibrium before, so that normal forces are not known."""
        self.model.touch.at(before.net.q)
        return not self.model.touch.terms.touching.numpy().any()

    def _slid(self, first: State, state: State) -> np.ndarray:
        """Blocks (W N, 3) that slips of a state count from: those of the `first` one, its angles about the frames that this has.

        Frames came here by way of iterates, and turned on it about their tangents beside ones that come straight.
        """
        q, net = first.net.q.numpy().copy(), self.net
        if self.newton.contact.terms.rolls:
            (u, t), (v, end) = (
                np.split(np.moveaxis(of.net.frame.numpy().reshape(6, net.worlds, -1), 0, -1), 2, axis=-1)
                for of in (first, state)
            )
            turned = polyline.signed_angle(polyline.transport(u, t, end), v, end)
            q.reshape(net.worlds, -1, 3)[:, net.angle_start :][:, : net.edges, 0] -= turned
        return q

    def _refuse_drifting(self, state: State, q: np.ndarray, at: float) -> None:
        """Refuse what loads carry away, as neither supports nor contact hold it."""
        way = np.where(self.tangent.angle, 0.0, np.abs(q - self._rest))
        farthest = int(np.argmax(way))
        if way[farthest] > ADRIFT * self._size:
            raise SolverError(
                f"no equilibrium at load parameter {at:g}: adrift, {self.tangent.where(farthest)} is carried away, as neither "
                "supports nor contact hold it; hold it, or put something in its way",
                state=state,
                outcome="adrift",
            )

    def _relax(self, relaxation, state: State, begun: np.ndarray) -> None:
        """Take less of a way with other normal forces, of worlds whose supports have not moved on it.

        All of it where less would be in the way of something: iterates do not go straight.
        """
        way = (state.net.q.numpy() - begun).reshape(self.net.worlds, -1)
        held = ~self.tangent.free.reshape(self.net.worlds, -1)
        part = relaxation(way, (way * held).any(1))
        if (part < 1.0).any():
            less = begun + (part[:, None] * way).reshape(begun.shape)
            if self.newton.contact.share(begun, less) == 1.0:
                state.net.q.assign(less)

    @property
    def arrived(self) -> bool:
        """Whether the supports of all worlds are where the last solve was to put them."""
        return not self.newton.islands.driven.numpy().any()

    def share(self, before: np.ndarray, after: np.ndarray) -> float:
        """The part of a motion from dofs `before` to `after` in which nothing passes through anything."""
        return self.newton.contact.share(self.tangent.back(before), self.tangent.back(self._beside(before, after)))

    def _replay(self, name: str, begin: Callable[[], None], launch: Callable[[], None]) -> None:
        """Launch what is captured under a name, again from its beginning while there is no room for what touches."""
        while True:
            begin()
            self._graphs.replay(name, launch)
            if not self.newton.outgrown():
                return
            self._graphs.clear()

    def _begin(
        self, state: State, at: float, before: State | None = None, slid: np.ndarray | None = None, rate=0.0
    ) -> None:
        tangent, part = self.tangent, self.tangent.parts[-1]
        q = tangent.dofs(state)
        start = q if before is None else self._beside(q, tangent.dofs(before))
        outer, gradient = tangent.loads(at, q), part.elastic_gradient(state)
        scale = self.owner.residuals.load_scale(outer, gradient)
        self.newton.begin(tangent.back(q), part.dead_loads(at), at, scale, tangent.back(start), slid, rate)
        for name, array in self._start.arrays().items():
            wp.copy(array, state.net.arrays()[name])

    def _beside(self, q: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Dofs q with the positions of `other` ones: angles, which are about other frames, take no way."""
        return np.where(self.tangent.angle, q, other)
