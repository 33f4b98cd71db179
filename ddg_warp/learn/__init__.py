"""Learning: data sets of recorded runs and of recordings of real cables, and sweeps that make them."""
