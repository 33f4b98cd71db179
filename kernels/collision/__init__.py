"""Kernels of contact, in four layers.

    candidates   pairs that may come within range: `boxes`, `candidates`, `runs`, `motion`; `impact` and `shares` limit motions by them
    collisions   pairs with closest points, as weights, distance and direction: `collisions`
    potentials   energies of collisions with derivatives: `pair_energy`, `pair_bend` and `pair_terms` of contact, `pair_friction`
    laws         energies by the gap and by the slip: `kernels.densities.contact` and `kernels.densities.friction`

The registry of potentials is `kernels.terms.CONTACT` and `FRICTION`; reverse mode is in `kernels.adjoint.contact`.
"""
