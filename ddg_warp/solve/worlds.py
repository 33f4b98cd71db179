"""Worlds apart: what each ends a step with, and worlds that start anew while the others go on."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.kernels.worlds import blank_kernels, forget_kernel, island_kernels, select_kernel
from ddg_warp.model.state import State
from ddg_warp.threads import capturing


def outcomes(model, parts: list, resting: wp.array) -> np.ndarray:
    """Return names (worlds,) of what became of each world: of the first reason why something in it was given up, or why it rests, else
    "converged"."""
    codes = resting.numpy()
    for part in parts:
        islands = part.islands
        given_up = islands.status.numpy() == outcome.GIVEN_UP
        codes = np.maximum(codes, np.where(given_up, islands.reason.numpy(), 0).reshape(model.worlds, -1).max(1))
    return np.array([outcome.NAMES[code or outcome.CONVERGED] for code in codes])


class Worlds:
    """The worlds of an integrator.

    A world in which something was given up rests: all of it is as it was before the step, and stays so until it is reset. Where worlds
    are `watch`ed, it is not a number instead.

    Attributes:
        resting: of every world the code of the outcome that it rests for, 0 where it goes on; see `kernels.outcome`.
        invalid: of every world that is watched the code of an outcome that its parameters are refused by, 0 where they are good.
        start: of worlds that are watched, the state that those are given which are taken out of a step.
    """

    def __init__(self, model):
        self.model = model
        self.resting, self._failed, self._mask = (self._zeros(model.worlds) for _ in range(3))
        self._any = self._zeros(1)
        self._note, self._seal, self._enter, self._clear, self._find = island_kernels()
        self._serial, self._loaded = arrays.serial(model.wp_device), False
        self.invalid: wp.array | None = None
        self.start: State | None = None

    def _zeros(self, count: int) -> wp.array:
        return wp.zeros(count, dtype=int, device=self.model.wp_device)

    def watch(self) -> None:
        """From now on take worlds out of steps whose parameters are `invalid` or whose state is not a number, and leave those that fail
        not a number."""
        self.invalid, self.start = self._zeros(self.model.worlds), self.model.state()

    def bar(self, parts: list, before: State, after: State, handed: list[wp.array]) -> None:
        """Before a step: have watched worlds rest that are taken out of it, as they are at rest; launches alone, so that it can be
        captured.

        Args:
            handed: arrays of all worlds, one after the other, whose entries have to be finite.
        """
        if self.invalid is None:
            return
        # of worlds that failed in the last step, entries of no node stay, which a step does not write
        wp.capture_if(self._any, lambda: self.take_over(self._failed, self.start, after))
        values, worlds = next(array for array in before.arrays().values() if array.size > 1), self.model.worlds
        cube, (_, bar, _) = cubed(values), blank_kernels(values.dtype)
        self._launch(bar, worlds, [self.invalid, cube, cube.shape[-1] // worlds], [self.resting])
        for array in handed:
            cube, (*_, judge) = cubed(array), blank_kernels(array.dtype)
            self._launch(judge, cube.shape, [cube, cube.shape[-1] // worlds], [self.resting])
        self._any.zero_()
        self._launch(self._find, worlds, [self.resting], [self._any])
        wp.capture_if(self._any, lambda: self._to_start(before, after))
        for part in parts:
            inputs = [self.resting, part.islands_each]
            self._launch(self._seal, len(part.islands), inputs, [part.islands.arrays[0]])

    def _to_start(self, before: State, after: State) -> None:
        """Have worlds that rest begin as at rest, and their grips end there, as searches for contact are of all worlds."""
        self.take_over(self.resting, self.start, before)
        if after.grips is not None:
            self.take_part(self.resting, self.start.grips, after.grips, self.model.worlds)

    def settle(self, parts: list, before: State, after: State) -> None:
        """After a step: have worlds rest in which something was given up; launches alone, so that it can be captured."""
        self._any.zero_()
        if self.invalid is None:
            self._failed.zero_()
        else:
            wp.copy(self._failed, self.resting)
            self._launch(self._find, self.model.worlds, [self._failed], [self._any])
        for part in parts:
            inputs = [part.islands.arrays[0], part.islands_each, self.resting, self._failed]
            self._launch(self._note, len(part.islands), inputs, [self._any])
        wp.capture_if(self._any, lambda: self._rest(parts, before, after))
        if after.grips is not None and self.invalid is None:  # which go where they are told, but for worlds that rest
            self.take_part(self.resting, before.grips, after.grips, before.model.worlds)

    def _rest(self, parts: list, before: State, after: State) -> None:
        if self.invalid is None:
            self.take_over(self._failed, before, after)
        else:
            self._blank(after)
        for part in parts:
            inputs = [self._failed, part.islands_each]
            self._launch(self._seal, len(part.islands), inputs, [part.islands.arrays[0]])
        self._launch(self._enter, self.model.worlds, [self._failed], [self.resting])

    def _blank(self, state: State) -> None:
        """Make a state not a number in worlds that failed."""
        for array in state.arrays().values():
            if array.shape[-1] % self.model.worlds == 0:
                cube, (blank, *_) = cubed(array), blank_kernels(array.dtype)
                self._launch(blank, cube.shape, [self._failed, cube.shape[-1] // self.model.worlds], [cube])

    def take_over(self, mask: wp.array, source: State, target: State) -> None:
        """Put everything of a state into another one, in worlds of a mask; a state of one world goes into each of them."""
        for name, part in target.parts().items():
            self.take_part(mask, source.parts()[name], part, source.model.worlds)

    def take_part(self, mask: wp.array, source, target, worlds: int) -> None:
        """As `take_over`, of a part of a state, from one of so many worlds."""
        given = source.arrays()
        for name, array in target.arrays().items():
            if array.shape[-1] % self.model.worlds == 0:  # else it is not there, but for one number
                self.take_array(mask, given[name], array, worlds)

    def take_array(self, mask: wp.array, source: wp.array, target: wp.array, worlds: int) -> None:
        """As `take_over`, of an array."""
        several = self.model.worlds
        share = target.shape[-1] // several
        stride = share if worlds == several else 0
        kernel, cubes = select_kernel(target.dtype, self._serial), [cubed(array) for array in (source, target)]
        dim = (1, 1, several, 1) if self._serial else (*cubes[1].shape[:2], several, share)
        self._launch(kernel, dim, [mask, share, stride, cubes[0]], [cubes[1]])

    def mask(self, mask) -> wp.array:
        """A mask that a user gives, on the device.

        Raises:
            SceneError: it is no array of bools, one a world.
        """
        try:
            values = np.asarray(mask)
        except (TypeError, ValueError, RuntimeError):
            values = np.zeros(0)
        if values.dtype != bool or values.shape != (self.model.worlds,):
            raise SceneError(
                f"reset: the mask is {values.dtype} of shape {values.shape}; give bools ({self.model.worlds},), True for worlds that "
                "start anew"
            )
        self._mask.assign(values.astype(np.int32))
        return self._mask

    def check_source(self, to, state: State) -> None:
        """Refuse what worlds of a state cannot start from.

        Raises:
            SceneError: it is no state of the model, nor of the same scene in one world; or belongs to another time, at which supports
                that are moved by functions of time are elsewhere.
        """
        if not isinstance(to, State):
            raise SceneError(f"reset: to is {to!r}; give a state of this model, or of one with one world")
        if to.model is not self.model:
            found, wanted = (_description(given) for given in (to, state))
            if to.model.worlds != 1 or found != wanted:
                raise SceneError(
                    "reset: to is of another model; give a state of this one, such as model.state(), or of the same scene built with "
                    "worlds=1, of the same precision and on the same device"
                )
        if len(self.model.grips) < len(self.model.motions) and to.time != state.time:
            raise SceneError(
                f"reset: to is of t = {to.time:g} s, and the state of {state.time:g} s, a time that all worlds share: supports that a "
                "Motion moves are elsewhere by now; give a state of that time, or hold them by Grip"
            )

    def reset(self, parts: list, mask: wp.array, to: State, target: State) -> None:
        """Put worlds of the mask into the state `to`, and forget what became of them."""
        self.take_over(mask, to, target)
        self._launch(forget_kernel(int), (1, self.model.worlds), [mask, 1], [self.resting.reshape((1, -1))])
        for part in parts:
            self._launch(self._clear, len(part.islands), [mask, part.islands_each], [part.islands.arrays[0]])
            for account in (part.energy.account, part.energy.failed) if part.energy else ():
                kernel = forget_kernel(account.dtype)
                self._launch(kernel, account.shape, [mask, part.islands_each], [account])

    def forget(self, parts: list) -> None:
        """Have all worlds go on, whatever became of them."""
        self.resting.zero_()
        for part in parts:
            part.islands.status.fill_(outcome.CONVERGED)
            part.islands.reason.zero_()

    def load_modules(self) -> None:
        """Compile and load what it launches, once."""
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
                types |= {self.model.types.real, wp.types.vector(3, self.model.types.real)}  # of what is handed in
                kernels += [kernel for dtype in types for kernel in blank_kernels(dtype)]
            kernels += [forget_kernel(dtype) for dtype in (int, self.model.types.real)]
            arrays.load_kernels(kernels, self.model.wp_device)
        self._loaded = True

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)


def cubed(array: wp.array) -> wp.array:
    """An array seen with three axes."""
    lead = 3 - array.ndim
    shape, strides = (1,) * lead + array.shape, array.strides[:1] * lead + array.strides
    view = wp.array(ptr=array.ptr, dtype=array.dtype, shape=shape, strides=strides, device=array.device)
    view._ref = array  # what it looks at lives as long
    return view


def _description(state: State) -> list:
    """Names, types and shapes of everything in one world of a state."""
    model = state.model
    return [str(model.wp_device)] + [
        (name, label, array.dtype, array.shape[:-1], max(1, array.shape[-1] // model.worlds))
        for name, part in state.parts().items()
        for label, array in part.arrays().items()
    ]
