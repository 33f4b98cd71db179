"""Geometry in NumPy: curves, surfaces, meshes, discrete operators, forms of shells, turning numbers."""
