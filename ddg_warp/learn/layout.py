"""What the tensors of a state are: their order, and where points and edges lie in them."""

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from ddg_warp.errors import SceneError

# arrays of a state that have gradients, by how their names begin
GRADIENTS = ("x", "v", "theta", "omega", "frame", "last", "q", "lag", "pose")


@dataclass(frozen=True)
class Field:
    """An array of a state as a tensor: its name, the axis along which worlds lie, and whether it has gradients."""

    name: str
    axis: int
    smooth: bool


def fields(model) -> list[Field]:
    """Arrays of a model's states that hold something, in their order."""
    nothing = "net/frame" if model.net is not None and not model.net.edges else ""
    return [
        Field(name, array.ndim - 1, name.partition("/")[2].rstrip("_0123456789") in GRADIENTS)
        for name, array in model.empty_state().arrays().items()
        if (array.size > 1 or name == "net/rate") and name != nothing
    ]


def view(array: wp.array) -> torch.Tensor:
    """A tensor that looks at an array."""
    return wp.to_torch(array, requires_grad=False)


def tensors(state, names: list[Field]) -> list[torch.Tensor]:
    """Tensors that look at the arrays of a state."""
    found = state.arrays()
    return [view(found[field.name]) for field in names]


def copies(values: list[torch.Tensor]) -> list[torch.Tensor]:
    """Of tensors, as they lie."""
    found = [torch.empty_like(value) for value in values]
    torch._foreach_copy_(found, values)
    return found


def along(values: torch.Tensor, field: Field, like: torch.Tensor) -> torch.Tensor:
    """Values of worlds, or of islands, as they lie along an array of a state, so that they multiply it."""
    count = like.shape[field.axis]
    if count != len(values):
        values = values.repeat_interleave(count // len(values))
    return values if like.ndim == field.axis + 1 else values[:, None]


class Layout:
    """Of the states of a model: points and edges, in the user's order, in their tensors.

    Attributes:
        fields: what the tensors of a state are.
    """

    def __init__(self, model):
        self.model, self.device = model, str(wp.device_to_torch(model.wp_device))
        self.fields = fields(model)
        self._places = {}

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
            k, column, rows = self.places(("points", i), lambda group=group: model.order.places(group))
            at, shape = self._of(f"{i}/{own}"), (group.nodes, worlds, group.rods, -1)
            found = points[:, rows][..., list(group.host.axes)]
            whole = values[at].reshape(shape)
            place = k[None], torch.arange(worlds, device=k.device)[:, None], column[None]
            values[at] = whole.index_put(place, found).reshape(values[at].shape)
        if model.net is not None:
            rows, blocks_of = self.places(("given", "net"), lambda: _last(*model.order.net_rows))
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
                k, column, rows = self.places(("edges", i), lambda group=group: model.order.edge_places(group))
                at = self._of(f"{i}/{own}")
                wide = torch.zeros_like(values[at]).reshape(group.nodes, worlds, group.rods)
                wide = wide.index_put((k[:, None], of[None], column[:, None]), more[:, rows].T)
                values[at] = values[at] + wide.reshape(values[at].shape)
        if model.net is not None:
            at, (rows, owned) = self._of(f"net/{blocks}"), self.net_edges()
            wide = torch.zeros_like(values[at]).reshape(worlds, -1, 3)
            wide = wide.index_put((of[:, None], owned[None], torch.zeros_like(owned)[None]), more[:, rows])
            values[at] = values[at] + wide.reshape(values[at].shape)
        return values

    def flagged(self, values: list[torch.Tensor], flags) -> list[torch.Tensor]:
        """Derivatives by the arrays of a state that have some, not numbers where the step has none."""
        found = [(value, field) for value, field in zip(values, self.fields, strict=True) if field.smooth]
        return list(torch._foreach_mul([value for value, _ in found], [self._flag(*own, flags) for own in found]))

    def _flag(self, values: torch.Tensor, field: Field, flags) -> torch.Tensor:
        """Flags of the islands of a part as they lie along such an array."""
        part = field.name.partition("/")[0]
        return along(self.by_world(flags) if part == "grips" else flags[self._part(part)], field, values)

    def by_world(self, flags) -> torch.Tensor:
        """One for worlds in which all has gradients."""
        return torch.stack([flag.reshape(self.model.worlds, -1).sum(1) * 0.0 + 1.0 for flag in flags]).prod(0)

    def net_edges(self) -> list[torch.Tensor]:
        """Of the edges of a net's rods, where they are among all, and their blocks."""
        return self.places(("edges", "net"), lambda: _net_edges(self.model))

    def places(self, key, find) -> list[torch.Tensor]:
        if key not in self._places:
            self._places[key] = [torch.as_tensor(np.asarray(v), device=self.device) for v in find()]
        return self._places[key]

    def _part(self, name: str) -> int:
        return len(self.model.groups) if name == "net" else int(name)

    def _of(self, name: str) -> int | None:
        return next((i for i, field in enumerate(self.fields) if field.name == name), None)

    def _picked(self, key: str, found: list[torch.Tensor], find) -> torch.Tensor:
        """Rows of what was found, one behind the other."""
        (rows,) = self.places(("picked", key), lambda: [find([len(own) for own in found])])
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
        if model.net is not None:
            own, blocks = _net_edges(model)
            rows[:, own] = first[len(twisted)] + world * model.net.blocks + blocks
        return rows.ravel()


def _net_edges(model) -> tuple[np.ndarray, np.ndarray]:
    """Of the edges of a net's rods, where they are among all, and their blocks."""
    rods, none = model.net.host.rods, np.zeros(0, np.int64)
    rows = [model.order.edge_starts[rod.rod] + np.arange(len(rod.edges)) for rod in rods]
    return np.concatenate([none, *rows]), np.concatenate([none, *(rod.edges for rod in rods)])


def _last(rows: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points and their blocks, of points that are one (joined) the last alone."""
    _, from_end = np.unique(blocks[::-1], return_index=True)
    kept = len(blocks) - 1 - from_end
    return rows[kept], blocks[kept]
