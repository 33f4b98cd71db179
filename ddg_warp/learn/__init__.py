"""Gradients of steps and equilibria, the torch interface, data sets and environments."""
