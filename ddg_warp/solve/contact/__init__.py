"""Which surfaces may touch, and how far they may move: memory and launches of `kernels.contact`."""
