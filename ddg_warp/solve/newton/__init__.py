"""Newton solvers of rod groups and of the coupled system, with residuals, line searches and edge rotations."""
