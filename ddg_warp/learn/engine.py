"""Steps of many worlds and their reverse, between tensors: what `ddg_warp.torch` stands on.

Memory of integrator and adjoint stays where it is, so that each is one captured graph: tensors are copied in and out.
"""

from contextlib import contextmanager
from dataclasses import replace

import torch
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.adjoint.step import asked_kernel, flag_kernels, smooth_kernel
from ddg_warp.learn.adjoint import Adjoint, EquilibriumAdjoint
from ddg_warp.learn.chains import Kept
from ddg_warp.learn.controls import StepControls
from ddg_warp.learn.layout import GRADIENTS, Layout, copies, tensors, view
from ddg_warp.learn.net import NetKept
from ddg_warp.learn.net_predictor import NetPredictor
from ddg_warp.learn.notice import Notice
from ddg_warp.learn.poses import Poses
from ddg_warp.learn.predictor import ChainPredictor
from ddg_warp.learn.tables import Tables
from ddg_warp.model.controls import Controls
from ddg_warp.model.recipe import Recipe
from ddg_warp.model.state import Sliding
from ddg_warp.solve import statics
from ddg_warp.solve.dynamics import Integrator
from ddg_warp.solve.graphs import Graphs
from ddg_warp.solve.worlds import cubed
from ddg_warp.threads import alone

FOREVER = 2**62  # steps between readings of outcomes, which worlds flag
LOAD = "load_steps", "start", "end"  # what is said of the way to an equilibrium, beside options of what solves for it


