"""Reverse of a step of a net; see `ddg_warp.learn.adjoint`."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import warp as wp

from ddg_warp.compile.storage import FREE
from ddg_warp.errors import SceneError
from ddg_warp.kernels.adjoint import net as reverse
from ddg_warp.kernels.net.elements import FRAME
from ddg_warp.learn.solve import HostSolve
from ddg_warp.learn.supports import Supports
from ddg_warp.model.net import NetState
from ddg_warp.solve.net.system import lists
from ddg_warp.solve.net.tangent import NetTangent


@dataclass
class NetKept:
    """What the reverse of a step reads of it: the state `before`, and the solution of its solve with its lagged data."""

    before: NetState
    solved: NetState
    whole: wp.array | None
    time: float = 0.0

    @property
    def frames(self) -> tuple[wp.array, wp.array]:
        """As of `Kept`."""
        return self.before.frame, self.solved.frame


@dataclass
class NetInputs:
    """Derivatives by what a step of a net read beside its state.

    Attributes:
        parameters: of every element set (parameters, W E); data: by its constant data (rows, W E).
        mass: by the masses of the dofs of blocks (W N,); load: by the forces on them, zero at held dofs.
        held: by where held dofs are at the solution (W N,).
        rate, damping, gravity: by what all blocks share, the share of each (W N,).
    """

    parameters: list[wp.array] = field(default_factory=list)
    data: list[wp.array] = field(default_factory=list)
    mass: wp.array | None = None
    load: wp.array | None = None
    held: wp.array | None = None
    rate: wp.array | None = None
    damping: wp.array | None = None
    gravity: wp.array | None = None
    elements_rate: list[wp.array] = field(default_factory=list)


class NetAdjoint:
    """Reverse of the steps of a model's net, and of its equilibria.

    Args:
        scheme: of the steps, None for equilibria.

    Raises:
        SceneError: the net has what no gradient goes through.
    """

    def __init__(self, model, scheme: str | None):
        net, real = model.net, model.types.real
        self.model, self.net, self.real, self.device = model, net, real, model.wp_device
        _refuse(model, scheme)
        self.solve = HostSolve(NetTangent(model, 0))
        host = net.host
        self.supports = Supports(model, net) if scheme and host.moves else None
        self._mass = wp.array(host.mass, dtype=net.vector, device=self.device)
        self._gravity = wp.array(np.array(model.scene.gravity, float)[None], dtype=net.vector, device=self.device)
        self._damping = wp.array([model.scene.mass_damping], dtype=real, device=self.device)
        self._pull = [reverse.pull_kernel(part.term, real) for part in net.sets]
        self._strains = [reverse.strain_kernel(p.term, real) if p.term.density.lagged else None for p in net.sets]
        self._lags = [reverse.lag_kernel(p.term, real) if p.term.measure.advance else None for p in net.sets]
        self._frame = reverse.frame_kernel(real)
        self._slots, self._frames = reverse.gather_kernels(real)
        self._solution, self._start = reverse.step_kernels(real, scheme == "implicit_midpoint")
        self._meets = [self._list(part.host.slots, host.blocks) for part in net.sets]
        self._edges = self._list(np.reshape(host.ends, (-1, 2)).T, host.blocks) if net.edges else None
        self._framed = []  # of the frames that elements read
        for part in net.sets:
            measure = part.term.measure
            angles = part.host.slots[measure.nodes : measure.nodes + measure.frames] - host.nodes
            self._framed.append(self._list(angles, net.edges) if measure.frames else None)
        self._unmoved = ~self.solve.tangent.free & ~np.tile(_moved(host).ravel(), net.worlds)

    def _list(self, targets: np.ndarray, count: int) -> tuple[wp.array, wp.array, int]:
        """Starts and items of what comes to each of `count` targets, and how many elements there are."""
        starts, items = lists(targets.ravel(), count)
        upload = (wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=self.device) for v in (starts, items))
        return *upload, targets.shape[1]

    def keep(self, step, before: NetState) -> NetKept:
        """What the step that a `NetStep` has just made leaves for its reverse; `before` has to stay as it is."""
        net, q = self.net, wp.clone(step.newton.q)
        data = {index: wp.clone(values) for index, values in step._data.items()}
        solved = replace(before, q=q, data=data)
        if net.edges:
            frame, lag = step._lagged
            solved = replace(solved, frame=wp.clone(frame), lag=[wp.clone(values) for values in lag])
        return NetKept(before, solved, wp.clone(step.islands.portion))

    def pull(
        self, kept: NetKept, after: NetState, given: NetState, s: float, states=None
    ) -> tuple[NetState, NetInputs]:
        """As `ChainAdjoint.pull`."""
        net, solved, before = self.net, kept.solved, kept.before
        rate = 1.0 / s
        start, inputs = net.empty(), NetInputs()
        by_end, by_q = wp.zeros_like(solved.q), wp.zeros_like(solved.q)
        frame, carried = self._rows(FRAME, net.edges), self._rows(FRAME, net.edges)
        inputs.parameters = [self._rows(len(part.term.parameter_names), part.elements) for part in net.sets]
        inputs.data = [self._rows(part.term.measure.data_size, part.elements) for part in net.sets]
        last = net.blocks - net.host.spins
        wp.copy(frame, given.frame)
        # strains of the end, which the next step is damped from
        slots, lags = self._shares()
        for i, kernel in enumerate(self._strains):
            if kernel:
                read = [net.elements(after, i), given.last[i]]
                self._over(i, kernel, read, [slots[i], lags[i], inputs.parameters[i]])
        self._collect(slots, lags, by_end, frame, inputs)
        # own lagged rows of the end, whose frames are as new
        by_lag = [self._own(i, lag, given.lag[i]) for i, lag in enumerate(lags)]
        slots, lags = self._shares()
        for i, kernel in enumerate(self._lags):
            if kernel:
                at = net.elements(after, i, solved.q)
                at.lag = solved.lag[i]
                self._over(i, kernel, [at, by_lag[i]], [slots[i], lags[i]])
        self._collect(slots, lags, by_end, frame, inputs)
        own = [self._own(i, lag) for i, lag in enumerate(lags)]
        if net.edges:
            ends = wp.zeros((2, net.edges * net.worlds), dtype=net.vector, device=self.device)
            read = [solved.q, net.ends, net.blocks, solved.frame, frame]
            self._launch(self._frame, net.edges * net.worlds, read, [ends, carried])
            starts, items, count = self._edges
            self._launch(self._slots, len(by_q), [starts, items, count, net.blocks, ends], [by_end])
        # the solve
        self._launch(self._solution, len(by_q), [given.q, given.v, by_end, rate, last, net.blocks], [by_q])
        w = self._solved(kept, solved, before, rate, by_q)
        slots, lags = self._shares()
        rates = wp.full(net.worlds, rate, dtype=self.real, device=self.device)
        for i, (part, kernel) in enumerate(zip(net.sets, self._pull, strict=True)):
            by_rate = wp.zeros(part.elements * net.worlds, dtype=self.real, device=self.device)
            at = net.elements(replace(solved, last=before.last), i, rate=rates)
            self._over(i, kernel, [at, w], [slots[i], lags[i], inputs.parameters[i], start.last[i], by_rate])
            inputs.elements_rate.append(by_rate)
        self._collect(slots, lags, by_q, carried, inputs)
        start.lag = [self._own(i, lag, more) for i, (lag, more) in enumerate(zip(lags, own, strict=True))]
        start.frame = carried
        if self.supports:
            frame, by_frame = (net.frames(array) for array in (solved.frame, carried))
            held, angle = net.components(by_q), net.angles(by_q)
            self.supports.pull(*states, net.points(solved.q), frame, held, angle, by_frame)
        count = len(by_q)
        inputs.mass, inputs.load, inputs.held, inputs.gravity = wp.zeros_like(by_q), w, by_q, wp.zeros_like(by_q)
        inputs.rate, inputs.damping = (wp.zeros(count, dtype=self.real, device=self.device) for _ in range(2))
        self._launch(
            self._start,
            count,
            [given.q, given.v, by_end, solved.q, before.q, before.v, w, self._stays(by_q), self._mass]
            + [self._gravity, net.host.nodes, last, net.blocks, rate, self._damping],
            [start.q, start.v, inputs.mass, inputs.rate, inputs.damping, inputs.gravity],
        )
        return start, inputs

    def _shares(self) -> tuple[list[wp.array], list[wp.array]]:
        """What slots and lagged data of every set bring, nothing yet."""
        slots, lags = [], []
        for part in self.net.sets:
            measure, count = part.term.measure, part.elements * self.net.worlds
            slots.append(wp.zeros((measure.slots, count), dtype=self.net.vector, device=self.device))
            lags.append(self._rows(measure.lag_size + measure.data_size, part.elements))
        return slots, lags

    def _collect(self, slots, lags, by_q: wp.array, frame: wp.array, inputs: NetInputs) -> None:
        """Add shares to the blocks, frames and constant data that they belong to."""
        net = self.net
        for i, (part, slot, lag) in enumerate(zip(net.sets, slots, lags, strict=True)):
            starts, items, count = self._meets[i]
            self._launch(self._slots, len(by_q), [starts, items, count, net.blocks, slot], [by_q])
            if self._framed[i]:
                starts, items, count = self._framed[i]
                self._launch(self._frames, net.edges * net.worlds, [starts, items, count, net.edges, lag], [frame])
            size, data = part.term.measure.lag_size, inputs.data[i]
            if part.term.measure.data_size:
                wp.map(wp.add, lag[size:], data, out=data)

    def _own(self, index: int, lag: wp.array, more: wp.array | None = None) -> wp.array:
        """Own rows among shares of lagged data, to which `more` is added."""
        measure = self.net.sets[index].term.measure
        if not measure.advance:
            return self._rows(1, 0)
        rows = wp.clone(lag[FRAME * measure.frames : measure.lag_size])
        if more is not None:
            wp.map(wp.add, rows, more, out=rows)
        return rows

    def _solved(self, kept, solved, before, rate: float, by_q: wp.array) -> wp.array:
        tangent = self.solve.tangent
        coefficient = rate * (rate + self.model.scene.mass_damping)
        right = tangent.into(by_q.numpy().astype(float).ravel())
        state = SimpleNamespace(net=replace(solved, last=before.last))
        w = self.solve(state, rate, coefficient, None if rate else kept.time, right)
        return self._upload(tangent.back(w))

    def _stays(self, by_q: wp.array) -> wp.array:
        """The part of derivatives by held dofs that goes to where the step starts."""
        tangent = self.solve.tangent
        values = tangent.into(by_q.numpy().astype(float).ravel())
        return self._upload(tangent.back(np.where(self._unmoved, values, 0.0)))

    def _upload(self, values: np.ndarray) -> wp.array:
        return wp.array(values.reshape(-1, 3), dtype=self.net.vector, device=self.device)

    def _rows(self, rows: int, elements: int) -> wp.array:
        shape = (max(1, rows), max(1, elements * self.net.worlds))
        return wp.zeros(shape, dtype=self.real, device=self.device)

    def _over(self, index: int, kernel, inputs: list, outputs: list) -> None:
        self._launch(kernel, self.net.sets[index].elements * self.net.worlds, inputs, outputs)

    def _launch(self, kernel, count: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, count, inputs, outputs, device=self.device)


def _refuse(model, scheme: str | None) -> None:
    """What has no gradient yet says so."""
    host = model.net.host
    for there, what in (
        (host.drag and scheme, "drag"),
        (host.followers and scheme, "a load that follows what it acts on"),
        (model.net.edges and scheme == "implicit_midpoint", "the midpoint rule with rods that twist"),
    ):
        if there:
            raise SceneError(f"the net: no gradient goes through {what} yet; leave it out, or take differences")


def _moved(host) -> np.ndarray:
    """Which dofs of a world motions put in place (blocks, 3)."""
    moved = np.zeros((host.blocks, 3), bool)
    moved[host.moving[:, 0]] = host.moving[:, 1:] > FREE
    moved[host.turning[:, 0], 0] = True
    return moved
