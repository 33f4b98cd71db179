"""Gyroscopic couples of spinning rods, before and after every step; see `kernels.forces.gyroscopic`."""

from dataclasses import replace

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.forces.gyroscopic import kick_kernel
from ddg_warp.model.state import State


class Gyroscope:
    """Half steps of gyroscopic couples of all rods with twist and rotary inertia.

    Args:
        model: model of the rods.
        dt: step length of every world [s].
    """

    def __init__(self, model, dt: wp.array):
        self._model = model
        heavy = [group.kind.twist and group.host.rotary.any() for group in model.groups]
        self._parts = [
            _Part(model, group, dt) if spins else None for group, spins in zip(model.groups, heavy, strict=True)
        ]
        heavy = (
            model.coupled is not None
            and model.coupled.host.mass[model.coupled.angle_start :][: model.coupled.edges].any()
        )
        self._coupled = _Part(model, model.coupled, dt) if heavy else None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [part.kernel for part in (*self._parts, self._coupled) if part]

    def begin(self, before: State, steps: list, coupled_step) -> State:
        """Return the state before a step with velocities after half of the couples; capturable."""
        groups = [
            part.begin(state, step.islands) if part else state
            for part, state, step in zip(self._parts, before.groups, steps, strict=True)
        ]
        coupled = self._coupled.begin(before.coupled, coupled_step.islands) if self._coupled else before.coupled
        return State(self._model, groups, coupled, before.time, before.grips)

    def finish(self, after: State, steps: list, coupled_step) -> None:
        """Apply the other half of the couples to the state after a step, in place; capturable."""
        for part, state, step in zip(self._parts, after.groups, steps, strict=True):
            if part:
                part.kick(state, state.v, step.islands, True)
        if self._coupled:
            self._coupled.kick(after.coupled, after.coupled.v, coupled_step.islands, True)


class _Part:
    """Gyroscopic couples of a rod group, or of the coupled system."""

    def __init__(self, model, part, dt: wp.array):
        real, device = model.types.real, model.wp_device
        self.kernel, self._part, self._dt, self._device = kick_kernel(real), part, dt, device
        host, vector = part.host, wp.types.vector(3, real)
        nodes, angles, colors = _edges(host)
        self._colors = [
            wp.array(
                np.column_stack([nodes[edges], host.index(angles[edges])]).astype(np.int32), dtype=int, device=device
            )
            for edges in (np.flatnonzero(colors == color) for color in range(colors.max(initial=-1) + 1))
        ]
        free = np.where(host.holding(np.arange(host.nodes)), 0.0, 1.0)
        free[list(getattr(host, "frames", ()))] = 0.0  # nodes on skew supports count as fixed
        self._free = wp.array(free, dtype=vector, device=device)
        self._is_coupled = part is model.coupled
        shape = (part.worlds * part.blocks,) if self._is_coupled else (part.nodes, part.columns)
        self._v = device_arrays.allocate(shape, vector, device)

    def begin(self, state, islands):
        """Return a state component with velocities after half of the couples."""
        device_arrays.copy(self._v, state.v)
        self.kick(state, self._v, islands, False)
        return replace(state, v=self._v)

    def kick(self, state, v: wp.array, islands, after: bool) -> None:
        """Apply half of the couples to velocities v."""
        part = self._part
        if self._is_coupled:
            x, rates, v, rotary = part.points(state.q), part.angles(state.v), part.points(v), part.node_mass
        else:
            x, rates, rotary = state.x, state.omega, part.rotary
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
    """Return nodes (E, 2), angles (E,) and colours (E,) of edges with rotary inertia; a colour has no common nodes."""
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
        colors[edge] = color = (~used & (used + 1)).bit_length() - 1  # the lowest colour free at both nodes
        taken[a], taken[b] = taken.get(a, 0) | 1 << color, taken.get(b, 0) | 1 << color
    return nodes, np.concatenate([np.zeros(0, int), *angles]), colors
