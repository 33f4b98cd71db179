"""Linear solves: elimination along chains, cyclic reduction, conjugate gradients and what they are preconditioned with."""
