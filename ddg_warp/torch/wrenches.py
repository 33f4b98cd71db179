"""Wrenches of steps as differentiable tensors.

A wrench is an explicit function of the states at both ends of a step of implicit Euler: the residual at fixed dofs, see
`kernels.residual.support_forces`. Torch differentiates the gathers and sums, and Warp the element forces. Gradients by the end state
continue through the step.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import warp as wp

from ddg_warp.adjoint.contact import ContactAdjoint
from ddg_warp.compile.support_dofs import NormalMoments, SupportDofs, matches
from ddg_warp.errors import SceneError
from ddg_warp.kernels.adjoint.element_forces import force_kernels
from ddg_warp.kernels.forces.drag import ROWS
from ddg_warp.scene.flow import is_on_host
from ddg_warp.solve.forces.control_loads import loaded_rows
from ddg_warp.solve.stepping.wrenches import coupled_elements_at, elements_at, support_count
from ddg_warp.torch.named_parameters import SHELL_COEFFICIENTS
from ddg_warp.torch.parameter_storage import ArrayParameterView, TermParameterView
from ddg_warp.torch.quadratic_forces import QuadraticForces, QuadraticPotential, torch_stream
from ddg_warp.torch.state_layout import view


@dataclass(frozen=True)
class WrenchTensors:
    """Wrenches of supports in B worlds, in the order of `Model.reactions`.

    Attributes:
        force: (B, supports, 3) [N]; moment: about `point` (B, supports, 3) [N m].
        point: first node of each support at the end of the step (B, supports, 3) [m].
    """

    force: torch.Tensor
    moment: torch.Tensor
    point: torch.Tensor

    @classmethod
    def zeros(cls, engine) -> "WrenchTensors":
        """Return zero wrenches of all worlds of an engine."""
        like = view(engine.before.arrays()[engine.fields[0].name])
        return cls(*(like.new_zeros((engine.model.worlds, support_count(engine.model.scene), 3)) for _ in range(3)))

    @classmethod
    def watched(cls, engine) -> "WrenchTensors":
        """Return the watched wrenches of an engine's last step, without gradient."""
        watched = engine.integrator.watched_wrenches
        return cls(*(view(values).clone() for values in (watched.force, watched.moment, watched.point)))

    def where(self, mask: torch.Tensor, elsewhere: "WrenchTensors") -> "WrenchTensors":
        """Select by a mask of worlds (B,) between two wrenches."""
        mask = mask[:, None, None]
        return WrenchTensors(
            *(torch.where(mask, a, b) for a, b in zip(vars(self).values(), vars(elsewhere).values(), strict=True))
        )


class ElementForces(torch.autograd.Function):
    """Function `forces(term, q, s, w, p)` -> derivatives of element energies by local dofs (n, dofs)."""

    @staticmethod
    def forward(ctx, term, *inputs):
        ctx.term = term
        ctx.save_for_backward(*inputs)
        result = torch.empty_like(inputs[0])
        _launch(term, 0, inputs, [result])
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, cotangent):
        inputs = ctx.saved_tensors
        results = [torch.empty_like(value) for value in inputs]
        _launch(ctx.term, 1, [*inputs, cotangent.contiguous()], results)
        return None, *results


def _launch(term, index: int, inputs, outputs) -> None:
    """Launch a kernel of `force_kernels` on tensors (n, ...)."""
    real = wp.dtype_from_torch(inputs[0].dtype)
    kernel = force_kernels(term, real)[index]

    def array(values):
        dtype = wp.types.vector(values.shape[1], real) if values.ndim == 2 else real
        return wp.from_torch(values.detach(), dtype=dtype, requires_grad=False)

    count = len(inputs[0])
    if count:
        with torch_stream(inputs[0]):
            device = wp.device_from_torch(inputs[0].device)
            wp.launch(kernel, count, [*map(array, inputs)], [*map(array, outputs)], device=device)


