"""Worlds of an integrator: outcomes, failures, reset."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.capture_lock import capturing
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.stepping.world_reset import blank_kernels, forget_kernel, island_kernels, select_kernel
from ddg_warp.model.state import State


def outcomes(model, parts: list, outcome_codes: wp.array) -> np.ndarray:
    """Return the outcome of each world (worlds,): of its first failure, or "converged"."""
    codes = outcome_codes.numpy()
    for part in parts:
        islands = part.islands
        given_up = islands.status.numpy() == outcome.STEP_FAILED
        codes = np.maximum(
            codes, np.where(given_up, islands.failure_status.numpy(), 0).reshape(model.worlds, -1).max(1)
        )
    return np.array([outcome.NAMES[code or outcome.CONVERGED] for code in codes])


class WorldReset:
    """Failure handling of the worlds of an integrator.

    A failed world is inactive: it keeps the state before the step until reset. In watched worlds (`watch`) the state becomes NaN
    instead.

    Attributes:
        outcome_codes: outcome code of each inactive world, 0 for active ones (worlds,); see `kernels.core.outcome`.
        invalid: outcome code of each watched world with refused parameters, else 0 (worlds,).
        start: state for watched worlds excluded from a step.
    """

    def __init__(self, model):
        self.model = model
        self.outcome_codes, self._failed, self._mask = (self._zeros(model.worlds) for _ in range(3))
        self._any = self._zeros(1)
        self._note, self._seal, self._enter, self._clear, self._find = island_kernels()
        self._serial, self._loaded = device_arrays.serial(model.wp_device), False
        self.invalid: wp.array | None = None
        self.start: State | None = None

    def _zeros(self, count: int) -> wp.array:
        return wp.zeros(count, dtype=int, device=self.model.wp_device)

    def watch(self) -> None:
        """Watch worlds: exclude worlds with `invalid` parameters or a NaN state from steps; failed worlds become NaN."""
        self.invalid, self.start = self._zeros(self.model.worlds), self.model.state()

    def deactivate(self, parts: list, before: State, after: State, handed: list[wp.array]) -> None:
        """Exclude invalid watched worlds from a step and set the start state; capturable.

        Args:
            handed: arrays of all worlds in order that must be finite.
        """
        if self.invalid is None:
            return
        # in worlds that failed in the last step, padding entries stay NaN, which a step does not write
        wp.capture_if(self._any, lambda: self.take_over(self._failed, self.start, after))
        values, worlds = next(array for array in before.arrays().values() if array.size > 1), self.model.worlds
        cube, (_, deactivate, _) = cubed(values), blank_kernels(values.dtype)
        self._launch(deactivate, worlds, [self.invalid, cube, cube.shape[-1] // worlds], [self.outcome_codes])
        for array in handed:
            cube, (*_, find_non_finite) = cubed(array), blank_kernels(array.dtype)
            self._launch(find_non_finite, cube.shape, [cube, cube.shape[-1] // worlds], [self.outcome_codes])
        self._any.zero_()
        self._launch(self._find, worlds, [self.outcome_codes], [self._any])
        wp.capture_if(self._any, lambda: self._to_start(before, after))
        for part in parts:
            inputs = [self.outcome_codes, part.islands_each]
            self._launch(self._seal, len(part.islands), inputs, [part.islands.arrays[0]])

    def _to_start(self, before: State, after: State) -> None:
        """Set inactive worlds to the start state, grips included, since the broad phase covers all worlds."""
        self.take_over(self.outcome_codes, self.start, before)
        if after.grips is not None:
            self.take_part(self.outcome_codes, self.start.grips, after.grips, self.model.worlds)

    def settle(self, parts: list, before: State, after: State) -> None:
        """Deactivate worlds with failures after a step; capturable."""
        self._any.zero_()
        if self.invalid is None:
            self._failed.zero_()
        else:
            wp.copy(self._failed, self.outcome_codes)
            self._launch(self._find, self.model.worlds, [self._failed], [self._any])
        for part in parts:
            inputs = [part.islands.arrays[0], part.islands_each, self.outcome_codes, self._failed]
            self._launch(self._note, len(part.islands), inputs, [self._any])
        wp.capture_if(self._any, lambda: self._rest(parts, before, after))
        if after.grips is not None and self.invalid is None:  # controls move grips, except in inactive worlds
            self.take_part(self.outcome_codes, before.grips, after.grips, before.model.worlds)

    def _rest(self, parts: list, before: State, after: State) -> None:
        if self.invalid is None:
            self.take_over(self._failed, before, after)
        else:
            self._blank(after)
        for part in parts:
            inputs = [self._failed, part.islands_each]
            self._launch(self._seal, len(part.islands), inputs, [part.islands.arrays[0]])
        self._launch(self._enter, self.model.worlds, [self._failed], [self.outcome_codes])

    def _blank(self, state: State) -> None:
        """Set a state to NaN in failed worlds."""
        for array in state.arrays().values():
            if array.shape[-1] % self.model.worlds == 0:
                cube, (blank, *_) = cubed(array), blank_kernels(array.dtype)
                self._launch(blank, cube.shape, [self._failed, cube.shape[-1] // self.model.worlds], [cube])

    def take_over(self, mask: wp.array, source: State, target: State) -> None:
        """Copy masked worlds of a state into another one. A state of one world goes into each of them."""
        for name, part in target.parts().items():
            self.take_part(mask, source.parts()[name], part, source.model.worlds)

    def take_part(self, mask: wp.array, source, target, worlds: int) -> None:
        """Copy masked worlds of one component of a state with `worlds` worlds; see `take_over`."""
        sources = source.arrays()
        for name, array in target.arrays().items():
            if array.shape[-1] % self.model.worlds == 0:  # else the array is absent, stored as one number
                self.take_array(mask, sources[name], array, worlds)

    def take_array(self, mask: wp.array, source: wp.array, target: wp.array, worlds: int) -> None:
        """Copy masked worlds of an array; see `take_over`."""
        several = self.model.worlds
        width = target.shape[-1] // several
        stride = width if worlds == several else 0
        kernel, cubes = select_kernel(target.dtype, self._serial), [cubed(array) for array in (source, target)]
        dim = (1, 1, several, 1) if self._serial else (*cubes[1].shape[:2], several, width)
        self._launch(kernel, dim, [mask, width, stride, cubes[0]], [cubes[1]])

    def mask(self, mask) -> wp.array:
        """Return a user's mask of worlds on the device.

        Raises:
            SceneError: no array of bools, one a world.
        """
        try:
            values = np.asarray(mask)
        except (TypeError, ValueError, RuntimeError):
            values = np.zeros(0)
        if values.dtype != bool or values.shape != (self.model.worlds,):
            raise SceneError(
                f"reset: the mask is {values.dtype} of shape {values.shape}; give bools ({self.model.worlds},), True for worlds that "
                "restart"
            )
        self._mask.assign(values.astype(np.int32))
        return self._mask

    def check_source(self, to, state: State) -> None:
        """Refuse an invalid source of a reset.

        Raises:
            SceneError: no state of the model or of the same scene in one world; or a state of another time, with supports moved by
                functions of time.
        """
        if not isinstance(to, State):
            raise SceneError(f"reset: to is {to!r}; give a state of this model, or of one with one world")
        if to.model is not self.model:
            description, wanted = (_description(each) for each in (to, state))
            if to.model.worlds != 1 or description != wanted:
                raise SceneError(
                    "reset: to is of another model; give a state of this one, such as model.state(), or of the same scene built with "
                    "worlds=1, of the same precision and on the same device"
                )
        if len(self.model.grips) < len(self.model.motions) and to.time != state.time:
            raise SceneError(
                f"reset: to is of t = {to.time:g} s, and the state of {state.time:g} s, a time common to all worlds: supports that a "
                "Motion moves are elsewhere by now; give a state of that time, or move them by a Grip"
            )

    def reset(self, parts: list, mask: wp.array, to: State, target: State) -> None:
        """Set masked worlds to the state `to`, and clear their outcomes."""
        self.take_over(mask, to, target)
        self._launch(forget_kernel(int), (1, self.model.worlds), [mask, 1], [self.outcome_codes.reshape((1, -1))])
        for part in parts:
            self._launch(self._clear, len(part.islands), [mask, part.islands_each], [part.islands.arrays[0]])
            for account in (part.energy.account, part.energy.failed) if part.energy else ():
                kernel = forget_kernel(account.dtype)
                self._launch(kernel, account.shape, [mask, part.islands_each], [account])

    def forget(self, parts: list) -> None:
        """Activate all worlds and clear all outcomes."""
        self.outcome_codes.zero_()
        for part in parts:
            part.islands.status.fill_(outcome.CONVERGED)
            part.islands.failure_status.zero_()

    def load_modules(self) -> None:
        """Compile and load all kernels, once."""
        if self._loaded:
            return
        with capturing():
            types = {
                array.dtype for part in self.model.empty_state().parts().values() for array in part.arrays().values()
            }
            kernels = [
                self._note,
                self._seal,
                self._enter,
                self._clear,
                self._find,
                *(select_kernel(dtype, self._serial) for dtype in types),
            ]
            if self.invalid is not None:
                types |= {self.model.types.real, wp.types.vector(3, self.model.types.real)}  # types of inputs
                kernels += [kernel for dtype in types for kernel in blank_kernels(dtype)]
            kernels += [forget_kernel(dtype) for dtype in (int, self.model.types.real)]
            device_arrays.load_kernels(kernels, self.model.wp_device)
        self._loaded = True

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)


def cubed(array: wp.array) -> wp.array:
    """Return a view of an array with three axes."""
    lead = 3 - array.ndim
    shape, strides = (1,) * lead + array.shape, array.strides[:1] * lead + array.strides
    view = wp.array(ptr=array.ptr, dtype=array.dtype, shape=shape, strides=strides, device=array.device)
    view._ref = array  # keeps the memory alive
    return view


def _description(state: State) -> list:
    """Return names, types and shapes of all arrays in one world of a state."""
    model = state.model
    return [str(model.wp_device)] + [
        (name, label, array.dtype, array.shape[:-1], max(1, array.shape[-1] // model.worlds))
        for name, part in state.parts().items()
        for label, array in part.arrays().items()
    ]
