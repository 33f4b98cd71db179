"""Compilation of a scene to arrays: dof maps, element sets, boundary conditions."""
