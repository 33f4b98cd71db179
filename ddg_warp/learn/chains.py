"""Reverse of a step of a group of rods on their own; see `ddg_warp.learn.adjoint`."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.compile.storage import FREE
from ddg_warp.errors import SceneError
from ddg_warp.kernels.adjoint import chain, step
from ddg_warp.learn.solve import ChainSolve
from ddg_warp.model.state import GroupState


@dataclass
class Kept:
    """What the reverse of a step reads of it.

    Attributes:
        before: the state that it started from.
        x, theta: the solution of its solve; frame: the lagged frames at it.
        whole: of every rod, the part of the step that its last solve was about.
        time: load parameter of an equilibrium.
    """

    before: GroupState
    x: wp.array
    theta: wp.array
    frame: wp.array
    whole: wp.array | None
    time: float = 0.0


@dataclass
class ChainInputs:
    """Derivatives by what a step of a group read beside its state, of every element, node or rod.

    Attributes:
        parameters: (rows of the parameter table, n, R); mass, rotary: of nodes and edges (n, R).
        load: by the forces on nodes and the moments on angles (block, n, R); zero at held dofs.
        held: by where held dofs are at the solution (block, n, R).
        rate, damping, gravity: by what all nodes share, the share of each (n, R).
    """

    parameters: wp.array
    mass: wp.array
    rotary: wp.array
    load: wp.array
    held: wp.array
    rate: wp.array
    damping: wp.array
    gravity: wp.array


class ChainAdjoint:
    """Reverse of the steps of a group of rods, and of their equilibria.

    Args:
        scheme: of the steps, None for equilibria.

    Raises:
        SceneError: the rods have what no gradient goes through.
    """

    def __init__(self, model, group, scheme: str | None):
        self.group, self.model = group, model
        real, kind, device = model.types.real, group.kind, model.wp_device
        _refuse(group, scheme)
        self.device, self.real = device, real
        self.vector = wp.types.vector(kind.dim, real)
        self.solve = ChainSolve(model, group)
        terms = range(len(kind.terms))
        self._pull = [chain.pull_kernel(kind, i, real) for i in terms]
        self._strain = [chain.strain_kernel(kind, i, real) for i in terms] if kind.viscous else []
        self._frame = chain.frame_kernel(kind, real) if kind.twist else None
        self._nodes, self._edges = chain.gather_kernels(kind, real)
        self._solution, self._start = step.step_kernels(kind, real, scheme == "implicit_midpoint")
        self._rows = sum(len(term.parameter_names) for term in kind.terms)
        self._moved = arrays.upload(np.tile(_moved(group), (1, group.worlds)), wp.uint8, device)
        self._rate = wp.zeros(group.columns, dtype=real, device=device)
        self._damping = wp.array([model.scene.mass_damping], dtype=real, device=device)

    def keep(self, step, before: GroupState) -> Kept:
        """What the step that a `ChainStep` has just made leaves for its reverse; `before` has to stay as it is."""
        newton, twist = step.newton, self.group.kind.twist
        theta, frame = (wp.clone(newton.theta), wp.clone(newton.frame)) if twist else (newton.theta, newton.frame)
        return Kept(before, wp.clone(newton.x), theta, frame, wp.clone(step.islands.portion))

    def pull(self, kept: Kept, after: GroupState, given: GroupState, s: float) -> tuple[GroupState, ChainInputs]:
        """Derivatives by the start of a step, and by what else it read.

        Args:
            after: the state that it led to.
            given: derivatives by that state.
            s: length of the implicit Euler step that it solved [s].
        """
        group, kind = self.group, self.group.kind
        before = kept.before
        window, lag, parameters = self._zeros(kind.window), self._zeros(13), self._zeros(self._rows)
        dof = self._zeros(kind.block)
        frame, by_frame = self._zeros(7, kind.twist), given.frame
        last = self._zeros(kind.strain_rows, kind.viscous)
        self._rate.fill_(1.0 / s)
        if kind.viscous:
            # strains of the end, which the next step is damped from
            for kernel in self._strain:
                read = [after.x, after.theta, after.frame, after.last, group.still]
                self._launch(kernel, [*read, *self._parameters, given.last], [window, lag, parameters])
            if kind.twist:
                by_frame = wp.clone(given.frame)
                self._launch(self._edges, [lag, group.count], [by_frame])
                lag.zero_()
        if kind.twist:
            self._launch(self._frame, [after.x, kept.frame, group.count, by_frame], [window, frame])
        more = self._zeros(kind.block)
        self._launch(self._nodes, [window, group.count], [more])
        end = [given.x, given.v, given.theta, given.omega, more]
        self._launch(self._solution, [*end, group.count, self._rate], [dof])
        w = self.solve(kept, before.last, s, dof)
        window.zero_()
        by_rate = wp.zeros((group.nodes, group.columns), dtype=self.real, device=self.device)
        for kernel in self._pull:
            read = [kept.x, kept.theta, kept.frame, before.last, self._rate]
            self._launch(kernel, [*read, *self._parameters, w], [window, lag, parameters, last, by_rate])
        self._launch(self._nodes, [window, group.count], [dof])
        if kind.twist:
            self._launch(self._edges, [lag, group.count], [frame])
        return self._start_of(kept, end, w, dof, by_rate, frame, last, parameters)

    def _start_of(self, kept, end, w, held, by_rate, frame, last, parameters) -> tuple[GroupState, ChainInputs]:
        group, kind, before = self.group, self.group.kind, kept.before

        def make(dtype=self.real, needed=True):
            shape = (group.nodes, group.columns) if needed else (1, 1)
            return arrays.allocate(shape, dtype, self.device)

        x, v, theta, omega = make(self.vector), make(self.vector), make(needed=kind.twist), make(needed=kind.twist)
        mass, rotary, damping, gravity = make(), make(), make(), make(self.vector)
        self._launch(
            self._start,
            [*end, kept.x, kept.theta, before.x, before.v, before.theta, before.omega, w, held, group.mass]
            + [group.rotary, group.fixed, self._moved, group.count, self._rate, self._damping, group.gravity],
            [x, v, theta, omega, mass, rotary, by_rate, damping, gravity],
        )
        start = GroupState(x, v, theta, omega, frame, last)
        return start, ChainInputs(parameters, mass, rotary, w, held, by_rate, damping, gravity)

    @property
    def _parameters(self) -> list:
        return [*self.group.parameters.arrays, self.group.count]

    def _zeros(self, rows: int, needed: bool = True) -> wp.array:
        shape = (rows, self.group.nodes, self.group.columns) if needed else (1, 1, 1)
        return arrays.allocate(shape, self.real, self.device)

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.group.nodes, self.group.columns), inputs, outputs, device=self.device)


def _refuse(group, scheme: str | None) -> None:
    """What has no gradient yet says so."""
    for there, what in (
        (group.kind.drag and scheme, "drag"),
        (group.host.followers and scheme, "a load that follows the rod"),
        (group.kind.twist and scheme == "implicit_midpoint", "the midpoint rule with twist"),
    ):
        if there:
            raise SceneError(
                f"rod {group.host.rods[0]}: no gradient goes through {what} yet; leave it out, or take differences"
            )


def _moved(group) -> np.ndarray:
    """Dofs that motions put in place, as bits of nodes (n, R)."""
    host, rods = group.host, group.rods
    moved = np.zeros((group.nodes, rods), np.uint8)
    for place, *poses in host.moving:
        for at, d in enumerate(host.axes):
            if poses[d] > FREE:
                moved[place // rods, place % rods] |= 1 << at
    for place in host.turning[:, 0] - host.nodes:
        moved[place // rods, place % rods] |= 1 << group.kind.dim
    return moved
