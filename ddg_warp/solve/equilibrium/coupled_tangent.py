"""Energy and tangent of the coupled system on the host; dofs are its blocks, three each, world by world."""

from functools import cached_property

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp.compile.residual_tolerance import largest_excess
from ddg_warp.geometry.edge_rotation import turned
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.coupled_element import coupled_storage, linear_stress_kernel
from ddg_warp.model import validate
from ddg_warp.model.parameters import ParameterTable
from ddg_warp.scene.grip import Grip
from ddg_warp.solve.collision import exact_hessian
from ddg_warp.solve.equilibrium.carried_dofs import CarriedDofs
from ddg_warp.solve.equilibrium.rigid_modes import Body
from ddg_warp.solve.equilibrium.tangent_part import TangentBlock
from ddg_warp.solve.forces.prescribed_element_data import CoupledMotion
from ddg_warp.solve.forces.user_force import UserForces
from ddg_warp.solve.linear.skew_supports import HostPlanes


class CoupledTangent(TangentBlock):
    """Tangent block of the coupled system. See `Tangent` for the methods."""

    def __init__(self, model, offset: int):
        host, worlds = model.coupled.host, model.worlds
        kind = np.zeros((host.blocks, 3), bool)
        kind[host.nodes :] = True
        self.free, self.angle = (np.tile(values.ravel(), worlds) for values in (~host.fixed, kind))
        super().__init__(model, model.coupled, offset, 3 * host.blocks * worlds)
        self.coupled, self.block = model.coupled, 3
        self.body_count, self.islands = host.bodies.count * worlds, worlds
        self.rate = model.coupled.still  # inverse time of strain-rate damping: zero at rest
        self.given_field = np.zeros((worlds, 3))  # field of controls, added to the scene's [T]
        self.planes = HostPlanes(host, worlds) if host.frames else None
        self.carried = CarriedDofs(host, worlds) if host.rigid_bodies else None
        self._anchored = host.fixed[: host.nodes].copy()
        for shell in host.shells:
            self._anchored[shell.nodes] = True

    @cached_property
    def _user_forces(self) -> UserForces | None:
        """User-defined forces, at rest; None without."""
        return UserForces(self.model, self.coupled.real, False) if self.coupled.user_forces else None

    def _user_forces_at(self, factor: float, q: np.ndarray) -> tuple[UserForces, wp.array, Islands]:
        """Return user-defined forces at dofs q and a load parameter, with blocks and islands for their evaluation."""
        forces, islands = self._user_forces, Islands(self.coupled.worlds, self.coupled.real, self.coupled.device)
        islands.needs_direction.fill_(1)
        blocks = wp.array(self.back(q).reshape(-1, 3), dtype=self.coupled.vector, device=self.coupled.device)
        forces.upload(factor, factor)
        forces.start_at(blocks)
        return forces, blocks, islands

    def loads(self, factor: float, q: np.ndarray) -> np.ndarray:
        return self._condensed(q, self.nodal_loads(factor, q))

    def nodal_loads(self, factor: float, q: np.ndarray) -> np.ndarray:
        """Return external forces (size,), of carried nodes on the nodes themselves."""
        result = super().loads(factor, q)
        if not self.coupled.user_forces:
            return result
        forces, blocks, islands = self._user_forces_at(factor, q)
        forces.evaluate(blocks, islands)
        return result + self.into(forces.total.numpy().astype(float).ravel())

    def work(self, factor: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the work of mean external forces on every dof between two dof vectors (size,) [J]."""
        return 0.5 * (self.nodal_loads(factor, before) + self.nodal_loads(factor, after)) * (after - before)

    def spread(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return a step with displacements of carried nodes."""
        return self.carried.spread(q, step) if self.carried else step

    def load_stiffness(self, factor: float, q: np.ndarray) -> sparse.csc_matrix | None:
        result = self._nodal_load_stiffness(factor, q)
        if not self.carried:
            return result
        geometric = self.carried.geometric(q, -self.nodal_loads(factor, q))
        return geometric if result is None else self.carried.matrix(q, result) + geometric

    def _nodal_load_stiffness(self, factor: float, q: np.ndarray) -> sparse.csc_matrix | None:
        result = super().load_stiffness(factor, q)
        if not self.coupled.user_forces:
            return result
        forces, blocks, islands = self._user_forces_at(factor, q)
        forces.linearise(blocks, islands)
        stiffness = self.matrix(forces.matrix())
        return stiffness if result is None else result + stiffness

    def accelerations(self, gravity: np.ndarray) -> np.ndarray:
        return np.where(np.arange(self.host.blocks)[:, None] < self.host.nodes, gravity, 0.0)

    @cached_property
    def _pattern(self) -> tuple[list, np.ndarray, np.ndarray]:
        """Sparsity pattern: (B, positions of element entries) of each set; rows and column starts of the Hessian (CSC)."""
        entries, local = [], []
        for part in self.coupled.sets:
            to_local, slot, component = _local(part.term.measure)
            dofs = 3 * _tiled(part.host.slots, self.host.blocks, self.coupled.worlds)[slot].T + component
            entries.append((dofs[:, None, :] * self.size + dofs[:, :, None]).ravel())
            local.append(to_local)
        pattern, places = np.unique(np.concatenate([np.zeros(0, int), *entries]), return_inverse=True)
        places = np.split(places, np.cumsum([len(e) for e in entries]))[:-1]
        columns, rows = np.divmod(pattern, self.size)
        return list(zip(local, places, strict=True)), rows, np.searchsorted(columns, np.arange(self.size + 1))

    def energies(self, state):
        """Yield (term's name, energies of its elements (worlds, elements))."""
        for i, part in enumerate(self.coupled.sets):
            out = wp.zeros(part.elements * self.coupled.worlds, dtype=self.coupled.real, device=self.coupled.device)
            self._launch(state, i, 0, out, ())
            values = out.numpy().astype(np.float64)
            yield part.term.name, values.reshape(self.coupled.worlds, -1)
        if self.model.touch:
            self.model.touch.evaluate(state.coupled.q, state.coupled.rate)
            yield "contact", self.model.touch.terms.energy.numpy().astype(np.float64)[:, None]

    def gradient(self, state) -> np.ndarray:
        elastic = self.elastic_gradient(state)
        if not self.model.touch:
            return elastic
        self.model.touch.evaluate(state.coupled.q, state.coupled.rate)
        return elastic - self._condensed(self.dofs(state), self._contact_forces())

    def friction(self, state) -> np.ndarray:
        """Return friction forces by `state.slip_velocity` (size,) [N, N m]."""
        forces = self.model.touch.friction(state.coupled.q, state.slip_velocity, state.coupled.rate)
        return self._condensed(self.dofs(state), self.into(forces.ravel()))

    def _contact_forces(self) -> np.ndarray:
        """Return the contact forces of the last evaluation (size,), of carried nodes on the nodes themselves."""
        return self.into(self.model.touch.terms.forces.numpy().astype(np.float64).ravel())

    def _condensed(self, q: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Return forces (size,) with the forces on carried nodes moved to the rigid bodies."""
        return self.carried.condense(q, forces) if self.carried else forces

    def elastic_gradient(self, state) -> np.ndarray:
        """Return the energy gradient without contact."""
        return self._condensed(self.dofs(state), self._nodal_gradient(state))

    def _nodal_gradient(self, state) -> np.ndarray:
        result = np.zeros((self.size // 3, 3))
        for i, part in enumerate(self.coupled.sets):
            slots, forces = part.host.slots, self.forces(state, i)
            index = _tiled(slots, self.host.blocks, self.coupled.worlds).ravel()
            for d in range(3):
                result[:, d] += np.bincount(index, forces[..., d].ravel(), len(result))
        return self.into(result.ravel())

    def into(self, values: np.ndarray) -> np.ndarray:
        """Return values in the nodal frames of skew supports, if any."""
        return self.planes.into(values) if self.planes else values

    def back(self, values: np.ndarray) -> np.ndarray:
        return self.planes.back(values) if self.planes else values

    def matrix(self, values: sparse.csc_matrix) -> sparse.csc_matrix:
        return self.planes.matrix(values) if self.planes else values

    def forces(self, state, index: int, parameters: ParameterTable | None = None) -> np.ndarray:
        """Return the energy derivatives of a set's elements by blocks (local nodes, elements, 3), for other parameters if given."""
        part = self.coupled.sets[index]
        shape = (len(part.host.slots), part.elements * self.coupled.worlds)
        out = wp.zeros(shape, dtype=self.coupled.vector, device=self.coupled.device)
        self._launch(state, index, 1, out, (), parameters=parameters)
        return out.numpy().astype(np.float64)

    def unit_forces(self, state, index: int, strains: np.ndarray) -> sparse.csr_matrix:
        """Return the derivatives of the strains of a set by the dofs, times the measures: forces of unit stresses (size, strains W E).

        Args:
            strains: at this state, with a quadratic law (strains, worlds, elements).
        """
        part, columns = self.coupled.sets[index], []
        dofs = 3 * _tiled(part.host.slots, self.host.blocks, self.worlds)[..., None] + np.arange(3)
        for unit in range(len(part.term.rest)):
            values = {name: np.full((1, 1), float(m == unit)) for m, name in enumerate(part.term.stiffness)}
            values |= {name: strains[m] - 1.0 for m, name in enumerate(part.term.rest)}
            table = ParameterTable(part.parameters.values | values, 1, self.coupled.real, self.coupled.device)
            forces = self.forces(state, index, table).transpose(1, 0, 2)
            element = np.broadcast_to(np.arange(len(forces))[:, None, None], forces.shape)
            entries = forces.ravel(), (dofs.transpose(1, 0, 2).ravel(), element.ravel())
            columns.append(sparse.csr_matrix(entries, shape=(self.size, len(forces))))
        result = sparse.hstack(columns, format="csr")
        return self.carried.projection(self.dofs(state)).T @ result if self.carried else result

    def hessian(self, state, stress: list | None = None) -> sparse.csc_matrix:
        validate.refuse_friction(self.model)
        return self.potential_hessian(state, stress)

    def potential_hessian(self, state, stress: list | None = None) -> sparse.csc_matrix:
        """Return the Hessian without friction, which has no potential."""
        scatter, rows, starts = self._pattern
        total = np.zeros(len(rows))
        for i, part in enumerate(self.coupled.sets):
            size, count = part.term.measure.size, part.elements * self.coupled.worlds
            out = wp.zeros((count, size, size), dtype=self.coupled.real, device=self.coupled.device)
            extra = np.zeros((len(part.term.measure.strains), count))
            if stress is not None:
                extra = stress[i] - self._stress(state, i)
            extra = wp.array(extra, dtype=self.coupled.real, device=self.coupled.device)
            self._launch(state, i, 2, out.transpose((1, 2, 0)), (size,), extra)
            values = out.numpy().astype(np.float64)
            values = 0.5 * (values + values.transpose(0, 2, 1))
            to_local, places = scatter[i]
            spread = np.matmul(to_local.T, (values.reshape(-1, size) @ to_local).reshape(count, size, -1))
            total += np.bincount(places, spread.ravel(), len(total))
        elastic = sparse.csc_matrix((total, rows, starts), shape=(self.size, self.size))
        if self.model.touch:
            self.model.touch.evaluate(state.coupled.q, state.coupled.rate)
            elastic = elastic + exact_hessian.hessian(self.model.touch.terms, state.coupled.q)
        if self.carried:
            q, gradient = self.dofs(state), self._nodal_gradient(state)
            if self.model.touch:
                gradient -= self._contact_forces()
            elastic = self.carried.matrix(q, elastic) + self.carried.geometric(q, gradient)
        return self.matrix(elastic)

    def linear_stress(self, state, step: np.ndarray) -> list:
        """Return the stresses (strains, elements) of every set at the strains e + J step."""
        result, step = [], self.spread(self.dofs(state), step)
        change = wp.array(self.back(step).reshape(-1, 3), dtype=self.coupled.vector, device=self.coupled.device)
        for i, part in enumerate(self.coupled.sets):
            shape = (len(part.term.measure.strains), part.elements * self.coupled.worlds)
            out = wp.zeros(shape, dtype=self.coupled.real, device=self.coupled.device)
            inputs = self.coupled.elements(state.coupled, i, rate=self.rate)
            kernel = linear_stress_kernel(part.term, self.coupled.real)
            wp.launch(kernel, (self.coupled.worlds, part.elements), [inputs, change], [out], device=self.coupled.device)
            result.append(out.numpy().astype(np.float64))
        return result

    def _stress(self, state, index: int) -> np.ndarray:
        part = self.coupled.sets[index]
        shape = (len(part.term.measure.strains), part.elements * self.coupled.worlds)
        strain, stress = (wp.zeros(shape, dtype=self.coupled.real, device=self.coupled.device) for _ in range(2))
        self.coupled.strains(state.coupled, index, strain, stress)
        return stress.numpy().astype(np.float64)

    def dofs(self, state) -> np.ndarray:
        return self.into(state.coupled.q.numpy().astype(np.float64).ravel())

    def rates(self, state) -> np.ndarray:
        return self.into(state.coupled.v.numpy().astype(np.float64).ravel())

    def assign(self, state, q: np.ndarray) -> None:
        q = self.back(q)
        if self.carried:
            q = self.carried.place(state.coupled.q.numpy().astype(np.float64).ravel(), q)
            self.carried.turn(state.coupled, q)
        state.coupled.q.assign(q.reshape(-1, 3))

    def retract(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return q moved along `step` by rotating edges of rods; see `ddg_warp.geometry.edge_rotation`.

        Rods are processed in rod order, from their supports: a rod is anchored where it meets processed rods or a shell.
        """
        q, step = self.back(q), self.back(step)
        moved = q + step
        if self.carried:
            moved = self.carried.place(q, moved)
            step = moved - q
        x, dx, out = (v.reshape(self.coupled.worlds, -1, 3) for v in (q, step, moved))
        order = [self.host.rods[i] for level in self.host.rod_order.levels for i in level]
        for world in range(self.coupled.worlds):
            excess = np.zeros((self.host.nodes, 3))
            placed = self._anchored.copy()
            for rod in order:
                nodes, closed = rod.all_nodes, rod.piece.kind.closed
                excess[nodes] = turned(x[world][nodes], dx[world][nodes], placed[nodes], excess[nodes], closed)
                placed[nodes] = True
            out[world][: self.host.nodes] += excess
        return self.into(moved)

    @cached_property
    def _motion(self) -> CoupledMotion:
        return CoupledMotion(self.model)

    def move_supports(self, state, before: float, load_factor: float) -> None:
        """Move supports of a state at load parameter `before` to load parameter `load_factor`."""
        if self.host.moves:
            self._motion.put(state, before, load_factor, state.coupled.q, state.coupled.frame)
        self.prescribe(state, load_factor)

    def give(self, inputs: dict[str, np.ndarray]) -> None:
        super().give(inputs)
        if "wrenches" in inputs:
            rigid, loads = self.host.rigid_bodies, self.given.reshape(self.worlds, -1, 3)
            loads[:, rigid.centers] += inputs["wrenches"][..., :3]
            loads[:, rigid.spins] += inputs["wrenches"][..., 3:]
        self.given_field[:] = inputs.get("field", 0.0)

    def prescribe(self, state, load_factor: float) -> None:
        """Set rotating support normals and the magnetic field to load parameter `load_factor`."""
        for index, data in state.coupled.data.items():
            part = self.coupled.sets[index]
            values = data.numpy().astype(np.float64)
            columns = np.arange(self.coupled.worlds)[:, None] * part.elements
            for motion in np.unique(part.turning[:, 2]):
                chosen = part.turning[:, 2] == motion
                element, row, _ = part.turning[chosen].T
                moved = self.model.motions[motion]
                if isinstance(moved, Grip):  # posed by world
                    where = state.poses().reshape(self.coupled.worlds, -1, 6)[:, self.model.grips.index(moved)]
                else:
                    where = load_factor
                turned = moved.turn(where, part.turning_rest[chosen])
                for d in range(3):
                    values[row + d, element + columns] = turned[..., d]
            if part.term.measure.field:
                first = part.term.measure.data_size - part.term.measure.field
                values[first:] = self.model.scene.applied_field.at(load_factor, load_factor)[:, None]
                values[first : first + 3] += np.repeat(load_factor * self.given_field, part.elements, axis=0).T
            data.assign(values)

    def edges(self, q: np.ndarray) -> np.ndarray:
        """Return the edge vectors (E, 3)."""
        x = self.back(q).reshape(self.coupled.worlds, -1, 3)
        first, second = self.host.edges.T
        return (x[:, second] - x[:, first]).reshape(-1, 3)

    def edge_dofs(self) -> np.ndarray:
        """Return the position dofs of both ends of all edges (2, E, 3)."""
        blocks = self.host.edges.T[:, None] + self.host.blocks * np.arange(self.coupled.worlds)[:, None]
        return 3 * blocks.reshape(2, -1)[..., None] + np.arange(3)

    @cached_property
    def balances(self) -> np.ndarray:
        """Mask of dofs with forces that sum to zero over a free body (size,); false for radial dofs of bodies of revolution."""
        result = np.repeat(np.arange(self.host.blocks)[:, None] < self.host.nodes, 3, axis=1)
        for shell in self.host.meridians:
            result[shell.nodes, :2] = False
        return np.tile(result.ravel(), self.worlds)

    @cached_property
    def component(self) -> np.ndarray:
        """Index of the connected component of every dof (size,); one component a world with contact."""
        bodies = self.host.bodies
        components = np.zeros(self.host.blocks, int) if self.model.touch else bodies.components[bodies.owner]
        worlds = np.arange(self.worlds)[:, None] * (components.max() + 1)
        return np.repeat((worlds + components).ravel(), 3)

    def body_loads(self, outer: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the sum of the outer forces on every body, or its largest support force if larger (worlds bodies,) [N]."""
        bodies, shape = self.host.bodies, (self.coupled.worlds, self.host.blocks, 3)
        gradient = np.array(gradient).reshape(shape)
        gradient[:, self.host.of_obstacles] = 0.0
        gradient, result = gradient.ravel(), []
        for applied, force in zip(
            np.where(self.free & ~self.angle, np.abs(outer), 0.0).reshape(shape),
            np.where(~self.free & ~self.angle, gradient, 0.0).reshape(shape),
            strict=True,
        ):
            result.append(bodies.loads(applied.sum(1), bodies.support(force)))
        return np.concatenate(result)

    def allowed(self, loads: np.ndarray) -> np.ndarray:
        """Return the residual tolerance at rtol = 1 (size,) [N, N m] from body loads; see `ddg_warp.compile.residual_tolerance`."""
        blocks = [self.host.bodies.limits(body_loads) for body_loads in loads.reshape(self.coupled.worlds, -1)]
        return np.repeat(np.concatenate(blocks), 3)

    def sums(self, loads: np.ndarray, rtol: float, residual: np.ndarray, rounding_floor: np.ndarray):
        """Return the subset residual test and the largest excess over rounding by world; see `residual_tolerance.largest_excess`."""
        by_world = loads.reshape(self.coupled.worlds, -1), residual.reshape(self.coupled.worlds, -1, 3)
        floors = rounding_floor.reshape(self.coupled.worlds, -1, 3).max(2)
        tests = [
            largest_excess(self.host.bodies.levels, body_loads, rtol, r, f)
            for body_loads, r, f in zip(*by_world, floors, strict=True)
        ]
        return tuple(np.array(values) for values in zip(*tests, strict=True))

    def edge_length(self) -> float:
        """Return the mean rest length of edges [m]."""
        return float(self.host.edge_lengths.mean())

    def point_dofs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of `State.points`, and the dofs (rows, 3) of the first world."""
        rows, blocks = self.model.order.coupled_rows
        return rows, self.host.dofs(blocks)

    def bodies(self) -> list[Body]:
        """Return rods with the rotations of rigid joints, shells, and shells of revolution, of every world."""
        host, none = self.host, np.zeros(0, int)
        joints = [part for part in host.sets if part.term.measure.spins]
        parts, carried = [], np.zeros(host.blocks, bool)
        if (rigid := host.rigid_bodies) is not None:
            carried[rigid.carried] = True
        for rod in host.rods:
            edges = rod.all_edges
            ends = np.stack([np.arange(len(edges)), (np.arange(len(edges)) + 1) % len(rod.all_nodes)], axis=1)
            spins = [part.slots[-1, np.isin(part.slots[-2], edges)] for part in joints]
            parts.append((rod.all_nodes, edges, ends, np.unique(np.concatenate([none, *spins]))))
        parts += [(body.nodes, none, np.zeros((0, 2), int), none) for body in (*host.shells, *host.meridians)]
        if rigid is not None:
            pairs = zip(rigid.origins, rigid.spins, strict=True)
            parts += [(np.array([origin]), none, np.zeros((0, 2), int), np.array([spin])) for origin, spin in pairs]
        result = []
        for world in range(self.coupled.worlds):
            dofs = self.offset + 3 * world * host.blocks
            for nodes, edges, ends, spins in parts:
                places = (dofs + 3 * blocks[:, None] + np.arange(3) for blocks in (nodes, spins))
                positions, spins = places
                nodes = np.where(carried[nodes][:, None], -1, positions)
                result.append(Body(nodes, dofs + 3 * edges, ends, spins))
        return result

    def where(self, dof: int) -> str:
        """Return the label of the node, edge or joint of a dof."""
        block = dof // 3 % self.host.blocks
        for rod in self.host.rods:
            for label, blocks in (("node", rod.nodes), ("edge", rod.edges)):
                if block in blocks:
                    return f"{label} {int(np.flatnonzero(blocks == block)[0])} of rod {rod.rod}"
        for i, shell in enumerate(self.host.shells):
            for label, blocks in (("vertex", shell.nodes), ("mesh edge", shell.edges)):
                if block in blocks:
                    return f"{label} {int(np.flatnonzero(blocks == block)[0])} of shell {i}"
        for i, meridian in enumerate(self.host.meridians):
            if block in meridian.nodes:
                return f"node {int(np.flatnonzero(meridian.nodes == block)[0])} of axisymmetric shell {i}"
        if (rigid := self.host.rigid_bodies) is not None:
            for blocks in (rigid.origins, rigid.spins, rigid.centers):
                if block in blocks:
                    return f"body {int(np.argmax(blocks == block))}"
            if block in rigid.carried:
                return f"a node of body {rigid.owner[np.argmax(rigid.carried == block)]}"
        return f"joint {block - self.host.nodes - self.host.angles}"

    def _launch(
        self,
        state,
        index: int,
        kernel: int,
        out: wp.array,
        columns: tuple,
        *more,
        parameters: ParameterTable | None = None,
    ) -> None:
        part, real = self.coupled.sets[index], self.coupled.real
        wp.launch(
            element_path.term_kernels(coupled_storage(part.term, real), 0, real)[kernel],
            (self.coupled.worlds, part.elements, *columns),
            [self.coupled.elements(state.coupled, index, rate=self.rate, parameters=parameters), *more],
            [out],
            device=self.coupled.device,
        )


def _tiled(slots: np.ndarray, blocks: int, worlds: int) -> np.ndarray:
    """Return the blocks of local nodes (n, W E) of all worlds."""
    return np.concatenate([slots + world * blocks for world in range(worlds)], axis=1)


def _local(measure) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return B of an element (local dofs, block dofs), and the local node and component of its columns."""
    full = np.zeros((measure.size, measure.slots, 3))
    for i, (a, b) in enumerate(measure.edges):
        full[3 * i : 3 * i + 3, b] += np.eye(3)
        full[3 * i : 3 * i + 3, a] -= np.eye(3)
    row = 3 * len(measure.edges)
    for i in range(measure.angles):
        full[row + i, measure.nodes + i, 0] = 1.0
    for i in range(measure.spins):
        rows = row + measure.angles + 3 * i
        full[rows : rows + 3, measure.nodes + measure.angles + i] = np.eye(3)
    row += measure.angles + 3 * measure.spins
    for i in range(measure.points):
        full[row + 3 * i : row + 3 * i + 3, i] = np.eye(3)
    slot, component = np.nonzero(full.any(0))
    return full[:, slot, component], slot, component
