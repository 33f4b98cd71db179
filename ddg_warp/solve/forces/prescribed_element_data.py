"""Prescribed data of the coupled system: motion of supports and clamped normals, and the magnetic field."""

import warp as wp

from ddg_warp.compile.boundary_conditions import pose_starts
from ddg_warp.kernels.forces.prescribed_element_data import field_kernel, normal_kernels
from ddg_warp.kernels.measures.magnetised_edge import FIELD
from ddg_warp.model.coupled_model import CoupledState
from ddg_warp.solve.forces.prescribed_motion import Motion


class CoupledMotion(Motion):
    """Prescribed motion of supports, and of the normals at clamped mesh edges.

    Attributes:
        data: data with normals that a solve uses, by index of the element set.
    """

    def __init__(self, model, midpoint: bool = False):
        super().__init__(model, model.coupled, midpoint)
        self._normals, self._turn = normal_kernels(model.types.real, midpoint)
        start, self.normals, self.data = pose_starts(model.motions), {}, model.coupled.turning_data()
        for i in self.data:
            (element, row, index), rest = model.coupled.sets[i].turning.T, model.coupled.sets[i].turning_rest
            self.normals[i] = self._list(element, row, start[index]), self._vectors(rest)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, *([self._normals, self._turn] if self.normals else [])]

    def place(self, islands, q: wp.array) -> None:
        """Move supported nodes among the blocks q."""
        super().place(islands, self.part.points(q))

    def direct(self, islands, q: wp.array, frame: wp.array) -> None:
        """Set prescribed twist angles, among the blocks q, and normals."""
        coupled = self.part
        super().direct(islands, coupled.points(q), coupled.frames(frame), coupled.angles(q))
        for index, (where, rest) in self.normals.items():
            inputs = [where, rest, self.pose, self.stride, self.rows, *islands.arrays, coupled.sets[index].elements]
            self._launch(self._normals, where, inputs, [self.data[index]])

    def turn(self, islands, before: CoupledState, after: CoupledState) -> None:
        """Rotate the normals in the end state of a substep, in worlds that accepted one."""
        for index, (where, rest) in self.normals.items():
            inputs = [where, rest, self.pose, self.stride, self.rows, *islands.arrays, self.part.sets[index].elements]
            self._launch(self._turn, where, [*inputs, before.data[index]], [after.data[index]])


class CoupledField:
    """Magnetic field in the data of magnetised edges, at the time of the balance and at the end of a step.

    Args:
        control_field: uniform field of a step added to the scene's, in every world (3, worlds) [T]; None without.

    Attributes:
        data: data with the field that a solve uses, by index of the element set.
    """

    def __init__(self, model, midpoint: bool, control_field: wp.array | None):
        self.model, self.coupled, self.midpoint, self.given = model, model.coupled, midpoint, control_field
        self.data = model.coupled.field_data()
        self._kernel = field_kernel(model.types.real)
        self._now, self._end = (wp.zeros(FIELD, dtype=model.types.real, device=model.wp_device) for _ in range(2))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._kernel] if self.data else []

    def upload(self, t0: float, t1: float) -> None:
        """Upload the field of a step from t0 to t1 [s]."""
        if not self.data:
            return
        field = self.model.scene.applied_field
        self._now.assign(field.at(0.5 * (t0 + t1) if self.midpoint else t1, 1.0))
        self._end.assign(field.at(t1, 1.0))
        for index, data in self.data.items():
            self._launch(index, self._now, self.coupled.every, data, data)

    def finish(self, moved: wp.array, before: CoupledState, after: CoupledState) -> None:
        """Set the field at the end of the step, in worlds that `moved`."""
        for index in self.data:
            self._launch(index, self._end, moved, before.data[index], after.data[index])

    def _launch(self, index: int, field: wp.array, moved: wp.array, before: wp.array, after: wp.array) -> None:
        element_set, first = self.coupled.sets[index], self.coupled.sets[index].term.measure.data_size - FIELD
        inputs = [field, self.given, first, element_set.elements, moved, before]
        dim = element_set.elements * self.model.worlds
        wp.launch(self._kernel, dim, inputs, [after], device=self.model.wp_device)
