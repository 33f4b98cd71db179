"""Drag on uncoupled and coupled rods in a flowing fluid; see `kernels.forces.drag`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import rod_layout
from ddg_warp.kernels.forces import drag
from ddg_warp.scene.drag import flow_at
from ddg_warp.solve.forces.force import Force
from ddg_warp.solve.linear.sparse_system import lists

VISCOUS = {"tangential": drag.TANGENTIAL, "normal": drag.NORMAL, "rotational": drag.ROTATIONAL}
GRANULAR = {
    "lateral": drag.LATERAL,
    "friction": drag.FRICTION,
    "leading": drag.LEADING,
    "slope": drag.SLOPE,
    "speed": drag.SPEED,
}
BODIES = {"first": drag.FIRST, "last": drag.LAST}


class Drag(Force):
    """Drag on a `RodGroup` or `CoupledModel`.

    Attributes:
        coefficients: of edges, as rows of `kernels.forces.drag`; initially the array of the model.

    Parameters:

        "drag.tangential", "drag.normal" [N s/m^2], "drag.rotational" [N s]
                         of the edges of rods with viscous drag, per length; rotational drag of those with twist
        "drag.lateral", "drag.friction", "drag.leading" [N/m], "drag.slope" (the tangent of `angle`), "drag.speed" [m/s]
                         of the edges of rods in a granular medium
        "drag.first", "drag.last" [N s/m]
                         of bodies at the first and at the last node of the edges of rods with drag; `Scene.drag(nodes=...)` assigns
                         the coefficient of a node to the edge that starts there, that of the last node to the last edge
    """

    name = "drag"
    parameters = VISCOUS | GRANULAR | BODIES
    signed, positive = ("leading",), ("slope", "speed")

    def __init__(self, model, part, kernel, midpoint: bool):
        self.model, self.part, self.midpoint, self._resist = model, part, midpoint, kernel
        self.coefficients, vector = part.coefficients[self.name], wp.types.vector(part.dim, model.types.real)
        self.flow = wp.array(self._flow(0.0), dtype=vector, device=model.wp_device)

    @staticmethod
    def has(name: str, coefficients: np.ndarray, twisted) -> np.ndarray:
        """Return the mask of edges that have a parameter (E,) from coefficients (rows, E), and the mask of edges with twist."""
        granular = coefficients[drag.SPEED] > 0.0
        chosen = (granular == (name in GRANULAR)) | (name in BODIES)
        return chosen & twisted if name == "rotational" else chosen

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._resist]

    def upload(self, t0: float, t1: float) -> None:
        """Upload the flow at the evaluation time of the scheme."""
        if callable(self.model.scene.flow):
            self.flow.assign(self._flow(0.5 * (t0 + t1) if self.midpoint else t1))

    def _flow(self, t: float) -> np.ndarray:
        return flow_at(self.model.scene, t)[None, list(self.part.host.axes)]

    def _islands(self, rate: float) -> Islands:
        """Return islands with the inverse length of a solve."""
        islands = Islands(self.part.columns, self.model.types.real, self.model.wp_device)
        islands.inertia_coefficient.fill_(1.0)
        islands.inverse_step.fill_(rate)
        return islands

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)


class RodGroupDrag(Drag):
    """Drag on a rod group in a flowing fluid."""

    def __init__(self, model, group, midpoint: bool = False):
        super().__init__(model, group, drag.rod_kernel(group.kind, model.types.real), midpoint)

    def freeze(self, before, newton) -> None:
        """Write inertia and target angles; see `Force`."""
        iterates, loading = newton.iterates, newton.loading
        self.resist(before, iterates.x, loading.mass, loading.rotary, iterates.target_angle, newton.islands)

    def resist(self, before, x: wp.array, mass: wp.array, rotary: wp.array, target_angle: wp.array, islands) -> None:
        """Write inertia and drag, with target angles, of a solve from the state `before`, given the predictor x."""
        group = self.part
        self._launch(
            self._resist,
            group.node_threads,
            [before.x, before.v, before.theta, x if self.midpoint else before.x, x, self.coefficients, self.flow]
            + [group.mass, group.rotary, group.count, *islands.arrays],
            [mass, rotary, target_angle],
        )

    def at(self, data, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return inertia and drag (node, column) of a state at t over a second, and the flow (dim,)."""
        self.upload(t, t)
        return device_arrays.download(self.inertia(data, 1.0)), self.flow.numpy()[0].astype(float)

    def inertia(self, data, rate: float) -> wp.array:
        """Return inertia and drag [node][column] of a solve of length 1 / `rate` from a state."""
        group, real, device = self.part, self.model.types.real, self.model.wp_device
        mass = device_arrays.allocate((group.nodes, group.columns), rod_layout.inertia_type(group.kind, real), device)
        self.resist(data, data.x, mass, wp.zeros_like(data.theta), wp.clone(data.theta), self._islands(rate))
        return mass

    def rates(self, data, lead: float) -> tuple[np.ndarray, np.ndarray]:
        """Return rates of nodes and edges (node, column), of massless dofs extrapolated by `lead` [s]."""
        v, a, omega, alpha, mass, rotary = (
            device_arrays.download(array).astype(float)
            for array in (data.v, data.a, data.omega, data.alpha, self.part.mass, self.part.rotary)
        )
        if lead > 0.0:
            v = v + lead * np.where((mass[..., None] <= 0.0) & (v != 0.0), a, 0.0)
            if self.part.kind.twist:
                omega = omega + lead * np.where((rotary <= 0.0) & (omega != 0.0), alpha, 0.0)
        return v, omega


