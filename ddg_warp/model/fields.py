"""Fields of a model: prescribed rest strains and rest forms, written to existing memory at the time of a step or state."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.model.rest_forms import rest_elements
from ddg_warp.scene.field import PrescribedParameter

ROD_TERMS = ("rod_stretch", "rod_bend_twist", "rod_bend", "planar_stretch", "planar_bend")


class Fields:
    """Fields of a model, and their current values in parameter tables.

    Attributes:
        items: `FieldElements` and `ShellField` by name.
        constant: True if no field of the scene changes in time.
        count: number of times that values were written.
    """

    def __init__(self, model):
        kinds = {True: FieldElements, False: ShellField}
        self.items = {each.name: kinds[each.shell is None](model, each) for each in model.scene.fields}
        self.constant = all(item.description.field.constant for item in self.items.values())
        self._worlds, self.count = model.worlds, 0
        self._time, self._controlled = None, False  # of the values in memory
        self._shells = [item for item in self.items.values() if isinstance(item, ShellField)]
        self._refuse_overlaps()
        self.tables = self.bind(model.groups, model.coupled)
        self.to(0.0, error=SceneError)

    def __bool__(self) -> bool:
        return bool(self.items)

    def bind(self, groups, coupled=None) -> list:
        """Return where fields are in the parameter tables of rod groups and a coupled system.

        The parameters are expanded to one value per element and world.

        Returns:
            (table, name of the parameter, [(field, flat indices (worlds, m), elements of the field (m,))]) each.
        """
        entries: dict[tuple, tuple] = {}
        for item in self.items.values():
            for part, name, shape, indices, elements in item.indices(groups, coupled):
                table = part.parameters
                if name not in table.prescribed:
                    table.prescribe(name, shape)
                entry = entries.setdefault((id(table), name), (table, name, []))
                entry[2].append((item, _slice(indices), _slice(elements)))
        return list(entries.values())

    def to(self, t: float, controls: Mapping | None = None, error=SolverError) -> None:
        """Write the values at a time, or at a load parameter, to memory that captured kernels read.

        Args:
            controls: values by name in place of the scene's, as of `FieldElements.given`.

        Raises:
            SolverError: a function failed, or its value does not fit; memory stays as it was.
        """
        if not self.items:
            return
        current = self._time is not None and (self.constant or self._time == t)
        if current and not controls and not self._controlled:
            return
        controls = controls or {}
        values = {name: controls[name] if name in controls else item.at(t, error) for name, item in self.items.items()}
        for name, item in self.items.items():
            item.values = values[name]
        self._time = None
        self.write(self.tables)
        for shell in self._shells:
            shell.put(error)
        self._time, self._controlled = t, bool(controls)
        self.count += 1

    def write(self, tables: list) -> None:
        """Write the current values to tables of `bind`."""
        for table, name, members in tables:
            table.write(name, [(indices, item.of(elements)) for item, indices, elements in members])

    def forget(self) -> None:
        """Write values again at the next request, after other changes of parameters."""
        self._time = None
        for shell in self._shells:
            shell.forget()

    def refuse(self, call: str, parameter: str, shell: int | None = None) -> None:
        """Refuse to change a parameter "term.parameter", or a form of a shell, that a field prescribes.

        Raises:
            ValueError: names the field.
        """
        for name, item in self.items.items():
            if (item.description.parameter, item.description.shell) == (parameter, shell):
                raise ValueError(
                    f"{call}: {parameter} is prescribed by the field '{name}'; give Controls(fields={{{name!r}: ...}}) to steps"
                )

    def _refuse_overlaps(self) -> None:
        owners: dict[tuple, str] = {}
        for name, item in self.items.items():
            shell = item.description.shell
            for rod in item.description.rods.tolist() if shell is None else [None]:
                owner = owners.setdefault((item.description.parameter, rod, shell), name)
                if owner != name:
                    place = f"rod {rod}" if shell is None else f"shell {shell}"
                    raise SceneError(
                        f"prescribe: {item.description.parameter} of {place} is in the fields '{owner}' and '{name}'; leave it "
                        "out of one"
                    )


class FieldElements:
    """Field of a model: the elements of its rods, and its values.

    Attributes:
        description: the scene's `PrescribedParameter`.
        shape: (elements,) of one rod, (rods, elements) of rods with equally many, else (all elements,).
        size: number of elements, rod after rod.
        values: current values, (), (size,), (worlds, 1) or (worlds, size).
    """

    def __init__(self, model, description: PrescribedParameter):
        self.description, self.worlds = description, model.worlds
        rods, along = description.rods.tolist(), {}
        for _, of_rods in self._parts(model.groups, model.coupled):
            along |= of_rods
        self._refuse_missing(model, [rod for rod in rods if rod not in along])
        sizes = [len(along[rod].index) for rod in rods]
        self.size = sum(sizes)
        self.shape = (len(rods), sizes[0]) if len(set(sizes)) == 1 and len(rods) > 1 else (self.size,)
        self._first = dict(zip(rods, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
        self._arguments, self.values = (), np.zeros(())
        if description.over != "time":
            argument = np.concatenate([self._over(model.scene, rod, along[rod].nodes) for rod in rods])
            self._arguments = (argument.reshape(*self.shape, *argument.shape[1:]),)

    def at(self, t: float, error=SolverError) -> np.ndarray:
        """Return the scene's values at a time, () or (size,).

        Raises:
            SolverError: the function failed, or its value does not fit.
        """
        values = self.description.field.at(t, error=error, arguments=self._arguments)
        if values.ndim == 0:
            return values
        if values.shape not in (self.shape, (self.size,)):
            values = _broadcast(self.description.field.label, values, self.shape, self._shapes, t, error)
        return values.reshape(-1)

    def of(self, elements: np.ndarray | slice) -> np.ndarray:
        """Return the current values of some elements, (), (m,), (worlds, 1) or (worlds, m)."""
        values = self.values
        return values[..., elements] if values.ndim and values.shape[-1] == self.size else values

    def given(self, values) -> np.ndarray:
        """Return checked values of a control, (), (size,), (worlds, 1) or (worlds, size).

        Raises:
            SceneError: a shape does not fit, or a value is not finite.
        """
        label = f"Controls: fields: '{self.description.name}'"
        values = argument_checks.array(label, values)
        values = values.reshape(self.flat(label, values.shape))
        if not np.isfinite(values).all():
            entry = np.argwhere(~np.isfinite(np.atleast_1d(values)))[0].tolist()
            raise SceneError(f"{label}: entry {entry} is not finite; give finite numbers")
        return values

    def flat(self, label: str, shape: tuple) -> tuple:
        """Return the shape (), (size,), (worlds, 1) or (worlds, size) of values of a shape.

        Raises:
            SceneError: the shape does not fit.
        """
        shape, worlds = tuple(shape), self.worlds
        if shape in ((), self.shape, (self.size,)):
            return shape and (self.size,)
        if shape in ((worlds, *self.shape), (worlds, self.size)):
            return worlds, self.size
        if shape in ((worlds, 1), (worlds,)):
            return worlds, 1
        raise SceneError(
            f"{label} has shape {shape}; give {self._shapes}, or these with ({worlds}, ...) in front for the worlds"
        )

    @property
    def _shapes(self) -> str:
        return f"one number or {self.shape}" + (f" or ({self.size},)" if len(self.shape) > 1 else "")

    def indices(self, groups, coupled) -> Iterator[tuple]:
        """Yield rod group or element set, parameter, shape, flat indices (worlds, m) and elements of the field (m,)."""
        for part, of_rods in self._parts(groups, coupled):
            rods = [rod for rod in self._first if rod in of_rods]
            if not rods:
                continue
            elements = np.concatenate([self._first[rod] + np.arange(len(of_rods[rod].index)) for rod in rods])
            index = np.concatenate([of_rods[rod].index for rod in rods])
            if part in groups:
                name, shape, stride = self.description.parameter, (part.nodes, part.columns), part.rods
            else:
                name, shape, stride = self._strain, (self.worlds, part.elements), part.elements
            yield part, name, shape, index + stride * np.arange(self.worlds)[:, None], elements

    @property
    def _strain(self) -> str:
        return self.description.parameter.rpartition(".")[2]

    def _parts(self, groups, coupled) -> Iterator[tuple]:
        """Yield rod groups and element sets with the parameter, each with its `_Along` by rod."""
        name, strain = self.description.parameter.rpartition(".")[0], self._strain
        for group in groups:
            for term in group.kind.terms:
                if term.name == name and strain in term.rest:
                    yield group, _of_group(group, term)
        for part in coupled.sets if coupled is not None else ():
            if part.term.name == name and strain in part.term.rest and name in ROD_TERMS:
                yield part, _of_set(part, coupled.host.rods)

    def _refuse_missing(self, model, rods: list[int]) -> None:
        parts = [*(model.groups), *(model.coupled.sets if model.coupled is not None else ())]
        terms = {
            term.name: term for part in parts for term in (part.kind.terms if part in model.groups else [part.term])
        }
        listed = [f"{term.name}.{strain}" for term in terms.values() if term.name in ROD_TERMS for strain in term.rest]
        for rod in rods:
            raise SceneError(
                f"prescribe '{self.description.name}': rod {rod} ('{model.curves.names[rod]}') has no rest strain "
                f"{self.description.parameter!r}; rods of this scene have {', '.join(sorted(listed)) or 'none'}"
            )

    def _over(self, scene, rod: int, nodes: np.ndarray) -> np.ndarray:
        """Return arc lengths (m,) or rest positions (m, 3) of elements between two nodes of a rod (m, 2)."""
        batch = next(each for each in scene.batches if each.first <= rod < each.first + each.rods)
        points = np.array(batch.points[rod - batch.first])
        if batch.closed:
            points = np.concatenate([points, points[:1]])
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        values = points if self.description.over == "position" else arc
        return values[np.clip(nodes, 0, len(points) - 1)].mean(1)


class ShellField:
    """Rest form of a shell that a field prescribes; attributes as of `FieldElements`."""

    def __init__(self, model, description: PrescribedParameter):
        self.description, self._model, self._written = description, model, None
        surface = model.coupled.host.shells[description.shell].surface
        triangles, edges = len(surface.triangles), len(surface.edges)
        self.shape = (edges,) if description.parameter == "angle" else (triangles, 3)
        self.values = np.zeros(())

    def at(self, t: float, error=SolverError) -> np.ndarray:
        """Return the form of the scene at a time.

        Raises:
            SolverError: the function failed, or its value does not fit.
        """
        field = self.description.field
        return _broadcast(field.label, field.at(t, error=error), self.shape, f"{self.shape}", t, error)

    def given(self, values) -> np.ndarray:
        """Return checked values of a control, the same in all worlds.

        Raises:
            SceneError: the shape does not fit, or a value is not finite.
        """
        return argument_checks.broadcast(
            f"Controls: fields: '{self.description.name}'", values, self.shape, own=len(self.shape)
        )

    def flat(self, label: str, shape: tuple) -> tuple:
        """Refuse tensors.

        Raises:
            SceneError: always.
        """
        raise SceneError(
            f"{label} is of a shell, whose tensors are parameters; see ddg_warp.torch.shell_parameters, or give an array to Controls"
        )

    def indices(self, groups, coupled) -> Iterator[tuple]:
        """Yield nothing: `put` writes the parameters."""
        return iter(())

    def forget(self) -> None:
        """Write values again at the next request."""
        self._written = None

    def put(self, error=SolverError) -> None:
        """Write the current values to the parameters of the shell.

        Raises:
            SolverError: the shell has no such form, or a metric without area.
        """
        if self._written is not None and np.array_equal(self._written, self.values):
            return
        try:
            plate, elements = rest_elements(
                self._model, self.description.shell, {self.description.parameter: self.values}
            )
        except ValueError as reason:
            raise _refusal(error, f"{self.description.field.label}: {reason}") from None
        self._model.coupled.host.shells[self.description.shell].plate = plate
        for part, first, parameters in elements:
            part.write_rest(first, parameters)
        self._written = np.array(self.values)


class _Along(NamedTuple):
    """Elements of a term along a rod: flat indices in the parameter of the first world (m,), and end nodes of the user (m, 2)."""

    index: np.ndarray
    nodes: np.ndarray


def _broadcast(label: str, values: np.ndarray, shape: tuple, shapes: str, t: float, error) -> np.ndarray:
    """Return values broadcast to a shape; refuse other shapes than `shapes` lists."""
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise _refusal(error, f"{label} has shape {values.shape} at t = {t:g}; give {shapes}") from None


def _refusal(error, text: str) -> Exception:
    return error(text) if error is SceneError else error(text, outcome=argument_checks.PRESCRIBED)


def _of_group(group, term) -> dict[int, _Along]:
    span, host, result = term.measure.span, group.host, {}
    for column, rod in enumerate(host.rods.tolist()):
        k = np.arange(int(host.count[column]) - (0 if group.kind.closed else span))
        result[rod] = _Along(k * group.columns + column, _nodes(k - int(host.first[column]), span))
    return result


def _of_set(part, rods: list) -> dict[int, _Along]:
    owner, k = part.host.owner
    first = {rod.rod: rod.first for rod in rods}
    order = np.lexsort((k, owner))
    present, starts = np.unique(owner[order], return_index=True)
    pieces = np.split(order, starts[1:])
    return {
        int(rod): _Along(index, _nodes(k[index] - first[int(rod)], part.term.measure.span))
        for rod, index in zip(present, pieces, strict=True)
    }


def _nodes(k: np.ndarray, span: int) -> np.ndarray:
    """Return the end nodes of edges k, or twice the node of vertices between edges k and k + 1 (m, 2)."""
    return np.stack([k, k + 1] if span == 1 else [k + 1, k + 1], axis=1)


def _slice(indices: np.ndarray) -> np.ndarray | slice:
    """Return indices (m,) or (1, m) as a slice where they are evenly spaced, which is faster; else unchanged."""
    flat = indices.reshape(-1)
    if (indices.ndim == 2 and len(indices) > 1) or not flat.size:
        return indices
    step = int(flat[1] - flat[0]) if flat.size > 1 else 1
    even = step > 0 and (np.diff(flat) == step).all()
    return slice(int(flat[0]), int(flat[-1]) + 1, step) if even else flat
