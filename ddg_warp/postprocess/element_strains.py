"""Strains and conjugate stresses of all elements of a term."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays


def group_strains(model, group, data) -> tuple[np.ndarray, np.ndarray]:
    """Return strains and stresses of a rod group (strains, nodes, worlds, rods)."""
    shape = (group.kind.strain_rows, group.nodes, group.columns)
    strain, stress = (device_arrays.allocate(shape, model.types.real, model.wp_device) for _ in range(2))
    model.strains(group, data, strain, stress)
    split = (*shape[:2], group.worlds, group.rods)
    return device_arrays.download(strain).reshape(split), device_arrays.download(stress).reshape(split)


def coupled_strains(coupled, state, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return strains and stresses of an element set (strains, worlds, elements)."""
    part = coupled.sets[index]
    shape = (len(part.term.measure.strains), coupled.worlds * part.elements)
    strain, stress = (wp.zeros(shape, dtype=coupled.real, device=coupled.device) for _ in range(2))
    coupled.strains(state.coupled, index, strain, stress)
    split = (shape[0], coupled.worlds, part.elements)
    return strain.numpy().astype(float).reshape(split), stress.numpy().astype(float).reshape(split)
