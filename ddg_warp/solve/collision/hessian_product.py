"""Products of the contact and friction matrix with vectors; see `kernels.collision.contact.hessian_product`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.assembly import set_struct
from ddg_warp.kernels.collision.contact.geometric_stiffness import KINDS
from ddg_warp.kernels.collision.contact.hessian_product import product_kernels
from ddg_warp.kernels.collision.primitives import EDGES
from ddg_warp.solve.collision.contact_set import ContactSet


class PairProduct:
    """Product of the matrix of some sets of pair elements with a vector; call `fit` after the sets have grown.

    Attributes:
        sets: the sets, see `kernels.collision.contact.assembly.set_struct`; most: largest capacity of a set.
        in_pairs: marks of the nodes in pairs, after `meet` (W N,).
    """

    def __init__(self, pair_sets: list, law, real, linear):
        self._law, self._mollified = law, [pair_set.mollified for pair_set in pair_sets if pair_set.mollified]
        self._parts, self._real, self._linear, self._device = pair_sets, real, linear, pair_sets[0].device
        types = int, wp.types.vector(3, real)
        self._nothing = [wp.zeros(0, dtype=dtype, device=self._device) for dtype in types]
        rolls, rotates = (any(getattr(each, name) for each in pair_sets) for name in ("rolls", "rotates"))
        made = product_kernels(real, linear, device_arrays.serial(self._device), rolls, rotates)
        self._multiply, self._gather, self._meet, self._settle = made
        self.kernels = [*made]
        self.kernels += [kernel for pair_set in self._mollified for kernel in pair_set.kernels]
        self.fit()

    def fit(self) -> None:
        """Take the present arrays of the sets."""
        self._sets = [self._set(pair_set) for pair_set in self._parts]  # an array of structures keeps no member alive
        self.sets = wp.array(self._sets, dtype=set_struct(self._real, self._linear), device=self._device)
        self.most = max(pair_set.found.capacity for pair_set in self._parts)
        self.in_pairs = wp.zeros(len(self._parts[0].numbers), dtype=wp.uint8, device=self._device)

    def meet(self) -> None:
        """Mark the nodes in pairs, for `settle`."""
        self._sweep(self._meet, len(self.in_pairs), [self.sets], [self.in_pairs])

    def prepare(self, x: wp.array, wanted: wp.array) -> None:
        """Differentiate near-parallel edges at positions x, in `wanted` worlds."""
        for edges in self._mollified:
            edges.differentiate(x, self._law, wanted)

    def __call__(self, v: wp.array, out: wp.array, x: wp.array | None = None, wanted: wp.array | None = None) -> None:
        """Add H v to `out`; with exact second derivatives at x in `wanted` worlds."""
        self.place(v, x, wanted)
        self.gather(out)

    def gather(self, out: wp.array) -> None:
        """Add the products of `place` to nodes."""
        self._sweep(self._gather, len(out), [self.sets], [out])

    def settle(self, v, out, inactive_mask: wp.array, busy: wp.array, dots: wp.array) -> None:
        """Add the products to active dofs in `busy` worlds, and write v . out of the nodes in pairs."""
        self._sweep(self._settle, len(out), [self.sets, self.in_pairs, v, inactive_mask, busy], [out, dots])

    def place(self, v, x=None, wanted=None) -> None:
        """Write the contributions of pairs to a product; arguments as of `__call__`."""
        exact_at = self._nothing if wanted is None else [wanted, x]
        device_arrays.take_turns(self._multiply, self.most, [self.sets, *exact_at, v], [], self._device)
        for edges in self._mollified if wanted is not None else ():
            if not edges.keeps:
                edges.multiply(v)

    def _set(self, pair_set):
        struct, kind = set_struct(self._real, self._linear)(), pair_set.found.kind
        for name in ("nodes", "used", "row", "bend", "angles", "lever", "rotations", "radii", "spin"):
            setattr(struct, name, getattr(pair_set.factor, name))
        names = ("pairs", "count", "gradient", "placed", "places", "numbers", "items", "idle")
        for name in (*names, "ranks", "angle_ranks", "rotation_ranks"):
            setattr(struct, name, getattr(pair_set, name))
        for name in ("marks", "starts", "columns") if pair_set.mollified and pair_set.mollified.keeps else ():
            setattr(struct, name, getattr(pair_set.mollified, name))
        struct.kind = KINDS.index(kind) if isinstance(pair_set, ContactSet) else -1
        struct.edges = (kind.first == 2) + (kind == EDGES)
        struct.rows, struct.primitives = pair_set.rows, pair_set.found.first.count
        return struct

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.sweep(kernel, count, inputs, outputs, self._device)
