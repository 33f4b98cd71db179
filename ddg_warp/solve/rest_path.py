"""Rest shapes as loads: growth, swelling and natural curvature that a static solve brings on along its load parameter."""

from collections.abc import Mapping

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.model.rest_shapes import set_rest

SHELL = {"points", "metric", "curvature", "angle"}
ROD = {"curvature": ("curvature", "kb"), "twist": ("twist",), "stretch": ("stretch",)}  # strains by what is given


class RestPath:
    """The way of a model's rest shapes from those that it has to others.

    Args:
        model: whose rest shapes change, in every world.
        rest: by shell or rod, an index or a name, what changes: of a shell as in `Model.set_rest`; of a rod "curvature" [1/m], "twist"
            [1/m] or "stretch" [1], one value or one an element (elements,), with as many components as the rod has curvatures.

    Raises:
        SceneError: names what does not exist or fit; nothing is changed then.
    """

    def __init__(self, model, rest: Mapping):
        if not isinstance(rest, Mapping):
            raise SceneError(f"statics: rest is {rest!r}; give a dictionary, shell or rod -> its rest shape")
        self.model, self._changes = model, []
        for key, given in rest.items():
            if not isinstance(given, Mapping) or not given:
                raise SceneError(f"statics: rest[{key!r}] is {given!r}; give a dictionary such as dict(curvature=...)")
            shell, rod = self._find(key, given)
            if shell is not None:
                self._add_shell(key, shell, given)
            else:
                for what, values in given.items():
                    self._add_rod(key, rod, what, values)

    def to(self, part: float) -> None:
        """Put rest shapes where a part of the way ends, 0 at its start and 1 at its end."""
        for put, start, end in self._changes:
            put({name: start[name] + part * (end[name] - start[name]) for name in end} if part != 1.0 else end)

    def _find(self, key, given: Mapping) -> tuple[int | None, int | None]:
        """Index of the shell or of the rod that a key means; of an index of both what is given tells which."""
        scene = self.model.scene
        shells = [i for i, shell in enumerate(scene.shells) if key in (i, shell.name)]
        rods = [i for i, name in enumerate(self._rod_names()) if key == i or (name and key == name)]
        of_shell, of_rod = set(given) <= SHELL, set(given) <= set(ROD)
        if shells and rods and set(given) == {"curvature"}:  # (T, 3) of a shell, or of a rod
            triangles = len(scene.shells[shells[0]].triangles)
            of_shell = np.shape(given["curvature"]) == (triangles, 3)
            of_rod = not of_shell
        if shells and of_shell:
            return shells[0], None
        if rods and of_rod:
            return None, rods[0]
        known = f"{sorted(SHELL)} of shells, {sorted(ROD)} of rods"
        what = "is no shell or rod" if not (shells or rods) else f"has {sorted(given)}; there are {known}"
        raise SceneError(
            f"statics: rest[{key!r}] {what}; the scene has {len(scene.shells)} shells, {scene.rod_count} rods"
        )

    def _rod_names(self) -> list[str]:
        return [batch.name for batch in self.model.scene.batches for _ in range(batch.rods)]

    def _add_shell(self, key, shell: int, given: Mapping) -> None:
        held = self.model.net.host.shells[shell]
        before = held.plate
        try:
            set_rest(self.model, shell, **given)
        except ValueError as error:
            raise SceneError(f"statics: rest[{key!r}]: {error}") from None
        after = held.plate
        forms = {"abar": "metric", "bbar": "curvature", "angle": "angle"}
        names = [name for name in forms if getattr(after, name) is not getattr(before, name)]
        start, end = ({name: np.array(getattr(plate, name)) for name in names} for plate in (before, after))

        def put(values):
            set_rest(self.model, shell, plate=values)

        put(start)
        self._changes.append((put, start, end))

    def _add_rod(self, key, rod: int, what: str, values) -> None:
        places = []
        for read, term, count, put in self._elements(rod):
            names = [
                name
                for name, strain in zip(term.rest, term.measure.strains, strict=True)
                if strain.startswith(ROD[what])
            ]
            if names:
                places.append((read, term, names, count, put))
        if not places:
            raise SceneError(f"statics: rest[{key!r}]: rod {rod} has no natural {what} that can be changed")
        for read, term, names, count, put in places:
            shape = (count, len(names)) if len(names) > 1 else (count,)
            found = arguments.broadcast(f"statics: rest[{key!r}][{what!r}]", values, shape).reshape(count, -1)
            start = {name: read(f"{term.name}.{name}") for name in names}
            self._changes.append((put, start, {name: found[:, i] for i, name in enumerate(names)}))

    def _elements(self, rod: int):
        """Of every term of a rod with rest strains: a reader of values, the term, number of its elements, and a writer."""
        model = self.model
        for group in model.groups:
            if rod not in group.host.rods:
                continue
            columns = np.flatnonzero(np.tile(group.host.rods, group.worlds) == rod)
            for term in group.kind.terms:
                if term.rest:
                    count = int(group.host.count[columns[0] % group.rods]) - (
                        0 if group.kind.closed else term.measure.span
                    )
                    yield _of_group(model, group, term, columns, count)
        for part in model.net.sets if model.net is not None else ():
            if part.term.rest and hasattr(part.host, "owner") and len(part.host.owner):
                elements = np.flatnonzero(part.host.owner[0] == rod)
                if elements.size and not part.term.measure.spins:
                    yield _of_set(model, part, elements)


def _of_group(model, group, term, columns: np.ndarray, count: int):
    def read(name):
        values = np.broadcast_to(group.parameters.values[name], (group.nodes, group.columns))
        return values[:count, columns[0]].copy()

    def put(values):
        changed = {}
        for name, own in values.items():
            name = f"{term.name}.{name}"
            full = np.array(np.broadcast_to(group.parameters.values[name], (group.nodes, group.columns)))
            full[:count, columns] = own[:, None]
            changed[name] = full
        model.note_change(group.parameters.set(**changed))

    return read, term, count, put


def _of_set(model, part, elements: np.ndarray):
    def read(name):
        values = part.parameters.values[name.rpartition(".")[2]]
        return np.broadcast_to(values, (len(values), part.elements))[0, elements].copy()

    def put(values):
        changed = {}
        for name, own in values.items():
            now = part.parameters.values[name]
            full = np.array(np.broadcast_to(now, (len(now), part.elements)))
            full[:, elements] = own
            changed[name] = full
        model.note_change(part.parameters.set(**changed))

    return read, part.term, len(elements), put
