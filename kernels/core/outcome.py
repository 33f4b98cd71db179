"""Outcomes of a Newton solve, as kernels write them into `status`."""

ACTIVE = 0
CONVERGED = 1
CONVERGED_TO_ROUNDING = 2
MAX_ITERATIONS = 3
LINE_SEARCH_FAILED = 4
NON_FINITE = 5
# The exact Hessian has a negative pivot, and no projected Hessian is allowed. In the coupled system also: conjugate gradients have no
# direction, as the preconditioner is not definite in this precision.
INDEFINITE = 6
STEP_FAILED = 7  # An earlier step failed for good; the rod stays in its last good state.
ROUNDING_DOMINATED = 8  # Instead of CONVERGED_TO_ROUNDING where rounding decides the motion, as allowed by the user.
# The midpoint rule would have exceeded the allowed energy drift; see `kernels.stepping.energy_drift`. Or contact of a rotating body
# would have created energy; see `kernels.rigid_bodies.contact_energy`.
ENERGY_DRIFT = 9
INTERPENETRATION = 10  # Primitives would have crossed.
MINIMUM_GAP = 11  # Minimum gap reached: the forces of the barrier, which grow without bound, have lost their digits.
ROTATED_TOO_FAR = 12  # Supports or obstacles would rotate farther in a step than substeps resolve.
INVALID_INPUT = 13  # A parameter or control of a step, given as a tensor, is not finite or not allowed.
NO_GRADIENT = 14  # A converged step through which no gradient goes; see `ddg_warp.torch.engine`.

NAMES = {
    CONVERGED: "converged",
    CONVERGED_TO_ROUNDING: "converged_to_rounding",
    MAX_ITERATIONS: "max_iterations",
    LINE_SEARCH_FAILED: "line_search_failed",
    NON_FINITE: "non_finite",
    INDEFINITE: "indefinite",
    STEP_FAILED: "given_up",
    ROUNDING_DOMINATED: "lost_in_rounding",
    ENERGY_DRIFT: "energy_drift",
    INTERPENETRATION: "crossed",
    MINIMUM_GAP: "no_room",
    ROTATED_TOO_FAR: "turned_too_far",
    INVALID_INPUT: "invalid_input",
    NO_GRADIENT: "no_gradient",
}
