"""Compilation of the coupled system, with dofs addressed by index."""
