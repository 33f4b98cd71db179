"""Discrete energy balance of the implicit midpoint rule, per uncoupled rod and per world of the coupled system."""

import math

import numpy as np
import warp as wp

from ddg_warp import argument_checks, device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.elements.coupled_element import coupled_storage
from ddg_warp.kernels.elements.rod_layout import rod_storage
from ddg_warp.kernels.stepping import energy_drift
from ddg_warp.scene.drag import is_square
from ddg_warp.solve.linear.sparse_system import Sums
from ddg_warp.timers import timer

BOUND = 0.1  # see `Integrator`


def bound(fraction: float | None, scheme: str) -> float | None:
    """Return the checked energy-drift bound of an integrator, None if the energy is not watched.

    Raises:
        SceneError: the bound is no fraction, or the scheme is not the midpoint rule.
    """
    if fraction is not None:
        fraction = argument_checks.number(
            "energy_bound", fraction, "a fraction between 0 and 1, or None", lambda v: 0.0 < v < 1.0
        )
    if scheme == "implicit_midpoint":
        return fraction
    if fraction not in (None, BOUND):
        raise SceneError(f"energy_bound = {fraction:g} is of the implicit midpoint rule; {scheme} takes energy out")
    return None


def summary(parts: list["_Energy"]) -> dict[str, float]:
    """Return energy drift and dissipation of all rods and worlds [J], and the largest relative drift."""
    account = np.concatenate([part.account.numpy() for part in parts], axis=1).astype(float)
    made, _, largest, dissipated = account
    fraction = np.abs(made) / np.maximum(largest + dissipated, np.finfo(float).tiny)
    return {"made": float(made.sum()), "dissipated": float(dissipated.sum()), "fraction": float(fraction.max())}


class _Energy:
    """Discrete energy balance of the steps of a stepper; see `kernels.stepping.energy_drift`.

    Args:
        step: `RodStep` or `CoupledStep`.
        count: number of rods in all worlds, or of worlds; rows: number of partial sums of each.
        kept: energy balance of the replaced stepper.

    Attributes:
        account: energy drift, its rounding, largest energy, and dissipation (4, count) [J].
    """

    def __init__(self, step, count: int, rows: int, kept):
        self.step, self.model = step, step.model
        real, self.device = self.model.types.real, self.model.wp_device

        def make(*shape):
            return wp.zeros(shape, dtype=real, device=self.device)

        self.account = kept.account if kept else make(energy_drift.ROWS, count)
        self.failed = kept.failed if kept else make(2, count)
        self.sums = make(rows, energy_drift.ROWS, count)
        self.rows = self.sums.transpose((1, 0, 2))
        self.rounding_factor = step.newton.options.floor_factor * self.model.types.eps
        self._record = energy_drift.drift_kernel(real)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self._elements, self._nodes, self._record]

    def _enter(self) -> None:
        """Update the energy balance, or mark steps as failed."""
        step = self.step
        self._launch(
            self._record,
            self.account.shape[1],
            [self.rows, step.integrator.energy_bound, *step.islands.arrays],
            [self.account, self.failed],
        )

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device)

    def failure(self, index: int) -> str:
        """Return the message on a failed rod or world."""
        made, largest = self.failed.numpy()[:, index]
        return (
            f"the midpoint rule would have {'made' if made > 0.0 else 'lost'} {abs(made):.3g} J of {largest:.3g} J; take a smaller dt, "
            f"scheme='implicit_euler', or a wider energy_bound than {self.step.integrator.energy_bound:g}"
        )


