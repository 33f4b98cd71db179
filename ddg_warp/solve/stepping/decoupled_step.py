"""Decoupled step: rods of the coupled system without contact are stepped as uncoupled rods.

Rods that only contact couples obey the equations of uncoupled rods while no pair is within the activation distance. The step is tried
this way in worlds without pairs in range at its start. If none came in range during the motion either, no contact force and no
friction act, and the result is the solution of the coupled system. Otherwise the coupled solver repeats the world's step from its
start. The decision depends only on the positions at both ends, not on earlier searches, so that a resumed run takes the same steps.

Culling of rods: while rods stay in bounds that do not overlap, no search is needed. The step is therefore tried before any test, then
tested by bounds, and where these are inconclusive, tried again with a test of pairs. All of that is below one graph condition.
"""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.compile.rod_groups import RodGroupData, compile_rod_groups
from ddg_warp.compile.rods import coupled_rods
from ddg_warp.kernels.collision.broad_phase.rod_culling import KNOWN
from ddg_warp.kernels.stepping import decoupled_rods as kernels
from ddg_warp.model.rod_elements import RodElements
from ddg_warp.model.rod_group import RodGroup
from ddg_warp.scene.flow import is_on_host
from ddg_warp.solve.collision.rod_culling import RodCulling
from ddg_warp.solve.stepping.rod_step import RodStep
from ddg_warp.timers import timer


