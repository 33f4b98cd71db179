"""CCD step fractions of a proposed motion on a device; see `kernels.collision.ccd.step_fractions`."""

from functools import partial

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.collision.ccd.step_fractions import fraction_kernels, limit_kernels
from ddg_warp.solve.collision.candidate_validity import CandidateValidity
from ddg_warp.timers import timer


class StepFilter:
    """CCD step fractions for the pairs of some lists; see `BroadPhase.filter`.

    Args:
        nodes: nodes of one world, which bounds the number of CCD bodies.

    Attributes:
        `shares`, `limited`: see `BroadPhase`.
    """

    def __init__(self, lists: list, nodes: int, worlds: int, real, device):
        self._lists, self._nodes, self._worlds, self._device = lists, nodes, worlds, device
        serial = device_arrays.serial(device)
        made = [limit_kernels(pairs.kind, real) for pairs in lists]
        self._picks, self._limits = zip(*made, strict=True)
        self._start, self._turn, self._settle, self._finish, self._shorten = fraction_kernels(real, serial)
        self.kernels = [*self._picks, *self._limits, self._start, self._turn, self._settle, self._finish, self._shorten]
        self._all = [wp.zeros(worlds * nodes, dtype=real, device=device) for _ in range(3)]
        self._earliest, self._later = (wp.zeros(worlds, dtype=real, device=device) for _ in range(2))
        self._open, self.limited = (wp.zeros(worlds, dtype=int, device=device) for _ in range(2))
        self._changed, self._rounds = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
        self._numbers = wp.zeros(len(lists), dtype=int, device=device)
        self._each_number = [self._numbers[k : k + 1] for k in range(len(lists))]
        self._unpicked = wp.zeros(0, dtype=int, device=device)
        self.shares = self._all[0]

    def check(self, ccd_body: wp.array, together: wp.array, num_ccd_bodies: int) -> None:
        """Refuse invalid arrays."""
        if ccd_body.shape != (self._nodes,) or ccd_body.dtype is not wp.int32:
            raise SceneError(
                f"ccd_body of a motion: one int32 for each of {self._nodes} nodes, not {ccd_body.shape} of {ccd_body.dtype}"
            )
        if together.shape != (self._worlds,) or together.dtype is not wp.int32:
            raise SceneError(
                f"together of a motion: one int32 for each of {self._worlds} world(s), not {together.shape} of {together.dtype}"
            )
        if not 1 <= num_ccd_bodies <= self._nodes:
            raise SceneError(
                f"num_ccd_bodies = {num_ccd_bodies!r} of a motion; they are 1 to {self._nodes}, the nodes of a world"
            )

    @timer("additive CCD")
    def __call__(
        self,
        base,
        q,
        ccd_body,
        together,
        num_ccd_bodies: int,
        min_separation_fraction: float,
        search_distance: float,
        overflow: wp.array,
        validity: CandidateValidity,
        time: wp.array,
    ) -> None:
        """Lower step fractions round by round, and limit q accordingly.

        Args:
            search_distance: search distance [m].
            overflow: see `SearchCounters`.
            validity: has the motion from `base` to q; searched paths are limited with it.
            time: (worlds,) smallest fractions, as of `BroadPhase`.
        """
        move = validity.move
        shares, before, lowered = (array[: self._worlds * num_ccd_bodies] for array in self._all)
        self.shares = shares
        outputs = [shares, before, lowered, self._earliest, self._later, time, self.limited]
        rounds = [self._open, self._changed, self._rounds]
        self._sweep(self._start, len(shares), [], [*outputs, *rounds])

        def lower(times: wp.array, again: bool, pick, limit, pairs, number: wp.array) -> None:
            count, picked = pairs.count, self._unpicked
            if again:
                inputs = [pairs.pairs, count, pairs.sides, ccd_body, num_ccd_bodies, shares, before]
                device_arrays.take_turns(pick, pairs.capacity, inputs, [pairs.picked, number], self._device)
                count, picked = number, pairs.picked
            inputs = [
                pairs.pairs,
                count,
                picked,
                pairs.sides,
                base,
                move,
                min_separation_fraction,
                search_distance,
                ccd_body,
                num_ccd_bodies,
                shares,
            ]
            device_arrays.take_turns(limit, pairs.capacity, inputs, [lowered, times], self._device)

        def go(times: wp.array, again: bool = True) -> None:
            if again:
                wp.launch(self._turn, self._worlds, [], [*rounds, self._numbers], device=self._device)
            of_lists = zip(self._picks, self._limits, self._lists, self._each_number, strict=True)
            device_arrays.side_by_side(
                [partial(lower, times, again, *list_data) for list_data in of_lists], self._device
            )
            inputs = [together, self._earliest, lowered, self._rounds]
            self._sweep(self._settle, len(shares), inputs, [shares, before, self._open, self._changed])

        go(self._earliest, again=False)
        wp.capture_while(self._changed, lambda: go(self._later))
        outputs = [shares, time, self.limited]
        self._sweep(self._finish, len(shares), [self._earliest, self._open, overflow], outputs)
        inputs = [base, move, ccd_body, num_ccd_bodies, shares, validity.done, together]
        self._sweep(self._shorten, len(q), inputs, [q, validity.start, validity.end])

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.sweep(kernel, count, inputs, outputs, self._device)
