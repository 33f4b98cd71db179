"""Rigid bodies of the coupled system: motion, and condensation of carried nodes onto the dofs of their bodies."""