class CoupledDrag(Drag):
    """Drag on the coupled rods in a flowing fluid."""

    def __init__(self, model, midpoint: bool = False):
        coupled, host, device = model.coupled, model.coupled.host, model.wp_device
        super().__init__(model, coupled, drag.coupled_kernel(model.types.real), midpoint)
        ends, angles = host.forced_edges
        places = np.stack([*ends, np.where(angles < 0, host.blocks, angles)], -1).ravel()
        starts, items = lists(places, host.blocks + 1)

        self.ends, self.starts, self.items = (
            wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=device) for v in (ends.T, starts, items // 3)
        )

    def freeze(self, before, newton) -> None:
        """Write inertia; see `Force`."""
        self.resist(before, newton.iterates.q, newton.loading.mass, newton.loading.scale, newton.islands)

    def resist(self, before, q: wp.array, mass: wp.array, load_scale: wp.array, islands) -> None:
        """Write inertia and drag `mass` of a solve from the state `before`, given the predictor q."""
        coupled = self.part
        self._launch(
            self._resist,
            coupled.worlds * coupled.blocks,
            [before.q, before.v, q if self.midpoint else before.q, q, coupled.mass, self.ends]
            + [self.coefficients, self.starts, self.items, self.flow, load_scale, *islands.arrays]
            + [coupled.blocks, coupled.host.nodes],
            [mass],
        )

    def at(self, state, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return inertia and drag (world, block) of a state at t over a second, and the flow (blocks, 3)."""
        coupled = self.part
        self.upload(t, t)
        flow = np.zeros((coupled.blocks, 3))
        flow[: coupled.host.nodes] = self.flow.numpy()[0]
        return self.inertia(state, 1.0).numpy(), flow

    def inertia(self, state, rate: float) -> wp.array:
        """Return inertia and drag [world][block] of a solve of length 1 / `rate` from a state."""
        coupled, device = self.part, self.model.wp_device
        mass = wp.zeros((coupled.worlds, coupled.blocks), dtype=block_inertia(coupled.real), device=device)
        self.resist(state, state.q, mass, coupled.still, self._islands(rate))
        return mass

    def rates(self, state, lead: float) -> np.ndarray:
        """Return rates of dof blocks (world, block), of massless dofs extrapolated by `lead` [s]."""
        coupled = self.part
        v, a = (array.numpy().astype(float).reshape(coupled.worlds, -1, 3) for array in (state.v, state.a))
        return v + lead * np.where((coupled.mass.numpy() <= 0.0) & (v != 0.0), a, 0.0) if lead > 0.0 else v
