"""Engine of `ddg_warp.torch`: steps of many worlds and their backward passes, between tensors.

Integrator and adjoint keep their memory, so that each is one captured graph; tensors are copied in and out.
"""

from contextlib import contextmanager
from dataclasses import replace

import torch
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.adjoint.coupled_predictor import CoupledPredictor
from ddg_warp.adjoint.coupled_step import CoupledSavedStep
from ddg_warp.adjoint.implicit import Adjoint, EquilibriumAdjoint
from ddg_warp.adjoint.rod_predictor import RodPredictor
from ddg_warp.adjoint.rod_step import SavedStep
from ddg_warp.capture_lock import alone
from ddg_warp.kernels.adjoint.time_step import flag_kernels, requested_kernels, smooth_kernel
from ddg_warp.model.controls import Controls
from ddg_warp.model.rebuild import ModelBuilder
from ddg_warp.model.state import Sliding
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.stepping.graph_cache import Graphs
from ddg_warp.solve.stepping.integrator import Integrator
from ddg_warp.solve.stepping.world_reset import cubed
from ddg_warp.torch.controls import FIELD, StepControls
from ddg_warp.torch.grip_poses import Poses
from ddg_warp.torch.notice import Notice
from ddg_warp.torch.parameter_tensors import ParameterTensors
from ddg_warp.torch.state_layout import GRADIENTS, StateLayout, copies, tensors, view

FOREVER = 2**62  # steps between host checks of outcomes, as worlds carry flags
LOAD = "load_steps", "start", "end"  # options of the load path of an equilibrium