class ContactForces(torch.autograd.Function):
    """Function `forces(adjoint, dt, rates, q0, q)` -> forces of contact and friction on dof blocks, in a step from q0 to q.

    `adjoint`: `ContactAdjoint`. `rates`: of the inertial stiffness at q and at q0 (worlds,), empty for none. Blocks are
    (worlds blocks, 3).
    """

    @staticmethod
    def forward(ctx, adjoint, dt, rates, *blocks):
        ctx.inputs = adjoint, dt, rates
        ctx.save_for_backward(*blocks)
        with torch_stream(blocks[0]):
            _evaluate_contact(*ctx.inputs, *blocks)
            return view(adjoint.system.terms.forces).clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, cotangent):
        with torch_stream(cotangent):
            (x0, x), rate = _evaluate_contact(*ctx.inputs, *ctx.saved_tensors)
            by_start, by_end = wp.zeros_like(x0), wp.zeros_like(x)
            ctx.inputs[0].vjp((x0, x0, x), _blocks(cotangent), rate, (by_start, by_start, by_end))
            return None, None, None, view(by_start), view(by_end)


def _blocks(values: torch.Tensor) -> wp.array:
    """Return vectors of dof blocks (n, 3) as a Warp array."""
    real = wp.dtype_from_torch(values.dtype)
    return wp.from_torch(values.detach().contiguous(), dtype=wp.types.vector(3, real), requires_grad=False)


def _evaluate_contact(adjoint, dt: float, rates: tuple, q0: torch.Tensor, q: torch.Tensor) -> tuple:
    """Evaluate contact at the end of a step from q0 to q; return both, and the inverse step (worlds,)."""
    x0, x = _blocks(q0), _blocks(q)
    rate = wp.full(adjoint.coupled.worlds, 1.0 / dt, dtype=adjoint.coupled.real, device=x.device)
    rates = tuple(wp.from_torch(values.contiguous()) if len(values) else None for values in rates)
    adjoint.system.find(x0, x0, x, rate, rates)
    while adjoint.has_overflow(x):
        adjoint.system.find(x0, x0, x, rate, rates)
    return (x0, x), rate


def without_gradient(engine) -> str:
    """Return the feature that leaves wrenches without gradient; empty for none."""
    model, parts = engine.model, _parts(engine.model)
    contact = model.coupled and model.coupled.host.contact_parameters
    fixed = [SupportDofs.of(part.host).place for part in parts]
    bodies = model.coupled and model.coupled.host.rigid_bodies
    refused = {
        "the midpoint rule": engine.midpoint,
        "several friction iterations": bool(contact) and contact.has_friction and contact.law.friction_iterations > 1,
        "gyroscopic couples": engine.integrator.gyroscopic,
        "shell normals that a grip turns": model.coupled is not None
        and any(model.motions[i] in model.grips for part in model.coupled.sets for i in part.turning[:, 2]),
        "user-defined forces on supports": model.coupled is not None
        and any(np.isin(force.blocks, fixed[-1]).any() for force in model.coupled.user_forces),
        "supports at an edge that a rigid body clamps": bool(bodies)
        and any(
            (np.isin(part.slots, fixed[-1]).any(0) & np.isin(part.slots, bodies.spins).any(0)).any()
            for part in model.coupled.host.sets
        ),
        "follower loads on supports": any(
            np.isin(load.places, places).any()
            for part, places in zip(parts, fixed, strict=True)
            for load in part.host.followers
        ),
        "a flow that is a function of position": is_on_host(model.scene.flow),
    }
    return next((name for name, used in refused.items() if used), "")


def _parts(model) -> list:
    return [*model.groups, *([model.coupled] if model.coupled is not None else [])]


