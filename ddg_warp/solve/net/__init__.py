"""Of nets, everything by index of a block."""
