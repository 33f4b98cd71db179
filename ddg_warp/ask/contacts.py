"""What touches what at a state."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.threads import launches


@dataclass(frozen=True)
class Contacts:
    """Pairs of edges, points or triangles in contact at a state; see `Model.contacts`.

    Attributes:
        world: (n,) that each pair is in; objects: (n, 2), both their objects, places in `names`.
        names: of rods, shells and obstacles that may touch, such as "rod 3".
        point: between the closest points (n, 3) [m]; gap: (n,) [m].
        force: of contact, without friction, on the first object (n, 3) [N]; the second has its opposite.
    """

    world: np.ndarray
    objects: np.ndarray
    names: list[str]
    point: np.ndarray
    gap: np.ndarray
    force: np.ndarray

    def __len__(self) -> int:
        return len(self.gap)


@launches
def contacts(model, state) -> Contacts:
    """What touches what at a state: all pairs closer than the range of contact.

    Raises:
        SceneError: the scene has no contact.
    """
    touch = model.touch
    if touch is None:
        raise SceneError("contacts: this scene has no contact; add scene.contact()")
    touch.at(state.net.q)
    found = touch.pairs(state.net.q)
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
    )
