"""Energy, gradient and exact tangent of a model on the host: for statics, stability and tests.

Every group of rods and the net contribute a part: dofs in a row, with offsets. See `ddg_warp.solve.chains.tangent` and
`ddg_warp.solve.net.tangent`.
"""

import numpy as np
from scipy import sparse

from ddg_warp.solve.chains.tangent import ChainTangent
from ddg_warp.threads import launches


@launches
class Tangent:
    """The potential energy of a model and its derivatives at a state, loads and held dofs included.

    Attributes:
        parts: what the groups of rods and the net contribute, each with the same methods.
        size: number of dofs, held and padding ones included.
        free: which dofs are free (size,) bool.
        angle: which dofs are angles (size,) bool.
        islands: number of islands: rods of groups, and worlds of the coupled system, which no stiffness connects; island: of each dof
            (size,); world: of each island (islands,).
        poses: of grips by load parameter, load -> (worlds, grips, 6); None where they are as the state has them.
    """

    def __init__(self, model):
        self.model, self.poses = model, None
        self.parts, offset = [], 0
        for group in model.groups:
            self.parts.append(ChainTangent(model, group, offset))
            offset += self.parts[-1].size
        if model.net is not None:
            from ddg_warp.solve.net.tangent import NetTangent

            self.parts.append(NetTangent(model, offset))
            offset += self.parts[-1].size
        self.size = offset
        self.free, self.angle = (
            np.concatenate([getattr(part, name) for part in self.parts]) for name in ("free", "angle")
        )

        first = np.cumsum([0, *(part.islands for part in self.parts)])
        self.islands = int(first[-1])
        self.island = np.concatenate(
            [
                at + np.repeat(np.arange(p.islands), p.size // p.islands)
                for at, p in zip(first, self.parts, strict=False)
            ]
        )
        self.world = np.concatenate([np.arange(part.islands) // (part.islands // model.worlds) for part in self.parts])

    @property
    def mass(self) -> np.ndarray:
        """Lumped mass and rotary inertia of every dof (size,) [kg, kg m^2]."""
        return np.concatenate([part.mass for part in self.parts])

    def energy(self, state) -> dict[str, np.ndarray]:
        """Elastic energy of every term (worlds,) [J]."""
        result = {}
        for part in self.parts:
            for name, values in part.energies(state):
                result[name] = result.get(name, 0.0) + values.sum(1)
        return result

    def element_energies(self, state) -> np.ndarray:
        """Elastic energies of all elements [J], for differences free of cancellation."""
        values, islands, first = [], [], 0
        for part in self.parts:
            for _, own in part.energies(state):
                values.append(own.ravel())
                islands.append(first + np.repeat(np.arange(part.islands), own.size // part.islands))
            first += part.islands
        self._element_island = np.concatenate(islands)
        return np.concatenate(values)

    def island_energies(self, element_energies: np.ndarray) -> np.ndarray:
        """Sums of values of elements, in the order of `element_energies`, over every island (islands,) [J]."""
        return np.bincount(self._element_island, element_energies, self.islands)

    def elastic_energy(self, state) -> float:
        """That of all worlds without what touches [J]."""
        return float(sum(v.sum() for part in self.parts for name, v in part.energies(state) if name != "contact"))

    def gradient(self, state) -> np.ndarray:
        """Derivative of the elastic energy (size,) [N, N m]; minus the internal force."""
        return np.concatenate([part.gradient(state) for part in self.parts])

    @property
    def shells_alone(self) -> bool:
        """Whether the model consists of shells alone."""
        return not self.model.groups and not self.model.net.edges

    def hessian(self, state, stress: list | None = None) -> sparse.csc_matrix:
        """Exact second derivative of the elastic energy (size, size); in the coupled system with other stresses where given."""
        blocks = [part.hessian(state) for part in self.parts[:-1]]
        last = self.parts[-1]
        blocks.append(last.hessian(state) if stress is None else last.hessian(state, stress))
        return blocks[0] if len(blocks) == 1 else sparse.block_diag(blocks, format="csc")

    def stiffness(self, state, load: float | None = None, stress: list | None = None) -> sparse.csc_matrix:
        """The tangent of the whole: `hessian`, less the derivative of the loads that follow at load parameter `load`.

        By default that of an equilibrium, which is its time. Where such loads are not conservative it is unsymmetric.
        """
        following = self.load_stiffness(state.time if load is None else load, self.dofs(state))
        hessian = self.hessian(state, stress)
        return hessian if following is None else hessian + following

    def linear_stress(self, state, step: np.ndarray) -> list:
        """Stresses (strains, elements) of every element set of the coupled system after a step, with strains e + J step."""
        return self.parts[-1].linear_stress(state, self.of(self.parts[-1], step))

    def give(self, found: dict[str, np.ndarray]) -> None:
        """From now on have the loads among what `Controls.checked` found, times the factor, beside those of the scene."""
        for part in self.parts:
            part.give(found)

    def loads(self, factor: float, q: np.ndarray) -> np.ndarray:
        """Outer forces (size,) [N, N m] on dofs q: gravity and dead loads times `factor`, timed loads at their amplitude."""
        return np.concatenate([part.loads(factor, self.of(part, q)) for part in self.parts])

    def load_stiffness(self, factor: float, q: np.ndarray) -> sparse.csc_matrix | None:
        """Minus the derivative of the loads with respect to q; None where loads do not follow q."""
        blocks = [part.load_stiffness(factor, self.of(part, q)) for part in self.parts]
        if all(block is None for block in blocks):
            return None
        empty = [sparse.csc_matrix((part.size, part.size)) for part in self.parts]
        return sparse.block_diag([e if b is None else b for b, e in zip(blocks, empty, strict=True)], format="csc")

    def dofs(self, state) -> np.ndarray:
        """Positions and angles of a state (size,)."""
        return np.concatenate([part.dofs(state) for part in self.parts])

    def retract(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """q moved along `step`; rods turn their edges instead of shearing them."""
        return np.concatenate([part.retract(self.of(part, q), self.of(part, step)) for part in self.parts])

    def assign(self, state, q: np.ndarray) -> None:
        """Put dofs (size,) into a state and carry its frames along."""
        for part in self.parts:
            part.assign(state, self.of(part, q))
        self.model.carry_frames(state)
        state.forget_equilibrium()

    def move_supports(self, state, before: float, at: float) -> None:
        """Put held dofs, and the magnetic field, where they are at load parameter `at`; the state belongs to `before`."""
        if self.model.motions or self.prescribes:
            self._hold(state, at)
            for part in self.parts:
                part.move_supports(state, before, at)
            self.model.carry_frames(state)

    def friction(self, state) -> np.ndarray:
        """Forces of friction by `state.rubbing` (size,) [N], which have no potential and are in no gradient; zero without."""
        result, touch = np.zeros(self.size), self.model.touch
        if touch and touch.terms.frictions:
            net = self.parts[-1]
            self.of(net, result)[:] = net.into(touch.friction(state.net.q, state.rubbing, state.net.rate).ravel())
        return result

    @property
    def prescribes(self) -> bool:
        """Whether supports turn normals of shells, or a magnetic field acts: what states hold beside their dofs."""
        return self.model.net is not None and any(
            len(part.turning) or part.term.measure.field for part in self.model.net.sets
        )

    def with_prescribed(self, state, at: float):
        """The state with grips, the normals that supports turn, and the magnetic field, of `at`; itself where none changes."""
        if not (self.prescribes or self.poses):
            return state
        state = state.copy()
        self._hold(state, at)
        if self.prescribes:
            self.parts[-1].prescribe(state, at)
        return state

    def _hold(self, state, at: float) -> None:
        """Put the grips of a state where they are at load parameter `at`."""
        if self.poses:
            state.grips.pose.assign(np.ascontiguousarray(self.poses(at).reshape(-1, 6).T))

    def support_step(self, state, before: float, at: float) -> np.ndarray:
        """How far the supports of a state that belongs to `before` are from where they are at `at` (size,), zero at free dofs."""
        if not self.model.motions:
            return np.zeros(self.size)
        moved = state.copy()
        self.move_supports(moved, before, at)
        return np.where(self.free, 0.0, self.dofs(moved) - self.dofs(state))

    def advance(self, state, step: np.ndarray, at: float):
        """Another state, moved along `step` (size,); its supports are then exactly where they are at load parameter `at`."""
        moved = state.copy()
        self.assign(moved, self.retract(self.dofs(state), step))
        self.move_supports(moved, at, at)
        moved.time = at
        return moved

    def rotation(self, q: np.ndarray, direction: np.ndarray) -> float:
        """Largest rotation of an edge, or change of an angle, that a step along `direction` would make [rad]."""
        return float(self.rotations(q, direction).max(initial=0.0))

    def rotations(self, q: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Largest rotation of an edge, or change of an angle, of every island (islands,) [rad]; see `rotation`."""
        worst = np.zeros(self.islands)
        np.maximum.at(worst, self.island[self.angle], np.abs(direction[self.angle]))
        first = 0
        for part in self.parts:
            edges, turns = (part.edges(self.of(part, v)) for v in (q, direction))
            length, own = np.linalg.norm(edges, axis=1), np.linalg.norm(turns, axis=1)
            turn = np.divide(own, length, out=np.zeros_like(own), where=length > 0.0)
            islands = worst[first : first + part.islands]
            np.maximum(islands, turn.reshape(part.islands, -1).max(1, initial=0.0), out=islands)
            first += part.islands
        return worst

    def turned_over(self, before: np.ndarray, after: np.ndarray) -> bool:
        """Whether an edge points backwards on dofs `after` as against `before`."""
        pairs = ((part.edges(self.of(part, before)), part.edges(self.of(part, after))) for part in self.parts)
        return any((np.sum(a * b, axis=1) < 0.0).any() for a, b in pairs)

    def edge_length(self) -> float:
        """Mean rest length of edges [m]: what makes angles and positions comparable."""
        return float(np.mean([part.edge_length() for part in self.parts]))

    def point_dofs(self) -> np.ndarray:
        """Dofs of the rows of `State.points` (P, 3), of the first world; -1 for what a planar rod has not."""
        result = np.full((self.model.points_count, 3), -1)
        for part in self.parts:
            rows, dofs = part.point_dofs()
            result[rows] = np.where(dofs < 0, -1, dofs + part.offset)
        return result

    def at_points(self, values: np.ndarray) -> np.ndarray:
        """The entries of dofs (size,) at points, in the shape of `State.points`; zero along what a planar rod has not."""
        worlds = self.model.worlds
        result = np.zeros((worlds, self.model.points_count, 3), values.dtype)
        for part in self.parts:
            rows, dofs = part.point_dofs()
            own = self.of(part, values).reshape(worlds, -1)
            result[:, rows] = np.where(dofs < 0, 0.0, own[:, dofs])
        return result if worlds > 1 else result[0]

    def where(self, dof: int) -> str:
        """Name of a dof's place, such as "node 3 of rod 1"."""
        part = next(part for part in self.parts if part.offset <= dof < part.offset + part.size)
        return part.where(dof - part.offset)

    def into(self, values: np.ndarray) -> np.ndarray:
        """Vectors in space (size,) as dofs are: components in the frames of oblique planes; see `ddg_warp.solve.net.planes`."""
        return np.concatenate([part.into(self.of(part, values)) for part in self.parts])

    def back(self, values: np.ndarray) -> np.ndarray:
        """Dofs, forces or steps (size,) as vectors in space."""
        return np.concatenate([part.back(self.of(part, values)) for part in self.parts])

    @staticmethod
    def of(part, values: np.ndarray) -> np.ndarray:
        """The entries of a part."""
        return values[part.offset : part.offset + part.size]
