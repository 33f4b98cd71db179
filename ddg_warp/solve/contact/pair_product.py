"""Products of the matrix of contact and friction with vectors; see `kernels.contact.pair_product`."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.contact.gather import set_struct
from ddg_warp.kernels.contact.pair_bend import KINDS
from ddg_warp.kernels.contact.pair_product import product_kernels
from ddg_warp.kernels.contact.surfaces import EDGES
from ddg_warp.solve.contact.contact_elements import ContactElements


class PairProduct:
    """The product of the matrix of some lists of pair elements with a vector; `fit` follows whenever they have got more room.

    Attributes:
        sets: the lists, see `kernels.contact.gather.set_struct`; most: the most pairs that one has room for.
    """

    def __init__(self, parts: list, law, real, linear):
        self._law, self._mollified = law, [part.mollified for part in parts if part.mollified]
        self._parts, self._real, self._linear, self._device = parts, real, linear, parts[0].device
        types = int, wp.types.vector(3, real)
        self._nothing = [wp.zeros(0, dtype=dtype, device=self._device) for dtype in types]
        made = product_kernels(real, linear, arrays.serial(self._device), any(part.rolls for part in parts))
        self._multiply, self._gather, self._meet, self._settle = made
        self.kernels = [*made]
        self.kernels += [kernel for part in self._mollified for kernel in part.kernels]
        self.fit()

    def fit(self) -> None:
        """Take the arrays that the lists have now."""
        self._sets = [self._set(part) for part in self._parts]  # an array of structures keeps nothing alive
        self.sets = wp.array(self._sets, dtype=set_struct(self._real, self._linear), device=self._device)
        self.most = max(part.found.capacity for part in self._parts)
        self._met = wp.zeros(len(self._parts[0].numbers), dtype=wp.uint8, device=self._device)

    def meet(self) -> None:
        """Which nodes are in pairs, for `settle`."""
        self._sweep(self._meet, len(self._met), [self.sets], [self._met])

    def prepare(self, x: wp.array, wanted: wp.array) -> None:
        """What products with what turns take at positions x, in the worlds that want it."""
        for part in self._mollified:
            part.differentiate(x, self._law, wanted)

    def __call__(self, v: wp.array, out: wp.array, x: wp.array | None = None, wanted: wp.array | None = None) -> None:
        """out += H v; with what turns at positions x in the worlds that want it."""
        self.place(v, x, wanted)
        self.gather(out)

    def gather(self, out: wp.array) -> None:
        """Add what is placed to nodes."""
        self._sweep(self._gather, len(out), [self.sets], [out])

    def settle(self, v, out, barred: wp.array, busy: wp.array, dots: wp.array) -> None:
        """The same on dofs that are not barred in worlds that are busy, and v . out of the nodes to which it adds."""
        self._sweep(self._settle, len(out), [self.sets, self._met, v, barred, busy], [out, dots])

    def place(self, v, x=None, wanted=None) -> None:
        """What pairs bring to nodes, of products as above."""
        given = self._nothing if wanted is None else [wanted, x]
        arrays.take_turns(self._multiply, self.most, [self.sets, *given, v], [], self._device)
        for part in self._mollified if wanted is not None else ():
            if not part.keeps:
                part.multiply(v)

    def _set(self, part):
        own, kind = set_struct(self._real, self._linear)(), part.found.kind
        for name in ("nodes", "used", "row", "bend", "angles", "lever"):
            setattr(own, name, getattr(part.factor, name))
        names = ("pairs", "count", "gradient", "placed", "places", "numbers", "items", "ranks", "angle_ranks", "idle")
        for name in names:
            setattr(own, name, getattr(part, name))
        for name in ("marks", "starts", "columns") if part.mollified and part.mollified.keeps else ():
            setattr(own, name, getattr(part.mollified, name))
        own.kind = KINDS.index(kind) if isinstance(part, ContactElements) else -1
        own.edges = (kind.first == 2) + (kind == EDGES)
        own.rows, own.things = part.rows, part.found.first.count
        return own

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        arrays.sweep(kernel, count, inputs, outputs, self._device)
