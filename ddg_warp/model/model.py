"""Model: a scene frozen for a device. Constant arrays, terms, dof map, and what can be asked of a state."""

from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.compile import axisymmetric
from ddg_warp.compile.chains import compile_chains
from ddg_warp.compile.conditions import scene_motions
from ddg_warp.compile.precision import choose, warn_of_rounding
from ddg_warp.errors import SceneError
from ddg_warp.geometry import polyline
from ddg_warp.io import Curves, Surfaces
from ddg_warp.kernels import element, step
from ddg_warp.model import glue, validate
from ddg_warp.model.group import Group
from ddg_warp.model.state import GroupState, State
from ddg_warp.threads import launches


@launches
class Model:
    """A built scene; see `Scene.build`.

    Attributes:
        scene: what it was built from.
        curves: rods in the user's order.
        groups: rods of one kind and similar length each; those that are part of the net are not among them.
        net: shells and what is joined, or None.
        precision: scalar types.
        worlds: number of independent copies.
        allow_rounding: whether what float32 loses in rounding is stepped and solved nevertheless.
    """

    def __init__(
        self, scene, *, device=None, precision: str | None = None, worlds: int = 1, allow_rounding: bool = False
    ):
        self.scene = scene
        self.wp_device = _device(device)
        self.types = choose(precision, self.wp_device)
        self.worlds = worlds
        self.version = 0  # rises with every change of a constant array, so that captured steps are captured anew
        self.chains = compile_chains(scene)
        self.motions = scene_motions(scene)
        self.groups = [Group(chain, scene, worlds, self.wp_device, self.types.real) for chain in self.chains]
        self.net = self._build_net() if needs_net(scene) else None
        self.allow_rounding = allow_rounding
        warn_of_rounding(self, scene.analysis)

    def _build_net(self):
        from ddg_warp.compile.net.blocks import compile_net
        from ddg_warp.model.net import DeviceNet

        supports = [*self.scene.shell_supports, *self.scene.ring_supports]
        turning = [s.motion is not None and s.motion.turns for s in supports]
        place = {id(motion): i for i, motion in enumerate(self.motions)}
        motions = [place[id(s.motion)] if turns else -1 for s, turns in zip(supports, turning, strict=True)]
        net = compile_net(self.scene, along=self.wp_device.is_cpu)
        return DeviceNet(net, self.worlds, self.wp_device, self.types.real, np.array(motions, int))

    def __repr__(self) -> str:
        scene, net = self.scene, self.net
        lines = [f"<Model on {self.device} in {self.precision}, {self.worlds} worlds of {self.points_count} points:"]
        if self.groups:
            lines.append(f"{sum(group.rods for group in self.groups)} rods of their own in {len(self.groups)} groups,")
        if net:
            rods, shells, turned = len(net.host.rods), len(net.host.shells), len(scene.axisymmetric_shells)
            lines.append(
                f"a net of {rods} rods, {shells} shells, {turned} shells of revolution ({net.host.blocks} blocks);"
            )
        return "\n ".join([*lines, "model.report() says more>"])

    @property
    def device(self) -> str:
        """Name of the Warp device."""
        return str(self.wp_device)

    @property
    def precision(self) -> str:
        """Name of the precision."""
        return self.types.name

    @cached_property
    def curves(self) -> Curves:
        """Rods, then meridians of axisymmetric shells, as thick as these."""
        batches, shells = self.scene.batches, self.scene.axisymmetric_shells
        if not batches and not shells:
            none = np.zeros(0, int)
            return Curves(none, none.astype(bool), np.zeros(0), np.zeros(0, object), none)
        counts = np.concatenate([*(np.full(b.rods, b.nodes) for b in batches), *([len(s.points)] for s in shells)])
        radius = [np.broadcast_to(_node_radius(b), (b.rods, b.nodes)).ravel() for b in batches]
        radius += [0.5 * axisymmetric.at_nodes(shell.thickness, len(shell.points)) for shell in shells]
        single = np.ones(len(shells), int)
        return Curves(
            counts=counts,
            closed=np.concatenate([*(np.full(b.rods, b.closed) for b in batches), single == 0]),
            radius=np.concatenate(radius),
            names=np.array([*(b.name for b in batches for _ in range(b.rods)), *(s.name for s in shells)], object),
            batch=np.repeat(_alike([*batches, *shells]), [*(b.rods for b in batches), *single]),
        )

    @cached_property
    def surfaces(self) -> Surfaces | None:
        """Shells as triangles among the rows of `State.points`; None without."""
        if not self.scene.shells:
            return None
        shells, rods = self.net.host.shells, int(self.curves.counts.sum())
        points = np.cumsum([0] + [len(shell.nodes) for shell in shells])
        triangles = np.cumsum([0] + [len(shell.surface.triangles) for shell in shells])
        return Surfaces(
            triangles=np.concatenate([s.surface.triangles + rods + at for s, at in zip(shells, points, strict=False)]),
            first=triangles[:-1],
            names=np.array([shell.name for shell in self.scene.shells], dtype=object),
            thickness=np.concatenate([shell.plate.thickness for shell in shells]),
        )

    @cached_property
    def net_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of `State.points` that the net fills, and the blocks that fill them."""
        if self.net is None:
            return np.zeros(0, int), np.zeros(0, int)
        start = np.concatenate([[0], np.cumsum(self.curves.counts)])
        host = self.net.host
        rows = [start[rod.rod] + np.arange(len(rod.nodes)) for rod in host.rods]
        first = len(start) - 1 - len(host.meridians)
        rows += [start[first + i] + np.arange(len(shell.nodes)) for i, shell in enumerate(host.meridians)]
        blocks = [part.nodes for part in (*host.rods, *host.meridians, *host.shells)]
        vertices = sum(len(shell.nodes) for shell in host.shells)
        return np.concatenate([*rows, start[-1] + np.arange(vertices)]).astype(int), np.concatenate(blocks)

    def places(self, group: Group) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of a group's nodes: place along the rod with ghosts, column, row of `State.points`."""
        start = np.concatenate([[0], np.cumsum(self.curves.counts)])
        return _user_index(group, group.host.own, start)

    @property
    def points_count(self) -> int:
        """Rows of `State.points` in one world."""
        vertices = 0 if self.net is None else sum(len(shell.nodes) for shell in self.net.host.shells)
        return int(self.curves.counts.sum()) + vertices

    def report(self) -> str:
        """What is in the model, what it costs, and what is left out."""
        from ddg_warp.ask.report import report

        return report(self)

    def energies(self, state: State) -> dict[str, float]:
        """Energies by term at a state [J]; see `ddg_warp.ask.inquiry`."""
        from ddg_warp.ask.inquiry import energies

        validate.check_state("energies", self, state)
        return energies(self, state)

    def reactions(self, state: State, **options) -> list:
        """Forces and moments of the supports; see `ddg_warp.ask.inquiry.reactions`."""
        from ddg_warp.ask.inquiry import reactions

        validate.check_state("reactions", self, state)
        return reactions(self, state, **options)

    def drag(self, state: State):
        """Forces and power of the drag on rods, an `inquiry.Drag`; see `ddg_warp.ask.inquiry.drag`."""
        from ddg_warp.ask.inquiry import drag

        validate.check_state("drag", self, state)
        return drag(self, state)

    def stresses(self, state: State) -> dict:
        """Axial forces and moments along the rods; see `ddg_warp.ask.inquiry.stresses`."""
        from ddg_warp.ask.inquiry import stresses

        validate.check_state("stresses", self, state)
        return stresses(self, state)

    def set_parameter(self, term: str, parameter: str, values) -> None:
        """Change a parameter of a term for all rods that have it, in every world or one by one.

        Args:
            term, parameter: names as `parameters` gives them, such as "rod_bend_twist", "stiffness_1".
            values: one number, one a world (worlds,), one an element (elements,), or (worlds, elements); elements of the longest
                rod of a group, those of clamped ends included.

        Raises:
            ValueError: nothing has the term, the term has no such parameter, or the shape or a value is wrong; nothing is changed.
        """
        parts = self.net.sets if self.net is not None else ()
        terms: dict[str, dict] = {}
        for own in (*(t for group in self.groups for t in group.kind.terms), *(part.term for part in parts)):
            terms.setdefault(own.name, {}).update({known.name: known for known in own.parameters})
        if not isinstance(term, str) or term not in terms:
            raise ValueError(
                f"set_parameter: no rod or shell has the term {term!r}; this model has {', '.join(sorted(terms))}"
            )
        known = terms[term]
        if not isinstance(parameter, str) or parameter not in known:
            raise ValueError(f"set_parameter: {term} has no parameter {parameter!r}; it has {', '.join(known)}")
        name, (rule, holds) = f"{term}.{parameter}", known[parameter].valid
        try:
            values = np.array(values, float)
        except (TypeError, ValueError):
            raise ValueError(f"{name} = {values!r}; give numbers") from None
        bad = np.flatnonzero(~(np.isfinite(values) & holds(values)))
        if bad.size:
            raise ValueError(f"{name}: value {bad[0]} is {values.ravel()[bad[0]]:g}; it is finite and {rule}")
        for group in self.groups:
            if name in group.parameters.values:
                group.set_parameter(name, values)
        for part in parts:
            if part.term.name == term and parameter in part.parameters.values:
                part.set_parameter(parameter, values)
        self.version += 1

    def set_rest(self, shell: int, *, points=None, metric=None, curvature=None, angle=None) -> None:
        """Change the rest shape of a shell in every world: growth, swelling, bilayers, creases, pre-stress.

        What is not given stays. Masses stay too, as does the direction of clamped normals. See `rest_shapes` for forms from
        principal stretches and curvatures.

        Args:
            shell: index of the shell.
            points: (P, 3) [m], a shape whose metric, curvature and angles are those at rest.
            metric: first fundamental form (T, 3) [m^2], (11, 12, 22) in the basis of the first two edges of a triangle.
            curvature: second fundamental form (T, 3) [m] in the same basis; bending "midedge_dof" and "midedge".
            angle: of the mesh edges (E,) [rad], positive where convex on the side of the normals; bending "hinge".

        Raises:
            ValueError: no such shell, a shape that does not fit, a metric without area, or what this bending model does not have.
        """
        from ddg_warp.model.rest_shapes import set_rest

        set_rest(self, shell, points=points, metric=metric, curvature=curvature, angle=angle)

    def parameters(self) -> dict[str, np.ndarray]:
        """Parameters of all terms by name, `group/term/parameter`, broadcastable to (node, column of the group).

        Of the net, `net/term/parameter`, where sets of one term with other laws are numbered from the second on, `net/term 1/...`.
        """
        result = {}
        for i, group in enumerate(self.groups):
            for name, values in group.parameters.values.items():
                result[f"{i}/{name.replace('.', '/')}"] = values
            result |= {f"{i}/mass": group.host.mass, f"{i}/rotary_inertia": group.host.rotary}
        laws: dict[str, list] = {}
        for part in self.net.sets if self.net is not None else ():
            laws.setdefault(part.term.name, []).append(part)
        for term, parts in laws.items():
            for number, part in enumerate(parts):  # rods with laws of their own have sets of their own
                place = f"net/{term}" + (f" {number}" if number else "")
                result |= {f"{place}/{name}": values for name, values in part.parameters.values.items()}
        return result

    def state(self, points=None, velocities=None, spins=None) -> State:
        """A first state: the rest state at rest, or with other positions and velocities.

        Args:
            points: positions (P, 3) or (worlds, P, 3) [m] in the order of `curves`. Reference frames are carried from rest to
                these positions, and edges glued to a shell turn with it; ghost nodes of clamped ends stay.
            velocities: (P, 3) or (worlds, P, 3) [m/s].
            spins: rate of the edges' angles (edges,) or (worlds, edges) [rad/s]; without, zero, but as the shell turns where they
                are glued.

        Raises:
            ValueError: a shape does not fit, or a value is not finite.
        """
        state = self.empty_state()
        for group, data in zip(self.groups, state.groups, strict=True):
            x = np.concatenate([group.host.x] * self.worlds, axis=1)
            if points is not None:
                self._scatter_nodes(group, points, x, "points")
            arrays.assign(data.x, x)
            if velocities is not None:
                v = np.zeros_like(x)
                self._scatter_nodes(group, velocities, v, "velocities")
                arrays.assign(data.v, v)
            if group.kind.twist:
                arrays.assign(data.frame, np.concatenate([group.host.frame] * self.worlds, axis=-1))
                if spins is not None:
                    omega = np.zeros((group.nodes, group.columns))
                    self._scatter_edges(group, spins, omega)
                    arrays.assign(data.omega, omega)
        if self.net is not None:
            state.net = self.net.rest()
            for values, array, what in ((points, state.net.q, "points"), (velocities, state.net.v, "velocities")):
                if values is not None:
                    array.assign(self._scatter_net(values, array.numpy(), what))
            if spins is not None:
                values, start = self._edge_values(spins)
                rates = state.net.v.numpy().reshape(self.worlds, -1, 3)
                for rod in self.net.host.rods:
                    rates[:, rod.edges, 0] = values[..., start[rod.rod] + np.arange(len(rod.edges))]
                state.net.v.assign(rates.reshape(-1, 3))
        if points is not None:
            self.carry_frames(state)
        if self.net is not None:
            glue.follow(self.net, state.net, angles=points is not None, rates=velocities is not None and spins is None)
        self.update_strains(state)
        return state

    def _scatter_nodes(self, group: Group, values, out: np.ndarray, what: str) -> None:
        """Put values in the user's order (P, 3) into (node, column, dim) of a group."""
        values = self._point_values(values, what)
        axes = [0, 2] if group.kind.dim == 2 else [0, 1, 2]
        k, column, index = self.places(group)
        for world in range(self.worlds):
            own = values if values.ndim == 2 else values[world]
            out[k, column + world * group.rods] = own[index][:, axes]

    def _scatter_net(self, values, blocks: np.ndarray, what: str) -> np.ndarray:
        """Blocks (worlds N, 3) with values in the user's order (P, 3) put in."""
        values = self._point_values(values, what)
        out = blocks.astype(float).reshape(self.worlds, -1, 3)
        rows, places = self.net_rows
        out[:, places] = (values if values.ndim == 3 else values[None])[:, rows]
        return out.reshape(-1, 3)

    def _point_values(self, values, what: str) -> np.ndarray:
        values, count = _numbers(what, values), self.points_count
        if values.shape not in ((count, 3), (self.worlds, count, 3)):
            raise ValueError(f"{what} have shape {values.shape}; they are ({count}, 3), or one such array a world")
        if not np.isfinite(values).all():
            raise ValueError(f"{what}: node {int(np.argwhere(~np.isfinite(values))[0][-2])} is not finite")
        return values

    def _scatter_edges(self, group: Group, values, out: np.ndarray) -> None:
        values, start = self._edge_values(values)
        own = group.host.own - (0 if group.kind.closed else 1)
        k, column, index = _user_index(group, own, start)
        for world in range(self.worlds):
            out[k, column + world * group.rods] = (values if values.ndim == 1 else values[world])[index]

    def _edge_values(self, values) -> tuple[np.ndarray, np.ndarray]:
        """Spins in the user's order, checked, and where the edges of each rod begin."""
        counts = self.curves.counts - np.where(self.curves.closed, 0, 1)
        values = _numbers("spins", values)
        if values.shape not in ((counts.sum(),), (self.worlds, counts.sum())):
            raise ValueError(f"spins have shape {values.shape}; they are ({counts.sum()},), or one such array a world")
        if not np.isfinite(values).all():
            raise ValueError(f"spins: edge {int(np.argwhere(~np.isfinite(values))[0][-1])} is not finite")
        return values, np.concatenate([[0], np.cumsum(counts)])

    def empty_state(self) -> State:
        """Arrays of a state, not yet filled."""
        net = self.net.empty() if self.net is not None else None
        return State(self, [self._group_state(group) for group in self.groups], net)

    def restore(self, snapshot: dict[str, np.ndarray]) -> State:
        """The state that `State.snapshot` saved, bit by bit.

        Raises:
            ValueError: the snapshot is of another model.
        """
        if not isinstance(snapshot, dict):
            raise ValueError(f"restore: {type(snapshot).__name__} is no snapshot; give what state.snapshot() returns")
        state = self.empty_state()
        names = {"time"} | {f"{part}/{name}" for part, data in state.parts().items() for name in data.arrays()}
        if names ^ set(snapshot):
            raise ValueError(f"snapshot is of another model: it differs by {', '.join(sorted(names ^ set(snapshot)))}")
        for part, data in state.parts().items():
            for name, array in data.arrays().items():
                values = np.asarray(snapshot[f"{part}/{name}"])
                if values.shape[: array.ndim] != array.shape:
                    raise ValueError(
                        f"snapshot is of another model: {name} has shape {values.shape}, not {array.shape}"
                    )
                arrays.assign(array, values)
        state.time = float(snapshot["time"])
        return state

    def _group_state(self, group: Group) -> GroupState:
        kind, real = group.kind, self.types.real
        vector = wp.types.vector(kind.dim, real)
        nodes = (group.nodes, group.columns)

        def make(shape, dtype, needed=True):
            return arrays.allocate(shape if needed else (1,) * len(shape), dtype, self.wp_device)

        return GroupState(
            x=make(nodes, vector),
            v=make(nodes, vector),
            theta=make(nodes, real, kind.twist),
            omega=make(nodes, real, kind.twist),
            frame=make((7, *nodes), real, kind.twist),
            last=make((kind.strain_rows, *nodes), real, kind.viscous),
        )

    def carry_frames(self, state: State) -> None:
        """Transport the reference frames of a state to its current tangents."""
        for group, data in zip(self.groups, state.groups, strict=True):
            if group.kind.twist:
                new = arrays.allocate(data.frame.shape, self.types.real, self.wp_device)
                every = wp.full(group.columns, 1, dtype=int, device=self.wp_device)
                wp.launch(
                    step.finish_frames_kernel(group.kind, self.types.real),
                    group.element_threads,
                    [data.x, data.frame, data.frame, group.count, every],
                    [new],
                    device=self.wp_device,
                )
                wp.copy(data.frame, new)
        if self.net is not None:
            self.net.carry(state.net, state.net)

    def update_strains(self, state: State) -> None:
        """Store the strains of a state where strain-rate damping looks for them."""
        for group, data in zip(self.groups, state.groups, strict=True):
            if group.kind.viscous:
                self.strains(group, data, data.last)
        if self.net is not None:
            self.net.update_strains(state.net)

    def strains(self, group: Group, data: GroupState, out: wp.array, stress: wp.array | None = None) -> None:
        """Launch the strain kernel of a group; stresses go to `stress`, if given (viscous parts at rest). Can be captured."""
        wp.launch(
            element.strain_kernel(group.kind, self.types.real),
            (group.elements, group.columns),
            [data.x, data.theta, data.frame, data.last, group.still, *group.parameters.arrays, group.count]
            + [int(stress is not None)],
            [out, out if stress is None else stress],
            device=self.wp_device,
        )

    def gather_nodes(self, values: list[np.ndarray], blocks: wp.array | None = None) -> np.ndarray:
        """From arrays (node, column, dim) of groups and blocks of the net (worlds N, 3) to the user's order, in three dimensions."""
        start = np.concatenate([[0], np.cumsum(self.curves.counts)])
        out = np.zeros((self.worlds, self.points_count, 3))
        if blocks is not None:
            rows, places = self.net_rows
            out[:, rows] = np.asarray(blocks.numpy() if isinstance(blocks, wp.array) else blocks).reshape(
                self.worlds, -1, 3
            )[:, places]
        for group, value in zip(self.groups, values, strict=True):
            axes = [0, 2] if group.kind.dim == 2 else [0, 1, 2]
            k, column, index = _user_index(group, group.host.own, start)
            for world in range(self.worlds):
                out[world][index[:, None], axes] = value[k, column + world * group.rods]
        return out[0] if self.worlds == 1 else out

    def gather_angles(self, state: State) -> np.ndarray | None:
        """Angles of all edges of rods; see `State.angles`."""
        net = None
        if self.net is not None and self.net.edges:
            net = state.net.q.numpy().reshape(self.worlds, -1, 3)[:, self.net.angle_start :, 0]
        return self.gather_edges([arrays.download(data.theta) for data in state.groups], net)

    def gather_edges(self, values: list[np.ndarray], net: np.ndarray | None = None, width: int = 0):
        """From arrays (node, column) of every group and values of the net's rod edges (worlds, edges) to the user's order."""
        if not any(group.kind.twist for group in self.groups) and net is None:
            return None
        counts = self.curves.counts - np.where(self.curves.closed, 0, 1)
        start = np.concatenate([[0], np.cumsum(counts)])
        out = np.zeros((self.worlds, start[-1], *([width] if width else [])))
        for group, value in zip(self.groups, values, strict=True):
            if group.kind.twist:
                own = group.host.own - (0 if group.kind.closed else 1)
                k, column, index = _user_index(group, own, start)
                for world in range(self.worlds):
                    out[world][index] = value[k, column + world * group.rods]
        for rod in self.net.host.rods if net is not None else ():
            rows = start[rod.rod] + np.arange(len(rod.edges))
            out[:, rows] = net[:, rod.edges - self.net.angle_start]
        return out[0] if self.worlds == 1 else out

    def gather_directors(self, state: State) -> np.ndarray | None:
        """First material directors of a state; see `State.directors`."""
        values, net = [], None
        if self.net is not None and self.net.edges:
            frame = np.moveaxis(state.net.frame.numpy().reshape(6, self.worlds, -1), 0, -1)
            angle = state.net.q.numpy().reshape(self.worlds, -1, 3)[:, self.net.angle_start :][:, : self.net.edges, 0]
            u, t = frame[..., :3], frame[..., 3:]
            net = polyline.material_directors(u, t, angle)
        for group, data in zip(self.groups, state.groups, strict=True):
            if not group.kind.twist:
                values.append(np.zeros(0))
                continue
            frame, theta = arrays.download(data.frame), arrays.download(data.theta)
            u, t = np.moveaxis(frame[0:3], 0, -1), np.moveaxis(frame[3:6], 0, -1)
            values.append(polyline.material_directors(u, t, theta))
        return self.gather_edges(values, net, 3)


