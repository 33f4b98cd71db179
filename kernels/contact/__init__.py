"""Kernels of contact: boxes, candidates and their motion; none of them has an adjoint."""
