"""What touches what at a state."""

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.io.contacts import Contacts
from ddg_warp.threads import launches


@launches
def contacts(model, state) -> Contacts:
    """What touches what at a state, `Contacts`: all pairs closer than the range of contact, and what rubs by its velocities.

    An equilibrium with friction has that of the way there.

    Raises:
        SceneError: the scene has no contact.
    """
    touch = model.touch
    if touch is None:
        raise SceneError("contacts: this scene has no contact; add scene.contact()")
    touch.at(state.net.q, state.net.rate)
    found = touch.pairs(state.net.q, state.rubbing)
    owners = {size: touch.shapes.things(size)[2] for size in touch.shapes.sizes}
    objects = np.zeros((len(found["gap"]), 2), int)
    for size, own in owners.items():
        for side in range(2):
            here = found["sizes"][:, side] == size
            objects[here, side] = own[found["things"][here, side]]
    near = np.flatnonzero(found["force"].any(1))
    return Contacts(
        found["world"][near],
        objects[near],
        touch.shapes.names,
        found["point"][near].astype(float),
        found["gap"][near].astype(float),
        found["force"][near].astype(float),
        found["friction"][near].astype(float),
    )
