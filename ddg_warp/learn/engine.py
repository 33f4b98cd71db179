"""Steps of many worlds and their reverse, between tensors: what `ddg_warp.torch` stands on.

Memory of integrator and adjoint stays where it is, so that each is one captured graph: tensors are copied in and out.
"""

from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.learn.adjoint import Adjoint, EquilibriumAdjoint
from ddg_warp.learn.chains import Kept
from ddg_warp.learn.net import NetKept
from ddg_warp.learn.poses import Poses
from ddg_warp.solve import statics
from ddg_warp.solve.controls import LOADS
from ddg_warp.solve.dynamics import Integrator
from ddg_warp.solve.graphs import Graphs

FOREVER = 2**62  # steps between readings of outcomes, which worlds flag
GRADIENTS = (
    "x",
    "v",
    "theta",
    "omega",
    "frame",
    "last",
    "q",
    "lag",
)  # arrays of a state that have some, by how their names begin


@dataclass(frozen=True)
class Field:
    """An array of a state as a tensor: its name, the axis along which worlds lie, and whether it has gradients."""

    name: str
    axis: int
    smooth: bool


def fields(model) -> list[Field]:
    """Arrays of a model's states that hold something, in their order."""
    result, nothing = [], {"net/frame"} if model.net is not None and not model.net.edges else set()
    for part, values in model.empty_state().parts().items():
        for name, array in values.arrays().items():
            if array.size > 1 and f"{part}/{name}" not in nothing:
                axis = array.ndim - 1
                result.append(Field(f"{part}/{name}", axis, name.rstrip("_0123456789") in GRADIENTS))
    return result


def tensors(state, names: list[Field]) -> list[torch.Tensor]:
    """Tensors that look at the arrays of a state."""
    found = {f"{part}/{name}": array for part, data in state.parts().items() for name, array in data.arrays().items()}
    return [wp.to_torch(found[field.name], requires_grad=False) for field in names]


def copies(values: list[torch.Tensor]) -> list[torch.Tensor]:
    """Of tensors, as they lie."""
    found = [torch.empty_like(value) for value in values]
    torch._foreach_copy_(found, values)
    return found


