"""Contact search, CCD and contact forces: memory and launches of `kernels.collision`."""