class Engine:
    """Steps and gradients of a model with its worlds.

    Args:
        source: the user's model; the engine steps a copy of it, so that tensors never get into what others step.
        worlds: how many the copy has.
        scheme, options: as of `Integrator`.

    Attributes:
        codes: outcomes of the last step of every world (worlds,), see `kernels.outcome`: 0 where it converged and, where gradients were
            asked for, has one.
        layout, fields: what the tensors of a state are.
        tables, controls: what else steps read.
        before, after: the states at the ends of a step.
        adjoint, poses: what its reverse goes by, once that was asked for.
        by_poses: derivatives by poses of grips of the last step or equilibrium that was pulled (worlds, grips, 6).
        by_equilibrium: tensors of the derivatives by the equilibrium before that; None without friction.
    """

    def __init__(self, source, worlds: int, scheme: str, options: dict):
        recipe = Recipe(source, worlds)
        self.model = model = recipe.build()
        self._version = recipe.version
        self.device = str(wp.device_to_torch(model.wp_device))
        self.midpoint = scheme == "implicit_midpoint"
        self.integrator = Integrator(model, scheme, failures="flag", check_every=FOREVER, energy_bound=None, **options)
        self.integrator.step_whole()
        self.integrator._spin(bool(self.integrator.gyroscopic))
        self.adjoint = self.poses = self.by_poses = self.by_equilibrium = None
        self._equilibria = {}  # reverse of those that are given poses, and of others
        self._solver = None  # of equilibria, and what it is for
        self.layout, self.tables = Layout(model), Tables(model)
        self.fields = self.layout.fields
        self.before, self.after = (buffer.own for buffer in self.integrator._buffers)
        self.source, self.target = (tensors(state, self.fields) for state in (self.before, self.after))
        self.controls = StepControls(self)
        self._flagged, self._streams = {}, {}
        self._solves, self._excuse, self._fails = flag_kernels(model.types.real)
        self._graphs = self._by_start = None
        self._numbered = False  # whether numbers of contact may be those of parameters
        self.integrator._worlds.watch()
        self.tables.invalid = view(self.integrator._worlds.invalid)
        self._codes = wp.zeros(worlds, dtype=int, device=model.wp_device)
        self.codes, self._resting = view(self._codes), self.integrator._worlds.resting
        self._told_of = Notice(model.wp_device)

    def follow(self, source) -> None:
        """Take over the parameters and rest shapes of the user's model where they have changed."""
        if self._version != source.version:
            with self.turn():
                self.tables.restore()
                recipe = Recipe(source, self.model.worlds)
                recipe.put(self.model)
                self._version = recipe.version

    @property
    def lost(self) -> bool:
        """Whether a step or a reverse had no gradient in a world, as far as the device has told by now."""
        return self._told_of.given

    # steps

    def forward(self, start: float, dt: float, state, controls: dict, graded: bool) -> list[torch.Tensor]:
        """Return tensors: the state after a step; flags (islands,) of every part, not numbers where it has no gradient, if that is
        asked; `codes` (worlds,); and the `lagged`, of 24 bytes a block in float64."""
        integrator = self.integrator
        self.fill(self.source, state)
        self._renumber(integrator._net)
        integrator._prepare(dt, self.before)
        self.controls.give(controls)
        integrator.advance(0, start, dt, anew=True)
        s = integrator._solved(dt)
        wp.copy(self._codes, self._resting)
        found = copies(self.target) + [self._smooth(part, s, graded) for part in integrator._parts]
        return [*found, self.codes.clone(), *(self.lagged() if graded else [])]

    def _renumber(self, owner) -> None:
        """Have a step or an equilibrium of the net take anew the numbers of contact that parameters may have changed."""
        if owner is not None and owner.arcs and (self.tables.given or self._numbered):
            self._numbered = self.tables.given
            owner.arcs.outdate()

    def smooth_flags(self) -> list[torch.Tensor]:
        """Flags (islands,) of every part, of steps through which gradients go everywhere."""
        real = wp.dtype_to_torch(self.model.types.real)
        return [torch.ones(len(part.islands), dtype=real, device=self.device) for part in self.integrator._parts]

    @property
    def solutions(self) -> list[wp.array]:
        """As of `NetContact`, of the net."""
        net = self.integrator._net
        return net.newton.contact.solutions if net is not None and net.newton.contact else []

    def lagged(self) -> list[torch.Tensor]:
        """Tensors of the `solutions` of the step just made, which its reverse reads."""
        return [view(values).clone() for values in self.solutions]

    def check(self, state) -> None:
        """Refuse to start from the tensors of a state in which surfaces overlap. Reads from the device where there is contact.

        Raises:
            SceneError: names the pair and by how much.
        """
        net = self.integrator._net
        if net is not None and net.newton.contact and not torch._C._are_functorch_transforms_active():
            with torch.no_grad(), self.turn():
                self.fill(self.source, state)
                net.newton.contact.check(self.before.net.q)

    @staticmethod
    def fill(places: list[torch.Tensor], values) -> None:
        """Copy tensors to where they are read."""
        torch._foreach_copy_(places, list(values))

    def _smooth(self, part, s: float, graded: bool) -> torch.Tensor:
        """One for islands whose step was one solve over s [s] in the frames that it began with, else not a number."""
        key, net = id(part), part is self.integrator._net
        if key not in self._flagged:  # of parts that there are; one made anew has another place
            islands, real, device = part.islands, self.model.types.real, self.model.wp_device
            of = (NetPredictor, part.net) if net else (ChainPredictor, part.group)
            predictor = of[0].of(self.model, of[1], part.motion, self.integrator.scheme)
            if net:
                frames = (part._lagged[0], self.before.net.frame) if part.net.edges else ()
            else:
                frames = (part.newton.frame, self.before.groups[part.index].frame) if part.group.kind.twist else ()
            if frames and predictor and predictor.carries:
                frames = frames[0], predictor.frame
            if net:
                frames = [frame.reshape((6, self.model.worlds, -1)).transpose((0, 2, 1)) for frame in frames]
            found = wp.ones(len(islands), dtype=real, device=device)
            none = 2 * [wp.zeros((0, 0, 0), dtype=real, device=device)]
            read = [*islands.arrays, int(predictor is not None), *(frames or none), part.islands_each]
            read += [found, self._codes, self._told_of.array]
            launch = wp.launch(smooth_kernel(real), len(islands), read, device=device, record_cmd=True)
            self._flagged[key] = part, predictor, launch, found, view(found)
        _, predictor, launch, _, flags = self._flagged[key]
        if not graded:
            return torch.ones_like(flags)
        if predictor:
            predictor.suit(part, s)
            predictor.find(self.before.net if net else self.before.groups[part.index])
        launch.launch()
        return flags.clone()

    # gradients

    def backward(
        self, start: float, dt: float, before, after, told, given, controls: dict
    ) -> tuple[list[torch.Tensor], list, list[torch.Tensor]]:
        """Derivatives by the state before a step, and by what else it read, part by part, and what they are multiplied by (islands,).

        These flags are not numbers where an island has no gradient and is asked for one, by derivatives other than zero. Worlds that
        failed are taken to be at rest, so that nothing is not a number where nothing is asked.

        Args:
            start, dt: time and length of the step.
            before, after, told, given: tensors of the state before it, those that `forward` gave, of which `told` are what follows the
                state, and those of the derivatives by its end.
            controls: which it was given.
        """
        adjoint = self._adjoint()
        self.controls.give_field(controls)
        self.controls.give_gravity(controls, adjoint)
        self.fill(self.source, before)
        self.fill([self.target[i] for i in self._read], [after[i] for i in self._read])
        self.fill(self._by_state, given)
        self.fill(self._told_places, told)
        if adjoint.upload(start, dt, self.tables.given):
            self._graphs.clear()
        self._graphs.replay("clean", self._clean)
        s, parts = self.integrator._solved(dt), list(self._parts)
        for kept, end in zip(parts if self.midpoint else (), self.after.groups, strict=False):
            for middle, *ends in ((kept.x, end.x, kept.before.x), (kept.theta, end.theta, kept.before.theta)):
                torch.mul(sum(view(array) for array in ends), 0.5, out=view(middle))
        if adjoint.net:
            parts.append(self._net_kept(start, dt))

        def launch():
            self._found = adjoint.pull_parts(self.before, self.after, parts, self._given, s)
            self._judge()

        self._graphs.replay(dt, launch)
        while adjoint.outgrown(parts):
            self._graphs.clear()
            self._graphs.replay(dt, launch)
        found, inputs = self._found
        if self.poses:
            ends = self.before, self.after
            self.poses.pull_step(found, inputs, ends, self._given, "poses" in controls)
            self.by_poses = self.poses.by_end
        if self._by_start is None:  # whose memory stays
            self._by_start = tensors(found, self.fields)
        return self._by_start, inputs, self._flag_tensors

    def _clean(self) -> None:
        """Put worlds that failed to rest, before a reverse; launches alone."""
        worlds, (mask, some) = self.integrator._worlds, self._failures
        some.zero_()
        wp.launch(self._fails, len(mask), [self._codes_then], [mask, some], device=mask.device)
        wp.capture_if(some, lambda: self._to_rest(worlds, mask))

    def _to_rest(self, worlds, mask: wp.array) -> None:
        for state in (self.before, self.after):
            worlds.take_over(mask, worlds.start, state)
        net = worlds.start.net
        for array in self._net.lagged if net else ():
            worlds.take_array(mask, net.q, array, self.model.worlds)

    def _judge(self) -> None:
        """Find the flags of a reverse; launches alone."""
        lost = self._lost
        lost.zero_()
        for own, flags, found, asked in zip(self.adjoint.parts, *self._flags, strict=True):
            failed = own.solve.failed
            outputs = [found, asked, lost, self._told_of.array]
            wp.launch(self._solves, failed.shape, [failed, flags], outputs, device=failed.device)
        wp.capture_if(lost, self._ask)

    def _ask(self) -> None:
        """Excuse islands that are asked for no gradient."""
        given = [part for name, part in self._given.parts().items() if name != "grips"]
        for part, found, asked in zip(given, *self._flags[1:], strict=True):
            for name, array in part.arrays().items():
                if name.rstrip("_0123456789") in GRADIENTS and array.shape[-1] % len(found) == 0:
                    cube, kernel = cubed(array), asked_kernel(array.dtype, self.model.types.real)
                    inputs = [found, cube, cube.shape[-1] // len(found)]
                    wp.launch(kernel, cube.shape, inputs, [asked], device=array.device)
            wp.launch(self._excuse, len(found), [asked], [found], device=found.device)

    def _adjoint(self) -> Adjoint:
        if self.adjoint is None:
            adjoint = Adjoint(self.integrator)
            self._given = self.model.empty_state()
            self._by_state = tensors(self._given, self.fields)
            unread = {f"{i}/{name}" for i, own in enumerate(adjoint.chains) for name in own.unread}
            self._read = [i for i, field in enumerate(self.fields) if field.name not in unread]
            self._graphs = Graphs(self.model, self._load)
            # laid out as states are, so that a graph can copy it
            solved = (self.model.empty_state() if self.midpoint else self.after).groups
            self._parts = [
                Kept(before, at.x, at.theta, before.frame, None)
                for at, before in zip(solved, self.before.groups, strict=True)
            ]
            if adjoint.net:
                before, data = self.before.net, self.after.net.data
                if self.midpoint:
                    data = {index: wp.clone(values) for index, values in data.items()}
                solved = replace(before, q=wp.clone(before.q), data=data)
                self._net = NetKept(before, solved, None, lagged=[wp.clone(values) for values in self.solutions])
                self._turned = wp.clone(before.q)  # scratch
            self.adjoint = adjoint
            self._make_flags()
            self.poses = Poses(adjoint, self.midpoint) if self.model.grips else None
        return self.adjoint

    def _make_flags(self) -> None:
        """Memory of what a reverse is told of a step, and of what it tells."""
        model, device = self.model, self.model.wp_device
        self._codes_then, mask, some, self._lost = (
            wp.zeros(count, dtype=int, device=device) for count in (model.worlds, model.worlds, 1, 1)
        )
        self._failures = mask, some
        counts = [len(part.islands) for part in self.integrator._parts]
        # of the step, of its reverse, and whether that is asked for any
        self._flags = [
            [wp.zeros(count, dtype=dtype, device=device) for count in counts]
            for dtype in (model.types.real, model.types.real, int)
        ]
        self._flag_tensors = [view(found) for found in self._flags[1]]
        kept = self._net.lagged if self.adjoint.net else []
        self._told_places = [view(place) for place in (*self._flags[0], self._codes_then, *kept)]

    def _load(self) -> None:
        kernels = [kernel for own in self.adjoint.parts for kernel in own.kernels]
        types = {array.dtype for array in self._given.arrays().values()}
        kernels += [asked_kernel(dtype, self.model.types.real) for dtype in types]
        kernels += [self._solves, self._excuse, self._fails]
        arrays.load_kernels(kernels, self.model.wp_device)
        self.integrator._worlds.load_modules()

    def _net_kept(self, start: float, dt: float) -> NetKept:
        """Of the net: joints' rotations are those at the rates of the step, as their dofs begin it at zero."""
        net, before, after, kept = self.model.net, self.before.net, self.after.net, self._net
        q = view(kept.solved.q)
        q.copy_(view(after.q))
        if self.midpoint:
            q.add_(view(before.q)).mul_(0.5)
            self._data_between(start, dt)
        spins = net.host.spins
        if spins:
            rates = view(after.v)
            if self.midpoint:  # the mean of those at both ends, over half of the step
                rates = 0.25 * (rates + view(before.v))
            q.view(net.worlds, -1, 3)[:, -spins:] = rates.reshape(net.worlds, -1, 3)[:, -spins:] * dt
        return kept

    def _data_between(self, start: float, dt: float) -> None:
        """Normals that supports turn, and the magnetic field, in the middle of a step, as its solve had them."""
        step = self.integrator._net
        step.prescribe(start, start + dt)
        if step.motion:
            step.motion.follow(self.before, self.after)
            # normals alone: angles are known
            wp.copy(self._turned, self._net.solved.q)
            step.motion.direct(self.adjoint.net.supports.islands, self._turned, self.before.net.frame)
        for index, data in self._net.solved.data.items():
            wp.copy(data, step._data[index])

    # equilibria

    def balance(self, state, controls: dict, options: dict, graded: bool) -> list[torch.Tensor]:
        """The equilibrium from the tensors of a state, and one of each part, as of `forward`.

        With friction, where gradients are asked for, the way there follows: load parameters and increments of all equilibria (n, 2),
        and of each its tensors and the velocities of its `Sliding`.
        """
        start, way = self.model.empty_state(), []
        self.fill(tensors(start, self.fields), state)
        load = {name: options[name] for name in LOAD if name in options}
        solver = self._static({name: value for name, value in options.items() if name not in LOAD})
        self._renumber(solver.net)
        found = solver.load(start, controls=_on_host(controls), way=way, **load)
        result = copies(tensors(found, self.fields)) + self.smooth_flags()
        if graded and found.sliding is not None:
            result.append(torch.tensor([[at.time, at.sliding.increment] for at in way], dtype=torch.float64))
            for at in way:
                result += [*copies(tensors(at, self.fields)), view(at.sliding.velocity).clone()]
        return result

    def _static(self, options: dict) -> statics.Equilibrium:
        """What solves for equilibria: that of the last time where options are the same, as its graphs take as long as a small solve."""
        asked = statics.StaticsOptions(**options), self.model.version
        if self._solver is None or self._solver[0] != asked:
            self._solver = asked, statics.Equilibrium(self.model, asked[0])
        return self._solver[1]

    def way(self, end: float, found) -> list[tuple]:
        """Of the tensors that `balance` gave, of every equilibrium on the way: load parameter, tensors, velocities and increment.

        Without friction that is the last one, at the load parameter `end`, alone.
        """
        rest, count = found[len(self.fields) + self.parts :], len(self.fields) + 1
        if not rest:
            return [(end, found[: len(self.fields)], None, 0.0)]
        numbers, *rest = rest
        each = [rest[i : i + count] for i in range(0, len(rest), count)]
        return [(at, own[:-1], own[-1], by) for (at, by), own in zip(numbers.tolist(), each, strict=True)]

    def balance_backward(self, end: float, state, controls: dict, given, velocity=None, increment: float = 0.0) -> list:
        """Derivatives by what an equilibrium at the load parameter `end`, under controls, reads, part by part.

        With friction it was come to with velocities, in an increment; then `by_equilibrium` are those by the one before.
        """
        posed = "poses" in controls
        if posed not in self._equilibria:
            adjoint = EquilibriumAdjoint(self.model, posed)
            self._equilibria[posed] = adjoint, Poses(adjoint) if posed else None
        adjoint, poses = self._equilibria[posed]
        at, by = self.model.empty_state(), self.model.empty_state()
        self.fill(tensors(at, self.fields), state)
        self.fill(tensors(by, self.fields), given)
        at.time = end
        if velocity is not None:
            at.sliding = Sliding(wp.empty_like(at.net.v), increment)
            view(at.sliding.velocity).copy_(velocity)
        inputs = adjoint.pull(at, by, _on_host(controls))
        self.by_equilibrium = tensors(adjoint.by_before, self.fields) if adjoint.rubs else None
        if posed:
            poses.pull_equilibrium(inputs, at, by)
            self.by_poses = poses.by_end
        return inputs

    def poses_of(self, state) -> torch.Tensor:
        """Poses of grips in the tensors of a state (worlds, grips, 6)."""
        place = next(i for i, field in enumerate(self.fields) if field.name == "grips/pose")
        return state[place].T.reshape(self.model.worlds, -1, 6)

    # what `ddg_warp.learn.step` asks

    @contextmanager
    def turn(self):
        """Keep other threads out of the engine's memory, and launch on torch's stream; on the CPU there is one order for all."""
        with alone(self):
            if not self.model.wp_device.is_cuda:
                yield
                return
            own = torch.cuda.current_stream(self.device)
            if own not in self._streams:
                self._streams[own] = wp.stream_from_torch(own)
            with wp.ScopedStream(self._streams[own]):
                yield

    @property
    def parts(self) -> int:
        """How many parts step on their own: groups of rods, and the net."""
        return len(self.integrator._parts)

    @property
    def told(self) -> int:
        """How many tensors `forward` gives beside the state, at most."""
        return self.parts + 1 + len(self.solutions)


def _on_host(controls: dict) -> Controls:
    """Controls as static solves take them, from tensors."""
    return Controls(**{name: value.detach().cpu().numpy() for name, value in controls.items()})
