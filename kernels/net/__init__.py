"""Kernels of nets: elements of any kind on shared dof blocks, gathered by index, and their sparse system."""
