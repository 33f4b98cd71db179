"""Reverse of time steps and equilibria by the implicit function theorem."""
