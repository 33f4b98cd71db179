"""Non-elastic forces and prescribed motion, as launches of a step."""
