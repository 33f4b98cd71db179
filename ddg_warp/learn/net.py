"""Reverse of a step of a net; see `ddg_warp.learn.adjoint`."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import warp as wp

from ddg_warp.compile.storage import FREE
from ddg_warp.kernels.adjoint import net as reverse
from ddg_warp.kernels.drag import block_inertia
from ddg_warp.kernels.net.elements import FRAME
from ddg_warp.learn.drag import NetDragAdjoint
from ddg_warp.learn.followers import Followers
from ddg_warp.learn.net_predictor import NetPredictor
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
    retries: wp.array | None = None
    time: float = 0.0

    @property
    def frame(self) -> wp.array:
        """Lagged frames at the solution."""
        return self.solved.frame


@dataclass
class NetInputs:
    """Derivatives by what a step of a net read beside its state.

    Attributes:
        parameters: of every element set (parameters, W E); data, end_data: by its constant data in the solve and at the end of the step
            (rows, W E).
        mass: by the masses of the dofs of blocks (W N,); load: by the forces on them, zero at held dofs.
        held: by where held dofs are at the solution (W N,).
        rate, damping, gravity: by what all blocks share, the share of each (W N,).
    """

    parameters: list[wp.array] = field(default_factory=list)
    data: list[wp.array] = field(default_factory=list)
    end_data: list[wp.array] = field(default_factory=list)
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
        scheme, posed: as of `ChainAdjoint`.

    Raises:
        SceneError: a motion has no gradient; see `Supports`.
    """

    def __init__(self, model, scheme: str | None, posed: bool = False):
        net, real = model.net, model.types.real
        self.model, self.net, self.real, self.device = model, net, real, model.wp_device
        self.solve = HostSolve(NetTangent(model, 0))
        host = net.host
        midpoint = scheme == "implicit_midpoint"
        self.supports = Supports(model, net, midpoint) if (scheme or posed) and host.moves else None
        motion = self.supports.motion if self.supports else None
        self._midpoint, drag = midpoint, bool(host.drag and scheme)
        self.followers = Followers(model, net, midpoint) if host.followers and scheme else None
        self.predictor = NetPredictor.of(model, net, motion, scheme)
        self._mass = wp.array(host.mass, dtype=net.vector, device=self.device)
        self._gravity = wp.array(np.array(model.scene.gravity, float)[None], dtype=net.vector, device=self.device)
        self._damping = wp.array([model.scene.mass_damping], dtype=real, device=self.device)
        self._pull = [reverse.pull_kernel(part.term, real) for part in net.sets]
        self._strains = [reverse.strain_kernel(p.term, real) if p.term.density.lagged else None for p in net.sets]
        self._lags = [reverse.lag_kernel(p.term, real) if p.term.measure.advance else None for p in net.sets]
        self._frame = reverse.frame_kernel(real)
        self._slots, self._frames = reverse.gather_kernels(real)
        self._solution, self._start = reverse.step_kernels(real, midpoint, drag)
        self.drag = NetDragAdjoint(model, net, midpoint, self._slots) if drag else None
        self._inertia = self.drag.inertia if drag else wp.zeros((1, 1), dtype=block_inertia(real), device=self.device)
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

    def suit(self, step, s: float) -> bool:
        """As of `ChainAdjoint`, of a `NetStep`."""
        return self.predictor is not None and self.predictor.suit(step, s)

    def upload(self, t0: float, t1: float) -> None:
        """As of `ChainAdjoint`."""
        for part in filter(None, (self.supports, self.followers, self.drag and self.drag.drag)):
            part.upload(t0, t1)

    def lagged(self, before: NetState, states=None) -> wp.array:
        """As of `ChainAdjoint`."""
        if self.predictor is None:
            return before.frame
        if self.supports:
            self.supports.follow(*states)
        self.predictor.find(before)
        return self.predictor.state.frame

    def keep(self, step, before: NetState) -> NetKept:
        """What the step that a `NetStep` has just made leaves for its reverse; `before` has to stay as it is."""
        net, q = self.net, wp.clone(step.newton.q)
        data = {index: wp.clone(values) for index, values in step._data.items()}
        solved = replace(before, q=q, data=data)
        if net.edges:
            frame, lag = step._lagged
            solved = replace(solved, frame=wp.clone(frame), lag=[wp.clone(values) for values in lag])
        islands = step.islands
        return NetKept(before, solved, wp.clone(islands.portion), wp.clone(islands.retries))

    def pull(
        self, kept: NetKept, after: NetState, given: NetState, s: float, states=None
    ) -> tuple[NetState, NetInputs]:
        """As `ChainAdjoint.pull`."""
        net, solved, before = self.net, kept.solved, kept.before
        rate = 1.0 / s
        start, inputs = net.empty(), NetInputs()
        by_end, by_q = wp.zeros_like(solved.q), wp.zeros_like(solved.q)
        frame = self._rows(FRAME, net.edges)
        inputs.parameters = [self._rows(len(part.term.parameter_names), part.elements) for part in net.sets]
        inputs.data, inputs.end_data = (
            [self._rows(part.term.measure.data_size, part.elements) for part in net.sets] for _ in range(2)
        )
        last = net.blocks - net.host.spins
        wp.copy(frame, given.frame)
        # strains of the end, which the next step is damped from
        slots, lags = self._shares()
        for i, kernel in enumerate(self._strains):
            if kernel:
                read = [net.elements(after, i), given.last[i]]
                self._over(i, kernel, read, [slots[i], lags[i], inputs.parameters[i]])
        self._collect(slots, lags, by_end, frame, inputs.end_data)
        ended, predictor, by_predicted, tangents = solved.q, self.predictor, None, before.q
        if predictor:
            self.lagged(before, states)
            lagged, by_predicted = predictor.state, predictor.by_q
            by_predicted.zero_()
            tangents = lagged.q if self._midpoint else tangents
            solved = replace(solved, frame=lagged.frame, lag=lagged.lag)
        if self._midpoint:
            ended = wp.map(wp.add, solved.q, wp.map(wp.sub, solved.q, before.q))
        carried, own = self._uncarried(solved, after, ended, frame, given.lag, lags, by_end, inputs.end_data)
        # the solve
        if self.drag:
            self.drag.resist(before, tangents, rate)
        self._launch(
            self._solution, len(by_q), [given.q, given.v, by_end, self._inertia, rate, last, net.blocks], [by_q]
        )
        w = self._solved(kept, solved, before, rate, by_q)
        slots, lags = self._shares()
        rates = wp.full(net.worlds, rate, dtype=self.real, device=self.device)
        for i, (part, kernel) in enumerate(zip(net.sets, self._pull, strict=True)):
            by_rate = wp.zeros(part.elements * net.worlds, dtype=self.real, device=self.device)
            at = net.elements(replace(solved, last=before.last), i, rate=rates)
            self._over(i, kernel, [at, w], [slots[i], lags[i], inputs.parameters[i], start.last[i], by_rate])
            inputs.elements_rate.append(by_rate)
        self._collect(slots, lags, by_q, carried, inputs.data)
        if self.solve.held is not None:
            wp.map(wp.add, by_q, self._upload(self.solve.tangent.back(self.solve.held)), out=by_q)
        own = [self._own(i, lag, more) for i, (lag, more) in enumerate(zip(lags, own, strict=True))]
        if self.supports:
            self.supports.follow(*states)
            frame, by_frame = (net.frames(array) for array in (solved.frame, carried))
            held, angle = net.components(by_q), net.angles(by_q)
            self.supports.pull(net.points(solved.q), frame, held, angle, by_frame)
        count = len(by_q)
        inputs.rate, inputs.damping = (wp.zeros(count, dtype=self.real, device=self.device) for _ in range(2))
        if self.drag:
            by_tangents = by_predicted if self._midpoint else start.q
            read = before, tangents, solved.q, w, rate, by_q, start, inputs.rate
            self.drag.pull(*read, by_tangents)
        if self.followers:
            of = net.components(w), net.angles(w), net.components(by_predicted)
            self.followers.pull(net.points(lagged.q), *of)
        if predictor:
            if predictor.carries:
                _, lags = self._shares()
                read = before, lagged, lagged.q, carried, own, lags, by_predicted, inputs.data
                carried, own = self._uncarried(*read)
            predictor.pull(before, by_q, start, inputs.rate)
        start.frame, start.lag = carried, own
        inputs.mass, inputs.load, inputs.held, inputs.gravity = wp.zeros_like(by_q), w, by_q, wp.zeros_like(by_q)
        self._launch(
            self._start,
            count,
            [given.q, given.v, by_end, solved.q, before.q, before.v, w, self._stays(by_q), self._inertia, self._mass]
            + [self._gravity, net.host.nodes, last, net.blocks, rate, self._damping],
            [start.q, start.v, inputs.mass, inputs.rate, inputs.damping, inputs.gravity],
        )
        return start, inputs

    def _uncarried(
        self, before: NetState, after: NetState, q: wp.array, frame: wp.array, given: list, lags: list, by_q, by_data
    ) -> tuple[wp.array, list[wp.array]]:
        """Reverse of `DeviceNet.carry`: from derivatives by lagged data of `after` to those by the data of `before`, which it returns,
        by the blocks q, which are added to `by_q`, and by constant data, which are added to `by_data`.

        Args:
            frame: by the frames of `after`, added to; given: by own lagged rows, beside what `lags`, shares of elements, bring of them.
        """
        net = self.net
        by_lag = [self._own(i, lag, given[i]) for i, lag in enumerate(lags)]
        slots, lags = self._shares()
        for i, kernel in enumerate(self._lags):
            if kernel:
                at = net.elements(after, i, q)
                at.lag = before.lag[i]
                self._over(i, kernel, [at, by_lag[i]], [slots[i], lags[i]])
        self._collect(slots, lags, by_q, frame, by_data)
        carried = self._rows(FRAME, net.edges)
        if net.edges:
            ends = wp.zeros((2, net.edges * net.worlds), dtype=net.vector, device=self.device)
            read = [q, net.ends, net.blocks, before.frame, frame]
            self._launch(self._frame, net.edges * net.worlds, read, [ends, carried])
            starts, items, count = self._edges
            self._launch(self._slots, len(by_q), [starts, items, count, net.blocks, ends], [by_q])
        return carried, [self._own(i, lag) for i, lag in enumerate(lags)]

    def _shares(self) -> tuple[list[wp.array], list[wp.array]]:
        """What slots and lagged data of every set bring, nothing yet."""
        slots, lags = [], []
        for part in self.net.sets:
            measure, count = part.term.measure, part.elements * self.net.worlds
            slots.append(wp.zeros((measure.slots, count), dtype=self.net.vector, device=self.device))
            lags.append(self._rows(measure.lag_size + measure.data_size, part.elements))
        return slots, lags

    def _collect(self, slots, lags, by_q: wp.array, frame: wp.array, by_data: list) -> None:
        """Add shares to the blocks, frames and constant data that they belong to."""
        net = self.net
        for i, (part, slot, lag) in enumerate(zip(net.sets, slots, lags, strict=True)):
            starts, items, count = self._meets[i]
            self._launch(self._slots, len(by_q), [starts, items, count, net.blocks, slot], [by_q])
            if self._framed[i]:
                starts, items, count = self._framed[i]
                self._launch(self._frames, net.edges * net.worlds, [starts, items, count, net.edges, lag], [frame])
            size, data = part.term.measure.lag_size, by_data[i]
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
        more = self.drag.matrix if self.drag else None
        w = self.solve(state, rate, coefficient, None if rate else kept.time, right, more)
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


def _moved(host) -> np.ndarray:
    """Which dofs of a world motions put in place (blocks, 3)."""
    moved = np.zeros((host.blocks, 3), bool)
    moved[host.moving[:, 0]] = host.moving[:, 1:] > FREE
    moved[host.turning[:, 0], 0] = True
    return moved