class Wrenches:
    """Wrenches of the steps of an engine.

    Raises:
        SceneError: the model has a feature whose wrenches have no gradient; names it.
    """

    def __init__(self, engine):
        self.engine, self.model = engine, engine.model
        if name := without_gradient(engine):
            raise SceneError(
                f"wrenches: no gradient goes through wrenches with {name}; take Integrator.wrenches or Environment(wrenches=True), "
                "whose values have none"
            )
        self._count, parts = support_count(self.model.scene), _parts(self.model)
        self._parts = [
            (_Coupled if part is self.model.coupled else _Rods)(engine, i, part, SupportDofs.of(part.host))
            for i, part in enumerate(parts)
        ]

    def __call__(self, before, after, parameters: list, controls: dict, dt: float) -> WrenchTensors:
        """Return the wrenches of a step of dt [s] between two `WorldState`."""
        parameter_tensors, summed = {}, {}
        for name, tensors in parameters:
            for place, values in zip(self.engine.tables.of(name)[1], tensors, strict=True):
                if isinstance(place, TermParameterView):
                    parameter_tensors[place.index, place.is_rod_group, place.name] = values
                elif isinstance(place, ArrayParameterView) and name not in SHELL_COEFFICIENTS:
                    summed.setdefault((place.index, place.is_rod_group, place.key[1]), []).append((place, values))
                else:
                    raise SceneError(f"wrenches: no gradient goes through wrenches by {name}; leave it out")
        parameter_tensors |= {key: entries[0][0].total(entries) for key, entries in summed.items()}
        worlds, like = self.model.worlds, before.values[0]
        force, moment, point = (like.new_zeros((worlds, self._count, 3)) for _ in range(3))
        states = [
            {field.name: value for field, value in zip(self.engine.fields, state.values, strict=True)}
            for state in (before, after)
        ]
        for part in reversed(self._parts):  # the first subsystem of a support gives its point
            nodes, x = part.references(states[1])
            point = point.index_copy(1, nodes, x)
        for part in self._parts:
            for support, f, arm, m in part(states, parameter_tensors, controls, dt, before.time + dt):
                if len(support):
                    force = force.index_add(1, support, f)
                    moment = moment.index_add(1, support, m + torch.linalg.cross(arm - point[:, support], f))
        return WrenchTensors(force, moment, point)


