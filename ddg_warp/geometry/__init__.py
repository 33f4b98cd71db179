"""Geometry in NumPy: curves, surfaces, meshes, discrete operators, fundamental forms, edge-rotation updates."""