class RodEnergy(_Energy):
    """Energy balance of a rod group."""

    def __init__(self, step, kept=None):
        group, newton = step.group, step.newton
        self.ranges = 1 if group.kind.serial else max(1, math.isqrt(group.nodes))
        super().__init__(step, group.columns, 2 * self.ranges, kept)
        self._loads = [newton.loading.force, newton.loading.moment]
        self._following = [force for force in step.forces if force.follows]
        if self._following:
            self._loads = [wp.clone(load) for load in self._loads]
        real = self.model.types.real
        self._elements = [energy_drift.element_kernel(rod_storage(group.kind, real), real, newton.linear)]
        self._nodes = energy_drift.node_kernel(
            group.kind.nodes, real, group.kind.quadratic, is_square(self.model.scene)
        )

    @timer("energy")
    def check_drift(self, before, start) -> None:
        """Test the energy drift of the step from the state `before`, with the lagged data of `start`."""
        step, group, newton = self.step, self.step.group, self.step.newton
        iterates, loading = newton.iterates, newton.loading
        for force in self._following:
            force.apply(iterates.x, *self._loads)
        grid, common = (self.ranges, group.columns), [self.rounding_factor, self.ranges]
        scalars = step.islands.arrays[1]
        states = [group.element_inputs(state, start.last, step.islands.inverse_step) for state in (before, iterates)]
        read = [*states, device_arrays.columns(newton.elements.stiffness), scalars, *common]
        self._launch(self._elements[0], grid, read, [self.rows[:, : self.ranges]])
        read = [group.node_state(before), iterates.x, iterates.theta, group.mass, group.rotary]
        read += [
            step.inertia,
            group.count,
            *self._loads,
            loading.force,
            loading.moment,
            int(bool(self._following)),
        ]
        self._launch(self._nodes, grid, [*read, scalars, step.damping, *common], [self.rows[:, self.ranges :]])
        self._enter()


class CoupledEnergy(_Energy):
    """Energy balance of the coupled system."""

    def __init__(self, step, kept=None):
        coupled, worlds, rows = step.coupled, step.model.worlds, energy_drift.ROWS
        super().__init__(step, worlds, len(coupled.sets) + 1, kept)
        real = self.model.types.real
        counts = [*(part.elements for part in coupled.sets), coupled.blocks]
        self._values = [wp.zeros((rows * worlds, n), dtype=real, device=self.device) for n in counts]
        self._rows = [v.reshape((rows, worlds, -1)).transpose((0, 2, 1)) for v in self._values]
        self._add = [Sums(rows * worlds, n, real, self.device) for n in counts]
        self._out = [self.sums[i].flatten() for i in range(len(counts))]
        storages = [coupled_storage(part.term, real) for part in coupled.sets]
        self._elements = [energy_drift.element_kernel(storage, real, step.newton.linear) for storage in storages]
        force = step.newton.loading.force
        self._following = [each for each in step.forces if each.follows]
        self._load = wp.clone(force) if self._following else force
        self._nodes = energy_drift.node_kernel(
            coupled.nodes, real, step.inertia is not None, is_square(self.model.scene)
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, *(kernel for add in self._add for kernel in add.kernels)]

    @timer("energy")
    def check_drift(self, before, middle) -> None:
        """Test the energy drift of the step from `before`, with the lagged data of `middle`."""
        step, coupled, newton = self.step, self.step.coupled, self.step.newton
        q, loading, outputs = newton.iterates.q, newton.loading, newton.elements.outputs
        points, scalars = coupled.points, step.islands.arrays[1]
        for i, (part, data, kernel) in enumerate(zip(coupled.sets, outputs, self._elements, strict=True)):
            states = [coupled.elements(middle, i, blocks, step.islands.inverse_step) for blocks in (before.q, q)]
            read = [*states, data["stiffness"], scalars, self.rounding_factor, part.elements]
            self._launch(kernel, (coupled.worlds, part.elements), read, [self._rows[i]])
        for force in self._following:
            force.apply(points(q), points(self._load), coupled.angles(self._load))
        read = [coupled.node_state(before), points(q), None, coupled.mass.transpose((1, 0)), None]
        read += [step.inertia, coupled.count]
        read += [points(self._load), None, points(loading.force), None, int(bool(self._following))]
        read += [scalars, step.damping, self.rounding_factor, coupled.blocks]
        self._launch(self._nodes, (coupled.worlds, coupled.blocks), read, [self._rows[-1]])
        for add, values, out in zip(self._add, self._values, self._out, strict=True):
            add(values, out)
        self._enter()
