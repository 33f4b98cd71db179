"""What is prescribed of a net from outside: motion of supports and of the normals that these turn, and a magnetic field."""

import warp as wp

from ddg_warp.compile.conditions import pose_starts
from ddg_warp.kernels.measures.magnetised_edge import FIELD
from ddg_warp.kernels.net.motion import field_kernel, normal_kernels
from ddg_warp.model.net import NetState
from ddg_warp.solve.motion import Motion


class NetMotion(Motion):
    """Motion of a net's supports, and of the normals at clamped mesh edges that these turn.

    Attributes:
        data: of the sets with such normals, by index, with those that a solve is about.
    """

    def __init__(self, model, midpoint: bool = False):
        super().__init__(model, model.net, midpoint)
        self._normals, self._turn = normal_kernels(model.types.real, midpoint)
        start, self.normals, self.data = pose_starts(model.motions), {}, model.net.turning_data()
        for i in self.data:
            (element, row, index), rest = model.net.sets[i].turning.T, model.net.sets[i].turning_rest
            self.normals[i] = self._list(element, row, start[index]), self._vectors(rest)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, *([self._normals, self._turn] if self.normals else [])]

    def place(self, islands, q: wp.array) -> None:
        """Put nodes, among the blocks q."""
        super().place(islands, self.part.points(q))

    def direct(self, islands, q: wp.array, frame: wp.array) -> None:
        """Put angles, among the blocks q, and normals."""
        net = self.part
        super().direct(islands, net.points(q), net.frames(frame), net.angles(q))
        for index, (where, rest) in self.normals.items():
            inputs = [where, rest, self.pose, self.stride, self.rows, *islands.arrays, net.sets[index].elements]
            self._launch(self._normals, where, inputs, [self.data[index]])

    def turn(self, islands, before: NetState, after: NetState) -> None:
        """Turn the normals of a state that a part of the step ends in, in the worlds that moved."""
        for index, (where, rest) in self.normals.items():
            inputs = [where, rest, self.pose, self.stride, self.rows, *islands.arrays, self.part.sets[index].elements]
            self._launch(self._turn, where, [*inputs, before.data[index]], [after.data[index]])


class NetField:
    """The magnetic field among the data of magnetised edges, at the time that the scheme balances forces at and at the end of a step.

    Args:
        given: the uniform field that a step is given on top of the scene's, in every world (3, worlds) [T]; None where none acts.

    Attributes:
        data: of those sets by index, with the field that a solve is about.
    """

    def __init__(self, model, midpoint: bool, given: wp.array | None):
        self.model, self.net, self.midpoint, self.given = model, model.net, midpoint, given
        self.data = model.net.field_data()
        self._kernel = field_kernel(model.types.real)
        self._now, self._end = (wp.zeros(FIELD, dtype=model.types.real, device=model.wp_device) for _ in range(2))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._kernel] if self.data else []

    def upload(self, t0: float, t1: float) -> None:
        """The field of a step."""
        if not self.data:
            return
        field = self.model.scene.applied_field
        self._now.assign(field.at(0.5 * (t0 + t1) if self.midpoint else t1, 1.0))
        self._end.assign(field.at(t1, 1.0))
        for index, data in self.data.items():
            self._launch(index, self._now, self.net.every, data, data)

    def finish(self, moved: wp.array, before: NetState, after: NetState) -> None:
        """Put the worlds that `moved` into the field at the end of the step."""
        for index in self.data:
            self._launch(index, self._end, moved, before.data[index], after.data[index])

    def _launch(self, index: int, field: wp.array, moved: wp.array, before: wp.array, after: wp.array) -> None:
        part, first = self.net.sets[index], self.net.sets[index].term.measure.data_size - FIELD
        inputs = [field, self.given, first, part.elements, moved, before]
        dim = part.elements * self.model.worlds
        wp.launch(self._kernel, dim, inputs, [after], device=self.model.wp_device)
