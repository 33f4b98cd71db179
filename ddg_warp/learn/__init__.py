"""Learning with the simulator: gradients of steps and equilibria, torch, data."""
