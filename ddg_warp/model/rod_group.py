"""Rod group on a device: constant arrays of uncoupled rods of one kind."""

from dataclasses import replace

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.compile import precision
from ddg_warp.compile.rod_groups import RodGroupData
from ddg_warp.kernels.core.nodes import state_type
from ddg_warp.kernels.elements import rod_layout
from ddg_warp.model.parameters import ParameterTable
from ddg_warp.scene import edge_forces


class RodGroup:
    """Constant device arrays of one rod group, all worlds side by side (column = world * R + rod).

    Attributes:
        parameters: "term.parameter" of all terms, broadcastable to (node, column).
        has_custom_mass: True if `mass` and `rotary` may differ from `host`.
    """

    def __init__(self, host: RodGroupData, scene, worlds: int, device, real):
        kind = replace(host.kind, serial=device_arrays.serial(device), rod_major=wp.get_device(device).is_cpu)
        vector = wp.types.vector(kind.dim, real)
        self.host, self.kind, self.worlds, self.device = host, kind, worlds, device
        self.rods = self.world_columns = len(host.rods)
        self.dim = kind.dim
        self.nodes = host.shape[0]
        self.columns = self.rods * worlds
        self.elements = self.nodes if kind.closed else self.nodes - 1
        self.node_threads, self.element_threads = (
            (device_arrays.takers(along, device), self.columns) for along in (self.nodes, self.elements)
        )

        def put(values, dtype):
            return device_arrays.upload(
                np.concatenate([values] * worlds, axis=-1) if worlds > 1 else values, dtype, device
            )

        self.count = put(host.count, int)
        self.length = put(host.length, real)
        self.world = wp.array(np.repeat(np.arange(worlds), self.rods), dtype=int, device=device)
        self.still = wp.zeros(self.columns, dtype=real, device=device)
        self.mass = put(host.mass, real)
        self.rotary = put(host.rotary, real)
        self.has_custom_mass = False
        self.coefficients = {name: put(values, real) for name, values in host.coefficients.items()}
        self.fixed = put(host.fixed, wp.uint8)
        self.anchor = put(_last_anchor(host), int)
        load, moment = _constant_loads(host) if host.loaded else (np.zeros((1, 1, kind.dim)), np.zeros((1, 1)))
        self.load = device_arrays.upload(np.concatenate([load] * worlds, axis=1), vector, device)
        self.load_angle = put(moment, real)
        gravity = np.asarray(scene.gravity, float)
        self.gravity_host = gravity[[0, 2]] if kind.dim == 2 else gravity
        self.gravity = wp.array(self.gravity_host[None], dtype=vector, device=device)
        self.outer = put(_outer_forces(host, self.gravity_host, load, moment), real)
        tiled = {name: np.tile(p, (1, worlds)) if p.shape[1] > 1 else p for name, p in host.parameters.items()}
        self.parameters = ParameterTable(tiled, 0, real, device)
        self._stiffnesses = None, ()  # key and values

    def element_inputs(self, state, last: wp.array, rate: wp.array | None = None, table: ParameterTable | None = None):
        """Return the inputs of element kernels at a state, or at an iterate with its x, theta and frame.

        Args:
            last: strains of the last step (strains, n, R).
            rate: inverse length of the solve of every rod [1/s], zero by default.
            table: parameters, by default the group's.
        """
        inputs = rod_layout.rod_elements_type(self.dim, self.parameters.arrays[0].dtype)()
        inputs.x, inputs.theta, inputs.frame = state.x, state.theta, state.frame
        inputs.last, inputs.rate = device_arrays.columns(last), self.still if rate is None else rate
        (inputs.buffer, inputs.table), inputs.count = (table or self.parameters).arrays, self.count
        return inputs

    @property
    def node_shape(self) -> tuple[int, int]:
        """Number of nodes of the longest rod, and of columns."""
        return self.nodes, self.columns

    @property
    def node_count(self) -> wp.array:
        """Number of nodes of every column."""
        return self.count

    def node_state(self, state):
        """Return positions and twist angles of a state, and their rates, for kernels over nodes."""
        result = state_type(self.kind.nodes, self.parameters.arrays[0].dtype)()
        result.x, result.v, result.theta, result.omega = state.x, state.v, state.theta, state.omega
        return result

    def set_parameter(self, name: str, values: np.ndarray) -> bool:
        """Replace "term.parameter"; return True if its memory was reallocated.

        Args:
            values: of shape (), (worlds,), (elements,) or (worlds, elements).
        """
        elements = self.nodes
        if values.ndim == 0:
            new = values.reshape(1, 1)
        elif values.shape == (self.worlds,):
            new = np.repeat(values, self.rods)[None]
        else:
            along = np.atleast_2d(values)
            if (
                along.ndim > 2
                or along.shape[0] not in (1, self.worlds)
                or not elements - 2 <= along.shape[1] <= elements
            ):
                raise ValueError(
                    f"{name} has shape {values.shape}; give one number, ({self.worlds},), (elements,) or ({self.worlds}, elements)"
                    f" with {elements - 2} vertices or {elements - 1} edges"
                )
            along = np.pad(along, ((0, 0), (0, elements - along.shape[1])), mode="edge")
            new = np.repeat(np.broadcast_to(along, (self.worlds, elements)), self.rods, axis=0).T
        return self.parameters.set(**{name: new})

    @property
    def node_mass(self) -> wp.array:
        """Masses of nodes as [node][column]."""
        return self.mass

    def dof_masses(self) -> np.ndarray:
        """Return masses of all dofs, rod by rod (columns n block,)."""
        if self.has_custom_mass:
            mass, rotary = (device_arrays.download(array).astype(float) for array in (self.mass, self.rotary))
        else:
            mass, rotary = (np.tile(values, (1, self.worlds)) for values in (self.host.mass, self.host.rotary))
        return np.stack([mass] * self.dim + [rotary] * self.kind.twist, axis=-1).transpose(1, 0, 2).ravel()

    def stiffnesses(self, s: float) -> tuple[np.ndarray, ...]:
        """Return stiffnesses of every rod (columns,) over a step of s [s]; see `precision.stiffnesses`.

        The last result is cached: a step needs it several times after every change of a parameter.
        """
        if self._stiffnesses[0] != (s, self.parameters.version):
            self._stiffnesses = (s, self.parameters.version), self._find_stiffnesses(s)
        return self._stiffnesses[1]

    def _find_stiffnesses(self, s: float) -> tuple[np.ndarray, ...]:
        host = self.host
        mass, length = host.mass.sum(0) / host.count, host.length
        if self.kind.quadratic:
            mass = (
                mass + s * edge_forces.least({n: v.T for n, v in host.coefficients.items()}) * host.length / host.count
            )
            length = np.where(host.fixed.any(0), length, np.inf)  # over long steps only these forces act on a free rod
        mass, length = (np.tile(values, self.worlds) for values in (mass, length))
        return precision.stiffnesses(self.kind, mass, length, self.parameters.values, s)

    def float32_errors(self, s: float) -> np.ndarray:
        """Return the float32 error of every rod (columns,) over a step of s [s]; see `precision.float32_error`."""
        stretching, _, softest = self.stiffnesses(s)
        return precision.float32_error(stretching, softest)

    def split_errors(self, s: float) -> np.ndarray:
        """Return the float32 errors of the mixed axial-force formulation (columns,).

        The formulation needs bending and one stretch per edge; errors of other rods are infinite.
        """
        _, bending, softest = self.stiffnesses(s)
        errors = precision.float32_error(np.maximum(bending, precision.largest_carried(softest)), softest)
        return errors if self.kind.span == 2 and self.kind.edge_strains == self.kind.tensions == 1 else errors + np.inf


