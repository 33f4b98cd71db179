"""Contact query: pairs in contact at a state."""

import numpy as np

from ddg_warp.capture_lock import launches
from ddg_warp.errors import SceneError
from ddg_warp.io.contact_records import Contacts


@launches
def contacts(model, state) -> Contacts:
    """Return all pairs within the activation distance, with contact and friction forces.

    Friction is that of the state's velocities, or of the load step that led to an equilibrium.

    Raises:
        SceneError: the scene has no contact.
    """
    touch = model.touch
    if touch is None:
        raise SceneError("contacts: this scene has no contact; add scene.contact()")
    touch.evaluate(state.coupled.q, state.coupled.rate)
    pairs = touch.pairs(state.coupled.q, state.slip_velocity)
    owners = {size: touch.shapes.primitives(size)[2] for size in touch.shapes.sizes}
    objects = np.zeros((len(pairs["gap"]), 2), int)
    for size, owner in owners.items():
        for side in range(2):
            of_size = pairs["sizes"][:, side] == size
            objects[of_size, side] = owner[pairs["primitives"][of_size, side]]
    active = np.flatnonzero(pairs["force"].any(1))
    return Contacts(
        pairs["world"][active],
        objects[active],
        touch.shapes.names,
        pairs["point"][active].astype(float),
        pairs["gap"][active].astype(float),
        pairs["force"][active].astype(float),
        pairs["friction"][active].astype(float),
    )
