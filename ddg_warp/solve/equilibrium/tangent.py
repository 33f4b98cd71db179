"""Energy, gradient and exact tangent of a model on the host: for statics, stability and tests.

Every rod group and the coupled system contribute a tangent block with contiguous dofs, see `ddg_warp.solve.equilibrium.rod_tangent` and
`ddg_warp.solve.equilibrium.coupled_tangent`.
"""

import numpy as np
from scipy import sparse

from ddg_warp.capture_lock import launches
from ddg_warp.solve.equilibrium.rod_tangent import RodTangent


@launches
class Tangent:
    """Potential energy of a model with derivatives at a state, loads and fixed dofs included.

    Attributes:
        parts: tangent blocks of the rod groups and of the coupled system, with equal methods.
        size: number of dofs, fixed and padding ones included.
        free: mask of free dofs (size,) bool.
        angle: mask of angles (size,) bool.
        islands: number of islands (uncoupled rods, worlds of the coupled system), which no stiffness connects.
        island: island of each dof (size,); world: world of each island (islands,).
        poses: poses of grips as a function of the load parameter, (worlds, grips, 6); None for the poses of the state.
    """

    def __init__(self, model):
        self.model, self.poses = model, None
        self.parts, offset = [], 0
        for group in model.groups:
            self.parts.append(RodTangent(model, group, offset))
            offset += self.parts[-1].size
        if model.coupled is not None:
            from ddg_warp.solve.equilibrium.coupled_tangent import CoupledTangent

            self.parts.append(CoupledTangent(model, offset))
            offset += self.parts[-1].size
        self.size = offset
        self.free, self.angle = (
            np.concatenate([getattr(part, name) for part in self.parts]) for name in ("free", "angle")
        )

        first = np.cumsum([0, *(part.islands for part in self.parts)])
        self.islands = int(first[-1])
        self.island = np.concatenate(
            [
                start + np.repeat(np.arange(p.islands), p.size // p.islands)
                for start, p in zip(first, self.parts, strict=False)
            ]
        )
        self.world = np.concatenate([np.arange(part.islands) // (part.islands // model.worlds) for part in self.parts])

    @property
    def mass(self) -> np.ndarray:
        """Lumped mass and rotary inertia of every dof (size,) [kg, kg m^2]."""
        return np.concatenate([part.mass for part in self.parts])

    def energy(self, state) -> dict[str, np.ndarray]:
        """Return the elastic energy of every term (worlds,) [J]."""
        result = {}
        for part in self.parts:
            for name, values in part.energies(state):
                result[name] = result.get(name, 0.0) + values.sum(1)
        return result

    def element_energies(self, state) -> np.ndarray:
        """Return elastic energies of all elements [J], for differences without cancellation."""
        values, islands, first = [], [], 0
        for part in self.parts:
            for _, energies in part.energies(state):
                values.append(energies.ravel())
                islands.append(first + np.repeat(np.arange(part.islands), energies.size // part.islands))
            first += part.islands
        self._element_island = np.concatenate(islands)
        return np.concatenate(values)

    def island_energies(self, element_energies: np.ndarray) -> np.ndarray:
        """Return sums of element values, ordered as `element_energies`, over islands (islands,) [J]."""
        return np.bincount(self._element_island, element_energies, self.islands)

    def elastic_energy(self, state) -> float:
        """Return the elastic energy of all worlds without contact [J]."""
        return float(sum(v.sum() for part in self.parts for name, v in part.energies(state) if name != "contact"))

    def gradient(self, state) -> np.ndarray:
        """Return the derivative of the elastic energy (size,) [N, N m], minus the internal force."""
        return np.concatenate([part.gradient(state) for part in self.parts])

    @property
    def shells_alone(self) -> bool:
        """True if the model consists of shells alone."""
        return not self.model.groups and not self.model.coupled.edges

    def hessian(self, state, stress: list | None = None) -> sparse.csc_matrix:
        """Return the exact Hessian of the elastic energy (size, size), for the coupled system with `stress` if given."""
        blocks = [part.hessian(state) for part in self.parts[:-1]]
        last = self.parts[-1]
        blocks.append(last.hessian(state) if stress is None else last.hessian(state, stress))
        return blocks[0] if len(blocks) == 1 else sparse.block_diag(blocks, format="csc")

    def stiffness(self, state, load: float | None = None, stress: list | None = None) -> sparse.csc_matrix:
        """Return the tangent stiffness: `hessian` plus load stiffness at load parameter `load`, by default `state.time`.

        It is unsymmetric under nonconservative follower loads.
        """
        following = self.load_stiffness(state.time if load is None else load, self.dofs(state))
        hessian = self.hessian(state, stress)
        return hessian if following is None else hessian + following

    def linear_stress(self, state, step: np.ndarray) -> list:
        """Return stresses (strains, elements) of element sets of the coupled system, at strains e + J step."""
        return self.parts[-1].linear_stress(state, self.of(self.parts[-1], step))

    def give(self, inputs: dict[str, np.ndarray]) -> None:
        """Set the control loads of `Controls.checked`, to be scaled like the loads of the scene."""
        for part in self.parts:
            part.give(inputs)

    def loads(self, factor: float, q: np.ndarray) -> np.ndarray:
        """Return external forces (size,) [N, N m] at dofs q: constant loads times `factor`, others by amplitude."""
        return np.concatenate([part.loads(factor, self.of(part, q)) for part in self.parts])

    def work(self, factor: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the work of mean external forces on every dof between two dof vectors (size,) [J]."""
        parts = self.parts
        return np.concatenate([part.work(factor, self.of(part, before), self.of(part, after)) for part in parts])

    def spread(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return a step (size,) with displacements of the nodes that rigid bodies carry."""
        return np.concatenate([part.spread(self.of(part, q), self.of(part, step)) for part in self.parts])

    @property
    def carries(self) -> bool:
        """True if rigid bodies carry nodes, so that forces on dofs do work on more than these dofs."""
        return bool(self.model.scene.bodies)

    def load_stiffness(self, factor: float, q: np.ndarray) -> sparse.csc_matrix | None:
        """Return the load stiffness, minus the derivative of loads by q; None without follower loads."""
        blocks = [part.load_stiffness(factor, self.of(part, q)) for part in self.parts]
        if all(block is None for block in blocks):
            return None
        empty = [sparse.csc_matrix((part.size, part.size)) for part in self.parts]
        return sparse.block_diag([e if b is None else b for b, e in zip(blocks, empty, strict=True)], format="csc")

    def dofs(self, state) -> np.ndarray:
        """Return positions and angles of a state (size,)."""
        return np.concatenate([part.dofs(state) for part in self.parts])

    def retract(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return q moved along `step`; rod groups use the edge-rotation update."""
        return np.concatenate([part.retract(self.of(part, q), self.of(part, step)) for part in self.parts])

    def assign(self, state, q: np.ndarray) -> None:
        """Write dofs (size,) to a state and update the reference frames."""
        for part in self.parts:
            part.assign(state, self.of(part, q))
        self.model.carry_frames(state)
        state.forget_equilibrium()

    def move_supports(self, state, before: float, load_factor: float) -> None:
        """Move fixed dofs and the magnetic field of a state from load parameter `before` to `load_factor`."""
        if self.model.motions or self.prescribes:
            self._hold(state, load_factor)
            for part in self.parts:
                part.move_supports(state, before, load_factor)
            self.model.carry_frames(state)

    def friction(self, state) -> np.ndarray:
        """Return friction forces by `state.slip_velocity` (size,) [N], which are not in the gradient; zero without friction."""
        result, touch = np.zeros(self.size), self.model.touch
        if touch and touch.terms.frictions:
            self.of(self.parts[-1], result)[:] = self.parts[-1].friction(state)
        return result

    @property
    def prescribes(self) -> bool:
        """True if states prescribe more than dofs: shell normals of supports, or a magnetic field."""
        return self.model.coupled is not None and any(
            len(part.turning) or part.term.measure.field for part in self.model.coupled.sets
        )

    def with_prescribed(self, state, load_factor: float):
        """Return the state with grips, prescribed normals and magnetic field of `load_factor`; itself if unchanged."""
        if not (self.prescribes or self.poses):
            return state
        state = state.copy()
        self._hold(state, load_factor)
        if self.prescribes:
            self.parts[-1].prescribe(state, load_factor)
        return state

    def _hold(self, state, load_factor: float) -> None:
        """Set the grip poses of a state at a load parameter."""
        if self.poses:
            state.grips.pose.assign(np.ascontiguousarray(self.poses(load_factor).reshape(-1, 6).T))

    def support_step(self, state, before: float, load_factor: float) -> np.ndarray:
        """Return the displacement of supports from `before` to `load_factor` (size,), zero at free dofs."""
        if not self.model.motions:
            return np.zeros(self.size)
        moved = state.copy()
        self.move_supports(moved, before, load_factor)
        return np.where(self.free, 0.0, self.dofs(moved) - self.dofs(state))

    def advance(self, state, step: np.ndarray, load_factor: float):
        """Return a state moved along `step` (size,), with supports exactly at `load_factor`."""
        moved = state.copy()
        self.assign(moved, self.retract(self.dofs(state), step))
        self.move_supports(moved, load_factor, load_factor)
        moved.time = load_factor
        return moved

    def rotation(self, q: np.ndarray, direction: np.ndarray) -> float:
        """Return the largest edge rotation or angle change of a step along `direction` [rad]."""
        return float(self.rotations(q, direction).max(initial=0.0))

    def rotations(self, q: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the largest edge rotation or angle change of every island (islands,) [rad]; see `rotation`."""
        worst = np.zeros(self.islands)
        np.maximum.at(worst, self.island[self.angle], np.abs(direction[self.angle]))
        first = 0
        for part in self.parts:
            position, step = self.of(part, q), self.of(part, direction)
            edges, turns = part.edges(position), part.edges(part.spread(position, step))
            length, turned = np.linalg.norm(edges, axis=1), np.linalg.norm(turns, axis=1)
            turn = np.divide(turned, length, out=np.zeros_like(turned), where=length > 0.0)
            islands = worst[first : first + part.islands]
            np.maximum(islands, turn.reshape(part.islands, -1).max(1, initial=0.0), out=islands)
            first += part.islands
        return worst

    def turned_over(self, before: np.ndarray, after: np.ndarray) -> bool:
        """Return True if an edge reverses direction between two dof vectors."""
        pairs = ((part.edges(self.of(part, before)), part.edges(self.of(part, after))) for part in self.parts)
        return any((np.sum(a * b, axis=1) < 0.0).any() for a, b in pairs)

    def edge_length(self) -> float:
        """Return the mean rest length of edges [m], the scale of angles against positions."""
        return float(np.mean([part.edge_length() for part in self.parts]))

    def point_dofs(self) -> np.ndarray:
        """Return the dofs of the rows of `State.points` (P, 3) in the first world; -1 across the plane of planar rods."""
        result = np.full((self.model.points_count, 3), -1)
        for part in self.parts:
            rows, dofs = part.point_dofs()
            result[rows] = np.where(dofs < 0, -1, dofs + part.offset)
        return result

    def at_points(self, values: np.ndarray) -> np.ndarray:
        """Return dof values (size,) in the shape of `State.points`; zero across the plane of planar rods."""
        worlds = self.model.worlds
        result = np.zeros((worlds, self.model.points_count, 3), values.dtype)
        for part in self.parts:
            rows, dofs = part.point_dofs()
            of_worlds = self.of(part, values).reshape(worlds, -1)
            result[:, rows] = np.where(dofs < 0, 0.0, of_worlds[:, dofs])
        return result if worlds > 1 else result[0]

    def where(self, dof: int) -> str:
        """Return the name of the node or edge of a dof, such as "node 3 of rod 1"."""
        part = next(part for part in self.parts if part.offset <= dof < part.offset + part.size)
        return part.where(dof - part.offset)

    def into(self, values: np.ndarray) -> np.ndarray:
        """Return vectors in space (size,) as dofs: components in nodal frames of skew supports; see `solve.linear.skew_supports`."""
        return np.concatenate([part.into(self.of(part, values)) for part in self.parts])

    def back(self, values: np.ndarray) -> np.ndarray:
        """Return dofs, forces or steps (size,) as vectors in space."""
        return np.concatenate([part.back(self.of(part, values)) for part in self.parts])

    @staticmethod
    def of(part, values: np.ndarray) -> np.ndarray:
        """Return the entries of a tangent block."""
        return values[part.offset : part.offset + part.size]
