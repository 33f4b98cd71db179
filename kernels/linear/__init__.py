"""Matrices, eliminations, preconditioners and conjugate gradients."""
