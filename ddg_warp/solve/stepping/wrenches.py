"""Wrenches of steps: force and moment at every support, grip and obstacle; see `kernels.residual.support_forces`."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import overload

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.compile.support_dofs import NormalMoments, SupportDofs, matches
from ddg_warp.errors import SceneError
from ddg_warp.kernels.collision.contact.obstacle_forces import obstacle_kernel, pairs_type
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements.coupled_element import coupled_storage
from ddg_warp.kernels.elements.rod_layout import rod_storage
from ddg_warp.kernels.residual import support_forces
from ddg_warp.kernels.residual.coupled_residual import inputs_type
from ddg_warp.kernels.residual.support_forces import ROWS
from ddg_warp.kernels.stepping import wrench_sums
from ddg_warp.scene.handle import OBSTACLE, RING_SUPPORT, SHELL_SUPPORT, SUPPORT, Handle, named
from ddg_warp.scene.scene import Scene
from ddg_warp.solve.linear.sparse_system import lists
from ddg_warp.typing import Floats

RUNS = 128  # sums of contact forces of each obstacle on a GPU


@dataclass(frozen=True)
class Reaction:
    """Resultant force and moment that one support of the scene exerts.

    Attributes:
        force: (3,) or (worlds, 3) [N].
        moment: about `point` (3,) or (worlds, 3) [N m].
        point: (3,) or (worlds, 3) [m].
    """

    force: Floats
    moment: Floats
    point: Floats


class Reactions(list[Reaction]):
    """Reactions of all supports, by position, by handle or by name.

    Supports are ordered as added: of rods, then of shells, rings and obstacles.
    """

    def __init__(self, reactions: Iterable[Reaction], scene: Scene):
        super().__init__(reactions)
        of_kinds = (scene.supports, scene.shell_supports, scene.ring_supports, scene.obstacles)
        self._first, self._names = {}, []
        for kind, supports in zip((SUPPORT, SHELL_SUPPORT, RING_SUPPORT, OBSTACLE), of_kinds, strict=True):
            self._first[kind] = len(self._names)
            self._names += [support.name for support in supports]

    @overload
    def __getitem__(self, item: int | str) -> Reaction: ...

    @overload
    def __getitem__(self, item: slice) -> list[Reaction]: ...

    def __getitem__(self, item: int | str | slice) -> Reaction | list[Reaction]:
        """Return the reaction of a position, handle or name; of a slice a list.

        Raises:
            SceneError: no support or obstacle has the name, several have it, or the handle is of something else.
        """
        if isinstance(item, str):
            item = int(named(SUPPORT, item, self._names))
        elif isinstance(item, Handle):
            if item.kind not in self._first:
                raise SceneError(f"{item!r} is no support; give what clamp, fix, hold or add_obstacle returned")
            item = self._first[item.kind] + item
        return super().__getitem__(item)

    def __reduce__(self):
        return list, (list(self),)

    @classmethod
    def series(cls, reactions: Sequence["Reactions"], scene: Scene) -> "Reactions":
        """Return the reactions of several states in one, with an axis of states in front of all arrays."""
        names = ("force", "moment", "point")
        of_supports = zip(*reactions, strict=True)
        stacked = (Reaction(*(np.stack([getattr(each, n) for each in s]) for n in names)) for s in of_supports)
        return cls(stacked, scene)


def support_count(scene) -> int:
    """Return the number of supports of a scene: of rods, then of shells, rings and obstacles."""
    return len(scene.supports) + len(scene.shell_supports) + len(scene.ring_supports) + len(scene.obstacles)


class Wrenches:
    """Wrenches of the last step of an integrator, on the device.

    Supports are ordered as in `Model.reactions`. Forces are means over the step, over its substeps too. They balance the momentum
    exactly: its change over the step length is the sum of all forces, mass damping and wrenches. Moments do so about the
    positions at the end of each solve: the end of the step for implicit Euler, its middle for the midpoint rule.

    Gyroscopic couples on fixed nodes are left out. A failed world has the wrenches of its accepted substeps.

    Attributes:
        force: (worlds, supports) vectors [N].
        moment: about `point`, (worlds, supports) vectors [N m].
        point: first node of each support at the end of the step, (worlds, supports) vectors [m].
    """

    def __init__(self, model):
        real, device = model.types.real, model.wp_device
        vector, shape = wp.types.vector(3, real), (model.worlds, support_count(model.scene))
        self.force, self.moment, self.point = (wp.zeros(shape, dtype=vector, device=device) for _ in range(3))
        self._model, self._sums = model, wrench_sums.sum_kernels(real)
        self._none = wp.zeros(0, dtype=int, device=device)
        parts = [*model.groups, *([model.coupled] if model.coupled is not None else [])]
        dofs = [SupportDofs.of(part.host) for part in parts]
        self._origins, owner = np.zeros((shape[1], 3)), np.full(shape[1], -1)
        for number, (part, fixed) in reversed(list(enumerate(zip(parts, dofs, strict=True)))):
            self._origins[fixed.first], owner[fixed.first] = part.host.points(fixed.reference), number
        self._origin = wp.array(self._origins, dtype=vector, device=device)
        self._parts = [self._reactions(part, fixed) for part, fixed in zip(parts, dofs, strict=True)]
        self._references = [
            _References(model, part, fixed, np.flatnonzero(owner == number), self._origin)
            for number, (part, fixed) in enumerate(zip(parts, dofs, strict=True))
        ]
        self._decoupled = []  # reactions of the rod groups of decoupled steps

    def _reactions(self, part, dofs: SupportDofs) -> "_Reactions":
        kind = CoupledReactions if part is self._model.coupled else RodReactions
        return kind(self._model, part, dofs, self._origins)

    def follow(self, coupled_step) -> None:
        """Allocate lists of pairs, and rod groups of decoupled steps, before a capture."""
        decoupled = coupled_step.decoupled
        groups = [rod_step.group for rod_step in decoupled.rod_steps] if decoupled else []
        if [part.part for part in self._decoupled] != groups:
            self._decoupled = [self._reactions(group, SupportDofs.of(group.host)) for group in groups]
        self._parts[-1].follow(coupled_step)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        parts = (*self._parts, *self._decoupled, *self._references)
        return [*self._sums, *(kernel for part in parts for kernel in part.kernels)]

    def begin(self) -> None:
        """Zero all reactions before a step; capturable."""
        for part in (*self._parts, *self._decoupled):
            part.clear()

    def add(self, step, start) -> None:
        """Add the reactions of the substep that a `RodStep` or `CoupledStep` has just solved from `start`; capturable.

        Decoupled steps replace the reactions of an earlier attempt.
        """
        stepped = getattr(step, "group", self._model.coupled)
        for parts, keeps in ((self._parts, 1), (self._decoupled, 0)):
            for part in parts:
                if part.part is stepped:
                    part.add(step, start, keeps)

    def sum(self, after, decoupled) -> None:
        """Sum the reactions of a step to the state `after`, with its `DecoupledStep` or None; capturable."""
        self.force.zero_()
        self.moment.zero_()
        parts = [(part, self._none) for part in self._parts]
        parts += [(part, decoupled.left) for part in self._decoupled if decoupled]
        for part, excluded in parts:
            for runs in part.runs:
                runs.sum(self._sums, excluded, self.force, self.moment)
        for references, state in zip(self._references, [*after.groups, after.coupled], strict=False):
            references.shift(state, self.force, self.moment, self.point)

    def at(self, state, loads: list[np.ndarray]) -> Reactions:
        """Return the reactions at a state without inertia and damping.

        Args:
            loads: external, contact and friction forces on the dofs of every rod group and of the coupled system, in space.
        """
        self.begin()
        for part, values, load in zip(self._parts, [*state.groups, state.coupled], loads, strict=False):
            part.add_static(values, load)
        self.sum(state, None)
        return self.values()

    def values(self) -> Reactions:
        """Return the wrench of every support. Reads from the device."""
        arrays = [array.numpy().astype(float) for array in (self.force, self.moment, self.point)]
        world = 0 if self._model.worlds == 1 else slice(None)
        reactions = [Reaction(*(values[world, i] for values in arrays)) for i in range(self.force.shape[1])]
        return Reactions(reactions, self._model.scene)


class _Runs:
    """Reactions of entries (n, worlds), sorted by support, and their sums over runs of entries.

    Args:
        support: support of each entry (n,), ascending; summed: True if each entry is a sum already.
    """

    def __init__(self, model, support: np.ndarray, summed: bool = False):
        real, self.device, self.worlds = model.types.real, model.wp_device, model.worlds
        vector = wp.types.vector(3, real)

        def make(rows):
            return [wp.zeros((rows, self.worlds), dtype=vector, device=self.device) for _ in range(2)]

        def put(values):
            return wp.array(np.asarray(values, np.int32), dtype=int, device=self.device)

        supports, first, count = np.unique(support, return_index=True, return_counts=True)
        length = np.ceil(np.sqrt(count)).astype(int)
        starts = [np.arange(begin, begin + n, size) for begin, n, size in zip(first, count, length, strict=True)]
        runs = np.concatenate([np.zeros(0, int), *starts])
        self.force, self.moment = make(len(support))
        self._summed = summed
        self._of_runs = (self.force, self.moment) if summed else make(len(runs))
        self._starts = put(np.append(runs, len(support)))
        by_support = np.append(first, len(support)) if summed else np.cumsum([0, *map(len, starts)])
        self._supports, self._by_support = put(supports), put(by_support)

    def clear(self) -> None:
        """Zero all reactions; capturable."""
        self.force.zero_()
        self.moment.zero_()

    def sum(self, kernels: tuple, excluded: wp.array, force: wp.array, moment: wp.array) -> None:
        """Add the reactions to the wrenches of supports, in worlds that are not `excluded`; capturable."""
        add_runs, add_supports = kernels
        if not self._summed:
            inputs, outputs = [self._starts, self.force, self.moment], [*self._of_runs]
            wp.launch(add_runs, (len(self._starts) - 1, self.worlds), inputs, outputs, device=self.device)
        inputs = [self._supports, self._by_support, *self._of_runs, excluded]
        wp.launch(add_supports, (len(self._supports), self.worlds), inputs, [force, moment], device=self.device)


class _Reactions:
    """Reactions at the fixed dofs of a rod group or of the coupled system.

    Attributes:
        `part`: the `RodGroup` or `CoupledModel`.
        runs: reactions of entries, to be summed over supports.
        kernels: kernels to load before a capture.
    """

    def __init__(self, model, part, dofs: SupportDofs, origins: np.ndarray):
        self.part, self._model, self._device, self._real = part, model, model.wp_device, model.types.real
        self._vector = wp.types.vector(3, self._real)
        self._nodal = _Runs(model, dofs.support)
        self.runs, self.kernels = [self._nodal], []
        self._entries = entries = support_forces.entries_type(self._real)()
        (place, column), (ends, _) = self._index(dofs.place), self._index(dofs.ends)
        entries.place, entries.ends = self._pairs(np.stack([place, column], -1)), self._pairs(ends)
        entries.is_angle, entries.columns = self._integers(dofs.is_angle), part.world_columns
        entries.share = wp.array(dofs.share, dtype=wp.types.matrix((3, 3), self._real), device=self._device)
        entries.origin = wp.array(origins[dofs.support], dtype=self._vector, device=self._device)

    @cached_property
    def _at_rest(self) -> list:
        """Arrays of islands that have accepted a step without inertia."""
        islands = Islands(self.part.columns, self._real, self._device)
        islands.substep_accepted.fill_(1)
        islands.substep_fraction.fill_(1.0)
        return islands.arrays

    def _gather(self, target: np.ndarray, items: np.ndarray, elements: int) -> None:
        """Store the incidence list of entries: `items` that contribute to the entries `target`."""
        entries = self._entries
        starts, order = lists(target, len(self._nodal.force))
        entries.starts, entries.items = self._integers(starts), self._integers(items[order])
        entries.elements = elements

    def _integers(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=self._device)

    def _pairs(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.vec2i, device=self._device)

    def _index(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return indices along a column, and columns in a world, of path nodes."""
        return _index(self.part, places)

    def clear(self) -> None:
        """Zero all reactions; capturable."""
        for runs in self.runs:
            runs.clear()

    def _launch(self, kernel, count: int, inputs: list, outputs: list) -> None:
        if count:
            wp.launch(kernel, (count, self._model.worlds), inputs, outputs, device=self._device)


