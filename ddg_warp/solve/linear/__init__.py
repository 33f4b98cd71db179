"""Linear systems: matrices, preconditioners, conjugate gradients, factorisations, eigenvalues, solver selection."""
