"""Equilibria, paths and stability: static Newton methods, arc-length continuation, tangents, rigid-body modes."""
