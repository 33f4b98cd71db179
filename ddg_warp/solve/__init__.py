"""Steps, Newton's method, linear solvers and preconditioners, equilibria, continuation, stability."""