class _Part:
    """Reactions at the fixed dofs of a rod group or of the coupled system, in the worlds of an engine."""

    def __init__(self, engine, number: int, part, dofs: SupportDofs):
        self.engine, self.model, self.number, self.part, self.dofs = engine, engine.model, number, part, dofs
        self._device, self._real = engine.device, wp.dtype_to_torch(engine.model.types.real)
        self._worlds = torch.arange(engine.model.worlds, device=self._device)[:, None]
        self._support = self._long(dofs.support)
        self._share, self._first = self._numbers(dofs.share), self._long(dofs.first)
        self._nodes, self._angles = np.flatnonzero(~dofs.is_angle), np.flatnonzero(dofs.is_angle)
        has_drag = bool(part.host.coefficients) or (part is engine.model.coupled and part.host.quadratic)
        self._potential = QuadraticPotential(engine.model, part) if has_drag else None

    def _long(self, values) -> torch.Tensor:
        return torch.as_tensor(np.array(values, np.int64), device=self._device)

    def _numbers(self, values) -> torch.Tensor:
        return torch.as_tensor(np.array(values, float), dtype=self._real, device=self._device)

    def _index(self, places) -> torch.Tensor:
        """Return indices (worlds, ...) in flat arrays of nodes, or of angles, of all worlds."""
        raise NotImplementedError

    def _flat(self, state: dict, name: str) -> torch.Tensor:
        """Return vectors in space of all nodes or angles of all worlds."""
        raise NotImplementedError

    def _mass(self, is_node: bool, parameter_tensors: dict) -> torch.Tensor:
        """Return masses of all nodes, or rotary inertia of all angles, (n, 1) or (n, 3)."""
        raise NotImplementedError

    def references(self, state: dict) -> tuple[torch.Tensor, torch.Tensor]:
        """Return supports, and their first nodes (worlds, supports, 3)."""
        return self._first, self._flat(state, "x")[self._index(self.dofs.reference)]

    def _loads(self, time: float, controls: dict) -> torch.Tensor:
        """Return loads on the fixed dof blocks (worlds, n, 3), without gravity."""
        host, total = self.part.host, np.zeros((self.part.host.size, 3))
        for load in (host.constant, *host.timed):
            np.add.at(total, load.places, load.at(time, 1.0) * load.force)
        result = self._numbers(total[self.dofs.place])[None].expand(len(self._worlds), -1, -1)
        for name, values in controls.items():
            if name not in ("forces", "moments"):
                continue
            values = values if name == "forces" else torch.stack([values, 0.0 * values, 0.0 * values], -1)
            entry, row = self._loaded[name]
            result = result.index_add(1, entry, values.index_select(1, row))
        return result

    @cached_property
    def _loaded(self) -> dict[str, tuple]:
        """Entries, and the user's row of points or edges of each, by name of a control load."""
        places, rows = loaded_rows(self.model, self.part)
        result = {}
        for name, some in (("forces", self._nodes), ("moments", self._angles)):
            i, j = matches(self.dofs.place[some], places)
            result[name] = self._long(some[i]), self._long(rows[j])
        return result

    def _gravity(self, controls: dict) -> torch.Tensor:
        """Return the gravity of every world (worlds, 1, 3)."""
        usual = self._numbers(self.model.scene.gravity)[None]
        return controls.get("gravity", usual).expand(len(self._worlds), 3)[:, None]

    def _element_forces(self, states, parameter_tensors, controls: dict, dt: float) -> torch.Tensor:
        """Return forces of the listed elements by local node (rows, worlds columns, 3)."""
        raise NotImplementedError

    def __call__(self, states, parameter_tensors, controls, dt: float, time: float):
        """Yield supports, forces, points of attack and further moments (worlds, n, 3)."""
        before, after = states
        elements = self._element_forces(states, parameter_tensors, controls, dt)
        targets, column, local = self._items
        count, worlds = len(self.dofs), len(self._worlds)
        contributions = elements[local[None], column[None] + self._worlds * self._columns]
        reaction = elements.new_zeros((worlds, count, 3)).index_add(1, targets, contributions)
        reaction = reaction - self._loads(time, controls)
        if self._potential:
            for some, values in self._quadratic_forces(states, parameter_tensors, (time, dt)):
                reaction = reaction.index_add(1, some, values)
        contact = self._contact(states, dt)
        if contact is not None:
            reaction = reaction - contact[self._index(self.dofs.place)]
        damping = self.model.scene.mass_damping
        rate = 1.0 / dt
        for some, x, v, is_node in ((self._nodes, "x", "v", True), (self._angles, "theta", "omega", False)):
            if not len(some):
                continue
            places = self._index(self.dofs.place[some])
            change = self._flat(after, x)[places] - self._flat(before, x)[places]
            inertia = change * (rate * (rate + damping)) - self._flat(before, v)[places] * rate
            inertia = inertia - self._gravity(controls) if is_node else inertia
            reaction = reaction.index_add(1, self._long(some), self._mass(is_node, parameter_tensors)[places] * inertia)
        nodes, angles = self._long(self._nodes), self._long(self._angles)
        force = torch.einsum("nij,wnj->wni", self._share[nodes], reaction[:, nodes])
        position = self._flat(after, "x")
        yield self._support[nodes], force, position[self._index(self.dofs.place[self._nodes])], 0.0 * force
        if len(angles):
            first, last = (position[self._index(self.dofs.ends[self._angles, end])] for end in (0, 1))
            t = torch.nn.functional.normalize(last - first, dim=-1)
            lagged = self._lagged_tangents(before)[self._index(self.dofs.place[self._angles])]
            size = reaction[:, angles, :1] * self._share[angles, :1, 0] / (1.0 + (t * lagged).sum(-1, keepdim=True))
            yield self._support[angles], 0.0 * first, first, (t + lagged) * size
        yield from self._normal_moments(after, elements)

    def _normal_moments(self, after: dict, elements: torch.Tensor):
        """Yield the moments on prescribed shell normals."""
        yield from ()

    def _contact(self, states, dt: float) -> torch.Tensor | None:
        """Return contact forces on all dof blocks; None without contact."""
        return None

    def _quadratic_forces(self, states, parameter_tensors, step: tuple[float, float]):
        """Yield entries, and forces against the quadratic potential there (worlds, n, 3)."""
        raise NotImplementedError

    def _coefficients(self, key: tuple, parameter_tensors) -> torch.Tensor:
        """Return the coefficients of the force with a quadratic potential, in storage layout (rows, ...)."""
        force = self._potential.force
        array = self.part.host.coefficients.get(force.name, np.zeros((ROWS, 0)))
        values = list(self._numbers(np.tile(array, len(self._worlds))))
        for name, row in force.parameters.items():
            replacement = parameter_tensors.get((*key, f"{force.name}.{name}"))
            if replacement is not None:
                values[row] = replacement.reshape(values[row].shape)
        return torch.stack(values)

    def _parameters(self, term, key: tuple, parameter_tensors, stored, pick) -> list[torch.Tensor]:
        """Return rest measure and parameters (n,) of elements; `pick` selects them from an array as in `parameter_tensors`."""
        index, is_rod_group, prefix = key
        result = []
        for name in term.parameter_names:
            name = prefix + name
            values = parameter_tensors.get((index, is_rod_group, name))
            result.append(pick(self._numbers(stored(name)) if values is None else values))
        return result


