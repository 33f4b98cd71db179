"""Parameters of user-defined forces on a device, and the nodes on which they act."""

import numpy as np
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.kernels.forces.user_force import (
    energy_kernel,
    pair_check_kernel,
    parameter_struct,
    potential_check_kernel,
)

TRIED = 8  # nodes whose pairs are checked
UNBALANCED = 1e-3  # error of opposite forces and of symmetric derivatives, relative


class UserForceArrays:
    """User-defined force on the coupled system.

    Attributes:
        force: the `UserForce` of the scene.
        blocks, nodes: dof blocks (n,) on which it acts, on the host and the device. A joint counts once.
        parameters: values of each node in each world, a struct (worlds, n).
        layout: name and number of components of each parameter.
    """

    def __init__(self, force, host, worlds: int, device, real):
        self.force, self.name, self.layout, self.worlds = force, force.name, force.layout, worlds
        rods = {rod.rod: rod.nodes for rod in host.rods}
        blocks = [rods[rod][nodes] for rod, nodes in force.rods]
        blocks = np.concatenate([*blocks, *(host.shells[shell].nodes[nodes] for shell, nodes in force.shells)])
        self.rows = np.sort(np.unique(blocks, return_index=True)[1])
        self.blocks = blocks[self.rows]
        self.nodes = wp.array(self.blocks.astype(np.int32), dtype=int, device=device)
        self.values, shape = {}, (worlds, len(self.rows))
        for (name, size), values in zip(self.layout, force.parameters.values(), strict=True):
            single = values if values.ndim < 1 + (size == 3) else values[self.rows]
            self.values[name] = np.broadcast_to(single, (*shape, 3) if size == 3 else shape).copy()
        self.parameters = wp.zeros(shape, dtype=parameter_struct(self.layout, real), device=device)
        self._real = real
        self._upload()
        if force.pairs:
            self._check_pairs(host.rest[self.blocks[:TRIED]])
        if force.potential:
            self._check_potential(host.rest[self.blocks[:TRIED]])

    def _check_potential(self, x: np.ndarray) -> None:
        """Refuse a potential of another force, by nodes near x (n, 3)."""
        device, size = self.parameters.device, max(float(np.ptp(x, axis=0).max()), 1e-3)
        x = (
            x + 0.01 * size * np.array([1.0, -2.0, 3.0]) * np.arange(1, len(x) + 1)[:, None]
        )  # springs have no force at rest
        points = wp.array(x, dtype=wp.types.vector(3, self._real), device=device)
        out = wp.zeros((2, len(x)), dtype=self._real, device=device)
        kernel = potential_check_kernel(
            self.force.function, self.force.potential, self.layout, self.force.pairs, self._real
        )
        wp.launch(kernel, len(x), [points, self.parameters], [out], device=device)
        force, error = out.numpy().astype(float).max(1)
        if not error <= UNBALANCED * force:
            call = "add_pair_force" if self.force.pairs else "add_nodal_force"
            raise SceneError(
                f"{call} {self.name!r}: the force is not the negative gradient of the potential; correct one of them, or leave out "
                "potential="
            )

    def _check_pairs(self, x: np.ndarray) -> None:
        """Refuse a pair force that is not opposite on the other node or has no symmetric derivative, by pairs of nodes at x (n, 3).

        Nodes at one point are left out, as a force may be infinite there.
        """
        first, second = np.triu_indices(len(x), 1)
        distinct = np.linalg.norm(x[first] - x[second], axis=1) > 0.0
        pairs, device = np.stack([first[distinct], second[distinct]]).astype(np.int32), self.parameters.device
        if not pairs.size:
            return
        points = wp.array(x, dtype=wp.types.vector(3, self._real), device=device)
        out = wp.zeros((4, pairs.shape[1]), dtype=self._real, device=device)
        kernel = pair_check_kernel(self.force.function, self.layout, self._real)
        inputs = [points, self.parameters, wp.array(pairs, dtype=int, device=device)]
        wp.launch(kernel, pairs.shape[1], inputs, [out], device=device)
        values = out.numpy().astype(float)
        i, j = pairs[:, np.argmax(~np.isfinite(values).all(0))]
        if not np.isfinite(values).all():
            raise SceneError(
                f"add_pair_force {self.name!r}: the force between its nodes {i} and {j} is not finite at rest"
            )
        force, sum_of_both, derivative, skew = values.max(1)
        if sum_of_both > UNBALANCED * force:
            raise SceneError(
                f"add_pair_force {self.name!r}: forces on the two nodes of a pair are not opposite; return a force that changes "
                "its sign if d does and p and q are exchanged"
            )
        if skew > UNBALANCED * derivative:
            raise SceneError(
                f"add_pair_force {self.name!r}: the derivative of the force by d is not symmetric; return a force along d that "
                "depends on its length"
            )

    @property
    def numbers(self) -> wp.array:
        """Parameters as numbers (worlds, n, components), a view."""
        size = sum(size for _, size in self.layout)
        array = self.parameters
        return wp.array(
            ptr=array.ptr, dtype=self._real, shape=(*array.shape, size), device=array.device, copy=False, deleter=None
        )

    def columns(self, name: str) -> slice:
        """Return the components of a parameter in `numbers`."""
        names, sizes = zip(*self.layout, strict=True)
        index = names.index(name)
        first = sum(sizes[:index])
        return slice(first, first + sizes[index])

    def set(self, name: str, values) -> None:
        """Replace a parameter in place, which captured graphs read: one value, one a world, one a node, or one each.

        Raises:
            ValueError: a wrong name, shape or value.
        """
        if name not in self.values:
            raise ValueError(f"set_parameter: {self.name} has no parameter {name!r}; it has {', '.join(self.values)}")
        values, stored = argument_checks.array(f"{self.name}.{name}", values), self.values[name]
        vector = stored.shape[2:]
        shapes = (vector, (self.worlds, 1, *vector), stored.shape[1:], stored.shape)
        if values.shape == (self.worlds, *vector) and values.shape not in (stored.shape[1:], stored.shape):
            values = values.reshape(self.worlds, 1, *vector)
        if values.shape not in shapes:
            raise ValueError(
                f"{self.name}.{name} has shape {values.shape}; give {vector or 'one number'}, {(self.worlds, *vector)}, "
                f"{stored.shape[1:]} or {stored.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"{self.name}.{name} is not finite")
        stored[:] = values
        self._upload()

    def energy(self, q: wp.array, time: float, blocks: int) -> np.ndarray:
        """Return the potential energy at dof blocks q of `blocks` a world (worlds,) [J]."""
        pairs, shape = self.force.pairs, self.parameters.shape
        kernel, out = (
            energy_kernel(self.force.potential, self.layout, pairs, self._real),
            wp.zeros(shape, dtype=self._real, device=q.device),
        )
        inputs = [self.nodes, self.parameters, q, time, blocks]
        wp.launch(kernel, shape, inputs, [out], device=q.device)
        return out.numpy().astype(float).sum(1)

    def _upload(self) -> None:
        numbers = [values.reshape(*values.shape[:2], -1) for values in self.values.values()]
        self.numbers.assign(np.concatenate(numbers, axis=-1))
