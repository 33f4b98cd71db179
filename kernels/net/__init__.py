"""Kernels of the coupled system: elements on shared dof blocks, gathered by index, and its matrix."""
