"""Outcomes of a Newton solve, as the device writes them into `status`."""

ACTIVE = 0
CONVERGED = 1
CONVERGED_TO_ROUNDING = 2
MAX_ITERATIONS = 3
LINE_SEARCH_FAILED = 4
NON_FINITE = 5
# the exact Hessian has a negative pivot, and nothing was to be put in its place; or, of a net, conjugate gradients have no direction,
# as their preconditioner is not definite in this precision
INDEFINITE = 6
GIVEN_UP = 7  # an earlier step failed for good; the rod rests at its last good state
LOST_IN_ROUNDING = (
    8  # counted instead of CONVERGED_TO_ROUNDING where rounding decides the motion, and the user allowed that
)
ENERGY_DRIFT = 9  # the midpoint rule would have made or lost more energy than it may; see `kernels.energy`
CROSSED = 10  # things would have passed through each other
NO_ROOM = 11  # surfaces have come so near that a barrier, whose forces grow without bound, has lost its digits
TURNED_TOO_FAR = 12  # supports or obstacles would turn farther in a step than substeps resolve
INVALID_INPUT = 13  # a parameter or control that a step was handed as a tensor is not finite, or none that it may be
NO_GRADIENT = 14  # a step that converged, through which no gradient goes; see `ddg_warp.learn.engine`

NAMES = {
    CONVERGED: "converged",
    CONVERGED_TO_ROUNDING: "converged_to_rounding",
    MAX_ITERATIONS: "max_iterations",
    LINE_SEARCH_FAILED: "line_search_failed",
    NON_FINITE: "non_finite",
    INDEFINITE: "indefinite",
    GIVEN_UP: "given_up",
    LOST_IN_ROUNDING: "lost_in_rounding",
    ENERGY_DRIFT: "energy_drift",
    CROSSED: "crossed",
    NO_ROOM: "no_room",
    TURNED_TOO_FAR: "turned_too_far",
    INVALID_INPUT: "invalid_input",
    NO_GRADIENT: "no_gradient",
}
