"""Contact within Newton's method on a net; see `kernels.net.touch`, and `solve.contact` for the search and the pairs.

What is proposed, a predictor or a step, is cut rod by rod before anything passes through anything. Supports and obstacles that move
are part of what is proposed. Worlds in which these, or the predictor, were cut are on their way: their iterate is where they are
bound for, where all but contact is balanced, and contact is linear about where they have come to. So the next direction begins with
what is left of the way, whatever holds it up.
"""

import math

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.kernels.net import touch as kernels
from ddg_warp.scene.obstacles import Obstacle
from ddg_warp.solve.chains.newton import EARLY
from ddg_warp.solve.contact.tally import Tally
from ddg_warp.solve.contact.touch import Touch
from ddg_warp.solve.net.contact_bands import ContactBands
from ddg_warp.solve.net.system import Sums
from ddg_warp.solve.net.units import number_bodies, number_units

FAR = 16.0  # margins that a node goes from which on a world has one share: of so long ways too many pairs would be near
# Where pairs would be too many all the same ways are cut to so many margins, and to a part of what they were until they are not.
LONGEST, SHORTER = 4096.0, 0.25
STIFFER = 100.0  # times as stiff contact has room where it had none: of five cases of cloth all five, by 10 times four
# parts of a step that failed at which motions are looked at: ways past each other are short beside the first gap, or beside the step
LOOKS = (*(2.0**-k for k in range(12, 3, -1)), *(k / 8 for k in range(1, 9)))
LEAST = 1e-3  # of the range, the gap from which on a barrier has no room
ROUNDING = 16.0  # units in the last place within which supports have arrived