def _device(name):
    """A Warp device by its name; by default CUDA if there is one."""
    try:
        return wp.get_device(name or ("cuda:0" if wp.is_cuda_available() else "cpu"))
    except (ValueError, RuntimeError, TypeError, AttributeError):
        known = ", ".join(device.alias for device in wp.get_devices())
        raise SceneError(f"device is {name!r}; there is {known}") from None


def _numbers(what: str, values) -> np.ndarray:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise ValueError(f"{what} are no array of numbers: {values!r}") from None


def needs_net(scene) -> bool:
    """Whether a scene has anything but rods on their own."""
    return bool(scene.shells or scene.joints or scene.attachments or scene.magnets or scene.axisymmetric_shells)


def _node_radius(batch) -> np.ndarray:
    radius = np.asarray(batch.section.radius, float)
    if radius.ndim == 0 or radius.shape[-1] == 1:
        return radius
    return 0.5 * (np.concatenate([radius[..., :1], radius], -1) + np.concatenate([radius, radius[..., -1:]], -1))


def _alike(parts) -> list[int]:
    """Number of the first part with the same name and stiffness; of shells of revolution their own."""
    seen: dict = {}
    keys = [(part.name, _hashable(part.section)) if hasattr(part, "section") else id(part) for part in parts]
    return [seen.setdefault(key, len(seen)) for key in keys]


def _hashable(section) -> tuple:
    """The numbers of a section, to be compared."""
    return tuple(
        np.asarray(value, dtype=object if value is None else float).tobytes() for value in vars(section).values()
    )


def _user_index(group: Group, own: np.ndarray, start: np.ndarray):
    """For nodes or edges of a group's rods: place along the rod with ghosts, column, place in the user's order."""
    column = np.repeat(np.arange(group.rods), own)
    at = np.arange(own.sum()) - np.repeat(np.concatenate([[0], np.cumsum(own)[:-1]]), own)
    return at + group.host.first[column], column, at + start[group.host.rods[column]]
