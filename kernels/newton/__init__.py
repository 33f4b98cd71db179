"""Newton iterations: line search, edge rotations, sleeping islands, relaxed convergence."""