class NetContact:
    """Contact of a `NetNewton`.

    Attributes:
        search, terms: candidates, and the energy of those that are near.
        forces (W N,) [N], stiffness (W N,) [N/m]: what pushes nodes, and a bound on how stiff that is.
        diagonal: (W N,) blocks of its matrix at nodes.
        bound: (W N,) where iterates of worlds on their way are bound for, and where those of others are.
        bodies: which each block of a world belongs to (blocks,), -1 for none, and how many there may be.
        bends: whether its matrix has what comes of pairs that turn, once the search is near; see `kernels.contact.pair_bend`.
        rubs: whether there is friction; rate: over what it counts slips (worlds,) [1/s].
        solutions: where the last step took friction anew, in this order, for its reverse: `lags` - 1 of (W N,) with friction.
        farthest: [m] that nodes go in worlds of one share, as too many pairs are near along longer ways; see `outgrown`.
        crossed: (1,) pairs that would have passed through each other in all steps so far; least: (1,) the smallest gap [m].
    """

    def __init__(self, newton, model):
        self.newton, self.net, self._scene = newton, newton.net, model.scene
        self._moves = bool(model.motions)
        net, host, real, linear, device = newton.net, newton.net.host, newton.real, newton.linear, newton.device
        if host.frames:
            raise SceneError(
                "contact: a support on an oblique plane of symmetry does not go with it; use an axis of space"
            )
        if newton.frozen:
            raise SceneError(
                "contact: solver 'projective' keeps the matrix of a step, which contact changes; use 'newton'"
            )
        newton.q.assign(np.tile(host.rest, (net.worlds, 1)))
        # forces on obstacles are asked of states, not here
        self.touch = Touch(net, linear, newton.q, host.of_obstacles)
        self.shapes, self.search, self.terms = self.touch.shapes, self.touch.search, self.touch.terms
        self.rubs, self.rate = host.touching.rubs, newton.islands.rate
        worlds, again = net.worlds, self.touch.law.lags - 1 if self.rubs else 0
        self.forces, self.stiffness, self.diagonal = self.terms.forces, self.terms.stiffness, self.terms.diagonal

        def make(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        self._modes, self._curved, self._projected = (make(worlds, int) for _ in range(3))
        self.bends, self._late = newton.psd != "gauss_newton", 0 if newton.psd == "none" else EARLY
        self._kept, self._gain = make((2, worlds), real), make(worlds, real)
        self.solutions = [make(newton.all, net.vector) for _ in range(again)]
        self._move = make(newton.all, net.vector)
        self.bound = make(newton.all, net.vector)
        self._way, self._pushed = (make(newton.all, wp.types.vector(3, linear)) for _ in range(2))
        self._going = make(1, int)
        self._longest, self.farthest = make(worlds, real), math.inf
        self._braced = make(worlds, int)
        self.crossed, self.least = make(1, wp.int64), wp.full(1, math.inf, dtype=real, device=device)
        self.tally = Tally(self.terms)
        self._counts = self.crossed, self.least, self.search.searches, *self.tally.arrays
        self.bodies = number_bodies(host)
        unit, self._units = number_units(*self.bodies, host, model.motions)
        self._unit = wp.array(unit, dtype=int, device=device)
        places = np.concatenate([host.moving[:, 0], host.turning[:, 0]])
        self._nodes = wp.array(places.astype(np.int32), dtype=int, device=device)
        self._aims = make((max(1, len(places)), worlds), net.vector)
        made = kernels.world_kernels(real)
        (
            self._account,
            self._find_modes,
            self._find_predicted,
            self._depart,
            self._expect,
            self._refuse,
            self._find_curved,
            self._again,
            self._find_short,
            self._less,
            self._brace,
        ) = made
        self._kernels = list(made)
        made = kernels.block_kernels(real, linear, arrays.serial(device))
        (
            self._differ_gain,
            self._lessen,
            self._aim,
            self._push,
            self._land,
            self._arrive,
            self._stay,
            self._near,
            self._part,
            self._find_way,
            self._add,
            self._keep_solution,
        ) = made
        self._kernels += made
        self._sum = Sums(worlds, newton.dots.shape[1], real, device)
        self._bands = None
        self._least = LEAST * float(host.touching.range.min()) if self.touch.keep else -math.inf
        self._stiffest = float(host.touching.stiffness.max())

    @property
    def touching_bodies(self) -> int:
        """How many there are in a world."""
        return len(np.setdiff1d(self.bodies[0], [-1]))

    def bind(self, chains) -> None:
        """Have a part in what chains eliminate, once their plan is made."""
        self._bands = ContactBands(chains, self.shapes)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        own = [*self._kernels, *(self._bands.kernels if self._bands else [])]
        return [*own, *self._sum.kernels, *self.search.kernels, *self.terms.kernels, *self.tally.kernels]

    def renew(self, before: wp.array) -> None:
        """Make the trees of the search anew at positions `before`, where searches do not build their own."""
        if self.newton.device.is_cuda:
            self.search.rebuild(before)

    def see(self, x: wp.array) -> None:
        """Have candidates at positions x, where no motion brings them."""
        self.search.update(x)

    def lag(self, x: wp.array, again: bool = False, rate: wp.array | None = None) -> None:
        """What friction takes from positions x, which are on the way that was cut last; slips, unless it does so `again`.

        Where a step begins, `rate` is that of the step before; see `PairTerms.lag`.
        """
        if self.rubs:
            self.terms.lag(x, again, rate)

    def rest(self) -> None:
        """Nothing is on its way: what is proposed is where it is."""
        wp.copy(self.bound, self.newton.q)
        self.newton.islands.driven.zero_()
        self._going.zero_()

    def lag_again(self, solution: wp.array) -> None:
        """Take friction anew from where the solve has come to, for worlds that have converged; keep that in one of `solutions`."""
        newton = self.newton
        self._sweep(self._keep_solution, [newton.q, newton.islands.moved, self.net.blocks], [solution])
        self.lag(newton.q, again=True)
        self._launch(self._again, self.net.worlds, [newton.islands.arrays[0]], [])

    def brace(self, dt: wp.array) -> None:
        """Have inertia in the stiffness of what a step of dt (worlds,) [s] found no room for, from its next trial to its end."""
        if self.terms.heavy:
            outputs = [self._braced, self.terms.law.rate]
            self._launch(self._brace, self.net.worlds, [*self.newton.islands.arrays, dt], outputs)

    def place(self) -> None:
        """Cut the predictor, once supports are placed, where they have to be."""
        newton = self.newton
        if len(self._nodes):
            inputs = [self._nodes, self.net.blocks, newton.q]
            self._launch(self._aim, (len(self._nodes), self.net.worlds), inputs, [self._aims])
        self._launch(self._find_predicted, self.net.worlds, [newton.islands.arrays[0]], [self._modes, self._longest])
        self._cut()
        self._launch(self._find_short, self.net.worlds, [self._modes, self.search.time], [newton.islands.arrays[0]])
        self._let_go()

    def evaluate(self) -> None:
        """Energies, forces and factors at the iterate, to which what was proposed was cut."""
        q, islands = self.newton.q, self.newton.islands
        if self.rubs:
            self.terms.evaluate(q, self.rate, iterates=(islands.slot, islands.iteration))
        else:
            self.terms.evaluate(q)

    def account(self, change: wp.array, noise: wp.array) -> None:
        """Add to the change of the energy of worlds, and to its rounding."""
        inputs = [self.terms.energy, self.terms.gap, self._least, self.search.overflow]
        inputs += [self.newton.islands.arrays[0], self._kept, change, noise]
        self._launch(self._account, self.net.worlds, inputs, [])

    def assemble(self) -> None:
        """What products and the preconditioner take of the last evaluation."""
        newton = self.newton
        outputs = [self._curved, self._projected]
        self._launch(self._find_curved, self.net.worlds, [newton.islands.arrays[0], self._late], outputs)
        self.terms.meet()
        if self.bends:
            self.terms.prepare(newton.q, self._curved)
        if self._bands:
            self.terms.join()

    def join(self) -> None:
        """Its own part in the preconditioner, once it and the matrix are assembled."""
        if self._bands:
            self._bands(self.terms, self.newton.islands.arrays[0])

    def direct(self) -> None:
        """Directions by conjugate gradients, along with what is left of the way."""
        wp.capture_if(self._going, self._approach)
        self.newton.krylov.solve()
        wp.capture_if(self._going, self._follow)

    def _approach(self) -> None:
        """Take from the residual what contact has against the rest of the way."""
        newton, blocks = self.newton, self.net.blocks
        busy = newton.islands.wanted
        self._sweep(self._find_way, [newton.q, self.bound, busy, blocks], [self._way])
        if len(self._nodes):
            inputs = [self._nodes, self._aims, newton.q, newton.fixed, busy, blocks]
            self._launch(self._push, (len(self._nodes), self.net.worlds), inputs, [self._way])
        self._pushed.zero_()
        self.terms.product(self._way, self._pushed)
        self._sweep(self._lessen, [self._pushed, newton.fixed, busy, blocks], [newton.right])

    def _follow(self) -> None:
        newton = self.newton
        self._sweep(self._add, [self._way, newton.islands.wanted, self.net.blocks], [newton.direction])

    def spread(self, p: wp.array) -> None:
        """What pairs bring to H p."""
        self.terms.place(p, self.newton.q, self._curved if self.bends else None)

    def settle(self, p: wp.array, product: wp.array) -> None:
        """Add it, and write p . H p block by block."""
        newton = self.newton
        self.terms.settle(p, product, newton.barred, newton.islands.wanted, newton.krylov_dots)

    def hold(self) -> None:
        """Cut what was moved, and say what that is expected to gain."""
        newton = self.newton
        self._launch(self._find_modes, self.net.worlds, [newton.islands.arrays[0]], [self._modes, self._longest])
        self._launch(self._depart, self.net.worlds, [self._modes], [newton.islands.arrays[0]])
        if len(self._nodes):
            inputs = [self._nodes, self._aims, newton.fixed, self._modes, *newton.islands.arrays, self.net.blocks]
            self._launch(self._land, (len(self._nodes), self.net.worlds), inputs, [newton.q])
        self._cut()
        self._let_go()
        inputs = [newton.right, newton.q, newton.base, self._modes, self.net.blocks]
        self._sweep(self._differ_gain, inputs, [newton.dots])
        self._sum(newton.dots, self._gain)
        inputs = [self._modes, self.search.time, self._gain]
        outputs = [*newton.islands.arrays, newton.stalled, self._projected]
        self._launch(self._expect, self.net.worlds, inputs, outputs)

    def _cut(self) -> None:
        """Shorten what is proposed, which stays among what is `bound`."""
        newton = self.newton
        far = FAR * self.search.margin
        inputs = [newton.q, newton.base, self._unit, self.net.host.nodes, far, self.net.blocks]
        self._sweep(self._stay, inputs, [self._move, self._modes, self.bound, self._longest])
        shorter = [self._modes, self._longest, self.farthest]
        if self.farthest < math.inf:
            self._sweep(self._near, [self._move, self._unit, *shorter, self.net.blocks], [newton.q])
        self.search.filter(self._move, newton.q, self._unit, self._modes, self._units, self.touch.keep)
        if self.farthest < math.inf:
            self._launch(self._less, self.net.worlds, shorter, [self.search.time])
        if len(self._nodes):
            eps = ROUNDING * newton.eps
            inputs = [self._nodes, self._aims, newton.fixed, self._modes, eps, self.net.blocks, newton.q]
            self._launch(self._arrive, (len(self._nodes), self.net.worlds), inputs, [newton.islands.arrays[0]])

    def share(self, before: np.ndarray, after: np.ndarray) -> float:
        """The part of a motion (3 W N,) of all worlds in which nothing passes through anything. Not in a capture."""
        base = wp.array(before.reshape(-1, 3), dtype=self.net.vector, device=self.newton.device)
        self._modes.fill_(kernels.WHOLE)
        move = after - before
        longest = float(np.abs(move).max())
        self.search.fit(base)
        while True:
            part = min(1.0, self.farthest / longest) if longest > 0.0 else 1.0
            q = wp.array((before + part * move).reshape(-1, 3), dtype=self.net.vector, device=self.newton.device)
            self.search.filter(base, q, self._unit, self._modes, self._units, self.touch.keep)
            if not self.search.fit(base, lambda: self._shorten(longest)):  # else nothing has moved
                return part * float(self.search.time.numpy().min())

    def _let_go(self) -> None:
        """Let go of what was proposed where nothing is on its way."""
        self._going.zero_()
        inputs = [self.newton.q, self.newton.islands.arrays[0], self.net.blocks]
        self._sweep(self._part, inputs, [self.bound, self._going])

    def finish(self, before: wp.array) -> None:
        """Take no part of a step in which things passed through each other."""
        newton = self.newton
        self.search.check_crossings(before, newton.q)
        inputs = [self.search.crossed, self.terms.gap, self.search.overflow, *newton.islands.arrays]
        self._launch(self._refuse, self.net.worlds, inputs, [self.crossed, self.least])
        self.tally(newton.islands.arrays[0])

    def statistics(self) -> dict:
        """Over all steps so far: searches, pairs that would have passed through each other, the smallest gap [m], infinite where none
        was within the range; how many candidates there are now; and what `Tally.statistics` has.
        """
        least = self.least.numpy()[0]
        return {
            "searches": int(self.search.searches.numpy()[0]),
            "refused_crossings": int(self.crossed.numpy()[0]),
            "smallest_gap": float(least) if least < least.dtype.type(self.search.reach) else math.inf,
            "candidates": sum(int(pairs.count.numpy()[0]) for pairs in self.search.lists),
        } | self.tally.statistics()

    def go_on(self, other: "NetContact") -> None:
        """Count on from another one."""
        for own, found in zip(self._counts, other._counts, strict=True):
            wp.copy(own, found)

    def check(self, x: wp.array) -> None:
        """Refuse to start from positions in which surfaces overlap, or are too close for a barrier. Reads from the device.

        Raises:
            SceneError: names the pair and by how much.
        """
        gap, pair = self.touch.closest(x)
        least = self._least if self.touch.keep else -self.touch.search.reach
        if gap <= least:
            meet = f"overlap by {-gap:.3g} m" if gap < 0.0 else "touch"
            if gap > 0.0:
                meet = f"are {gap:.3g} m apart, too close for a barrier, which needs {least:.3g} m,"
            raise SceneError(
                f"contact: {pair} {meet} at the start; move them apart, as model.pushed_apart(state) does, give "
                "them a smaller radius, or let them pass by contact_between(..., ignore=True)"
            )

    def tightest(self, x: wp.array, reason: int) -> str:
        """The pair that is the closest at positions x, which may be why a solve has failed by an outcome, and what keeps it apart.

        Empty where nothing is near. Reads from the device.
        """
        gap, pair = self.touch.closest(x)
        if gap >= self.search.reach:
            return ""
        return (
            f"the smallest gap, {gap:.3g} m, is between {pair}; {self._widen(gap) if reason == outcome.NO_ROOM else ''}"
        )

    def blocked(self, tangent, state, start: float, end: float) -> str:
        """What to do about two things, both held, that motions drive into each other from `start` to `end`; empty where none are seen.

        Looks at the times `LOOKS` in between, from a state that belongs to the first. Reads from the device.
        """
        for part in LOOKS if self._moves else ():
            there = state.copy()
            tangent.move_supports(there, start, start + part * (end - start))
            if told := self._driven(there.net.q):
                return told
        return ""

    def _driven(self, x: wp.array) -> str:
        """What to do about two things that overlap at positions x, both held and one moved, so that nothing yields; else empty."""
        gap, pair, nodes = self.touch.closest_nodes(x)
        host, scene = self.net.host, self._scene
        if gap > max(self._least, 0.0) or not all(host.fixed[of].all() for of in nodes):
            return ""
        supports = [*scene.supports, *scene.shell_supports, *scene.ring_supports, *scene.obstacles]
        moved = {
            f"obstacle '{support.name}'" if isinstance(support, Obstacle) else f"support {number} ({support.call})"
            for number, (support, held) in enumerate(zip(supports, host.held, strict=True))
            if support.motion is not None and any(np.isin(of, held.places).any() for of in nodes)
        }
        if not moved:
            return ""
        return (
            f"{pair} are both held, and the motion of {' and of '.join(sorted(moved))} drives them into each other: change "
            "that motion, free what holds one of them, or let them pass by contact_between(..., ignore=True), "
        )

    def _widen(self, gap: float) -> str:
        """What helps where there is no room, that which helps most first; `gap` [m] is the smallest before."""
        if gap < self._least:
            return "move them apart, as model.pushed_apart(state) does, "
        if self.terms.heavy:
            return f"give their contact a larger stiffness, such as {STIFFER * self._stiffest:.3g} N/m, or a larger range, "
        return (
            f"give their contact a larger stiffness, {STIFFER:g} times as much or none, by which it is as large as steps need, or a "
            "larger range, "
        )

    def _shorten(self, longest: float) -> bool:
        """Go shorter ways than `longest` [m] from now on, if that is long."""
        longest, least = min(self.farthest, longest), FAR * self.search.margin
        if longest <= least:
            return False
        self.farthest = max(least, min(longest * SHORTER, LONGEST * self.search.margin))
        return True

    def outgrown(self, x: wp.array, spare: bool = False) -> bool:
        """Whether pairs did not fit, for which there is room then, or to `spare` it no need: long ways past a crowd are gone in parts.

        Reads from the device.
        """

        def shorten() -> bool:
            return self._shorten(float(self._longest.numpy().max()))

        grown = self.search.fit(x, shorten if spare else None)
        grown = self.terms.fit() or grown
        if grown:
            self.tally.forget()
        return grown

    def _sweep(self, kernel, inputs: list, outputs: list) -> None:
        arrays.sweep(kernel, self.net.blocks, inputs, outputs, self.newton.device, worlds=self.net.worlds)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.newton.device)
