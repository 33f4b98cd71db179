"""Solvers of the coupled system, with dofs addressed by block index."""
