"""Gyroscopic couples of spinning rods, before and after every step; see `kernels.gyroscopic`."""

from dataclasses import replace

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.gyroscopic import kick_kernel
from ddg_warp.model.state import State


class Gyroscope:
    """Half time steps of the couples of all rods with twist and rotary inertia.

    Args:
        model: whose rods they are.
        dt: length of a step of every world [s].
    """

    def __init__(self, model, dt: wp.array):
        self._model = model
        heavy = [group.kind.twist and group.host.rotary.any() for group in model.groups]
        self._parts = [_Part(model, group, dt) if own else None for group, own in zip(model.groups, heavy, strict=True)]
        heavy = model.net is not None and model.net.host.mass[model.net.angle_start :][: model.net.edges].any()
        self._net = _Part(model, model.net, dt) if heavy else None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [part.kernel for part in (*self._parts, self._net) if part]

    def begin(self, before: State, steps: list, net_step) -> State:
        """Return the state before a step with the velocities that the couples give it; launches alone."""
        groups = [
            part.begin(own, step.islands) if part else own
            for part, own, step in zip(self._parts, before.groups, steps, strict=True)
        ]
        net = self._net.begin(before.net, net_step.islands) if self._net else before.net
        return State(self._model, groups, net, before.time, before.grips)

    def finish(self, after: State, steps: list, net_step) -> None:
        """Give the state after a step its half, in place; launches alone."""
        for part, own, step in zip(self._parts, after.groups, steps, strict=True):
            if part:
                part.kick(own, own.v, step.islands, True)
        if self._net:
            self._net.kick(after.net, after.net.v, net_step.islands, True)


class _Part:
    """Of a group of rods, or of the net."""

    def __init__(self, model, part, dt: wp.array):
        real, device = model.types.real, model.wp_device
        self.kernel, self._part, self._dt, self._device = kick_kernel(real), part, dt, device
        host, vector = part.host, wp.types.vector(3, real)
        nodes, angles, colors = _edges(host)
        self._colors = [
            wp.array(np.column_stack([nodes[own], host.index(angles[own])]).astype(np.int32), dtype=int, device=device)
            for own in (np.flatnonzero(colors == color) for color in range(colors.max(initial=-1) + 1))
        ]
        free = np.where(host.holding(np.arange(host.nodes)), 0.0, 1.0)
        free[list(getattr(host, "frames", ()))] = 0.0  # nodes on oblique planes count as held
        self._free = wp.array(free, dtype=vector, device=device)
        self._is_net = part is model.net
        shape = (part.worlds * part.blocks,) if self._is_net else (part.nodes, part.columns)
        self._v = arrays.allocate(shape, vector, device)

    def begin(self, own, islands):
        """Return the part of a state with other velocities."""
        arrays.copy(self._v, own.v)
        self.kick(own, self._v, islands, False)
        return replace(own, v=self._v)

    def kick(self, own, v: wp.array, islands, after: bool) -> None:
        """Change velocities v of a part of a state."""
        part = self._part
        if self._is_net:
            x, rates, v, rotary = part.points(own.q), part.angles(own.v), part.points(v), part.node_mass
        else:
            x, rates, rotary = own.x, own.omega, part.rotary
        flags, _ = islands.arrays
        for edges in reversed(self._colors) if after else self._colors:
            inputs = [
                edges,
                self._free,
                x,
                rates,
                part.node_mass,
                rotary,
                self._dt,
                part.world_columns,
                int(after),
                flags,
            ]
            wp.launch(self.kernel, (len(edges), part.worlds), inputs, [v], device=self._device)


def _edges(host) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges with rotary inertia, their nodes (E, 2) and angles (E,) as places, and colors (E,): no two of one color share a node."""
    places, nodes, angles = host.places, [], []
    for row in range(len(places.rods)):
        if places.twist[row]:
            count = places.own[row] - (0 if places.closed[row] else 1)
            k, rows = np.arange(count), np.full(count, row)
            nodes.append(np.column_stack([places.nodes(rows, k), places.nodes(rows, (k + 1) % places.own[row])]))
            angles.append(places.angles(rows, k))
    nodes = np.concatenate([np.zeros((0, 2), int), *nodes])
    taken, colors = {}, np.zeros(len(nodes), int)
    for edge, (a, b) in enumerate(nodes.tolist()):
        used = taken.get(a, 0) | taken.get(b, 0)
        colors[edge] = color = (~used & (used + 1)).bit_length() - 1  # the lowest that both have left
        taken[a], taken[b] = taken.get(a, 0) | 1 << color, taken.get(b, 0) | 1 << color
    return nodes, np.concatenate([np.zeros(0, int), *angles]), colors