class Engine:
    """Steps and gradients of a model with its worlds.

    Args:
        model, scheme, options: as of `Integrator`.

    Attributes:
        fields: what the tensors of a state are.
        whole: of every part, the part of the last step that its islands' last solve was about (islands,).
    """

    def __init__(self, model, scheme: str, options: dict):
        self.model, self.device = model, str(wp.device_to_torch(model.wp_device))
        self._midpoint = scheme == "implicit_midpoint"
        self.integrator = Integrator(model, scheme, failures="flag", check_every=FOREVER, energy_bound=None, **options)
        self.adjoint = self._equilibria = None
        self.fields = fields(model)
        self.before, self.after = (buffer.own for buffer in self.integrator._buffers)
        self.source, self.target = (tensors(state, self.fields) for state in (self.before, self.after))
        self._tables, self._places_found, self._views = {}, {}, {}
        self._written, self._held, self._tables_seen, self._streams = {}, {}, {}, {}
        self._graphs = None

    # parameters

    def tables(self, name: str) -> list:
        """Parts whose table has a parameter "term.parameter": (table, its full shape, rows of its elements among all).

        Elements are counted rod by rod, those of clamped ends included, then through the element sets of the net.

        Raises:
            SceneError: nothing has it.
        """
        if name not in self._tables:
            found, model, own = [], self.model, name.rpartition(".")
            counts = np.zeros(model.scene.rod_count, np.int64)  # elements of every rod on its own
            groups = [(group, self._inside(group, name)) for group in model.groups if name in group.parameters.values]
            for group, inside in groups:
                counts[group.host.rods] = inside.sum(0)
            first = np.cumsum(counts) - counts
            for group, inside in groups:
                rows = first[group.host.rods] + np.arange(group.nodes)[:, None]
                found.append((group.parameters, np.where(inside, rows, 0), True))
            start = int(counts.sum())
            for part in model.net.sets if model.net is not None else ():
                if part.term.name == own[0] and own[2] in part.parameters.values:
                    found.append((part.parameters, start + np.arange(part.elements), False))
                    start += part.elements
            if not found:
                known = sorted({*self.names()})
                raise SceneError(f"parameters: nothing has {name!r}; this model has {', '.join(known)}")
            device = str(wp.device_to_torch(model.wp_device))
            self._tables[name] = (
                start,
                [(table, torch.as_tensor(rows, device=device), chain) for table, rows, chain in found],
            )
        return self._tables[name]

    @staticmethod
    def _inside(group, name: str) -> np.ndarray:
        """Where rods of a group have elements of the term that a parameter belongs to (n, R)."""
        term = next(term for term in group.kind.terms if name.startswith(f"{term.name}."))
        missing = 0 if group.kind.closed else term.measure.span
        return np.arange(group.nodes)[:, None] < group.host.count - missing

    def names(self) -> list[str]:
        """Names of all parameters."""
        model = self.model
        result = [name for group in model.groups for name in group.parameters.values]
        for part in model.net.sets if model.net is not None else ():
            result += [f"{part.term.name}.{name}" for name in part.parameters.values]
        return result

    def full(self, name: str, values: torch.Tensor) -> list[torch.Tensor]:
        """A parameter of shape (), (B,), (E,) or (B, E) as each table has it with one number an element and world."""
        count, found = self.tables(name)
        worlds, real = self.model.worlds, wp.dtype_to_torch(self.model.types.real)
        shape = tuple(values.shape)
        if shape == ():
            wide = values.expand(worlds, count)
        elif shape in ((worlds, 1), (1, count), (worlds, count), (1, 1)):
            wide = values.expand(worlds, count)
        elif shape == (worlds,) and worlds != count and worlds > 1:
            wide = values[:, None].expand(worlds, count)
        elif shape == (count,) and (worlds != count or worlds == 1):
            wide = values.expand(worlds, count)
        else:
            raise SceneError(
                f"parameters: {name} has shape {shape}; give (), ({worlds}, 1) for each world, (1, {count}) for each element, or "
                f"({worlds}, {count})"
            )
        wide = wide.to(device=self.device, dtype=real)
        result = []
        for _, rows, chain in found:
            if values.shape[-1:] in ((), (1,)) or shape == (worlds,) != (count,):  # alike in all elements
                own = wide[:, :1].expand(worlds, rows.numel())
            else:  # whose reverse adds to each element once, so in one order
                own = wide.index_select(1, rows.reshape(-1))
            if chain:
                own = own.reshape(worlds, *rows.shape).permute(1, 0, 2).reshape(rows.shape[0], -1)
            result.append(own)
        return result

    def value(self, name: str) -> torch.Tensor:
        """The values that the model has of a parameter (worlds, elements)."""
        count, found = self.tables(name)
        worlds, own = self.model.worlds, name.rpartition(".")[2]
        result = torch.zeros((worlds, count), dtype=wp.dtype_to_torch(self.model.types.real), device=found[0][1].device)
        for table, rows, chain in found:
            values = np.broadcast_to(table[name if chain else own], self._shape(rows, chain))
            wide = torch.tensor(values, dtype=result.dtype, device=result.device)
            if chain:
                group = next(group for group in self.model.groups if group.parameters is table)
                inside = torch.as_tensor(self._inside(group, name))
                wide = wide.reshape(rows.shape[0], worlds, -1).permute(1, 0, 2)
                result[:, rows[inside]] = wide[:, inside]
            else:
                result[:, rows] = wide
        return result

    def _shape(self, rows: torch.Tensor, chain: bool) -> tuple[int, int]:
        worlds = self.model.worlds
        return (rows.shape[0], worlds * rows.shape[1]) if chain else (worlds, len(rows))

    def write(self, names: tuple, values: list[torch.Tensor]) -> None:
        """Put full parameters in place; what is there already stays, and others are as the model has them."""
        places = [
            (table, name if chain else name.rpartition(".")[2], self._shape(rows, chain))
            for name in names
            for table, rows, chain in self.tables(name)[1]
        ]
        for table, key, shape in places:  # first, as this makes their memory anew
            if table[key].shape != shape:
                table.set(**{key: np.broadcast_to(table[key], shape)})
                self.model.version += 1
                # with what it holds; other tables still hold what was written
                self._written = {place: kept for place, kept in self._written.items() if kept[0] is not table}
        now = {(id(table), key) for table, key, _ in places}
        for place in [place for place in self._written if place not in now]:  # back to what the model has
            table, (_, key) = self._written.pop(place)[0], place
            self._view(table, key, table[key].shape).copy_(torch.tensor(table[key]))
        for (table, key, shape), given in zip(places, values, strict=True):
            if self._written.get((id(table), key)) != (table, id(given), given._version):
                self._view(table, key, shape).copy_(given)
                self._written[id(table), key] = table, id(given), given._version
                self._held[id(table), key] = given  # so that nothing else gets its id

    def _view(self, table, key: str, shape: tuple) -> torch.Tensor:
        buffer, view = self._tables_seen.get((id(table), key), (None, None))
        if buffer is not table.buffer:
            buffer, view = table.buffer, self._look(table, key, shape)
            self._tables_seen[id(table), key] = buffer, view
        return view

    @staticmethod
    def _look(table, key: str, shape: tuple) -> torch.Tensor:
        row = list(table.values).index(key)
        offset = sum(values.size for values in list(table.values.values())[:row])
        return wp.to_torch(table.buffer, requires_grad=False)[offset : offset + shape[0] * shape[1]].view(shape)

    # steps

    def forward(self, start: float, dt: float, state, controls: dict, graded: bool) -> list[torch.Tensor]:
        """The state after a step, its tensors, and of every part what tells whether it has a gradient (islands,), if that is asked."""
        integrator = self.integrator
        self.fill(self.source, state)
        integrator._prepare(dt, self.before)
        self._give(controls)
        integrator.advance(0, start, dt, anew=True)
        return copies(self.target) + [self._smooth(part, graded) for part in integrator._parts]

    @staticmethod
    def fill(places: list[torch.Tensor], values) -> None:
        """Copy tensors to where they are read."""
        torch._foreach_copy_(places, list(values))

    def _smooth(self, part, graded: bool) -> torch.Tensor:
        """One for islands whose step was one solve in the frames that it began with, else not a number."""
        key = "smooth", id(part)
        if key not in self._views:  # of parts that there are; one made anew has another place
            net = part is self.integrator._net
            frames = ()
            if net and part.net.edges:
                frames = part._lagged[0], self.before.net.frame
            elif not net and part.group.kind.twist:
                frames = part.newton.frame, self.before.groups[part.index].frame
            views = [
                wp.to_torch(array, requires_grad=False)
                for array in (part.islands.status, part.islands.portion, *frames)
            ]
            self._views[key] = part, views, torch.ones_like(views[1])
        _, (status, portion, *frames), ones = self._views[key]
        if not graded:
            return ones.clone()
        smooth = (portion == 1.0) & (status <= outcome.CONVERGED_TO_ROUNDING)
        if frames:
            same = (frames[0] == frames[1]).all(0)
            smooth &= same.all(0) if same.ndim == 2 else same.reshape(len(portion), -1).all(1)
        return torch.where(smooth, 1.0, float("nan")).to(portion.dtype)

    def _give(self, controls: dict) -> None:
        """Hand the integrator loads and poses."""
        integrator, model = self.integrator, self.model
        if integrator.given is None and any(name in controls for name in LOADS):
            integrator._control({"gravity": np.array(model.scene.gravity, float)[None]}, 0)
        if integrator.given is not None:
            given = integrator.given
            given.any = any(name in controls for name in LOADS)
            for name in LOADS:
                place = wp.to_torch(getattr(given, name), requires_grad=False)
                if name in controls:
                    value = controls[name]
                    if name == "gravity":
                        value = value - torch.as_tensor(given._usual, dtype=value.dtype, device=value.device)
                    place.copy_(value)
                else:
                    place.zero_()
        if model.grips:
            place = wp.to_torch(self.after.grips.pose, requires_grad=False)
            if "poses" in controls:
                place.copy_(controls["poses"].reshape(-1, 6).T)
            else:
                place.copy_(wp.to_torch(self.before.grips.pose, requires_grad=False))

    # gradients

    def _adjoint(self) -> Adjoint:
        if self.adjoint is None:
            adjoint = Adjoint(self.integrator)
            self._given = self.model.empty_state()
            self._by_state = tensors(self._given, self.fields)
            self._graphs = Graphs(self.model, self._load)
            groups = zip(self.before.groups, self.after.groups, strict=True)
            # laid out as states are, so that a graph can copy it
            solved = [data.x for data in (self.model.empty_state() if self._midpoint else self.after).groups]
            self._parts = [
                Kept(before, x, after.theta, before.frame, None)
                for x, (before, after) in zip(solved, groups, strict=True)
            ]
            self.adjoint = adjoint
            self.poses = Poses(self) if self.model.grips and not self._midpoint else None
        return self.adjoint

    def _load(self) -> None:
        kernels = [kernel for own in self.adjoint.chains for kernel in own.kernels]
        arrays.load_kernels(kernels, self.model.wp_device)

    def backward(self, start: float, dt: float, before, after, given) -> tuple[list[torch.Tensor], list]:
        """Derivatives by the state before a step, and by what else it read, part by part.

        Args:
            start, dt: time and length of the step.
            before, after, given: tensors of the states at its ends, and of the derivatives by the latter.
        """
        adjoint = self._adjoint()
        self.fill(self.source, before)
        self.fill(self.target, after)
        self.fill(self._by_state, given)
        if adjoint.upload(start, dt):
            self._graphs.clear()
        s, parts = self.integrator._solved(dt), list(self._parts)
        for kept, end in zip(parts if self._midpoint else (), self.after.groups, strict=False):
            x, ends = wp.to_torch(kept.x, requires_grad=False), (end.x, kept.before.x)
            torch.mul(sum(wp.to_torch(array, requires_grad=False) for array in ends), 0.5, out=x)
        if adjoint.net:
            parts.append(self._net_kept(start, dt))

        def launch():
            self._found = adjoint.pull_parts(self.before, self.after, parts, self._given, s)

        if all(own.solve.system for own in adjoint.chains) and not adjoint.net:
            self._graphs.replay(dt, launch)
        else:
            launch()
        found, inputs = self._found
        self._solved_by = [
            None if own.solve.failed is None else wp.to_torch(own.solve.failed, requires_grad=False) == 0
            for own in adjoint.chains
        ]
        found.grips = self.model.empty_state().grips
        return copies(tensors(found, self.fields)), inputs

    def _net_kept(self, start: float, dt: float) -> NetKept:
        """Of the net: joints' rotations are those at the rates of the step, as their dofs begin it at zero."""
        net, before, after = self.model.net, self.before.net, self.after.net
        solved, data = wp.clone(after.q), after.data
        q = wp.to_torch(solved, requires_grad=False)
        if self._midpoint:
            q.add_(wp.to_torch(before.q, requires_grad=False)).mul_(0.5)
            data = self._data_between(start, dt, solved)
        spins = net.host.spins
        if spins:
            rates = wp.to_torch(after.v, requires_grad=False).reshape(net.worlds, -1, 3)[:, -spins:]
            q.view(net.worlds, -1, 3)[:, -spins:] = rates * dt
        return NetKept(before, replace(before, q=solved, data=data), None)

    def _data_between(self, start: float, dt: float, q: wp.array) -> dict:
        """Normals that supports turn, and the magnetic field, in the middle of a step, as its solve had them."""
        step = self.integrator._net
        step.prescribe(start, start + dt)
        if step.motion:
            step.motion.follow(self.before, self.after)
            step.motion.direct(self.adjoint.net.supports.islands, q, self.before.net.frame)
        return step._data

    # equilibria

    def balance(self, state, options: dict) -> list[torch.Tensor]:
        """The equilibrium from the tensors of a state, and one of each part, as of `forward`."""
        start = self.model.empty_state()
        self.fill(tensors(start, self.fields), state)
        found = statics.solve(self.model, start, **options)
        ones = [
            torch.ones(len(part.islands), dtype=state[0].dtype, device=state[0].device)
            for part in self.integrator._parts
        ]
        return copies(tensors(found, self.fields)) + ones

    def balance_backward(self, end: float, state, given) -> list:
        """Derivatives by what an equilibrium at the load parameter `end` reads, part by part."""
        if self._equilibria is None:
            self._equilibria = EquilibriumAdjoint(self.model)
        at, by = self.model.empty_state(), self.model.empty_state()
        self.fill(tensors(at, self.fields), state)
        self.fill(tensors(by, self.fields), given)
        at.time = end
        return self._equilibria.pull(at, by)

    # what `ddg_warp.learn.step` asks

    def stream(self):
        """Launches on torch's stream; on the CPU there is one order for all."""
        if not self.model.wp_device.is_cuda:
            return nullcontext()
        own = torch.cuda.current_stream(self.device)
        if own not in self._streams:
            self._streams[own] = wp.stream_from_torch(own)
        return wp.ScopedStream(self._streams[own])

    def solved(self, flags) -> list[torch.Tensor]:
        """Flags of a step, not numbers where its reverse has failed, too: of rods that are at no minimum."""
        ones = zip(flags, [*self._solved_by, None], strict=False)
        return [flag if ok is None else torch.where(ok, flag, float("nan")) for flag, ok in ones]

    @property
    def parts(self) -> int:
        """How many parts step on their own: groups of rods, and the net."""
        return len(self.integrator._parts)

    def parameter_axes(self, names: tuple) -> list[int]:
        """Axes along which the worlds of full parameters lie."""
        return [int(chain) for name in names for _, _, chain in self.tables(name)[1]]

    def flagged(self, values: torch.Tensor, field: Field, flags) -> torch.Tensor:
        """Derivatives by an array of a state, not numbers where the step has none."""
        flag = flags[self._part(field.name.partition("/")[0])]
        if values.shape[field.axis] != len(flag):  # entries of a net, world by world
            flag = flag.repeat_interleave(values.shape[field.axis] // len(flag))
        shape = [1] * values.ndim
        shape[field.axis] = -1
        return values * flag.reshape(shape)

    def _part(self, name: str) -> int:
        return len(self.model.groups) if name == "net" else int(name)

    def by_parameters(self, names: tuple, inputs: list, flags) -> list[torch.Tensor]:
        """Derivatives by full parameters, in the order of `write`."""
        result, model = [], self.model
        for name in names:
            own = name.rpartition(".")[2]
            for table, rows, chain in self.tables(name)[1]:
                if chain:
                    index = next(i for i, group in enumerate(model.groups) if group.parameters is table)
                    row = list(table.values).index(name)
                    values = wp.to_torch(inputs[index].parameters, requires_grad=False)[row]
                    result.append(values * flags[index])
                else:
                    index = next(i for i, part in enumerate(model.net.sets) if part.parameters is table)
                    row = list(table.values).index(own)
                    values = wp.to_torch(inputs[-1].parameters[index], requires_grad=False)[row]
                    result.append(values.reshape(model.worlds, len(rows)) * flags[-1][:, None])
        return result

    def require(self, name: str) -> None:
        """Refuse derivatives by a control that has none.

        Raises:
            SceneError: it has none.
        """
        if name == "poses" and self._midpoint:
            raise SceneError(
                "no gradient goes through the poses of grips by the midpoint rule yet; take 'implicit_euler', or poses.detach()"
            )

    def by_control(self, name: str, value: torch.Tensor, inputs: list, flags) -> torch.Tensor:
        """Derivatives by what a step is given (worlds, ...)."""
        if name == "poses":
            if self.poses is None:  # which `require` has refused to whoever asks for them
                return torch.zeros_like(value)
            return self.poses.pull(inputs, value) * self._by_world(flags)[:, None, None]
        result = torch.zeros_like(value)
        model, worlds = self.model, self.model.worlds
        for i, group in enumerate(model.groups):
            found = inputs[i]
            if name == "gravity":
                own = wp.to_torch(found.gravity, requires_grad=False) * flags[i][:, None]
                own = own.reshape(group.nodes, worlds, group.rods, -1).sum((0, 2))
                result[:, list(group.host.axes)] += own
                continue
            w = (wp.to_torch(found.load, requires_grad=False) * flags[i]).reshape(-1, group.nodes, worlds, group.rods)
            if name == "forces":
                k, column, rows = self._places(("points", i), lambda group=group: model.order.places(group))
                result[:, rows[:, None], torch.tensor(group.host.axes)] = w[: group.kind.dim, k, :, column].permute(
                    2, 0, 1
                )
            elif group.kind.twist:
                k, column, rows = self._places(("edges", i), lambda group=group: model.order.edge_places(group))
                result[:, rows] = w[group.kind.dim, k, :, column].T
        if model.net is not None:
            found = inputs[-1]
            if name == "gravity":
                own = wp.to_torch(found.gravity, requires_grad=False).reshape(worlds, -1, 3).sum(1)
                return result + own * flags[-1][:, None]
            w = wp.to_torch(found.load, requires_grad=False).reshape(worlds, -1, 3) * flags[-1][:, None, None]
            if name == "forces":
                rows, blocks = self._places(("points", "net"), lambda: model.order.net_rows)
                result[:, rows] = w[:, blocks]
            else:
                for rod in model.net.host.rods:
                    first = int(model.order.edge_starts[rod.rod])
                    result[:, first : first + len(rod.edges)] = w[:, torch.as_tensor(rod.edges), 0]
        return result

    def _places(self, key, find) -> list[torch.Tensor]:
        if key not in self._places_found:
            self._places_found[key] = [torch.as_tensor(np.asarray(v), device=self.device) for v in find()]
        return self._places_found[key]

    def _by_world(self, flags) -> torch.Tensor:
        """One for worlds in which all has gradients."""
        return torch.stack([flag.reshape(self.model.worlds, -1).sum(1) * 0.0 + 1.0 for flag in flags]).prod(0)

    # the user's order

    def _of(self, name: str) -> int | None:
        return next((i for i, field in enumerate(self.fields) if field.name == name), None)

    def points(self, values, own: str, blocks: str) -> torch.Tensor:
        """Points (worlds, P, 3) from the tensors of a state."""
        model, found = self.model, []
        for i, group in enumerate(model.groups):
            x = values[self._of(f"{i}/{own}")].reshape(-1, group.kind.dim)
            if group.kind.dim == 2:
                x = torch.stack([x[:, 0], torch.zeros_like(x[:, 0]), x[:, 1]], 1)
            found.append(x)
        if model.net is not None:
            found.append(values[self._of(f"net/{blocks}")])
        return self._picked("points", found, self._point_rows).view(model.worlds, model.points_count, 3)

    def edges(self, values) -> torch.Tensor:
        """Angles (worlds, edges) from the tensors of a state."""
        model = self.model
        twisted = [i for i, group in enumerate(model.groups) if group.kind.twist]
        found = [values[self._of(f"{i}/theta")].reshape(-1) for i in twisted]
        if model.net is not None:
            found.append(values[self._of("net/q")][:, 0])
        none = torch.zeros(1, dtype=values[0].dtype, device=values[0].device)
        return self._picked("edges", [*found, none], self._edge_rows).view(model.worlds, -1)

    def _picked(self, key: str, found: list[torch.Tensor], find) -> torch.Tensor:
        """Rows of what was found, one behind the other."""
        (rows,) = self._places(("picked", key), lambda: [find([len(own) for own in found])])
        return (found[0] if len(found) == 1 else torch.cat(found)).index_select(0, rows)

    def _point_rows(self, sizes: list[int]) -> np.ndarray:
        model, worlds = self.model, self.model.worlds
        rows, first = np.zeros((worlds, model.points_count), np.int64), np.cumsum([0, *sizes])
        world = np.arange(worlds)[:, None]
        for at, group in zip(first, model.groups, strict=False):
            k, column, own = model.order.places(group)
            rows[:, own] = at + k * group.columns + world * group.rods + column
        if model.net is not None:
            own, blocks = model.order.net_rows
            rows[:, own] = first[len(model.groups)] + world * model.net.blocks + blocks
        return rows.ravel()

    def _edge_rows(self, sizes: list[int]) -> np.ndarray:
        model, worlds = self.model, self.model.worlds
        first = np.cumsum([0, *sizes])
        rows, world = np.full((worlds, model.order.edges_count), first[-2]), np.arange(worlds)[:, None]
        twisted = [group for group in model.groups if group.kind.twist]
        for at, group in zip(first, twisted, strict=False):
            k, column, own = model.order.edge_places(group)
            rows[:, own] = at + k * group.columns + world * group.rods + column
        for rod in model.net.host.rods if model.net is not None else ():
            own = model.order.edge_starts[rod.rod] + np.arange(len(rod.edges))
            rows[:, own] = first[len(twisted)] + world * model.net.blocks + rod.edges
        return rows.ravel()

    def put_points(self, values: list, own: str, blocks: str, points: torch.Tensor) -> list:
        """Tensors of a state with points (P, 3) or (worlds, P, 3) in place of its own.

        Raises:
            SceneError: their shape does not fit.
        """
        model, worlds = self.model, self.model.worlds
        if tuple(points.shape) not in ((model.points_count, 3), (worlds, model.points_count, 3)):
            raise SceneError(
                f"points have shape {tuple(points.shape)}; they are ({model.points_count}, 3) or ({worlds}, {model.points_count}, 3)"
            )
        points = points.to(device=values[0].device, dtype=wp.dtype_to_torch(model.types.real))
        points, values = points.expand(worlds, *points.shape[-2:]), list(values)
        for i, group in enumerate(model.groups):
            k, column, rows = self._places(("points", i), lambda group=group: model.order.places(group))
            at, shape = self._of(f"{i}/{own}"), (group.nodes, worlds, group.rods, -1)
            found = points[:, rows][..., list(group.host.axes)]
            whole = values[at].reshape(shape)
            place = k[None], torch.arange(worlds, device=k.device)[:, None], column[None]
            values[at] = whole.index_put(place, found).reshape(values[at].shape)
        if model.net is not None:
            rows, blocks_of = self._places(("given", "net"), lambda: _last(*model.order.net_rows))
            at = self._of(f"net/{blocks}")
            whole = values[at].reshape(worlds, -1, 3)
            place = torch.arange(worlds, device=rows.device)[:, None], blocks_of[None]
            values[at] = whole.index_put(place, points[:, rows]).reshape(values[at].shape)
        return values

    def turn_edges(self, values, own: str, blocks: str, more: torch.Tensor) -> list:
        """Tensors of a state with something added to the angles of its edges (worlds, edges), or to their rates."""
        values, model, worlds = list(values), self.model, self.model.worlds
        of = torch.arange(worlds, device=values[0].device)
        for i, group in enumerate(model.groups):
            if group.kind.twist:
                k, column, rows = self._places(("edges", i), lambda group=group: model.order.edge_places(group))
                at = self._of(f"{i}/{own}")
                wide = torch.zeros_like(values[at]).reshape(group.nodes, worlds, group.rods)
                wide = wide.index_put((k[:, None], of[None], column[:, None]), more[:, rows].T)
                values[at] = values[at] + wide.reshape(values[at].shape)
        for rod in model.net.host.rods if model.net is not None else ():
            first, at = int(model.order.edge_starts[rod.rod]), self._of(f"net/{blocks}")
            wide = torch.zeros_like(values[at]).reshape(worlds, -1, 3)
            rows = torch.as_tensor(rod.edges, device=wide.device)[None]
            added = more[:, first : first + len(rod.edges)]
            wide = wide.index_put((of[:, None], rows, torch.zeros_like(rows)), added)
            values[at] = values[at] + wide.reshape(values[at].shape)
        return values


def _last(rows: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points and their blocks, of points that are one (joined) the last alone."""
    _, from_end = np.unique(blocks[::-1], return_index=True)
    kept = len(blocks) - 1 - from_end
    return rows[kept], blocks[kept]
