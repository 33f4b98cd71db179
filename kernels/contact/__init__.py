"""Kernels of contact, by four ideas.

    candidates   pairs that may come within range: `boxes`, `candidates`, `runs`, `motion`; `impact` and `shares` bound motions by them
    collisions   pairs with their closest points, as weights, distance and direction: `collisions`
    potentials   energies of collisions with their derivatives: `pair_energy`, `pair_bend` and `pair_terms` of contact, `pair_friction`
    laws         energies by the gap and by the slip: `kernels.densities.contact` and `kernels.densities.friction`

The registry of potentials is `kernels.terms.CONTACT` and `FRICTION`; reverse mode is in `kernels.adjoint.contact`.
"""