def _index(part, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return indices along a column, and columns in a world, of nodes or edges of a subsystem."""
    return np.divmod(part.host.index(places), part.world_columns)


class RodReactions(_Reactions):
    """Reactions at the fixed dofs of a rod group."""

    def __init__(self, model, group, dofs: SupportDofs, origins: np.ndarray):
        super().__init__(model, group, dofs, origins)
        kind, real = group.kind, self._real
        target, element, column, local = elements_at(group.host, dofs, *self._index(dofs.place))
        listed, where = np.unique(np.stack([column, element], -1), axis=0, return_inverse=True)
        self._gather(target, where.reshape(-1) * ROWS + local, len(listed))
        self._listed, locals_count = self._pairs(listed), kind.span + 1 + (2 if kind.twist else 0)
        self._values = wp.zeros((locals_count, len(listed) * model.worlds), dtype=self._vector, device=self._device)
        storage, by_local = rod_storage(kind, real), support_forces.rod_local_function(kind, real)
        self._evaluate = [
            support_forces.element_force_kernel(storage, index, by_local, locals_count, real)
            for index in range(len(kind.terms))
        ]
        self._react = support_forces.rod_reaction_kernel(kind, real)
        self.kernels = [*self._evaluate, self._react]

    def evaluate(self, inputs) -> wp.array:
        """Evaluate the elements at supports, and return their forces by local node; capturable."""
        count = len(self._listed)
        for kernel in self._evaluate:
            self._launch(kernel, count, [inputs, self._listed, self.part.rods, 0, count], [self._values])
        return self._values

    def add(self, step, start, keeps: int) -> None:
        """Add the reactions of an accepted substep, or replace the sums before; capturable."""
        group, newton, (flags, scalars) = self.part, step.newton, step.islands.arrays
        iterates, loading = newton.iterates, newton.loading
        values = self.evaluate(group.element_inputs(iterates, start.last, step.islands.inverse_step))
        inputs = [self._entries, values, loading.mass, loading.rotary, flags, scalars, iterates.x, iterates.theta]
        inputs += [iterates.frame, iterates.target, iterates.target_angle, group.gravity, loading.force, loading.moment]
        outputs = [self._nodal.force, self._nodal.moment]
        self._launch(self._react, len(outputs[0]), [*inputs, int(loading.loaded), keeps], outputs)

    def add_static(self, state, load: np.ndarray) -> None:
        """Add the reactions at a state; see `Wrenches.at`."""
        group, kind = self.part, replace(self.part.kind, quadratic=False)
        load = load.reshape(group.columns, group.nodes, kind.block).swapaxes(0, 1)
        vector = wp.types.vector(kind.dim, self._real)
        force = device_arrays.upload(np.ascontiguousarray(load[..., : kind.dim]), vector, self._device)
        moment = device_arrays.upload(np.ascontiguousarray(load[..., -1]), self._real, self._device)
        weightless = wp.zeros(1, dtype=vector, device=self._device)
        values = self.evaluate(group.element_inputs(state, state.last))
        inputs = [self._entries, values, group.mass, group.rotary, *self._at_rest, state.x, state.theta, state.frame]
        inputs += [state.x, state.theta, weightless, force, moment, 1, 1]
        kernel, outputs = support_forces.rod_reaction_kernel(kind, self._real), [self._nodal.force, self._nodal.moment]
        self._launch(kernel, len(outputs[0]), inputs, outputs)


def elements_at(host, dofs: SupportDofs, k: np.ndarray, column: np.ndarray) -> tuple:
    """Return (entry, element, column, local node) of all elements at nodes or angles k of columns of a rod group."""
    kind, count, entry = host.kind, host.count[column], np.arange(len(k))
    entries = []
    for offset in range(kind.span + 1):
        some = ~dofs.is_angle | (offset < kind.span)
        element, local = k - offset, offset + np.where(dofs.is_angle, kind.span + 1, 0)
        if kind.closed:
            element = element % count
        some &= (element >= 0) & (element < count - (0 if kind.closed else 1))
        entries.append([values[some] for values in (entry, element, column, local)])
    return tuple(np.concatenate(values) for values in zip(*entries, strict=True))


def coupled_elements_at(host, dofs: SupportDofs, normals: NormalMoments) -> tuple:
    """Return the elements of the coupled system next to supports.

    Returns:
        Elements of each set, in consecutive columns. Entry, column and local node of all pairs of a fixed dof block and an element.
        Columns of `normals`.
    """
    listed, pairs, columns, first = [], [np.zeros((3, 0), int)], np.zeros(len(normals), int), 0
    for index, element_set in enumerate(host.sets):
        of_normals = normals.element[:, 0] == index
        at_supports = np.isin(element_set.slots, dofs.place)
        wanted = at_supports.any(0)
        wanted[normals.element[of_normals, 1]] = True
        elements = np.flatnonzero(wanted)
        local, column = np.nonzero(at_supports[:, elements])
        each, entry = matches(element_set.slots[local, elements[column]], dofs.place)
        pairs.append(np.stack([entry, first + column[each], local[each]]))
        columns[of_normals] = first + np.searchsorted(elements, normals.element[of_normals, 1])
        listed.append(elements)
        first += len(elements)
    return listed, *np.concatenate(pairs, axis=1), columns


class CoupledReactions(_Reactions):
    """Reactions at the fixed dofs of the coupled system, moments on prescribed shell normals, and forces on obstacles."""

    def __init__(self, model, coupled, dofs: SupportDofs, origins: np.ndarray):
        super().__init__(model, coupled, dofs, origins)
        host, scene, real = coupled.host, model.scene, self._real
        normals = NormalMoments.of(host, len(scene.supports), len(scene.shell_supports))
        listed, target, column, local, columns = coupled_elements_at(host, dofs, normals)
        total = sum(map(len, listed))
        self._gather(target, column * ROWS + local, total)
        self._sets, first = [], 0
        for index, elements in enumerate(listed):
            storage, rows = coupled_storage(coupled.sets[index].term, real), len(host.sets[index].slots)
            if len(elements):
                kernel = support_forces.element_force_kernel(storage, 0, storage.slots, rows, real)
                self._sets.append((index, self._pairs(np.stack([0 * elements, elements], -1)), first, kernel))
            first += len(elements)
        rows = max((len(element_set.slots) for element_set in host.sets), default=1)
        self._values = wp.zeros((rows, total * model.worlds), dtype=self._vector, device=self._device)
        self._react, self.kernels = None, [kernel for *_, kernel in self._sets]
        self._normals = self._obstacles = None
        if len(normals):
            self._normals = _Normals(self, model, coupled, normals, columns, total)
            self.runs.append(self._normals.runs)
            self.kernels += self._normals.kernels
        if host.contact_parameters and scene.obstacles:
            self._obstacles = _Obstacles(self, model, coupled, origins)
            self.runs.append(self._obstacles.runs)
            self.kernels += self._obstacles.kernels

    def follow(self, step) -> None:
        """Allocate the arrays for a `CoupledStep`, before a capture."""
        newton, host = step.newton, self.part.host
        outer = newton.contact is not None or newton.user_forces is not None
        self._react = support_forces.coupled_reaction_kernel(self._real, newton.linear, host.quadratic, outer)
        device_arrays.load_kernels([self._react], self._device)
        if self._obstacles:
            self._obstacles.follow(newton.contact.terms)

    def evaluate(self, state, q: wp.array, rate: wp.array) -> wp.array:
        """Evaluate the elements at supports at dofs q, and return their forces by local node; capturable."""
        total = self._entries.elements
        for index, listed, first, kernel in self._sets:
            inputs = [self.part.elements(state, index, q, rate), listed, 1, first, total]
            self._launch(kernel, len(listed), inputs, [self._values])
        return self._values

    def add(self, step, start, keeps: int) -> None:
        """Add the reactions of an accepted substep; capturable."""
        newton, islands = step.newton, step.islands.arrays
        q = newton.iterates.proposed
        values = self.evaluate(start, q, step.islands.inverse_step)
        outputs = [self._nodal.force, self._nodal.moment]
        inputs = [self._entries, values, newton.residual.inputs, start.frame, self.part.edges, *islands]
        self._launch(self._react, len(outputs[0]), inputs, outputs)
        if self._normals:
            self._normals.add(values, islands, q)
        if self._obstacles:
            self._obstacles.add(islands, q)

    def add_static(self, state, load: np.ndarray) -> None:
        """Add the reactions at a state; see `Wrenches.at`."""
        coupled, islands = self.part, self._at_rest
        inputs = inputs_type(self._real, False)()
        inputs.q = inputs.base = inputs.target = state.q
        inputs.mass, inputs.blocks, inputs.nodes = coupled.mass, coupled.blocks, coupled.host.nodes
        inputs.gravity = wp.zeros(1, dtype=self._vector, device=self._device)
        inputs.load = wp.array(load.reshape(-1, 3), dtype=self._vector, device=self._device)
        values, outputs = self.evaluate(state, state.q, coupled.still), [self._nodal.force, self._nodal.moment]
        kernel = support_forces.coupled_reaction_kernel(self._real, self._real, False, False)
        read = [self._entries, values, inputs, state.frame, coupled.edges, *islands]
        self._launch(kernel, len(outputs[0]), read, outputs)
        if self._normals:
            self._normals.add(values, islands, state.q)


class _Normals:
    """Moments on prescribed shell normals; see `NormalMoments`."""

    def __init__(self, owner, model, coupled, normals: NormalMoments, columns: np.ndarray, total: int):
        sets, self._launch, self._blocks, self._total = coupled.host.sets, owner._launch, coupled.blocks, total
        self.runs = _Runs(model, normals.support)
        nodes = [sets[index].slots[: sets[index].term.measure.nodes, element] for index, element in normals.element]
        corners = np.full((max(map(len, nodes)), len(nodes)), -1)
        for i, of_element in enumerate(nodes):
            corners[: len(of_element), i] = of_element
        _, of_element = np.unique(normals.element, axis=0, return_inverse=True)
        edges = np.zeros(len(normals), int)
        np.bitwise_or.at(
            edges, of_element.reshape(-1), np.where(normals.corner < 0, 0, 1 << np.maximum(normals.corner, 0))
        )
        arrays = columns, corners, normals.corner, edges[of_element.reshape(-1)]
        self._inputs = [owner._integers(values) for values in arrays]
        self.kernels = [support_forces.normal_moment_kernel(model.types.real)]

    def add(self, values: wp.array, islands: list, q: wp.array) -> None:
        """Add the moments of an accepted substep; capturable."""
        inputs = [*self._inputs, values, self._total, *islands, q, self._blocks]
        self._launch(self.kernels[0], len(self.runs.moment), inputs, [self.runs.moment])


class _Obstacles:
    """Sums of contact and friction over obstacles; see `kernels.collision.contact.obstacle_forces`."""

    def __init__(self, owner, model, coupled, origins: np.ndarray):
        host, device, real = coupled.host, model.wp_device, model.types.real
        count, self._launch, self._integers = len(host.obstacles), owner._launch, owner._integers
        self._real, self._device, self._blocks, self._of_terms = real, device, coupled.blocks, None
        self._length = 1 if device_arrays.serial(device) else RUNS
        first = support_count(model.scene) - count
        self.runs = _Runs(model, np.repeat(first + np.arange(count), self._length), True)
        self._obstacle = np.full(coupled.blocks, -1)
        for number, nodes in enumerate(zip(host.obstacles, host.markers, strict=True)):
            self._obstacle[np.concatenate(nodes)] = number
        self._owner = self._integers(self._obstacle)
        self._origin = wp.array(origins[first:], dtype=wp.types.vector(3, real), device=device)
        self.kernels = [obstacle_kernel(real)]

    def follow(self, terms) -> None:
        """Take the present arrays of a `ContactPotential`; not in a capture."""
        shapes = terms.search.shapes
        of_object = np.full(len(shapes.names), -1)
        for number, nodes in shapes.spinning.items():
            of_object[number] = self._obstacle[nodes[0]]
        self._structs = [self._pairs(pair_set) for pair_set in (*terms.lists, *terms.frictions)]  # keeps arrays alive
        pairs = wp.array(self._structs, dtype=pairs_type(self._real), device=self._device)
        self._inputs = [pairs, self._owner, self._integers(of_object), len(of_object), self._length, self._origin]

    def _pairs(self, pair_set):
        struct, candidates = pairs_type(self._real)(), pair_set.found
        struct.count, struct.starts, struct.partners = pair_set.count, pair_set.starts, pair_set.partners
        struct.nodes, struct.used, struct.gradient = pair_set.factor.nodes, pair_set.factor.used, pair_set.gradient
        struct.primitives, struct.first = candidates.first.count, candidates.kind.first
        if hasattr(pair_set, "lagged"):
            struct.spinning, struct.arm = pair_set.lagged.spinning, pair_set.lagged.arm
        return struct

    def add(self, islands: list, q: wp.array) -> None:
        """Add the forces of an accepted substep; capturable."""
        inputs, outputs = [*self._inputs, q, self._blocks, *islands], [self.runs.force, self.runs.moment]
        self._launch(self.kernels[0], len(outputs[0]), inputs, outputs)


class _References:
    """Reference points of supports, by the subsystem of their first node."""

    def __init__(self, model, part, dofs: SupportDofs, supports: np.ndarray, origin: wp.array):
        self._part, self._model, self._origin, device = part, model, origin, model.wp_device
        node, column = _index(part, dofs.reference[np.searchsorted(dofs.first, supports)])
        self._nodes = wp.array(np.stack([node, column], -1).astype(np.int32), dtype=wp.vec2i, device=device)
        self._supports = wp.array(supports.astype(np.int32), dtype=int, device=device)
        self.kernels = [wrench_sums.shift_kernel(part.dim, model.types.real)]

    def shift(self, state, force: wp.array, moment: wp.array, point: wp.array) -> None:
        """Write the reference points in a state, and convert moments to them; capturable."""
        x = self._part.points(state.q) if self._part is self._model.coupled else state.x
        inputs = [self._supports, self._nodes, self._part.world_columns, self._origin, x, force]
        dim, device = (len(self._supports), self._model.worlds), self._model.wp_device
        if dim[0]:
            wp.launch(self.kernels[0], dim, inputs, [moment, point], device=device)