class Engine:
    """Steps and gradients of a model, batched over worlds.

    Args:
        source: the user's model; the engine steps a copy, so that tensors never enter the original.
        worlds: number of worlds of the copy.
        scheme, options: see `Integrator`.

    Attributes:
        codes: outcomes of the last step per world (worlds,), see `kernels.core.outcome`. Zero if good.
        layout, fields: layout of the tensors of a state.
        tables, controls: parameters and controls of steps.
        before, after: states at the ends of a step.
        adjoint, poses: backward pass of steps, made at the first request.
        by_poses: gradient with respect to the grip poses of the last step or equilibrium pulled (worlds, grips, 6).
        by_equilibrium: tensors of the gradient with respect to the equilibrium before it; None without friction.
    """

    def __init__(self, source, worlds: int, scheme: str, options: dict):
        recipe = ModelBuilder(source, worlds)
        self.model = model = recipe.build()
        self._version = recipe.version
        self.device = str(wp.device_to_torch(model.wp_device))
        self.midpoint = scheme == "implicit_midpoint"
        self.integrator = Integrator(model, scheme, failures="flag", check_every=FOREVER, energy_bound=None, **options)
        self.integrator.step_whole()
        self.integrator._spin(bool(self.integrator.gyroscopic))
        self.adjoint = self.poses = self.by_poses = self.by_equilibrium = None
        self._equilibria = {}  # adjoints of equilibria, by True if grip poses are inputs
        self._solver = None  # options and solver of equilibria
        self.layout, self.tables = StateLayout(model), ParameterTensors(model)
        self.fields = self.layout.fields
        self.before, self.after = (buffer.own for buffer in self.integrator._buffers)
        self.source, self.target = (tensors(state, self.fields) for state in (self.before, self.after))
        self.controls = StepControls(self)
        self._flagged, self._streams = {}, {}
        self._solves, self._excuse, self._fails = flag_kernels(model.types.real)
        self._graphs = self._by_start = None
        self.wrenches = None  # made at the first request
        self._numbered = False  # True if tensors may have changed contact parameters
        self.integrator._worlds.watch()
        self.tables.invalid = view(self.integrator._worlds.invalid)
        self._codes = wp.zeros(worlds, dtype=int, device=model.wp_device)
        self.codes, self._outcome_codes = view(self._codes), self.integrator._worlds.outcome_codes
        self._outputs_of = Notice(model.wp_device)

    def follow(self, source) -> None:
        """Copy changed parameters and rest shapes of the user's model."""
        if self._version != source.version:
            with self.turn():
                self.tables.restore()
                recipe = ModelBuilder(source, self.model.worlds)
                recipe.put(self.model)
                self._version = recipe.version

    @property
    def lost(self) -> bool:
        """True if a step or backward pass had no gradient in a world, as far as the device has reported yet."""
        return self._outputs_of.given

    # steps

    def forward(self, start: float, dt: float, state, controls: dict, graded: bool) -> list[torch.Tensor]:
        """Make a step and return tensors of the results.

        Returns:
            The state after the step, flags (islands,) of every subsystem, and `codes` (worlds,). Flags are NaN for steps without
            gradient if `graded`; then `lagged` follows, 24 bytes a dof block in float64.
        """
        integrator = self.integrator
        self.fill(self.source, state)
        self._renumber(integrator._coupled)
        integrator._prepare(dt, self.before)
        self.controls.give(controls)
        self.controls.give_fields(integrator.evaluation_time(start, dt), controls)
        self.controls.give_drives(integrator.evaluation_time(start, dt), controls)
        with self.controls.driven():
            integrator.advance(0, start, dt, anew=True)
        s = integrator._solved(dt)
        wp.copy(self._codes, self._outcome_codes)
        results = copies(self.target) + [self._smooth(part, s, graded) for part in integrator._parts]
        return [*results, self.codes.clone(), *(self.lagged() if graded else [])]

    def _renumber(self, owner) -> None:
        """Make the stepper of the coupled system re-read contact parameters that tensors may have changed."""
        if owner is not None and owner.arcs and (self.tables.given or self._numbered):
            self._numbered = self.tables.given
            owner.arcs.outdate()

    def smooth_flags(self) -> list[torch.Tensor]:
        """Return flags (islands,) of every subsystem for steps that have gradients everywhere."""
        real = wp.dtype_to_torch(self.model.types.real)
        return [torch.ones(len(part.islands), dtype=real, device=self.device) for part in self.integrator._parts]

    @property
    def solutions(self) -> list[wp.array]:
        """Data of the solve of the coupled system that no state has.

        These are the solutions of the friction iterations, see `NewtonContact`, then `virial` of rigid bodies, see
        `kernels.rigid_bodies.condensation`.
        """
        coupled = self.integrator._coupled
        if coupled is None:
            return []
        newton = coupled.newton
        bodies = [newton.rigid_bodies.bodies.virial] if newton.rigid_bodies else []
        return [*(newton.contact.solutions if newton.contact else []), *bodies]

    def lagged(self) -> list[torch.Tensor]:
        """Return copies of the `solutions` of the step just made, for the backward pass."""
        return [view(values).clone() for values in self.solutions]

    def check(self, state) -> None:
        """Refuse start states with overlapping surfaces. Reads from the device if the model has contact.

        Raises:
            SceneError: names the pair and the overlap.
        """
        coupled = self.integrator._coupled
        if coupled is not None and coupled.newton.contact and not torch._C._are_functorch_transforms_active():
            with torch.no_grad(), self.turn():
                self.fill(self.source, state)
                coupled.newton.contact.diagnosis.check(self.before.coupled.q)

    @staticmethod
    def fill(targets: list[torch.Tensor], values) -> None:
        """Copy tensors into the memory that kernels read."""
        torch._foreach_copy_(targets, list(values))

    def _smooth(self, part, s: float, graded: bool) -> torch.Tensor:
        """Return 1 for islands stepped by a single solve over s [s] without frame updates, else NaN."""
        key, coupled = id(part), part is self.integrator._coupled
        if key not in self._flagged:  # keyed by live steppers; a rebuilt one has another id
            islands, real, device = part.islands, self.model.types.real, self.model.wp_device
            choice = (CoupledPredictor, part.coupled) if coupled else (RodPredictor, part.group)
            predictor = choice[0].of(self.model, choice[1], part.motion, self.integrator.scheme)
            if coupled:
                frames = (part._lagged[0], self.before.coupled.frame) if part.coupled.edges else ()
            else:
                iterates, twist = part.newton.iterates, part.group.kind.twist
                frames = (iterates.frame, self.before.groups[part.index].frame) if twist else ()
            if frames and predictor and predictor.carries:
                frames = frames[0], predictor.frame
            if coupled:
                frames = [frame.reshape((6, self.model.worlds, -1)).transpose((0, 2, 1)) for frame in frames]
            flag_array = wp.ones(len(islands), dtype=real, device=device)
            none = 2 * [wp.zeros((0, 0, 0), dtype=real, device=device)]
            read = [*islands.arrays, int(predictor is not None), *(frames or none), part.islands_each]
            read += [flag_array, self._codes, self._outputs_of.array]
            launch = wp.launch(smooth_kernel(real), len(islands), read, device=device, record_cmd=True)
            self._flagged[key] = part, predictor, launch, flag_array, view(flag_array)
        _, predictor, launch, _, flags = self._flagged[key]
        if not graded:
            return torch.ones_like(flags)
        if predictor:
            predictor.suit(part, s)
            predictor.find(self.before.coupled if coupled else self.before.groups[part.index])
        launch.launch()
        return flags.clone()

    # gradients

    def backward(
        self, start: float, dt: float, before, after, other_results, cotangent, controls: dict
    ) -> tuple[list[torch.Tensor], list, list[torch.Tensor]]:
        """Return the gradients of a step by start state and other inputs, and flags (islands,).

        Flags are NaN where an island has no gradient but a nonzero cotangent, and so are its gradients by the start state; others are
        to be multiplied by the flags. Failed worlds are treated as at rest, so that they contribute no NaN without a cotangent.

        Args:
            start, dt: time and length of the step.
            before, after: tensors of the states before and after the step.
            other_results: further results of `forward`, after the state.
            cotangent: tensors of the gradient with respect to the state after the step, None for zero.
            controls: controls of the step.
        """
        adjoint = self._adjoint()
        self.controls.give_field(controls)
        self.controls.give_gravity(controls, adjoint)
        self.controls.give_fields(self.integrator.evaluation_time(start, dt), controls)
        self.controls.give_drives(self.integrator.evaluation_time(start, dt), controls)
        pushed = self.model.rigid_bodies is not None and "wrenches" in controls
        if pushed:
            view(self._moment).copy_(torch.nan_to_num(controls["wrenches"][..., 3:].reshape(-1, 3)))
        self._fill_all((before, after, cotangent), other_results)
        if adjoint.upload(start, dt):
            self._graphs.clear()
        between = self.midpoint or adjoint.coupled is not None  # then solutions are formed of cleaned states
        if between:
            self._graphs.replay("clean", self._clean)
        s, parts = self.integrator._solved(dt), list(self._parts)
        for kept, end in zip(parts if self.midpoint else (), self.after.groups, strict=False):
            for middle, *ends in ((kept.x, end.x, kept.before.x), (kept.theta, end.theta, kept.before.theta)):
                torch.mul(sum(view(array) for array in ends), 0.5, out=view(middle))
        if adjoint.coupled:
            kept = self._net_kept(start, dt)
            parts.append(replace(kept, moment=self._moment) if pushed else kept)

        def launch():
            if not between:
                self._clean()
            self._found = adjoint.vjp_of_parts(self.before, self.after, parts, self._given, s)
            self._judge()

        self._graphs.replay((dt, pushed), launch)
        while adjoint.has_overflow(parts):
            self._graphs.clear()
            self._graphs.replay((dt, pushed), launch)
        by_start, inputs = self._found
        if self.poses:
            ends = self.before, self.after
            self.poses.pull_step(by_start, inputs, ends, self._given, "poses" in controls)
            self.by_poses = self.poses.by_end
        if self._by_start is None:  # whose memory stays
            self._by_start = tensors(by_start, self.fields)
        return self._by_start, inputs, self._flag_tensors

    def _fill_all(self, states, other_results) -> None:
        """Copy the tensors of a step, of the gradient by the end (None for zero), and of the results other than the state."""
        count = self.parts
        targets, values, empty = self._output_places[:count], list(other_results[:count]), []
        for places, tensors_of, read in zip(
            (self.source, self.target, self._by_state), states, self._read, strict=True
        ):
            for i in read:
                if tensors_of[i] is None:
                    empty.append(places[i])
                else:
                    targets.append(places[i])
                    values.append(tensors_of[i])
        self.fill(targets, values)  # of one type, in few launches
        self.fill(self._output_places[count:], other_results[count:])
        if empty:
            torch._foreach_zero_(empty)

    def _clean(self) -> None:
        """Put failed worlds at rest before a backward pass; launches only."""
        worlds, (mask, some) = self.integrator._worlds, self._failures
        some.zero_()
        wp.launch(self._fails, len(mask), [self._codes_then, self._lost], [mask, some], device=mask.device)
        wp.capture_if(some, lambda: self._to_rest(worlds, mask))

    def _to_rest(self, worlds, mask: wp.array) -> None:
        for state in (self.before, self.after):
            worlds.take_over(mask, worlds.start, state)
        for rod_adjoint in self.adjoint.rod_adjoints:  # NaN of the last pass, which stay in the padding of shorter rods
            rod_adjoint.clear()
        coupled = worlds.start.coupled
        for array in self._coupled.lagged if coupled else ():
            worlds.take_array(mask, coupled.q, array, self.model.worlds)
        if coupled and self._coupled.virial is not None:
            worlds.take_array(mask, self._no_virial, self._coupled.virial, self.model.worlds)

    def _judge(self) -> None:
        """Compute the flags of a backward pass; launches only."""
        lost = self._lost
        lost.zero_()
        for adjoint, flags, result_flags, requested in zip(self.adjoint.parts, *self._flags, strict=True):
            failed = adjoint.solve.failed
            outputs = [result_flags, requested, lost, self._outputs_of.array]
            wp.launch(self._solves, failed.shape, [failed, flags], outputs, device=failed.device)
        wp.capture_if(lost, self._ask)

    def _ask(self) -> None:
        """Reset to 1 the flags of islands with zero cotangent; replace the gradients of others without a gradient by NaN."""
        real, by_start = self.model.types.real, self._found[0]
        for cotangent, gradient, result_flags, requested in zip(
            self._graded(self._given), self._graded(by_start), *self._flags[1:], strict=True
        ):
            for cube in _cubes(cotangent, len(result_flags)):
                asked, _ = requested_kernels(cube.dtype, real)
                inputs = [result_flags, cube, cube.shape[-1] // len(result_flags)]
                wp.launch(asked, cube.shape, inputs, [requested], device=cube.device)
            wp.launch(self._excuse, len(result_flags), [requested], [result_flags], device=result_flags.device)
            for cube in _cubes(gradient, len(result_flags)):
                _, spoil = requested_kernels(cube.dtype, real)
                inputs = [result_flags, cube.shape[-1] // len(result_flags)]
                wp.launch(spoil, cube.shape, inputs, [cube], device=cube.device)

    @staticmethod
    def _graded(state) -> list:
        """Return the states of all subsystems, in the order of the flags."""
        return [part for name, part in state.parts().items() if name != "grips"]

    def _adjoint(self) -> Adjoint:
        if self.adjoint is None:
            adjoint = Adjoint(self.integrator)
            self._given = self.model.empty_state()
            self._by_state = tensors(self._given, self.fields)
            # fields of the start, of the end, and of the gradient by the end
            self._read = [self._indices_but([part.unread[k] for part in adjoint.rod_adjoints]) for k in range(3)]
            self._graphs = Graphs(self.model, self._load)
            # same layout as states, so that a graph can copy it
            solved = (self.model.empty_state() if self.midpoint else self.after).groups
            self._parts = [
                SavedStep(before, solution.x, solution.theta, before.frame, None)
                for solution, before in zip(solved, self.before.groups, strict=True)
            ]
            if adjoint.coupled:
                before, data = self.before.coupled, self.after.coupled.data
                if self.midpoint:
                    data = {index: wp.clone(values) for index, values in data.items()}
                solved = replace(before, q=wp.clone(before.q), data=data)
                lagged, virial = [wp.clone(values) for values in self.solutions], None
                if self.model.coupled.bodies:
                    *lagged, virial = lagged
                    self._no_virial, self._moment = wp.zeros_like(virial), wp.zeros_like(before.momentum)
                self._coupled = CoupledSavedStep(before, solved, None, lagged=lagged, virial=virial)
                self._turned = wp.clone(before.q)  # scratch
            self.adjoint = adjoint
            self._make_flags()
            self.poses = Poses(adjoint, self.midpoint) if self.model.grips else None
        return self.adjoint

    def _indices_but(self, unread: list[set[str]]) -> list[int]:
        """Return the indices of fields, except the names that each rod group leaves unread."""
        names = {f"{i}/{name}" for i, each in enumerate(unread) for name in each}
        return [i for i, field in enumerate(self.fields) if field.name not in names]

    def _make_flags(self) -> None:
        """Allocate the flags that a backward pass reads and writes."""
        model, device = self.model, self.model.wp_device
        self._codes_then, mask, some, self._lost = (
            wp.zeros(count, dtype=int, device=device) for count in (model.worlds, model.worlds, 1, 1)
        )
        self._failures = mask, some
        counts = [len(part.islands) for part in self.integrator._parts]
        # flags of the step, of its backward pass, and of a nonzero cotangent
        self._flags = [
            [wp.zeros(count, dtype=dtype, device=device) for count in counts]
            for dtype in (model.types.real, model.types.real, int)
        ]
        self._flag_tensors = [view(result_flags) for result_flags in self._flags[1]]
        kept = []
        if self.adjoint.coupled:
            virial = self._coupled.virial
            kept = [*self._coupled.lagged, *([] if virial is None else [virial])]
        self._output_places = [view(place) for place in (*self._flags[0], self._codes_then, *kept)]

    def _load(self) -> None:
        kernels = [kernel for adjoint in self.adjoint.parts for kernel in adjoint.kernels]
        types = {array.dtype for array in self._given.arrays().values()}
        kernels += [kernel for dtype in types for kernel in requested_kernels(dtype, self.model.types.real)]
        kernels += [self._solves, self._excuse, self._fails]
        device_arrays.load_kernels(kernels, self.model.wp_device)
        self.integrator._worlds.load_modules()

    def _net_kept(self, start: float, dt: float) -> CoupledSavedStep:
        """Return the saved step of the coupled system.

        Joint rotations are the rates of the step times its length, since these dofs are zero at the start of each step.
        """
        coupled, before, after, kept = self.model.coupled, self.before.coupled, self.after.coupled, self._coupled
        q = view(kept.solved.q)
        q.copy_(view(after.q))
        if self.midpoint:
            q.add_(view(before.q)).mul_(0.5)
            self._data_between(start, dt)
        spins = coupled.host.spins
        if spins:
            rates = view(after.v)
            if self.midpoint:  # mean rate of both ends, over half of the step
                rates = 0.25 * (rates + view(before.v))
            q.view(coupled.worlds, -1, 3)[:, -spins:] = rates.reshape(coupled.worlds, -1, 3)[:, -spins:] * dt
        return kept

    def _data_between(self, start: float, dt: float) -> None:
        """Write the data of the solve at the midpoint of a step: normals rotated by supports, and the magnetic field."""
        step = self.integrator._coupled
        step.prescribe(start, start + dt)
        if step.motion:
            step.motion.follow(self.before, self.after)
            # only normals are needed: angles are known
            wp.copy(self._turned, self._coupled.solved.q)
            step.motion.direct(self.adjoint.coupled.supports.islands, self._turned, self.before.coupled.frame)
        for index, data in self._coupled.solved.data.items():
            wp.copy(data, step._data[index])

    # equilibria

    def balance(self, state, controls: dict, options: dict, graded: bool) -> list[torch.Tensor]:
        """Return the tensors of the equilibrium found from a state, and smooth flags of every subsystem, as `forward`.

        With friction and `graded` the load path follows: load parameters and increments of all equilibria (n, 2), then for each its
        tensors and the velocities of its `Sliding`.
        """
        start, path = self.model.empty_state(), []
        self.fill(tensors(start, self.fields), state)
        load = {name: options[name] for name in LOAD if name in options}
        solver = self._static({name: value for name, value in options.items() if name not in LOAD})
        self._renumber(solver.coupled)
        self.controls.give_fields(load.get("start", 0.0), {})
        last = solver.load(start, controls=_on_host(controls), way=path, **load)
        result = copies(tensors(last, self.fields)) + self.smooth_flags()
        if graded and last.sliding is not None:
            result.append(torch.tensor([[point.time, point.sliding.increment] for point in path], dtype=torch.float64))
            for point in path:
                result += [*copies(tensors(point, self.fields)), view(point.sliding.velocity).clone()]
        return result

    def _static(self, options: dict) -> statics.Equilibrium:
        """Return the equilibrium solver, reused while options are the same, since graph capture costs as much as a small solve."""
        wanted_options = statics.StaticsOptions(**options), self.model.version
        if self._solver is None or self._solver[0] != wanted_options:
            self._solver = wanted_options, statics.Equilibrium(self.model, wanted_options[0])
        return self._solver[1]

    def way(self, end: float, results) -> list[tuple]:
        """Return load parameter, tensors, velocities and increment of every equilibrium of a load path, from the results of `balance`.

        Without friction the path is the last equilibrium, at the load parameter `end`.
        """
        rest, count = results[len(self.fields) + self.parts :], len(self.fields) + 1
        if not rest:
            return [(end, results[: len(self.fields)], None, 0.0)]
        numbers, *rest = rest
        each = [rest[i : i + count] for i in range(0, len(rest), count)]
        return [
            (factor, values[:-1], values[-1], increment)
            for (factor, increment), values in zip(numbers.tolist(), each, strict=True)
        ]

    def balance_backward(
        self, end: float, state, controls: dict, cotangent, velocity=None, increment: float = 0.0
    ) -> list:
        """Return the gradients of the inputs, by subsystem, of an equilibrium at the load parameter `end`.

        With friction, `velocity` and `increment` are of the load step to the equilibrium; `by_equilibrium` is then the gradient
        with respect to the equilibrium before.
        """
        posed = "poses" in controls
        if posed not in self._equilibria:
            adjoint = EquilibriumAdjoint(self.model, posed)
            self._equilibria[posed] = adjoint, Poses(adjoint) if posed else None
        adjoint, poses = self._equilibria[posed]
        equilibrium, by_state = self.model.empty_state(), self.model.empty_state()
        self.fill(tensors(equilibrium, self.fields), state)
        self.fill(tensors(by_state, self.fields), cotangent)
        equilibrium.time = end
        if velocity is not None:
            equilibrium.sliding = Sliding(wp.empty_like(equilibrium.coupled.v), increment)
            view(equilibrium.sliding.velocity).copy_(velocity)
        self.controls.give_fields(end, {})
        inputs = adjoint.vjp(equilibrium, by_state, _on_host(controls))
        self.by_equilibrium = tensors(adjoint.by_before, self.fields) if adjoint.has_friction else None
        if posed:
            poses.pull_equilibrium(inputs, equilibrium, by_state)
            self.by_poses = poses.by_end
        return inputs

    def poses_of(self, state) -> torch.Tensor:
        """Return the grip poses in the tensors of a state (worlds, grips, 6)."""
        index = next(i for i, field in enumerate(self.fields) if field.name == "grips/pose")
        return state[index].T.reshape(self.model.worlds, -1, 6)

    # used by `ddg_warp.torch.autograd`

    @contextmanager
    def turn(self):
        """Lock the engine's memory against other threads and launch on torch's stream; the CPU has one order for all."""
        with alone(self):
            if not self.model.wp_device.is_cuda:
                yield
                return
            stream = torch.cuda.current_stream(self.device)
            if stream not in self._streams:
                self._streams[stream] = wp.stream_from_torch(stream)
            with wp.ScopedStream(self._streams[stream]):
                yield

    @property
    def parts(self) -> int:
        """Number of subsystems: rod groups, and the coupled system."""
        return len(self.integrator._parts)

    @property
    def extra_outputs(self) -> int:
        """Maximum number of tensors that `forward` returns besides the state."""
        return self.parts + 1 + len(self.solutions)


def _cubes(part, islands: int) -> list[wp.array]:
    """Return the arrays of a subsystem's state that have gradients, with three axes and columns of `islands` islands."""
    return [
        cubed(array)
        for name, array in part.arrays().items()
        if name.rstrip("_0123456789") in GRADIENTS and array.shape[-1] % islands == 0
    ]


def _on_host(controls: dict) -> Controls:
    """Convert controls from tensors to host arrays for static solvers."""
    values = {name: value.detach().cpu().numpy() for name, value in controls.items()}
    fields = {name.removeprefix(FIELD): values.pop(name) for name in controls if name.startswith(FIELD)}
    return Controls(**values, fields=fields or None)
