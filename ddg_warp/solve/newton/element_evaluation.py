"""Evaluation of all elements of the coupled system: energies, gradients and Gauss-Newton factors."""

from collections.abc import Callable
from functools import partial

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.coupled_element import coupled_storage
from ddg_warp.kernels.linear.rod_dof_map import allows_mixed_axial
from ddg_warp.solve.newton.rod_newton import FIRST_EXACT_ITERATION


class ElementEvaluation:
    """Evaluation of the element sets of a `CoupledModel`. Attributes have an entry for each set.

    Args:
        psd: see `NewtonOptions`; linear: scalar type of factors.
        banded: True if substructuring assembles elements along rods.
        mixed_axial: True if edges may be stiffer than the matrix carries, where possible; see `RodSubstructuring.allows_mixed_axial`.

    Attributes:
        exact_from: first iteration with second derivatives, or None.
        local: True if derivatives are of the local dofs; split: True for edge tensions as unknowns.
        outputs: output arrays by name.
    """

    def __init__(self, coupled, psd: str, linear, banded: bool, mixed_axial: bool):
        self.coupled, self._linear = coupled, linear
        serial = device_arrays.serial(coupled.device)
        exact = [psd != "gauss_newton" and part.term.measure.packed > 0 for part in coupled.sets]
        first = 0 if psd == "none" else FIRST_EXACT_ITERATION
        self.exact_from = tuple(first if wanted else None for wanted in exact)
        self.local = tuple(banded and part.host.along for part in coupled.sets)
        self.mixed_axial = tuple(
            mixed_axial and local and allows_mixed_axial(part.term)
            for local, part in zip(self.local, coupled.sets, strict=True)
        )
        options = list(zip(coupled.sets, self.exact_from, self.local, self.mixed_axial, strict=True))
        self.outputs = [self._allocate(*of_set) for of_set in options]
        self._kernels = [
            element_path.evaluate_kernel(
                coupled_storage(part.term, coupled.real, not local, serial),
                coupled.real,
                linear,
                first is not None,
                is_split,
            )
            for part, first, local, is_split in options
        ]

    def _allocate(self, part, exact_from: int | None, local: bool, mixed_axial: bool) -> dict[str, wp.array]:
        """Return the output arrays of an element set."""
        coupled, linear, measure = self.coupled, self._linear, part.term.measure
        count, vector = coupled.worlds * part.elements, wp.types.vector(3, linear)
        rows, factor, gradient = (
            (measure.size, linear, coupled.real) if local else (measure.slots, vector, coupled.vector)
        )

        def lay(rows, dtype):
            return device_arrays.allocate((rows, count), dtype, coupled.device)

        def make(shape):
            return wp.zeros(shape, dtype=linear, device=coupled.device)

        return {
            "factor": lay(len(measure.strains) * rows, factor),
            "tension": lay(max(1, measure.tensions) + mixed_axial, linear),
            "second": make((1, 1)) if exact_from is None else lay(measure.packed, linear),
            "gradient": lay(rows, gradient),
            "energy": lay(2, coupled.real),
            "stiffness": make(count),
        }

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [(kernel, 128) for kernel in self._kernels]

    def launches(self, state, q: wp.array, islands) -> list[Callable[[], None]]:
        """Return the independent launches that evaluate all sets at positions q, with the lagged data of `state`."""
        return [partial(self._evaluate, index, state, q, islands) for index in range(len(self.outputs))]

    def _evaluate(self, index: int, state, q: wp.array, islands) -> None:
        coupled = self.coupled
        results = element_path.results_type(coupled.real, self._linear, not self.local[index])()
        for name, values in self.outputs[index].items():
            setattr(results, name, values)
        wp.launch(
            self._kernels[index],
            (coupled.worlds, device_arrays.takers(coupled.sets[index].elements, coupled.device)),
            [coupled.elements(state, index, q, islands.inverse_step), *islands.arrays, self.exact_from[index] or 0],
            [results],
            device=coupled.device,
            block_dim=128,
        )
