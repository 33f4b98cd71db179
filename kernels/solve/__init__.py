"""Linear solvers: direct elimination along rods, cyclic reduction, conjugate gradients and preconditioners."""
