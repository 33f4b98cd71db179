"""The balance of forces at the blocks of a net on a device; see `kernels.net.balance` and `places`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.judge import SETTLED
from ddg_warp.kernels.net import balance


class Balance:
    """Residuals of all blocks, what they do to the energy, and the worlds that are out of equilibrium.

    Args:
        newton: the `NetNewton` whose iterate, loads and results these are; `drag`, whether its blocks have more than a mass.
    """

    def __init__(self, newton, drag: bool):
        self.newton, net, real, linear = newton, newton.net, newton.real, newton.linear
        self.chains = newton.chains if newton.chains and newton.chains.banded else None
        given, found = balance.given_type(real, drag)(), balance.found_type(real, linear)()
        given.q = newton.here
        for name in ("base", "target", "mass", "gravity", "load", "fixed", "arm", "longest"):
            setattr(given, name, getattr(newton, name))
        given.settled = SETTLED * net.host.bodies.shortest
        given.allowed, given.blocks, given.nodes = newton.allowed.blocks, net.blocks, net.host.nodes
        given.rtol, given.floor = newton.options.rtol, newton.options.floor_factor * newton.eps
        for name in ("right", "square", "change", "noise"):
            setattr(found, name, getattr(newton, name))
        if newton.contact:
            given.push, given.pressed = newton.contact.forces, newton.contact.stiffness
        found.least, found.ratio = newton.allowed.least, newton.allowed.ratio
        self.given, self.found = given, found
        self._meetings = list(self._meeting_of_sets())  # an array of structures keeps nothing alive
        self.sets = wp.array(self._meetings, dtype=balance.meeting_type(real, linear), device=net.device)
        some = self.chains.elsewhere if self.chains else np.arange(0)
        self.some = wp.array(some.astype(np.int32), dtype=int, device=net.device)
        self.count = len(some) if self.chains else net.blocks
        if newton.planes:
            self._frames = [newton.planes.of_blocks, newton.planes.frames[real]]
        else:
            types = int, wp.types.matrix((3, 3), real)
            self._frames = [wp.zeros(0, dtype=dtype, device=net.device) for dtype in types]
        self.kernels = [
            balance.balance_kernel(real, linear, drag, newton.contact is not None, arrays.serial(net.device))
        ]

    def _meeting_of_sets(self):
        """What the elements of each set bring to the blocks."""
        newton, net = self.newton, self.newton.net
        nothing = [wp.zeros((1, 1), dtype=kind, device=net.device) for kind in (net.vector, newton.real)]
        for part, own, local, meets in zip(net.sets, newton.parts, newton.local, newton.system.meets, strict=True):
            meeting, measure = balance.meeting_type(newton.real, newton.linear)(), part.term.measure
            meeting.gradient, meeting.along = (nothing[0], own["gradient"]) if local else (own["gradient"], nothing[1])
            ends = np.transpose(measure.ends) if local else np.zeros((0, 2))
            meeting.ends = wp.array(ends.astype(np.int32), dtype=int, device=net.device)
            meeting.energy, meeting.stiffness, (meeting.starts, meeting.items) = own["energy"], own["stiffness"], meets
            meeting.nodes, meeting.elements = measure.nodes, part.elements
            yield meeting

    def __call__(self) -> None:
        """Balance the iterate."""
        newton, total = self.newton, self.newton.worlds * self.count
        if self.chains:
            self.chains.balance(self.given, newton.islands, self.found)
        arrays.sweep(
            self.kernels[0],
            total,
            [self.given, self.some, self.sets, *self._frames, *newton.islands.arrays, self.count, total],
            [self.found],
            newton.device,
        )
