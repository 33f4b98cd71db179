"""Non-elastic forces, and prescribed motion."""
