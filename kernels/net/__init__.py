"""Kernels of the coupled system: elements of any kind on shared dof blocks, gathered by index, and the sparse system."""
