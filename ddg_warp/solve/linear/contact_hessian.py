"""Hessian of contact and friction at one position: products with vectors, and blocks of the preconditioner."""

import warp as wp

from ddg_warp.solve.linear.contact_bands import ContactBands
from ddg_warp.timers import timer


class ContactHessian:
    """Matrix-free Hessian of a `ContactPotential`, at the positions of the last evaluation.

    Args:
        shapes: collision mesh.

    Attributes:
        diagonal: (W N,) diagonal blocks.
    """

    def __init__(self, terms, shapes):
        self._terms, self._shapes, self.diagonal = terms, shapes, terms.blocks.diagonal
        self._bands = self._q = self._curved = None

    @property
    def products(self):
        """`PairProduct` of contact and friction."""
        return self._terms.products

    def bind(self, substructuring) -> None:
        """Add contact to the bands of a bound `RodSubstructuring` from now on."""
        self._bands = ContactBands(substructuring, self._shapes)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return self._bands.kernels if self._bands else []

    def linearise(self, q: wp.array, curved: wp.array | None) -> None:
        """Prepare products at positions q, with geometric stiffness in worlds with nonzero `curved` (worlds,)."""
        self._q, self._curved = q, curved
        self._terms.meet()
        if curved is not None:
            self._terms.prepare(q, curved)

    def assemble(self) -> None:
        """Assemble the blocks of edges that the bands need."""
        if self._bands:
            self._terms.join()

    @timer("contact")
    def add_to_bands(self, flags: wp.array) -> None:
        """Add the blocks to the preconditioner, once its own are assembled, in worlds whose flags want a direction."""
        if self._bands:
            self._bands(self._terms, flags)

    def spread(self, p: wp.array) -> None:
        """Write the contributions of pairs to H p."""
        self._terms.place(p, self._q, self._curved)

    def settle(self, p: wp.array, product: wp.array, system) -> None:
        """Add the contributions of pairs to the product, and write p . H p block by block."""
        self._terms.settle(p, product, system.masks.inactive, system.wanted, system.dots)