def _local_forces(measure, f: torch.Tensor, dim: int) -> torch.Tensor:
    """Return forces by local node (rows, n, 3) of forces by local dofs (n, dofs)."""
    rows = f.new_zeros((measure.nodes + measure.angles + measure.spins, len(f), 3))
    parts = list(rows)
    axes = [0, 2] if dim == 2 else [0, 1, 2]

    def lifted(values):
        out = values.new_zeros((len(values), 3))
        out[:, axes] = values
        return out

    for i, (a, b) in enumerate(measure.edges):
        force = lifted(f[:, dim * i : dim * i + dim])
        parts[b], parts[a] = parts[b] + force, parts[a] - force
    row = dim * len(measure.edges)
    for i in range(measure.angles):
        parts[measure.nodes + i] = torch.stack([f[:, row + i], 0.0 * f[:, 0], 0.0 * f[:, 0]], -1)
    row += measure.angles
    for i in range(measure.spins):
        parts[measure.nodes + measure.angles + i] = f[:, row + 3 * i : row + 3 * i + 3]
    row += 3 * measure.spins
    for i in range(measure.points):
        parts[i] = parts[i] + f[:, row + 3 * i : row + 3 * i + 3]
    return torch.stack(parts)


class _Rods(_Part):
    """Reactions at the fixed dofs of a rod group."""

    def __init__(self, engine, number: int, group, dofs: SupportDofs):
        super().__init__(engine, number, group, dofs)
        k, column = np.divmod(group.host.index(dofs.place), group.rods)
        target, element, column, local = elements_at(group.host, dofs, k, column)
        listed, where = np.unique(np.stack([column, element], -1), axis=0, return_inverse=True)
        self._columns = len(listed)
        self._items = self._long(target), self._long(where.reshape(-1)), self._long(local)
        column, first = listed.T
        count, closed = group.host.count[column], group.kind.closed
        along = [first + offset for offset in range(group.kind.span + 1)]
        along = [np.where(k >= count, k - count if closed else 0, k) for k in along]
        self._whole = closed | (first < count - 2)
        self._along = [self._index(k * group.rods + column) for k in along]

    def _index(self, places) -> torch.Tensor:
        k, column = np.divmod(self.part.host.index(np.asarray(places)), self.part.rods)
        return (self._long(k) * self.part.columns + self._long(column))[None] + self._worlds * self.part.rods

    def _flat(self, state: dict, name: str) -> torch.Tensor:
        return self._spatial(state[f"{self.number}/{name}"], name in ("theta", "omega"))

    def _spatial(self, values: torch.Tensor, is_angle: bool) -> torch.Tensor:
        """Return vectors in space of nodes (n, R, dim), or of angles (n, R)."""
        if is_angle:
            values = values.reshape(-1)
            return torch.stack([values, 0.0 * values, 0.0 * values], -1)
        values = values.reshape(-1, self.part.dim)
        if self.part.dim == 2:
            values = torch.stack([values[:, 0], 0.0 * values[:, 0], values[:, 1]], -1)
        return values

    def _mass(self, is_node: bool, parameter_tensors: dict) -> torch.Tensor:
        values = parameter_tensors.get((self.number, True, "mass" if is_node else "inertia"))
        values = view(self.part.mass if is_node else self.part.rotary) if values is None else values
        return values.reshape(-1, 1)

    def _lagged_tangents(self, before: dict) -> torch.Tensor:
        return before[f"{self.number}/frame"][3:6].reshape(3, -1).T

    def _quadratic_forces(self, states, parameter_tensors, step: tuple[float, float]):
        kind = self.part.kind
        (x0, v0, theta0), (x, _, theta) = (
            [
                state[f"{self.number}/{name}"] if kind.twist or name != "theta" else self._numbers([[0.0]])
                for name in ("x", "v", "theta")
            ]
            for state in states
        )
        p = self._coefficients((self.number, True), parameter_tensors)
        force, moment = QuadraticForces.apply(self._potential, step, x0, v0, theta0, x, theta, p)
        force = self._spatial(force, False)
        yield self._long(self._nodes), force[self._index(self.dofs.place[self._nodes])]
        if kind.twist:
            yield self._long(self._angles), self._spatial(moment, True)[self._index(self.dofs.place[self._angles])]

    def _element_forces(self, states, parameter_tensors, controls: dict, dt: float) -> torch.Tensor:
        (before, after), group, kind = states, self.part, self.part.kind
        x = after[f"{self.number}/x"].reshape(-1, kind.dim)
        places, worlds = self._along, len(self._worlds)
        total = x.new_zeros((kind.span + 1 + (2 if kind.twist else 0), worlds * self._columns, 3))
        for term, place in zip(kind.terms, kind.places(), strict=True):
            measure = term.measure
            chosen = np.flatnonzero(self._whole | (measure.span != 2))
            nodes = [index[:, self._long(chosen)].reshape(-1) for index in places]
            q = [x[nodes[i + 1]] - x[nodes[i]] for i in range(measure.span)]
            if measure.angles:
                theta = after[f"{self.number}/theta"].reshape(-1)
                q += [theta[nodes[0]][:, None], theta[nodes[1]][:, None]]
            q = torch.cat(q, 1)
            s = q.new_zeros((len(q), 1))
            if measure.lag_size:
                frame = before[f"{self.number}/frame"].reshape(7, -1)
                s = torch.cat([frame[:6, nodes[0]], frame[:6, nodes[1]], frame[6:, nodes[0]]]).T
            w, *p = self._parameters(
                term,
                (self.number, True, f"{term.name}."),
                parameter_tensors,
                lambda name: np.broadcast_to(group.parameters[name], (group.nodes, group.columns)),
                lambda values, first=nodes[0]: values.expand(group.nodes, group.columns).reshape(-1)[first],
            )
            if term.density.lagged:
                rows = slice(place[3], place[3] + len(measure.strains))
                p += [*before[f"{self.number}/last"][rows].reshape(len(measure.strains), -1)[:, nodes[0]]]
                p.append(torch.full_like(w, 1.0 / dt))
            f = ElementForces.apply(term, q.contiguous(), s.contiguous(), w.contiguous(), torch.stack(p, 1))
            local = _local_forces(_RodMeasure(measure, kind), f, kind.dim)
            columns = (self._worlds * self._columns + self._long(chosen)[None]).reshape(-1)
            rows = [*range(measure.span + 1), *(kind.span + 1 + i for i in range(measure.angles))]
            total = total.index_put((self._long(rows)[:, None], columns[None]), local, accumulate=True)
        return total


