"""Reverse of what a step or an equilibrium computes: from derivatives of a loss by results to those by inputs."""
