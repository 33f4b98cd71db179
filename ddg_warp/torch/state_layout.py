"""Layout of the tensors of a state: order of arrays, and indices of points and edges."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.torch.rigid_bodies import BodyLayout

# prefixes of the names of arrays that have gradients
GRADIENTS = ("x", "v", "theta", "omega", "frame", "last", "q", "lag", "pose", "rotation", "momentum")
ALWAYS = ("net/rate", "net/rotation", "net/momentum")  # arrays that are no placeholders, whatever their size


@dataclass(frozen=True)
class Field:
    """Array of a state as a tensor: name, axis of the worlds, and True if it has gradients."""

    name: str
    axis: int
    smooth: bool


def fields(model) -> list[Field]:
    """Return the nonempty arrays of a model's states, in order."""
    nothing = "net/frame" if model.coupled is not None and not model.coupled.edges else ""
    return [
        Field(name, array.ndim - 1, name.partition("/")[2].rstrip("_0123456789") in GRADIENTS)
        for name, array in model.empty_state().arrays().items()
        if (array.size > 1 or name in ALWAYS) and name != nothing
    ]


def view(array: wp.array) -> torch.Tensor:
    """Return a tensor view of an array, whatever torch's default device."""
    if array.device.is_cpu and torch.get_default_device().type != "cpu":
        with torch.device("cpu"):  # `wp.to_torch` would copy memory of the host to the default device
            return wp.to_torch(array, requires_grad=False)
    return wp.to_torch(array, requires_grad=False)


def tensors(state, names: list[Field]) -> list[torch.Tensor]:
    """Return tensor views of the arrays of a state."""
    by_name = state.arrays()
    return [view(by_name[field.name]) for field in names]


def copies(values: list[torch.Tensor]) -> list[torch.Tensor]:
    """Return copies of tensors, in the same memory layout."""
    results = [torch.empty_like(value) for value in values]
    torch._foreach_copy_(results, values)
    return results