def _last_anchor(host: RodGroupData) -> np.ndarray:
    """Return the last node of every rod (R,) that is fixed in all directions, or -1."""
    return np.where(host.anchored, np.arange(host.shape[0])[:, None], -1).max(axis=0)


def _constant_loads(host: RodGroupData) -> tuple[np.ndarray, np.ndarray]:
    """Return constant nodal forces (n, R, dim) [N] and edge moments (n, R) [N m]; moments (1, 1) without twist."""
    load = host.constant_loads()
    force = load[: host.nodes].reshape(*host.shape, 3)[..., :: 2 if host.kind.dim == 2 else 1]
    return force, load[host.nodes :, 0].reshape(host.shape) if host.kind.twist else np.zeros((1, 1))


def _outer_forces(host: RodGroupData, gravity: np.ndarray, load: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """Return the load scale of every rod (R,) [N]: sum of the magnitudes of external forces."""
    forces, rods = np.zeros_like(host.mass), len(host.rods)
    for d in np.flatnonzero(gravity) if not host.loaded else range(len(gravity)):
        force = host.mass * gravity[d]
        if host.loaded:
            force += load[..., d]
        forces += np.abs(force, out=force)
    total = forces.sum(0)
    if host.loaded:
        total += np.abs(moment).sum(0) / host.length
    return total + changing_forces(host).reshape(-1, rods).sum(0)


def changing_forces(host: RodGroupData) -> np.ndarray:
    """Return magnitudes of time-dependent and follower loads by storage index [N].

    Time-dependent loads count with their full amplitude, moments over the length of the rod.
    """
    force = np.zeros(host.size)
    for timed in host.timed:
        arm = np.where(timed.places < host.nodes, 1.0, host.length[timed.places % len(host.rods)])
        np.add.at(force, timed.places, np.abs(timed.force).sum(1) / arm)
    for couple in host.followers:
        np.add.at(force, couple.places, couple.sizes(None))  # wherever its nodes are
    return force
