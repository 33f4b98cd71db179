"""Contact and friction on the candidates of a search: energies, forces, and products with the Hessian.

See `kernels.collision.contact.potential` and `kernels.collision.friction.potential`.
"""

from functools import partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.densities import Density
from ddg_warp.kernels.terms import FRICTION_LAWS
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.contact_blocks import ContactBlocks
from ddg_warp.solve.collision.contact_set import ContactSet
from ddg_warp.solve.collision.friction_set import FrictionSet
from ddg_warp.solve.collision.hessian_product import PairProduct
from ddg_warp.solve.collision.parameter_tables import at_island_rate, law_tables, table
from ddg_warp.solve.collision.surface_rotation import RotatingSurfaces
from ddg_warp.solve.collision.world_sums import WorldSums


class ContactPotential:
    """Contact of all pairs of a `BroadPhase`, with one law, parameters by pairs of groups of objects, and friction.

    Friction acts on the pairs that are active when `lag` is called, at the start of a step, with their normal forces. Searches
    within the step leave it unchanged.

    `lag`, `evaluate`, `product` and `join` read nothing back and can be captured, on the CPU too. Capture their graphs again whenever
    `version` of the search grows, after `fit` of the search and of the terms, starting with `lag`. While pairs do not fit, energies are
    infinite.

    Args:
        search: candidates; to be updated before each `evaluate`.
        law: `densities.contact.smooth_penalty`, `log_barrier` or a `gap_law`.
        stiffness: [N/m], not negative. Stiffness, range and thickness are numbers, or symmetric (groups, groups).
        range: activation distance [m], positive, at most the reach of the search.
        thickness: distance of zero gap [m], by default the sum of both radii.
        groups: group of each object (objects,), from 0; by default one group.
        friction: coefficient mu, a number or symmetric (groups, groups), not negative; None or 0: no friction is built.
        `ways`: anisotropic friction multipliers (groups, groups, 3), not negative, for sliding of a rod, the first object: forwards,
            towards its last node, backwards, and across. By default friction is isotropic.
        friction_law: "logistic" or "polynomial", see `densities.friction`.
        velocity: stick threshold nu [m/s], positive; sticking contacts creep at a fraction of it.
        linear: type of factors and of vectors of products, by default the type of positions.
        silent: nodes of a world that need no forces and products, and may be in thousands of pairs.
        inertia: masses [kg], not negative, a number or symmetric (groups, groups). Times the squared rates of `law` they bound the
            stiffness from below; None or 0: no bound.
        shared: arrays (worlds, groups, groups) by name that replace parameters of the law.
        exact: whether products with geometric stiffness are exact for nearly parallel edges, too, however many.

    Attributes:
        energy: (worlds,) [J], of contact and the potential of friction; forces: (worlds times nodes,) [N].
        gap: (worlds,) smallest gap of all candidates [m], at most the reach of the search; touching, dissipated: see `WorldSums`.
        blocks: the `ContactBlocks` of the matrix.
        rolls, rotates: whether friction rotates rods, or rigid bodies.
        start: positions and angles at the start of slip (worlds times nodes,), unless given to `evaluate`.
        more: addition to normal forces in friction (worlds,) [N], zero except for forced sticking.
        law: `law_struct`, on the device, with rates of inertia (worlds,) [1/s], initially zero; lag_law: law of the last friction lag.
        products: the `PairProduct` of all lists.
        spins: rotations of spinning objects since the start of slip.

    Raises:
        SceneError: names the parameter, the pair of objects if any, and the remedy.
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
        inputs = {
            "stiffness": stiffness,
            "range": range,
            "thickness": thickness,
            "friction": friction,
            "inertia": inertia,
        }
        self.law, has_friction = law_tables(search, inputs, groups, shared or {})
        self.heavy = inertia is not None and bool(np.any(inertia))
        self.lag_law, self._law_before = (
            self.law,
            at_island_rate(self.law, self.real) if self.heavy and has_friction else None,
        )
        nodes = len(search.shapes.points) * search.worlds
        self.gap = wp.zeros(search.worlds, dtype=self.real, device=self.device)
        self._no_rate, self._no_gap = wp.zeros_like(self.gap), wp.zeros_like(self.gap)
        self._least = wp.full_like(self.gap, search.search_distance)  # of the pairs so far
        self.forces = wp.zeros(nodes, dtype=wp.types.vector(3, self.real), device=self.device)
        silenced = np.zeros(len(search.shapes.points), np.uint8)
        silenced[[] if silent is None else silent] = 1
        silenced = wp.array(silenced, dtype=wp.uint8, device=self.device)
        self.lists = [ContactSet(pairs, law, nodes, self.real, self.linear, silenced, exact) for pairs in search.lists]
        self._version, self._lagged = search.version, -1
        self.spins = RotatingSurfaces(search)
        self.frictions = self._with_friction(has_friction, ways, friction_law, velocity, silenced)
        self.start, self.more = wp.zeros_like(self.forces), wp.zeros_like(self.gap)
        self.rolls = any(part.rolls for part in self.frictions)
        self.rotates = any(part.rotates for part in self.frictions)
        self.blocks = ContactBlocks(search, len(self.law.square), self.linear, self.rolls, self.rotates)
        self.products = PairProduct(self._parts, self.law, self.real, self.linear)
        self._rub = PairProduct(self.frictions, self.law, self.real, self.linear) if self.frictions else None
        self._totals = totals = WorldSums(self.lists, self.frictions, search, self.real)
        self.energy, self.active_pairs, self.dissipated = totals.energy, totals.active_pairs, totals.dissipated
        self._no_iterates = (wp.zeros(0, dtype=int, device=self.device),) * 2

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        parts = [kernel for part in self._parts for kernel in part.kernels]
        kernels = [*self.blocks.kernels, *(self.spins.kernels if self.frictions else [])]
        return [*kernels, *self.products.kernels, *self._totals.kernels, *parts]

    @property
    def _parts(self) -> list:
        return [*self.lists, *self.frictions]

    def fit(self) -> bool:
        """Grow buffers to the capacity of the lists of the search, and return whether they grew. Not in a capture.

        After growth, repeat the step from its `lag`.
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
        """Set the rates of `law` (worlds,) [1/s] for the inertial stiffness; None for zero."""
        if self.heavy and rate is not None:
            wp.copy(self.law.rate, rate)
        elif self.heavy:
            self.law.rate.zero_()

    def lag(self, x: wp.array, again: bool = False, rate: wp.array | None = None) -> None:
        """Lag friction: take pairs, normal forces and tangents from contact at x, the start of slip.

        If friction is lagged `again`, slip keeps its start. Without friction this is a no-op.

        Args:
            x: positions (worlds times nodes,).
            again: whether the line search continues.
            rate: rate of the inertial stiffness at x (worlds,) [1/s]; by default the rate of `law`.

        Raises:
            SolverError: if the lists of the search have grown since `fit`.
        """
        if not self.frictions:
            return
        self._require_fit()
        self.lag_law = self.law
        if self._law_before and rate is not None:
            wp.copy(self._law_before.rate, rate)
            self.lag_law = self._law_before
        law = self.lag_law

        def lag(part: ContactSet, friction: FrictionSet) -> None:
            part.write(x, law, self._no_gap)
            friction.lag(law, x, again, self.more)

        device_arrays.side_by_side(
            [partial(lag, *both) for both in zip(self.lists, self.frictions, strict=True)], self.device
        )
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
        """Compute energies, forces, factors and smallest gaps at positions x; with rates, also of friction.

        Args:
            rate: 1/h of each world (worlds,) [1/s]; no friction where it is 0.
            start: positions at the start of slip, by default the positions of `lag`.
            iterates: index of the accepted one of two iterates, 0 or 1, and number of iterates, by world. Then the friction matrix
                has the direction as an extra unknown, see `kernels.collision.friction.potential`.

        Raises:
            SolverError: if the lists of the search have grown since `fit`, or friction was not lagged since then, or rates do not fit.
        """
        if rate is not None:
            self._check(rate)
        self._require_fit()
        start = self.start if start is None else start
        rate = self._no_rate if rate is None else rate
        iterates = self._no_iterates if iterates is None else iterates

        def evaluate_friction() -> None:
            self.spins(start, x)
            for part in self.frictions:
                part.evaluate(x, start, rate, iterates)

        push = [partial(part.evaluate, x, self.law, self._least) for part in self.lists]
        device_arrays.side_by_side([*push, *([evaluate_friction] if self.frictions else [])], self.device)
        collect = partial(self.blocks.collect, self.products.sets, self.forces)
        totals = partial(self._totals, self.search.counters.overflow, self._least, self.gap)
        device_arrays.side_by_side([collect, totals], self.device)

    def _require_fit(self) -> None:
        """Refuse lists that have grown since `fit`."""
        if self._version != self.search.version:
            raise SolverError("the lists of pairs have grown; call fit() of these terms, and capture graphs again")

    def product(self, v: wp.array, out: wp.array, x: wp.array | None = None, wanted: wp.array | None = None) -> None:
        """Add H v of the last `evaluate` to `out`, vectors of 3 (worlds times nodes,).

        H is the Gauss-Newton matrix, positive semi-definite by construction; with the positions x of that `evaluate`, the exact
        Hessian. For friction both are equal. With `wanted` (worlds,), H includes the geometric stiffness at x
        (`kernels.collision.contact.geometric_stiffness`) in worlds where that is nonzero, after `prepare`.
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
        """Mark the nodes in pairs of the last `evaluate`, for `settle`."""
        self.products.meet()

    def prepare(self, x: wp.array, wanted: wp.array) -> None:
        """Prepare products with geometric stiffness at x, in worlds with nonzero `wanted` (worlds,)."""
        self.products.prepare(x, wanted)

    def place(self, v: wp.array, x: wp.array, wanted: wp.array | None) -> None:
        """Write the contributions of pairs to `product` at nodes, for `settle`."""
        self.products.place(v, x, wanted)

    def settle(self, v: wp.array, out: wp.array, inactive_mask: wp.array, busy: wp.array, dots: wp.array) -> None:
        """Gather the `product` written by `place` on active dofs, in worlds that are `busy` (1), and v . out for nodes in pairs.

        Requires `meet`.

        Args:
            inactive_mask: bits of inactive dofs of each node; dots: (worlds, nodes).
        """
        self.products.settle(v, out, inactive_mask, busy, dots)

    def join(self) -> None:
        """Assemble the `blocks` between the nodes of edges, of the last `evaluate`."""
        self.blocks.join(self.products.sets)

    def _check(self, rate: wp.array) -> None:
        """Refuse rates of the wrong shape or type, and friction without `lag`."""
        if rate.shape != (self.search.worlds,) or rate.dtype is not self.real:
            raise SolverError(
                f"rates of contact are {self.search.worlds} of {self.real.__name__}, one a world,"
                f" not {rate.shape} of {rate.dtype.__name__}"
            )
        if self.frictions and self._lagged != self._version:
            raise SolverError("friction has no pairs of the step's start; call lag() there, and again after fit()")

    def _with_friction(self, has_friction: bool, multipliers, law: str, velocity: float, silent) -> list[FrictionSet]:
        """Return the friction of each list, none without friction."""
        if law not in FRICTION_LAWS:
            raise SceneError(f"friction_law = {law!r} of contact; it is one of {', '.join(FRICTION_LAWS)}")
        if not 0.0 < velocity < np.inf:
            raise SceneError(f"velocity = {velocity!r} of friction; it is positive and finite [m/s]")
        if not has_friction:
            return []
        number = self.law.friction.shape[1]
        same = multipliers is None or (np.asarray(multipliers) == 1.0).all()
        multipliers = (
            None
            if same
            else [
                table("ways", multiplier, number, False) for multiplier in np.moveaxis(np.asarray(multipliers), -1, 0)
            ]
        )
        return [
            FrictionSet(
                part,
                FRICTION_LAWS[law],
                float(velocity),
                None if same else np.stack(multipliers, -1),
                self.search.shapes,
                self.spins,
                len(self.forces),
                self.real,
                self.linear,
                silent,
            )
            for part in self.lists
        ]