def along(values: torch.Tensor, field: Field, like: torch.Tensor) -> torch.Tensor:
    """Reshape values of worlds, or of islands, so that they multiply an array of a state."""
    count = like.shape[field.axis]
    if count != len(values):
        values = values.repeat_interleave(count // len(values))
    return values.reshape(-1, *[1] * (like.ndim - field.axis - 1))


class StateLayout:
    """Layout of the states of a model: points and edges, in user order, in tensors.

    Attributes:
        fields: fields of the tensors of a state.
        real: their dtype.
    """

    def __init__(self, model):
        self.model, self.device = model, str(wp.device_to_torch(model.wp_device))
        self.fields, self.real = fields(model), wp.dtype_to_torch(model.types.real)
        self._places = {}

    @cached_property
    def bodies(self) -> BodyLayout:
        """Rigid bodies.

        Raises:
            SceneError: the model has none.
        """
        if not self.model.scene.bodies:
            raise SceneError("the scene has no rigid body; add one by scene.add_body(...)")
        return BodyLayout(self)

    def points(self, values, array: str, blocks: str) -> torch.Tensor:
        """Return points (worlds, P, 3) from the tensors of a state."""
        model, point_arrays = self.model, []
        for i, group in enumerate(model.groups):
            x = values[self.index(f"{i}/{array}")].reshape(-1, group.kind.dim)
            if group.kind.dim == 2:
                x = torch.stack([x[:, 0], torch.zeros_like(x[:, 0]), x[:, 1]], 1)
            point_arrays.append(x)
        if model.coupled is not None:
            point_arrays.append(values[self.index(f"net/{blocks}")])
        return self._picked("points", point_arrays, self._point_rows).view(model.worlds, model.points_count, 3)

    def edges(self, values) -> torch.Tensor:
        """Return twist angles (worlds, edges) from the tensors of a state."""
        model = self.model
        twisted = [i for i, group in enumerate(model.groups) if group.kind.twist]
        angles = [values[self.index(f"{i}/theta")].reshape(-1) for i in twisted]
        if model.coupled is not None:
            angles.append(values[self.index("net/q")][:, 0])
        none = torch.zeros(1, dtype=values[0].dtype, device=values[0].device)
        return self._picked("edges", [*angles, none], self._edge_rows).view(model.worlds, -1)

    def put_points(self, values: list, array: str, blocks: str, points: torch.Tensor) -> list:
        """Return the tensors of a state with points replaced by (P, 3) or (worlds, P, 3).

        Raises:
            SceneError: the shape does not fit.
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
            index, shape = self.index(f"{i}/{array}"), (group.nodes, worlds, group.rods, -1)
            new = points[:, rows][..., list(group.host.axes)]
            old = values[index].reshape(shape)
            target = k[None], torch.arange(worlds, device=k.device)[:, None], column[None]
            values[index] = old.index_put(target, new).reshape(values[index].shape)
        if model.coupled is not None:
            rows, blocks_of = self.places(("given", "net"), lambda: _last(*model.order.coupled_rows))
            index = self.index(f"net/{blocks}")
            old = values[index].reshape(worlds, -1, 3)
            target = torch.arange(worlds, device=rows.device)[:, None], blocks_of[None]
            values[index] = old.index_put(target, points[:, rows]).reshape(values[index].shape)
        return values

    def turn_edges(self, values, array: str, blocks: str, more: torch.Tensor) -> list:
        """Return the tensors of a state with an increment (worlds, edges) added to twist angles, or to their rates."""
        values, model, worlds = list(values), self.model, self.model.worlds
        world = torch.arange(worlds, device=values[0].device)
        for i, group in enumerate(model.groups):
            if group.kind.twist:
                k, column, rows = self.places(("edges", i), lambda group=group: model.order.edge_places(group))
                index = self.index(f"{i}/{array}")
                increment = torch.zeros_like(values[index]).reshape(group.nodes, worlds, group.rods)
                increment = increment.index_put((k[:, None], world[None], column[:, None]), more[:, rows].T)
                values[index] = values[index] + increment.reshape(values[index].shape)
        if model.coupled is not None:
            index, (rows, owned) = self.index(f"net/{blocks}"), self.coupled_edges()
            increment = torch.zeros_like(values[index]).reshape(worlds, -1, 3)
            increment = increment.index_put((world[:, None], owned[None], torch.zeros_like(owned)[None]), more[:, rows])
            values[index] = values[index] + increment.reshape(values[index].shape)
        return values

    def flagged(self, values: list[torch.Tensor], flags) -> list[torch.Tensor]:
        """Return copies of the gradients by the arrays of a state; for grips NaN in worlds with such a flag."""
        results = copies([value for value, field in zip(values, self.fields, strict=True) if field.smooth])
        smooth = [field for field in self.fields if field.smooth]
        for value, field in zip(results, smooth, strict=True) if self.model.grips else ():
            if field.name.startswith("grips/"):
                value *= along(self.by_world(flags), field, value)
        return results

    def by_world(self, flags) -> torch.Tensor:
        """Return 1 for worlds with a gradient in every island, else NaN."""
        return torch.stack([flag.reshape(self.model.worlds, -1).sum(1) * 0.0 + 1.0 for flag in flags]).prod(0)

    def coupled_edges(self) -> list[torch.Tensor]:
        """Return rows among all edges, and dof blocks, of the edges of coupled rods."""
        return self.places(("edges", "net"), lambda: _coupled_edges(self.model))

    def places(self, key, find) -> list[torch.Tensor]:
        if key not in self._places:
            self._places[key] = [torch.as_tensor(np.asarray(v), device=self.device) for v in find()]
        return self._places[key]

    def index(self, name: str) -> int | None:
        """Return the index of the tensor with a name; None without."""
        return next((i for i, field in enumerate(self.fields) if field.name == name), None)

    def _picked(self, key: str, values: list[torch.Tensor], find) -> torch.Tensor:
        """Return rows of concatenated arrays."""
        (rows,) = self.places(("picked", key), lambda: [find([len(array) for array in values])])
        return (values[0] if len(values) == 1 else torch.cat(values)).index_select(0, rows)

    def _point_rows(self, sizes: list[int]) -> np.ndarray:
        model, worlds = self.model, self.model.worlds
        rows, first = np.zeros((worlds, model.points_count), np.int64), np.cumsum([0, *sizes])
        world = np.arange(worlds)[:, None]
        for offset, group in zip(first, model.groups, strict=False):
            k, column, points = model.order.places(group)
            rows[:, points] = offset + k * group.columns + world * group.rods + column
        if model.coupled is not None:
            points, blocks = model.order.coupled_rows
            rows[:, points] = first[len(model.groups)] + world * model.coupled.blocks + blocks
        return rows.ravel()

    def _edge_rows(self, sizes: list[int]) -> np.ndarray:
        model, worlds = self.model, self.model.worlds
        first = np.cumsum([0, *sizes])
        rows, world = np.full((worlds, model.order.edges_count), first[-2]), np.arange(worlds)[:, None]
        twisted = [group for group in model.groups if group.kind.twist]
        for offset, group in zip(first, twisted, strict=False):
            k, column, edges = model.order.edge_places(group)
            rows[:, edges] = offset + k * group.columns + world * group.rods + column
        if model.coupled is not None:
            edges, blocks = _coupled_edges(model)
            rows[:, edges] = first[len(twisted)] + world * model.coupled.blocks + blocks
        return rows.ravel()


def _coupled_edges(model) -> tuple[np.ndarray, np.ndarray]:
    """Return rows among all edges, and dof blocks, of the edges of coupled rods."""
    rods, none = model.coupled.host.rods, np.zeros(0, np.int64)
    rows = [model.order.edge_starts[rod.rod] + np.arange(len(rod.edges)) for rod in rods]
    return np.concatenate([none, *rows]), np.concatenate([none, *(rod.edges for rod in rods)])


def _last(rows: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of points and dof blocks, of joined points only the last."""
    _, from_end = np.unique(blocks[::-1], return_index=True)
    kept = len(blocks) - 1 - from_end
    return rows[kept], blocks[kept]