class DecoupledStep:
    """Rods of a `CoupledStep` as uncoupled rod groups, whose states are scratch.

    Attributes:
        `rod_steps`: steps of the rod groups.
        runs: culling of rods; None if there are primitives other than edges.
        left: worlds of the last step that the coupled solver takes (worlds,).
    """

    def __init__(self, step, groups: list[RodGroup]):
        self.step_of, self.model, self.coupled = step, step.model, step.coupled
        real, device, worlds = self.model.types.real, self.model.wp_device, self.coupled.worlds
        self._fields, self._written = self.model.fields.bind(groups), 0  # before kernels read the memory of parameters
        self.rod_steps = [self._rod_step(group) for group in groups]
        self._states = [self.model.group_state(group) for group in groups]
        self._places = [Places(self.coupled, group) for group in groups]
        if self.model.version:  # the groups are of the scene
            for places in self._places:
                places.take_parameters()
        self._kernels = [kernels.rod_kernels(group.kind, real) for group in groups]
        self._search = step.newton.contact.search
        self.runs = RodCulling(self._search) if len(self._search.lists) == 1 else None
        # without culling all worlds are in doubt
        self._known = self.runs.known if self.runs else wp.full((KNOWN, worlds), 1, dtype=int, device=device)
        self._begin, self._hope, self._near, self._judge = kernels.world_kernels(real)
        self._wait, self._stay, self._follow = kernels.place_kernels(real, device_arrays.serial(device))
        self._world_status = wp.zeros((kernels.REPORTED, worlds), dtype=int, device=device)
        self.left, self._tried = (self._world_status[row] for row in (kernels.LEFT, kernels.TRIED))
        self._any_tried, self._some, self._again = (wp.zeros(1, dtype=int, device=device) for _ in range(3))
        obstacles = np.concatenate([np.zeros(0, int), *self.coupled.host.obstacles]).astype(np.int32)
        self._obstacles = wp.array(obstacles, dtype=int, device=device)
        self._mixed = not all(places.whole for places in self._places)

    def _rod_step(self, group: RodGroup, **options) -> RodStep:
        rod_step = RodStep(self.step_of.integrator, self.model, group, **options)
        if rod_step.motion:
            rod_step.motion.go_by(self.step_of.motion)
        return rod_step

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture, without the kernels of rod groups."""
        loaded = [
            self._begin,
            self._hope,
            self._near,
            self._judge,
            *(kernel for each in self._kernels for kernel in each),
        ]
        loaded += self.runs.kernels if self.runs else []
        loaded += [self._wait] if self.coupled.worlds > 1 else []
        return loaded + ([self._stay, self._follow] if len(self._obstacles) else [])

    def adapt(self, s: float, parameters_changed: bool = False) -> bool:
        """Update parameters and solver selection for a step of s [s], as `CoupledStep.adapt`; return True if graphs are outdated."""
        changed = any([places.take_parameters() for places in self._places])
        for i, rod_step in enumerate(self.rod_steps):
            if (means := rod_step.choose_solver(s, parameters_changed)) != rod_step.means or (
                parameters_changed and rod_step.newton.outdated
            ):
                self.rod_steps[i], changed = self._rod_step(rod_step.group, means=means, counts_of=rod_step), True
        return changed

    def prescribe(self, t0: float, t1: float) -> None:
        """Upload prescribed data of the rod groups between t0 and t1, fields of the model included."""
        fields = self.model.fields
        if fields and self._written != fields.count:
            fields.write(self._fields)
            self._written = fields.count
        for rod_step in self.rod_steps:
            rod_step.prescribe(t0, t1)

    def renew(self) -> None:
        """Rebuild the BVH of runs, on devices where tests only refit."""
        if self.runs and self.model.wp_device.is_cuda:
            self.runs.build()

    def step(self, before, after) -> None:
        """Launch the step; worlds with pairs in range are solved by the coupled system."""
        step = self.step_of
        inputs = [*step.islands.arrays, self._world_status, self._known]
        self._launch(self._begin, self.coupled.worlds, inputs, [step.remaining, self._again])
        if self.runs is None:
            self._by_pairs(before, after)
            wp.capture_if(step.remaining, lambda: step.go_on(before, after))
            return
        self._try(before, after, lambda: self.runs.hold(before.q, after.q, self._tried))
        self._judge_by(0)
        wp.capture_if(step.remaining, lambda: self._ask(before, after))

    def _ask(self, before, after) -> None:
        """Test open worlds with new bounds of runs, then by pairs; leave the remainder to the coupled system."""
        step = self.step_of
        wp.capture_if(self._again, lambda: self._look(before, after))
        wp.capture_if(step.remaining, lambda: self._by_pairs(before, after))
        wp.capture_if(step.remaining, lambda: step.go_on(before, after))

    def _look(self, before, after) -> None:
        self.step_of.remaining.zero_()
        self.runs.look(before.q, after.q, self._tried)
        self._judge_by(0)

    def _by_pairs(self, before, after) -> None:
        """Try the step in open worlds without pairs in range at the start, during the motion and at the end."""
        step, search = self.step_of, self._search
        for signal in (step.remaining, self._any_tried, self._some):
            signal.zero_()
        search.update(before.q)
        search.measure(before.q, enough=search.search_distance)
        overflow, (_, scalars) = search.counters.overflow, step.islands.arrays
        inputs = [search.gap, search.search_distance, overflow, scalars, self._world_status]
        self._launch(self._hope, self.coupled.worlds, inputs, [self._any_tried, step.remaining])
        wp.capture_if(self._any_tried, lambda: self._try_and_search(before, after))

    def _try_and_search(self, before, after) -> None:
        worlds, blocks, search = self.coupled.worlds, self.coupled.blocks, self._search
        self._try(before, after)
        if worlds > 1:
            device_arrays.sweep(
                self._wait,
                blocks,
                [self._world_status, blocks, before.q],
                [after.q],
                self.coupled.device,
                worlds=worlds,
            )
        search.update(before.q, after.q, search.every)
        for pairs in search.lists:
            self._launch(self._near, 1, [pairs.count], [self._some])
        wp.capture_if(self._some, lambda: self._measure(before, after))
        self._judge_by(1)
        if self.runs:
            self.runs.look(before.q, after.q, self._tried)

    @timer("decoupled rods")
    def _try(self, before, after, test_runs=None) -> None:
        """Solve the rods of tried worlds once; `test_runs` reads positions only and runs in parallel with the remaining launches."""
        rod_steps = list(zip(self.rod_steps, self._states, self._places, self._kernels, strict=True))
        for rod_step in rod_steps:
            self._solve(before, after, *rod_step)
        self._move(before, after)

        def complete() -> None:
            for rod_step in rod_steps:
                self._complete(after, *rod_step)

        device_arrays.side_by_side([test_runs, complete] if test_runs else [complete], self.model.wp_device)
        if self._mixed:
            self.coupled.update_strains(after)

    def _solve(self, before, after, rod_step, state, places, rod_kernels) -> None:
        """Solve the rods of a group once, and write their positions."""
        gather, scatter_positions, _ = rod_kernels
        group, world_status = rod_step.group, self._world_status
        lists = [places.rows, group.count]
        rod_arrays = [state.x, state.v, state.theta, state.omega, state.frame, state.last, state.a, state.alpha]
        inputs = [
            *lists,
            world_status,
            places.sizes,
            self.coupled.host.nodes,
            before.q,
            before.v,
            before.a,
            *places.lagged(before),
        ]
        self._launch(gather, group.node_threads, inputs, [*rod_arrays, *rod_step.islands.arrays])
        rod_step.move(state, state)
        inputs = [*lists, places.sizes, state.x, state.theta, rod_step.islands.arrays[0]]
        self._launch(scatter_positions, group.node_threads, inputs, [world_status, after.q])

    def _complete(self, after, rod_step, state, places, rod_kernels) -> None:
        """Write all results of a rod group but positions."""
        *_, scatter = rod_kernels
        rod_step.complete(state, state, state)
        group, inputs = rod_step.group, [places.rows, rod_step.group.count, places.sizes, self.coupled.host.nodes]
        inputs += [state.v, state.omega, state.frame, state.last, state.a, state.alpha, self._world_status]
        self._launch(scatter, group.node_threads, inputs, [after.v, after.a, *places.lagged(after)])

    def _move(self, before, after) -> None:
        """Move obstacles to the end of the step."""
        step, blocks = self.step_of, self.coupled.blocks
        if not len(self._obstacles):
            return
        dim, inputs = (
            (len(self._obstacles), self.coupled.worlds),
            [self._obstacles, self._world_status, blocks, before.q],
        )
        self._launch(self._stay, dim, inputs, [after.q])
        if step.motion:
            step.motion.place(step.islands, after.q)
        self._launch(self._follow, dim, [*inputs, after.q, step.integrator._dt], [after.v, after.a])

    def _judge_by(self, searched: int) -> None:
        """End the step of worlds without pairs in range, tested by bounds (`searched` 0) or by pairs (1)."""
        step, search = self.step_of, self._search
        inputs = [
            searched,
            self._some,
            search.gap,
            search.search_distance,
            search.crossed,
            search.counters.overflow,
            step.rounded,
        ]
        inputs += [self._known, self._world_status, *step.islands.arrays, step.newton.contact.tally.counts]
        outputs = [step.tally, step.work, step.remaining, self._again]
        self._launch(self._judge, self.coupled.worlds, inputs, outputs)

    def _measure(self, before, after) -> None:
        self._search.passing(before.q, self.step_of.newton.contact.limit.min_separation_fraction)
        self._search.measure(after.q, enough=self._search.search_distance)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)


class Places:
    """Dof map of a rod group within the coupled system.

    Attributes:
        rows (8, R): see `kernels.stepping.decoupled_rods`; sizes: numbers of blocks, rod edges, and elements of both element sets
            in a world.
        whole: True if the coupled system lags the same strains of these rods as the group.
    """

    def __init__(self, coupled, group: RodGroup):
        host, kind = coupled.host, group.kind
        self._group, self._taken = group, {}
        by_rod = {rod.rod: rod for rod in host.rods}
        rods = [by_rod[rod] for rod in group.host.rods.tolist()]
        self._elements = RodElements(coupled, kind, group.host.rods, group.nodes)
        self._sets, elements = self._elements.sets, self._elements.lists
        none = [np.zeros(0, int)] * len(rods)
        lists = [rod.all_nodes for rod in rods], [rod.all_edges for rod in rods], elements.get(2, none), elements[1]
        rows = np.concatenate([np.transpose([_evenly(places) for places in each]) for each in lists])
        self.rows = wp.array(np.ascontiguousarray(rows, np.int32), dtype=int, device=coupled.device)
        sizes = [coupled.sets[self._sets[span]].elements if span in self._sets else 0 for span in (2, 1)]
        self.sizes = wp.vec4i(coupled.blocks, coupled.edges, *sizes)
        self.whole = all(
            coupled.sets[self._sets[term.measure.span]].term.density.lagged == term.density.lagged
            for term in kind.terms
        )

    def take_parameters(self) -> bool:
        """Copy changed parameters of the coupled system to the group; return True if arrays were reallocated."""
        changed = self._elements.parameters(self._taken)
        return bool(changed) and self._group.parameters.set(**changed)

    def lagged(self, state) -> list[wp.array]:
        """Return the lagged data of a coupled state: frames, bending data, bending strains and stretch strains."""
        bending, stretch = self._sets.get(2, self._sets[1]), self._sets[1]
        return [state.frame, state.lag[bending], state.last[bending], state.last[stretch]]


def uncoupled(model) -> bool:
    """Return True if only contact couples the rods of a model, and all rods are open."""
    host, scene = model.coupled.host, model.scene
    if not host.contact_parameters or not host.rods or any(rod.piece.kind.closed for rod in host.rods):
        return False
    joined = scene.shells, scene.axisymmetric_shells, scene.joints, scene.attachments, scene.bodies, scene.magnets
    return not any((*joined, scene.user_forces))


def is_decoupled(integrator) -> bool:
    """Return True if an integrator allows decoupled steps: default solver, implicit Euler, no control loads, no field of flow."""
    usual = integrator.solver == "newton" and integrator.linear == "auto" and integrator.scheme == "implicit_euler"
    return usual and not is_on_host(integrator.model.scene.flow) and integrator.given is None and not integrator.whole


def rods_of(model) -> list[RodGroup]:
    """Return the rods of the coupled system as uncoupled rod groups."""
    real, device = model.types.real, model.wp_device
    rod_steps: list[RodGroupData] = compile_rod_groups(model.scene, coupled_rods(model.scene))
    return [RodGroup(rod_step, model.scene, model.worlds, device, real) for rod_step in rod_steps]


def _evenly(indices: np.ndarray) -> tuple[int, int]:
    """Return the first of some indices, and their constant stride."""
    if len(indices) < 2:
        return (int(indices[0]) if len(indices) else 0), 0
    strides = np.diff(indices)
    assert (strides == strides[0]).all(), "the numbering of a coupled system is not even along a rod"
    return int(indices[0]), int(strides[0])