@dataclass(frozen=True)
class _RodMeasure:
    """Local nodes of a measure on a rod, of any dimension."""

    measure: object
    kind: object
    spins = points = 0

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return self.measure.span + 1

    @property
    def angles(self) -> int:
        """Number of twist angles."""
        return self.measure.angles

    @property
    def edges(self) -> list[tuple[int, int]]:
        """Nodes of the edges."""
        return [(i, i + 1) for i in range(self.measure.span)]


class _Coupled(_Part):
    """Reactions at the fixed dofs of the coupled system."""

    def __init__(self, engine, number: int, coupled, dofs: SupportDofs):
        super().__init__(engine, number, coupled, dofs)
        host, scene = coupled.host, engine.model.scene
        self._adjoint = ContactAdjoint(coupled, on_obstacles=True) if host.contact_parameters else None
        normals = NormalMoments.of(host, len(scene.supports), len(scene.shell_supports))
        self._listed, *items, columns = coupled_elements_at(host, dofs, normals)
        self._items, self._columns = tuple(map(self._long, items)), sum(map(len, self._listed))
        self._normals = []  # supports, columns, nodes of elements, corner and edges of entries of one set
        for index, element_set in enumerate(host.sets):
            some = np.flatnonzero(normals.element[:, 0] == index)
            for chosen in (some[normals.corner[some] < 0], some[normals.corner[some] >= 0]):
                if len(chosen):
                    element, corner = normals.element[chosen, 1], normals.corner[chosen]
                    nodes = element_set.slots[: element_set.term.measure.nodes, element]
                    edges = (element[:, None] == element) @ np.eye(3)[corner] if corner[0] >= 0 else None
                    self._normals.append((normals.support[chosen], self._long(columns[chosen]), nodes, corner, edges))

    def _index(self, places) -> torch.Tensor:
        return self._long(places)[None] + self._worlds * self.part.blocks

    def _flat(self, state: dict, name: str) -> torch.Tensor:
        return state["net/q" if name in ("x", "theta") else "net/v"]

    def _mass(self, is_node: bool, parameter_tensors: dict) -> torch.Tensor:
        values = parameter_tensors.get((-1, False, "mass" if is_node else "inertia"))
        if values is None:
            return view(self.part.mass).reshape(-1, 3)
        before = 0 if is_node else self.part.angle_start
        after = self.part.blocks - before - values.shape[1]
        return torch.nn.functional.pad(values, (before, after)).reshape(-1, 1).expand(-1, 3)

    def _lagged_tangents(self, before: dict) -> torch.Tensor:
        """Return tangents by dof block, zero but for angles of rods."""
        coupled, worlds = self.part, len(self._worlds)
        tangents = before["net/frame"][3:6].T.reshape(worlds, coupled.edges, 3)
        start, rest = coupled.angle_start, coupled.blocks - coupled.angle_start - coupled.edges
        return torch.nn.functional.pad(tangents, (0, 0, start, rest)).reshape(-1, 3)

    def _quadratic_forces(self, states, parameter_tensors, step: tuple[float, float]):
        before, after = states
        p, angles = self._coefficients((-1, False), parameter_tensors), self._numbers([[0.0]])
        values = before["net/q"], before["net/v"], angles, after["net/q"], angles, p
        force, _ = QuadraticForces.apply(self._potential, step, *values)
        yield self._long(np.arange(len(self.dofs))), force[self._index(self.dofs.place)]

    def _contact(self, states, dt: float) -> torch.Tensor | None:
        """Return contact forces on all dof blocks; None without contact."""
        if self._adjoint is None:
            return None
        before, after = states
        rates = [state.get("net/rate", state["net/q"].new_zeros(0)) for state in (after, before)]
        return ContactForces.apply(self._adjoint, dt, rates, before["net/q"], after["net/q"])

    def _element_forces(self, states, parameter_tensors, controls: dict, dt: float) -> torch.Tensor:
        (before, after), coupled, worlds = states, self.part, len(self._worlds)
        q, host = after["net/q"], self.part.host
        if host.spins:
            blocks = q.reshape(worlds, -1, 3)
            spins = after["net/v"].reshape(worlds, -1, 3)[:, -host.spins :] * dt
            q = torch.cat([blocks[:, : -host.spins], spins], 1).reshape(-1, 3)
        rows = max(len(element_set.slots) for element_set in host.sets)
        parts = []
        for index, listed in enumerate(self._listed):
            if not len(listed):
                continue
            part = coupled.sets[index]
            term, measure, count = part.term, part.term.measure, part.elements
            slots = host.sets[index].slots[:, listed]
            place = [self._index(slot).reshape(-1) for slot in slots]
            element = (self._long(listed)[None] + self._worlds * count).reshape(-1)
            local = [q[place[b]] - q[place[a]] for a, b in measure.edges]
            local += [q[place[measure.nodes + i], :1] for i in range(measure.angles)]
            local += [q[place[measure.nodes + measure.angles + i]] for i in range(measure.spins)]
            local += [q[place[i]] for i in range(measure.points)]
            local = torch.cat(local, 1)
            s = []
            for i in range(measure.frames):
                edges = self._long(slots[measure.nodes + i] - coupled.angle_start)[None] + self._worlds * coupled.edges
                s.append(before["net/frame"][:, edges.reshape(-1)])
            if measure.lag_size > 6 * measure.frames:
                s.append(before[f"net/lag_{index}"][:, element])
            if measure.data_size:
                data = after.get(f"net/data_{index}")
                data = view(part.data)[:, self._long(np.tile(listed, worlds))] if data is None else data[:, element]
                if measure.field and "field" in controls:  # whose values the data of the state have
                    more = (controls["field"] - controls["field"].detach()).T.repeat_interleave(len(listed), 1)
                    above, below = measure.data_size - measure.field, measure.field - len(more)
                    data = data + torch.nn.functional.pad(more, (0, 0, above, below))
                s.append(data)
            s = torch.cat(s).T if s else local.new_zeros((len(local), 1))
            w, *p = self._parameters(
                term,
                (index, False, ""),
                parameter_tensors,
                lambda name, part=part: np.broadcast_to(part.parameters[name], (worlds, part.elements)),
                lambda values, element=element, part=part: values.expand(worlds, part.elements).reshape(-1)[element],
            )
            if term.density.lagged:
                p += [*before[f"net/last_{index}"][:, element], torch.full_like(w, 1.0 / dt)]
            f = ElementForces.apply(term, local.contiguous(), s.contiguous(), w.contiguous(), torch.stack(p, 1))
            forces = _local_forces(measure, f, 3).reshape(-1, worlds, len(listed), 3)
            parts.append(torch.nn.functional.pad(forces, (0, 0, 0, 0, 0, 0, 0, rows - len(forces))))
        return torch.cat(parts, 2).reshape(rows, -1, 3)

    def _normal_moments(self, after: dict, elements: torch.Tensor):
        """Yield the moments on prescribed shell normals; see `NormalMoments`."""
        x = self._flat(after, "x")
        for support, columns, nodes, corner, edges in self._normals:
            corners = torch.stack([x[self._index(node)] for node in nodes])
            forces = elements[: len(nodes), columns[None] + self._worlds * self._columns]
            moment = -torch.linalg.cross(corners - corners[:1], forces).sum(0)
            if edges is not None:
                sides = corners[[1, 2, 0]] - corners[:3]
                normal = torch.linalg.cross(sides[0], -sides[2])
                gram = normal[..., :, None] * normal[..., None, :] / normal.norm(dim=-1)[..., None, None]
                gram = gram + torch.einsum("ne,ewni,ewnj->wnij", self._numbers(edges), sides, sides)
                edge = sides[self._long(corner), :, torch.arange(len(corner), device=x.device)].transpose(0, 1)
                moment = edge * (edge * torch.linalg.solve(gram, moment)).sum(-1, keepdim=True)
            yield self._long(support), 0.0 * moment, corners[0], moment
