"""Drag on uncoupled and coupled rods in a flowing fluid; see `kernels.forces.drag`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import rod_layout
from ddg_warp.kernels.forces import drag, shell_drag
from ddg_warp.scene.drag import is_square
from ddg_warp.solve.forces.flow import FlowVelocity
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
        flow: `FlowVelocity` of the fluid.

    Parameters:

        "drag.tangential", "drag.normal" [N s/m^2], "drag.rotational" [N s]
                         of the edges of rods with viscous drag, per length; rotational drag of those with twist
        "drag.tangential", "drag.normal" [N s^2/m^3]
                         of the edges of rods in scenes with quadratic drag
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
        self.coefficients, self.flow = part.coefficients.get(self.name), FlowVelocity(model, part, midpoint)

    @staticmethod
    def has(name: str, coefficients: np.ndarray, twisted) -> np.ndarray:
        """Return the mask of edges that have a parameter (E,) from coefficients (rows, E), and the mask of edges with twist."""
        speed = coefficients[drag.SPEED]
        chosen = speed >= 0.0 if name in BODIES else (speed > 0.0) == (name in GRANULAR)
        return chosen & twisted if name == "rotational" else chosen

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._resist, *self.flow.kernels]

    def upload(self, t0: float, t1: float) -> None:
        """Upload the flow at the evaluation time of the scheme."""
        self.flow.upload(t0, t1)

    def sample(self, before, t0: float, t1: float) -> None:
        """Upload the flow at the nodes of a state; see `Force`."""
        self.flow.sample(before, t0, t1)

    def _balanced(self, rates: np.ndarray, flow: np.ndarray) -> np.ndarray:
        """Return velocities b of nodes such that D (b - rates) are the forces; see `kernels.forces.drag`."""
        return 0.5 * (flow + rates) if is_square(self.model.scene) else flow

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
        super().__init__(model, group, drag.rod_kernel(group.kind, model.types.real, is_square(model.scene)), midpoint)

    def freeze(self, before, newton) -> None:
        """Write inertia and target angles; see `Force`."""
        iterates, loading = newton.iterates, newton.loading
        self.resist(before, iterates.x, loading.mass, loading.rotary, iterates.target_angle, newton.islands)

    def resist(self, before, x: wp.array, mass: wp.array, rotary: wp.array, target_angle: wp.array, islands) -> None:
        """Write inertia and drag, with target angles, of a solve from the state `before`, given the predictor x."""
        group = self.part
        self.flow.evaluate(before)
        self._launch(
            self._resist,
            group.node_threads,
            [before.x, before.v, before.theta, x if self.midpoint else before.x, x, self.coefficients, self.flow.array]
            + [group.mass, group.rotary, group.count, *islands.arrays],
            [mass, rotary, target_angle],
        )

    def at(self, data, t: float, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return inertia and drag (node, column) of a state at t over a second, and the forces on nodes with rates [N]."""
        self.upload(t, t)
        self.sample(data, t, t)
        inertia, flow = (device_arrays.download(array) for array in (self.inertia(data, 1.0), self.flow.array))
        return inertia, np.einsum(
            "krij,krj->kri", inertia["stiffness"], self._balanced(rates, flow.astype(float)) - rates
        )

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
    """Drag on the coupled rods and shells in a flowing fluid.

    Attributes:
        shell_coefficients: of triangles, world by world (2, W T), as rows of `kernels.forces.shell_drag`; None without shells in it.
    """

    def __init__(self, model, midpoint: bool = False):
        coupled, host, square = model.coupled, model.coupled.host, is_square(model.scene)
        rods = drag.coupled_kernel(model.types.real, square) if coupled.coefficients else None
        super().__init__(model, coupled, rods, midpoint)
        ends, angles = host.forced_edges
        self._edges = self._elements(np.stack([*ends, np.where(angles < 0, host.blocks, angles)], -1), 2)
        self._resist_shells = self.shell_coefficients = None
        if len(host.drag_triangles):
            self._resist_shells = shell_drag.resist_kernel(model.types.real, square, rods is None)
            self._triangles = self._elements(host.drag_triangles, 3)
            self.shell_coefficients = coupled.shell_coefficients

    def _elements(self, places: np.ndarray, corners: int) -> list[wp.array]:
        """Return nodes of elements, the first `corners` of blocks (E, n), and elements by block, as offsets and items."""
        starts, items = lists(places.ravel(), self.part.blocks + 1)
        values = places[:, :corners], starts, items // places.shape[1]
        return [wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=self.model.wp_device) for v in values]

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [kernel for kernel in (self._resist, self._resist_shells, *self.flow.kernels) if kernel]

    def freeze(self, before, newton) -> None:
        """Write inertia; see `Force`."""
        self.resist(before, newton.iterates.q, newton.loading.mass, newton.loading.scale, newton.islands)

    def resist(self, before, q: wp.array, mass: wp.array, load_scale: wp.array, islands) -> None:
        """Write inertia and drag `mass` of a solve from the state `before`, given the predictor q."""
        coupled = self.part
        self.flow.evaluate(before)
        read = [before.q, before.v, q if self.midpoint else before.q, q, coupled.mass]
        further = [self.flow.array, load_scale, *islands.arrays, coupled.blocks, coupled.host.nodes]
        count = coupled.worlds * coupled.blocks
        if self._resist:
            places, *items = self._edges
            self._launch(self._resist, count, [*read, places, self.coefficients, *items, *further], [mass])
        if self._resist_shells:
            places, *items = self._triangles
            self._launch(self._resist_shells, count, [*read, places, self.shell_coefficients, *items, *further], [mass])

    def at(self, state, t: float, rates: np.ndarray) -> np.ndarray:
        """Return the forces on dof blocks with rates (world, block, 3) of a state at t [N, N m]."""
        self.upload(t, t)
        self.sample(state, t, t)
        stiffness = self.inertia(state, 1.0).numpy()["stiffness"]
        balanced, nodes = np.zeros_like(rates), self.part.host.nodes
        flow = device_arrays.download(self.flow.array).astype(float).swapaxes(0, 1)
        balanced[:, :nodes] = self._balanced(rates, flow)[:, :nodes]
        return np.einsum("wkij,wkj->wki", stiffness, balanced - rates)

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
