"""Parameters of a model as tensors, and the tables that its kernels read."""

import numpy as np
import torch
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.learn.layout import view


class Tables:
    """Of a model: what its parameters are, how tensors are put in their place, and derivatives by them."""

    def __init__(self, model):
        self.model = model
        self._found, self._row_of, self._seen = {}, {}, {}
        self._written, self._held, self._views = {}, {}, {}

    def of(self, name: str) -> list:
        """Parts whose table has a parameter "term.parameter": (table, its full shape, rows of its elements among all).

        Elements are counted rod by rod, those of clamped ends included, then through the element sets of the net.

        Raises:
            SceneError: nothing has it.
        """
        if name not in self._found:
            model, own = self.model, name.rpartition(".")
            start, groups = model.order.elements(name)
            found = [(group.parameters, rows, True) for group, _, rows in groups]
            for part in model.net.sets if model.net is not None else ():
                if part.term.name == own[0] and own[2] in part.parameters.values:
                    found.append((part.parameters, start + np.arange(part.elements), False))
                    start += part.elements
            if not found:
                known = sorted({*self.names()})
                raise SceneError(f"parameters: nothing has {name!r}; this model has {', '.join(known)}")
            device = str(wp.device_to_torch(model.wp_device))
            self._found[name] = (
                start,
                [(table, torch.as_tensor(rows, device=device), chain) for table, rows, chain in found],
            )
        return self._found[name]

    def names(self) -> list[str]:
        """Names of all parameters."""
        model = self.model
        result = [name for group in model.groups for name in group.parameters.values]
        for part in model.net.sets if model.net is not None else ():
            result += [f"{part.term.name}.{name}" for name in part.parameters.values]
        return result

    def full(self, name: str, values: torch.Tensor) -> list[torch.Tensor]:
        """A parameter of shape (), (B,), (E,) or (B, E) as each table has it with one number an element and world."""
        count, found = self.of(name)
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
        wide = wide.to(device=found[0][1].device, dtype=real)
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
        count, found = self.of(name)
        worlds, own = self.model.worlds, name.rpartition(".")[2]
        result = torch.zeros((worlds, count), dtype=wp.dtype_to_torch(self.model.types.real), device=found[0][1].device)
        for table, rows, chain in found:
            values = np.broadcast_to(table[name if chain else own], self._shape(rows, chain))
            wide = torch.tensor(values, dtype=result.dtype, device=result.device)
            if chain:
                _, groups = self.model.order.elements(name)
                inside = torch.as_tensor(next(inside for group, inside, _ in groups if group.parameters is table))
                wide = wide.reshape(rows.shape[0], worlds, -1).permute(1, 0, 2)
                result[:, rows[inside]] = wide[:, inside]
            else:
                result[:, rows] = wide
        return result

    def write(self, names: tuple, values: list[torch.Tensor]) -> None:
        """Put full parameters in place; what is there already stays, and others are as the model has them."""
        places = [
            (table, name if chain else name.rpartition(".")[2], self._shape(rows, chain))
            for name in names
            for table, rows, chain in self.of(name)[1]
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

    def axes(self, names: tuple) -> list[int]:
        """Axes along which the worlds of full parameters lie."""
        return [int(chain) for name in names for _, _, chain in self.of(name)[1]]

    def pull(self, names: tuple, inputs: list, flags) -> list[torch.Tensor]:
        """Derivatives by full parameters, in the order of `write`."""
        result, worlds = [], self.model.worlds
        for name in names:
            for (_, rows, chain), (index, row) in zip(self.of(name)[1], self._rows(name), strict=True):
                if chain:
                    result.append(self._by(index, inputs[index].parameters)[row] * flags[index])
                else:
                    values = view(inputs[-1].parameters[index])[row]
                    result.append(values.reshape(worlds, len(rows)) * flags[-1][:, None])
        return result

    def _by(self, index: int, array: wp.array) -> torch.Tensor:
        """A tensor that looks at derivatives of a group of rods, whose memory stays from step to step."""
        if self._seen.get(index, (None,))[0] is not array:
            self._seen[index] = array, view(array)
        return self._seen[index][1]

    def _rows(self, name: str) -> list[tuple[int, int]]:
        """Of the parts that have a parameter, in the order of `of`: which it is, and the row that it has in their tables."""
        if name not in self._row_of:
            model, own, found = self.model, name.rpartition(".")[2], []
            for table, _, chain in self.of(name)[1]:
                parts = model.groups if chain else model.net.sets
                index = next(i for i, part in enumerate(parts) if part.parameters is table)
                found.append((index, list(table.values).index(name if chain else own)))
            self._row_of[name] = found
        return self._row_of[name]

    def _shape(self, rows: torch.Tensor, chain: bool) -> tuple[int, int]:
        worlds = self.model.worlds
        return (rows.shape[0], worlds * rows.shape[1]) if chain else (worlds, len(rows))

    def _view(self, table, key: str, shape: tuple) -> torch.Tensor:
        buffer, view = self._views.get((id(table), key), (None, None))
        if buffer is not table.buffer:
            buffer, view = table.buffer, self._look(table, key, shape)
            self._views[id(table), key] = buffer, view
        return view

    @staticmethod
    def _look(table, key: str, shape: tuple) -> torch.Tensor:
        row = list(table.values).index(key)
        offset = sum(values.size for values in list(table.values.values())[:row])
        return view(table.buffer)[offset : offset + shape[0] * shape[1]].view(shape)
