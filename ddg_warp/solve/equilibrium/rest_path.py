"""Rest shapes as loads: growth, swelling and natural curvature in proportion to the load parameter."""

from collections.abc import Mapping

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.model.rest_shapes import set_rest

SHELL = {"points", "metric", "curvature", "angle"}
ROD = {"curvature": ("curvature", "kb"), "twist": ("twist",), "stretch": ("stretch",)}  # strains by key


class RestPath:
    """Linear path of the rest shapes of a model from the present to given rest shapes.

    Args:
        model: model to change, in every world.
        rest: changes by shell or rod, index or name. Shells take the arguments of `Model.set_rest`. Rods take "curvature" [1/m],
            "twist" [1/m] or "stretch" [1], one value or one an element (elements,), with as many components as the rod has curvatures.

    Raises:
        SceneError: an object or value does not exist or fit; nothing is changed then.
    """

    def __init__(self, model, rest: Mapping):
        if not isinstance(rest, Mapping):
            raise SceneError(f"statics: rest is {rest!r}; give a dictionary, shell or rod -> its rest shape")
        self.model, self._changes = model, []
        for key, changes in rest.items():
            if not isinstance(changes, Mapping) or not changes:
                raise SceneError(
                    f"statics: rest[{key!r}] is {changes!r}; give a dictionary such as dict(curvature=...)"
                )
            shell, rod = self._find(key, changes)
            if shell is not None:
                self._add_shell(key, shell, changes)
            else:
                for strain, values in changes.items():
                    self._add_rod(key, rod, strain, values)

    def to(self, fraction: float) -> None:
        """Set rest shapes at a fraction of the path, 0 at the start and 1 at the end."""
        for write, start, end in self._changes:
            write(
                {name: start[name] + fraction * (end[name] - start[name]) for name in end} if fraction != 1.0 else end
            )

    def _find(self, key, changes: Mapping) -> tuple[int | None, int | None]:
        """Return the index of the shell or rod of a key; changes decide if both exist."""
        scene = self.model.scene
        shells = [i for i, shell in enumerate(scene.shells) if key in (i, shell.name)]
        rods = [i for i, name in enumerate(self._rod_names()) if key == i or (name and key == name)]
        of_shell, of_rod = set(changes) <= SHELL, set(changes) <= set(ROD)
        if shells and rods and set(changes) == {"curvature"}:  # (T, 3) of a shell, or of a rod
            triangles = len(scene.shells[shells[0]].triangles)
            of_shell = np.shape(changes["curvature"]) == (triangles, 3)
            of_rod = not of_shell
        if shells and of_shell:
            return shells[0], None
        if rods and of_rod:
            return None, rods[0]
        keys = f"{sorted(SHELL)} of shells, {sorted(ROD)} of rods"
        fault = "is no shell or rod" if not (shells or rods) else f"has {sorted(changes)}; there are {keys}"
        raise SceneError(
            f"statics: rest[{key!r}] {fault}; the scene has {len(scene.shells)} shells, {scene.rod_count} rods"
        )

    def _rod_names(self) -> list[str]:
        return [batch.name for batch in self.model.scene.batches for _ in range(batch.rods)]

    def _add_shell(self, key, shell: int, changes: Mapping) -> None:
        shell_host = self.model.coupled.host.shells[shell]
        before = shell_host.plate
        try:
            set_rest(self.model, shell, **changes)
        except ValueError as error:
            raise SceneError(f"statics: rest[{key!r}]: {error}") from None
        after = shell_host.plate
        forms = {"abar": "metric", "bbar": "curvature", "angle": "angle"}
        names = [name for name in forms if getattr(after, name) is not getattr(before, name)]
        start, end = ({name: np.array(getattr(plate, name)) for name in names} for plate in (before, after))

        def put(values):
            set_rest(self.model, shell, plate=values)

        put(start)
        self._changes.append((put, start, end))

    def _add_rod(self, key, rod: int, strain_key: str, values) -> None:
        targets = []
        for read, term, count, write in self._elements(rod):
            names = [
                name
                for name, strain in zip(term.rest, term.measure.strains, strict=True)
                if strain.startswith(ROD[strain_key])
            ]
            if names:
                targets.append((read, term, names, count, write))
        if not targets:
            raise SceneError(f"statics: rest[{key!r}]: rod {rod} has no natural {strain_key} that can be changed")
        for read, term, names, count, write in targets:
            shape = (count, len(names)) if len(names) > 1 else (count,)
            target_values = argument_checks.broadcast(f"statics: rest[{key!r}][{strain_key!r}]", values, shape).reshape(
                count, -1
            )
            for name in names:
                try:
                    self.model.fields.refuse(f"statics: rest[{key!r}]", f"{term.name}.{name}")
                except ValueError as error:
                    raise SceneError(str(error)) from None
            start = {name: read(f"{term.name}.{name}") for name in names}
            self._changes.append((write, start, {name: target_values[:, i] for i, name in enumerate(names)}))

    def _elements(self, rod: int):
        """Yield (reader, term, number of elements, writer) of every term of a rod with rest strains."""
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
        for part in model.coupled.sets if model.coupled is not None else ():
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
        for name, strains in values.items():
            name = f"{term.name}.{name}"
            full = np.array(np.broadcast_to(group.parameters.values[name], (group.nodes, group.columns)))
            full[:count, columns] = strains[:, None]
            changed[name] = full
        model.note_change(group.parameters.set(**changed))

    return read, term, count, put


def _of_set(model, part, elements: np.ndarray):
    def read(name):
        values = part.parameters.values[name.rpartition(".")[2]]
        return np.broadcast_to(values, (len(values), part.elements))[0, elements].copy()

    def put(values):
        changed = {}
        for name, strains in values.items():
            stored = part.parameters.values[name]
            full = np.array(np.broadcast_to(stored, (len(stored), part.elements)))
            full[:, elements] = strains
            changed[name] = full
        model.note_change(part.parameters.set(**changed))

    return read, part.term, len(elements), put
