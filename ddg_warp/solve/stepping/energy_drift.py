"""Discrete energy balance of the implicit midpoint rule, per uncoupled rod and per world of the coupled system."""

import math

import numpy as np
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.kernels.stepping import coupled_energy_drift, rod_energy_drift
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
    """Discrete energy balance of the steps of a stepper; see `kernels.stepping.rod_energy_drift`.

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

        self.account = kept.account if kept else make(rod_energy_drift.ROWS, count)
        self.failed = kept.failed if kept else make(2, count)
        self.sums = make(rows, rod_energy_drift.ROWS, count)
        self.rows = self.sums.transpose((1, 0, 2))
        self.floor = step.newton.options.floor_factor * self.model.types.eps
        self._judge = rod_energy_drift.drift_kernel(real)

    def _enter(self) -> None:
        """Update the energy balance, or mark steps as failed."""
        step = self.step
        wp.launch(
            self._judge,
            self.account.shape[1],
            [self.rows, step.integrator.energy_bound, *step.islands.arrays],
            [self.account, self.failed],
            device=self.device,
        )

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
        group = step.group
        self.ranges = 1 if group.kind.serial else max(1, math.isqrt(group.nodes))
        super().__init__(step, group.columns, self.ranges, kept)
        self._loads = [step.newton.load, step.newton.load_angle]
        self._follows = bool(group.host.followers)
        if self._follows:
            self._loads = [wp.clone(load) for load in self._loads]
        self._measure = rod_energy_drift.rod_kernel(group.kind, self.model.types.real, step.newton.linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._measure, self._judge]

    @timer("energy")
    def judge(self, before, start) -> None:
        """Test the energy drift of the step from the state `before`, with the lagged data of `start`."""
        step, group, newton = self.step, self.step.group, self.step.newton
        if self._follows:
            step.loads.apply(newton.x, *self._loads)
        wp.launch(
            self._measure,
            (self.ranges, group.columns),
            [group.element_inputs(state, start.last, step.islands.inverse_step) for state in (before, newton)]
            + [before.v, before.omega, *step.islands.arrays, newton.mass, group.rotary]
            + [
                *self._loads,
                newton.load,
                newton.load_angle,
                int(self._follows),
                newton.stiffness,
                step.damping,
                self.floor,
                self.ranges,
            ],
            [self.rows],
            device=self.device,
        )
        self._enter()


class CoupledEnergy(_Energy):
    """Energy balance of the coupled system."""

    def __init__(self, step, kept=None):
        coupled, worlds = step.coupled, step.model.worlds
        super().__init__(step, worlds, len(coupled.sets) + 1, kept)
        real = self.model.types.real
        counts = [*(part.elements for part in coupled.sets), coupled.blocks]
        self._values = [wp.zeros((rod_energy_drift.ROWS * worlds, n), dtype=real, device=self.device) for n in counts]
        self._add = [Sums(rod_energy_drift.ROWS * worlds, n, real, self.device) for n in counts]
        self._out = [self.sums[i].flatten() for i in range(len(counts))]
        self._elements = [
            coupled_energy_drift.element_kernel(part.term, real, step.newton.linear) for part in coupled.sets
        ]
        force = step.newton.loading.force
        self._load = wp.clone(force) if coupled.host.followers else force
        self._blocks = coupled_energy_drift.block_kernel(real, step.drag is not None)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        sums = [kernel for add in self._add for kernel in add.kernels]
        return [*self._elements, self._blocks, self._judge, *sums]

    @timer("energy")
    def judge(self, before, middle) -> None:
        """Test the energy drift of the step from `before`, with the lagged data of `middle`."""
        step, coupled, newton = self.step, self.step.coupled, self.step.newton
        q, loading, outputs = newton.iterates.q, newton.loading, newton.elements.outputs
        for i, (part, data, kernel) in enumerate(zip(coupled.sets, outputs, self._elements, strict=True)):
            wp.launch(
                kernel,
                (step.model.worlds, part.elements),
                [
                    coupled.elements(middle, i, q=q, rate=step.islands.inverse_step),
                    before.q,
                    data["stiffness"],
                    self.floor,
                    *step.islands.arrays,
                ],
                [self._values[i]],
                device=self.device,
            )
        if coupled.host.followers:
            step.loads.apply(coupled.points(q), coupled.points(self._load), coupled.angles(self._load))
        wp.launch(
            self._blocks,
            len(q),
            [
                before.q,
                before.v,
                q,
                loading.mass,
                *step.islands.arrays,
                step.damping,
                self._load,
                loading.force,
                self.floor,
            ]
            + [coupled.blocks],
            [self._values[-1]],
            device=self.device,
        )
        for add, values, out in zip(self._add, self._values, self._out, strict=True):
            add(values, out)
        self._enter()
