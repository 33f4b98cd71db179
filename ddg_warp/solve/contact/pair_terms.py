"""Contact and friction on the candidates of a search: energies, forces, and products with the Hessian.

See `kernels.contact.pair_energy` and `kernels.contact.pair_friction`.
"""

from functools import partial

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.contact import gather
from ddg_warp.kernels.densities import Density
from ddg_warp.kernels.terms import FRICTION_LAWS
from ddg_warp.solve.contact.broad_phase import BroadPhase
from ddg_warp.solve.contact.contact_elements import ContactElements
from ddg_warp.solve.contact.friction_elements import FrictionElements
from ddg_warp.solve.contact.law_tables import at_own_rate, law_tables, table
from ddg_warp.solve.contact.pair_product import PairProduct
from ddg_warp.solve.contact.spins import Spins
from ddg_warp.solve.contact.totals import Totals


class PairTerms:
    """Contact of all pairs of a `BroadPhase`, in one law with parameters by pairs of groups of objects, and their friction.

    Friction is that of the pairs that push each other when `lag` is called, at the start of a step, and of its normal forces; searches
    within the step leave it alone.

    `lag`, `evaluate`, `product` and `join` read nothing back and can be captured, on the CPU too; graphs that hold them have
    to be captured anew whenever `version` of the search grows, after `fit` of the search and of this, beginning with `lag`. While pairs
    do not fit energies are infinite.

    Args:
        search: candidates; to be updated before each `evaluate`.
        law: `densities.contact.smooth_penalty` or `log_barrier`.
        stiffness: [N/m], not negative; range: gap below which surfaces push each other [m], positive, at most the reach of the search;
            thickness: distance at which the gap is zero [m], by default the sum of both radii. Numbers, or symmetric (groups, groups).
        groups: of each object (objects,), from 0; by default all are in one.
        friction: coefficient mu, a number or symmetric (groups, groups), not negative; None or 0: no friction is built.
        ways: multiples of it (groups, groups, 3), not negative, of a rod, the first of two objects, that slides forwards, towards its
            last node, backwards, and across; by default it is the same all ways.
        friction_law: "logistic" or "polynomial", see `densities.friction`.
        velocity: nu [m/s], positive: what sticks creeps with a share of it.
        linear: type of factors and of vectors of products, by default that of positions.
        silent: nodes of a world that forces and products need not be told of, which may be in thousands of pairs.
        inertia: masses [kg], not negative, a number or symmetric (groups, groups): the stiffness is at least that times the square of
            the rates of `law`; None or 0: it is as given.
        shared: by name of what is by groups, arrays (worlds, groups, groups) that the law has in place of its own.
        exact: whether products with what turns are exact for edges that are all but parallel, too, however many these are.

    Attributes:
        energy: (worlds,) [J], that of contact and the potential of friction; forces: (worlds times nodes,) [N].
        gap: (worlds,) the smallest of all candidates [m], at most the reach of the search; touching, dissipated: see `Totals`.
        diagonal: (worlds times nodes,) blocks of the Gauss-Newton matrix at nodes, 3 x 3 [N/m]; between: (worlds times edges,) those
            between the first and the second node of edges, in the order of `shapes.things(2)`. Each pair's own part of rods, 6 x 6 for
            an edge, is in both, positive semi-definite together. See `join`.
        rolls: whether friction turns rods; turned: then of each edge's angle that with the first and with the second node [N], and with
            the angle of the next edge of the rod [N m]; those with themselves are among `diagonal`.
        stiffness: (worlds times nodes,) [N/m], traces of `diagonal`.
        start: positions and angles that slip starts from (worlds times nodes,), if not from others; more: what friction counts beside
            normal forces (worlds,) [N], none but where what meets is to stick.
        law: `law_struct`, on the device, with rates of inertia (worlds,) [1/s], zero at first; lag_law: the one by
            which friction was lagged last; products: the `PairProduct` of all lists.
        spins: how far objects that spin have turned since slips started.

    Raises:
        SceneError: names the parameter, the pair of objects where there is one, and the remedy.
    """

    def __init__(
        self,
        search: BroadPhase,
        law: Density,
        *,
        stiffness,
        range,
        thickness=None,
        groups=None,
        friction=None,
        ways=None,
        friction_law: str = "logistic",
        velocity: float = 1e-3,
        linear=None,
        silent: np.ndarray | None = None,
        inertia=None,
        shared: dict[str, wp.array] | None = None,
        exact: bool = False,
    ):
        self.search, self.device, self.real = search, search.device, search.real
        self.linear = linear or self.real
        given = {
            "stiffness": stiffness,
            "range": range,
            "thickness": thickness,
            "friction": friction,
            "inertia": inertia,
        }
        self.law, rubs = law_tables(search, given, groups, shared or {})
        self.heavy = inertia is not None and bool(np.any(inertia))
        self.lag_law, self._law_before = self.law, at_own_rate(self.law, self.real) if self.heavy and rubs else None
        nodes = len(search.shapes.points) * search.worlds
        self.gap = wp.zeros(search.worlds, dtype=self.real, device=self.device)
        self._no_rate = wp.zeros_like(self.gap)
        self.forces = wp.zeros(nodes, dtype=wp.types.vector(3, self.real), device=self.device)
        self.stiffness = wp.zeros(nodes, dtype=self.real, device=self.device)
        block = wp.types.matrix((3, 3), self.linear)
        self.diagonal = wp.zeros(nodes, dtype=block, device=self.device)
        self.between = wp.zeros(search.worlds * len(self.law.square), dtype=block, device=self.device)
        self._told, self._told_edges = (
            wp.zeros(len(array), dtype=wp.uint8, device=self.device) for array in (self.forces, self.between)
        )
        told_not = np.zeros(len(search.shapes.points), np.uint8)
        told_not[[] if silent is None else silent] = 1
        told_not = wp.array(told_not, dtype=wp.uint8, device=self.device)
        self.lists = [
            ContactElements(pairs, law, nodes, self.real, self.linear, told_not, exact) for pairs in search.lists
        ]
        self._version, self._lagged = search.version, -1
        self.spins = Spins(search)
        self.frictions = self._with_friction(rubs, ways, friction_law, velocity, told_not)
        self.start, self.more = wp.zeros_like(self.forces), wp.zeros_like(self.gap)
        self.rolls = any(part.rolls for part in self.frictions)
        made = gather.collect_kernels(self.real, self.linear, arrays.serial(self.device), self.rolls)
        self._collect, self._join, self._roll = made
        edges = len(self.between) if self.rolls else 0
        types = (*(wp.types.vector(3, self.linear),) * 2, self.linear)
        self.turned = [wp.zeros(edges, dtype=dtype, device=self.device) for dtype in types]
        angles = search.shapes.angles(2)[:, 0].astype(np.int32)
        self._angles = wp.array(angles if self.rolls else angles[:0], dtype=int, device=self.device)
        self.products = PairProduct(self._parts, self.law, self.real, self.linear)
        self._rub = PairProduct(self.frictions, self.law, self.real, self.linear) if self.frictions else None
        self._totals = told = Totals(self.lists, self.frictions, search.worlds, self.real, self.device)
        self.energy, self.touching, self.dissipated = told.energy, told.touching, told.dissipated
        self._no_iterates = (wp.zeros(0, dtype=int, device=self.device),) * 2

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        parts = [kernel for part in self._parts for kernel in part.kernels]
        own = [
            self._collect,
            self._join,
            *([self._roll] if self.rolls else []),
            *(self.spins.kernels if self.frictions else []),
        ]
        return [*own, *self.products.kernels, *self._totals.kernels, *parts]

    @property
    def _parts(self) -> list:
        return [*self.lists, *self.frictions]

    def fit(self) -> bool:
        """Make as much room as the lists of the search have; whether there was less. Not in a capture.

        If so, the step is to be done again from its `lag` on.
        """
        if self._version == self.search.version:
            return False
        for part in self._parts:
            part.reserve()
        for product in filter(None, (self.products, self._rub)):
            product.fit()
        self._totals.fit()
        self._version = self.search.version
        return True

    def brace(self, rate: wp.array | None) -> None:
        """Set the rates of `law` (worlds,) [1/s], by which inertia counts in the stiffness; to zero without."""
        if self.heavy and rate is not None:
            wp.copy(self.law.rate, rate)
        elif self.heavy:
            self.law.rate.zero_()

    def lag(self, x: wp.array, again: bool = False, rate: wp.array | None = None) -> None:
        """Take pairs, normal forces and tangents of friction from contact at x, and x as where slip starts.

        Slip still starts from where it did if friction is lagged `again`. Does nothing where there is no friction.

        Args:
            x: positions (worlds times nodes,).
            again: whether a search goes on.
            rate: by which inertia counts in the stiffness at x (worlds,) [1/s]; by default that of `law`.

        Raises:
            SolverError: if the lists of the search have grown since `fit`.
        """
        if not self.frictions:
            return
        self._start_anew()
        self.lag_law = self.law
        if self._law_before and rate is not None:
            wp.copy(self._law_before.rate, rate)
            self.lag_law = self._law_before
        law = self.lag_law

        def lag(part: ContactElements, friction: FrictionElements) -> None:
            part.write(x, law, self.gap)
            friction.lag(law, x, again, self.more)

        arrays.side_by_side([partial(lag, *both) for both in zip(self.lists, self.frictions, strict=True)], self.device)
        if not again:
            wp.copy(self.start, x)
        self._lagged = self._version

    def evaluate(
        self,
        x: wp.array,
        rate: wp.array | None = None,
        start: wp.array | None = None,
        iterates: tuple[wp.array, wp.array] | None = None,
    ) -> None:
        """Energies, forces, factors and the smallest gaps at positions x; with rates, those of friction too.

        Args:
            rate: 1/h of each world (worlds,) [1/s]; no friction where it is 0.
            start: positions that slip starts from, by default those of `lag`.
            iterates: of each world, which of two iterates is the accepted one, 0 or 1, and how many there were; then the matrix of
                friction is that of its direction as an unknown of its own, see `kernels.contact.pair_friction`.

        Raises:
            SolverError: if the lists of the search have grown since `fit`, or friction was not lagged since then, or rates do not fit.
        """
        if rate is not None:
            self._check(rate)
        self._start_anew()
        start = self.start if start is None else start
        rate = self._no_rate if rate is None else rate
        iterates = self._no_iterates if iterates is None else iterates

        def rub() -> None:
            self.spins(start, x)
            for part in self.frictions:
                part.evaluate(x, start, rate, iterates)

        push = [partial(part.evaluate, x, self.law, self.gap) for part in self.lists]
        arrays.side_by_side([*push, *([rub] if self.frictions else [])], self.device)
        arrays.side_by_side([self._sum_up, partial(self._totals, self.search.overflow)], self.device)

    def _sum_up(self) -> None:
        outputs = [self.forces, self.diagonal, self.stiffness, self._told]
        arrays.sweep(self._collect, len(self.forces), [self.products.sets], outputs, self.device)

    def _start_anew(self) -> None:
        """No gap was seen yet."""
        if self._version != self.search.version:
            raise SolverError("the lists of pairs have grown; call fit() of these terms, and capture graphs anew")
        self.gap.fill_(self.search.reach)

    def product(self, v: wp.array, out: wp.array, x: wp.array | None = None, wanted: wp.array | None = None) -> None:
        """out += H v of the last `evaluate`, vectors of 3 (worlds times nodes,).

        H is the Gauss-Newton matrix, positive semi-definite by form; with the positions x of that `evaluate`, the exact Hessian. Of
        friction both are the same. With `wanted` (worlds,), H has at x what of the exact one comes of pairs that turn
        (`kernels.contact.pair_bend`), in worlds where that is not zero, once `prepare` was called there.
        """
        if x is None or wanted is not None:
            self.products(v, out, x, wanted)
            return
        for part in self.lists:
            part.exact_product(v, x, self.law)
        if self._rub:
            self._rub.place(v)
        self.products.gather(out)

    def meet(self) -> None:
        """What `settle` takes of the last `evaluate`: which nodes are in pairs."""
        self.products.meet()

    def prepare(self, x: wp.array, wanted: wp.array) -> None:
        """What products take that have at x what comes of pairs that turn, in worlds where `wanted` (worlds,) is not zero."""
        self.products.prepare(x, wanted)

    def place(self, v: wp.array, x: wp.array, wanted: wp.array | None) -> None:
        """What pairs bring to nodes of `product`, for `settle`."""
        self.products.place(v, x, wanted)

    def settle(self, v: wp.array, out: wp.array, barred: wp.array, busy: wp.array, dots: wp.array) -> None:
        """`product` as it was placed, on dofs that are not barred, in worlds that are `busy` (1), and v . out for nodes in pairs.

        After `meet`.

        Args:
            barred: of each node, bits of the dofs whose product is not asked for; dots: (worlds, nodes).
        """
        self.products.settle(v, out, barred, busy, dots)

    def join(self) -> None:
        """Write `between` and `turned` of the last `evaluate`."""
        edges = self.search.lists[0].first
        inputs = [self.products.sets, edges.surface, edges.count]
        arrays.sweep(self._join, len(self.between), inputs, [self.between, self._told_edges], self.device)
        if self.rolls:
            inputs = [self.products.sets, self._angles, len(self.search.shapes.points)]
            arrays.sweep(self._roll, len(self.between), inputs, self.turned, self.device)

    def _check(self, rate: wp.array) -> None:
        """Refuse rates that do not fit, and friction that was not lagged."""
        if rate.shape != (self.search.worlds,) or rate.dtype is not self.real:
            raise SolverError(
                f"rates of contact are {self.search.worlds} of {self.real.__name__}, one a world,"
                f" not {rate.shape} of {rate.dtype.__name__}"
            )
        if self.frictions and self._lagged != self._version:
            raise SolverError("friction has no pairs of the step's start; call lag() there, anew after fit()")

    def _with_friction(self, rubs: bool, ways, law: str, velocity: float, silent) -> list[FrictionElements]:
        """Friction of each list, where there is any."""
        if law not in FRICTION_LAWS:
            raise SceneError(f"friction_law = {law!r} of contact; it is one of {', '.join(FRICTION_LAWS)}")
        if not 0.0 < velocity < np.inf:
            raise SceneError(f"velocity = {velocity!r} of friction; it is positive and finite [m/s]")
        if not rubs:
            return []
        number = self.law.friction.shape[1]
        same = ways is None or (np.asarray(ways) == 1.0).all()
        ways = None if same else [table("ways", way, number, False) for way in np.moveaxis(np.asarray(ways), -1, 0)]
        return [
            FrictionElements(
                part,
                FRICTION_LAWS[law],
                float(velocity),
                None if same else np.stack(ways, -1),
                self.search.shapes,
                self.spins,
                len(self.forces),
                self.real,
                self.linear,
                silent,
            )
            for part in self.lists
        ]
