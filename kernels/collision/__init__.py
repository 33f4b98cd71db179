"""Kernels of contact and friction, in four layers.

    candidates   pairs that may come within range: `broad_phase`; `ccd` limits motions by them
    collisions   pairs with closest points, as weights, distance and direction: `contact.closest_points`
    potentials   energies of collisions with derivatives: `contact.potential`, `friction.potential`
    laws         energies by the gap and by the slip: `kernels.densities.contact` and `kernels.densities.friction`

The registry of potentials is `kernels.terms.CONTACT` and `FRICTION`; reverse mode is in `kernels.adjoint.contact`.
"""
