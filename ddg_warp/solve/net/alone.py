"""Steps in which the rods of a net touch nothing: each is solved on its own, as a rod of a group.

Where rods are coupled by contact alone and no pair is within its reach, the equations of a step are those of the rods one by one. So a
step is tried that way, in worlds in which nothing is near at its start. If nothing came near on the way either, no force of contact and
no friction act in it, and it is the solution of the whole: else the world is left to the net, from the start of the step. What decides
depends on the positions at both ends alone, not on what was searched for before, so that a run that is resumed takes the same steps.
"""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.compile.chains import ChainGroup, compile_chains
from ddg_warp.compile.rods import net_rods
from ddg_warp.kernels.net import alone as kernels
from ddg_warp.model.group import Group
from ddg_warp.solve.chains.step import ChainStep


class Alone:
    """Rods of a `NetStep` as groups of rods on their own; their states are scratch.

    Attributes:
        chains: their steps, a group each.
        left: which worlds of the last step are left to the net (worlds,).
    """

    def __init__(self, step, groups: list[Group]):
        self.step_of, self.model, self.net = step, step.model, step.net
        real, device, worlds = self.model.types.real, self.model.wp_device, self.net.worlds
        self.chains = [self._chain(group) for group in groups]
        self._states = [self.model.group_state(group) for group in groups]
        self._places = [Places(self.net, group) for group in groups]
        self._kernels = [kernels.rod_kernels(group.kind, real) for group in groups]
        step.newton.contact.search.look_for_runs()
        self._hope, self._near, self._judge = kernels.world_kernels(real)
        self._wait, self._stay, self._follow = kernels.place_kernels(real, arrays.serial(device))
        self._told = wp.zeros((kernels.TOLD, worlds), dtype=int, device=device)
        self.left = self._told[kernels.LEFT]
        self._tried, self._some = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
        obstacles = np.concatenate([np.zeros(0, int), *self.net.host.obstacles]).astype(np.int32)
        self._obstacles = wp.array(obstacles, dtype=int, device=device)
        self._mixed = not all(places.whole for places in self._places)

    def _chain(self, group: Group, **given) -> ChainStep:
        chain = ChainStep(self.step_of.integrator, self.model, group, **given)
        if chain.motion:
            chain.motion.go_by(self.step_of.motion)
        return chain

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture, without those of the chains."""
        own = [self._hope, self._near, self._judge, *(kernel for each in self._kernels for kernel in each)]
        own += [self._wait] if self.net.worlds > 1 else []
        return own + ([self._stay, self._follow] if len(self._obstacles) else [])

    def adapt(self, s: float) -> bool:
        """As of `NetStep`."""
        changed = False
        for i, chain in enumerate(self.chains):
            if (means := chain.suited(s)) != chain.means:
                self.chains[i], changed = self._chain(chain.group, means=means, counts_of=chain), True
        return changed

    def step(self, before, after) -> None:
        """Launch the step in worlds in which nothing is near, and leave what remains to be done in `remaining` of the `NetStep`."""
        step = self.step_of
        search = step.newton.contact.search
        search.update(before.q)
        search.measure(before.q)
        for signal in (step.remaining, self._tried) if self.net.worlds > 1 else ():
            signal.zero_()
        inputs = [search.gap, search.reach, search.overflow, step.islands.arrays[1]]
        self._launch(self._hope, self.net.worlds, inputs, [self._told, self._tried, self._some, step.remaining])
        wp.capture_if(self._tried, lambda: self._try(before, after))

    def _try(self, before, after) -> None:
        for each in zip(self.chains, self._states, self._places, self._kernels, strict=True):
            self._solve(before, after, *each)
        if self._mixed:
            self.net.update_strains(after)
        self._move(before, after)
        self._check(before, after)

    def _solve(self, before, after, chain, state, places, own) -> None:
        """One solve of the rods of a group."""
        gather, scatter = own
        group, told = chain.group, self._told
        lists = [places.rows, group.count]
        sizes = [places.sizes, self.net.host.nodes]
        of_rods = [state.x, state.v, state.theta, state.omega, state.frame, state.last]
        inputs = [*lists, told, *sizes, before.q, before.v, *places.lagged(before)]
        self._launch(gather, group.node_threads, inputs, [*of_rods, *chain.islands.arrays])
        chain.attempt(state, state)
        inputs = [*lists, *sizes, *of_rods, chain.islands.arrays[0]]
        self._launch(scatter, group.node_threads, inputs, [told, after.q, after.v, *places.lagged(after)])

    def _move(self, before, after) -> None:
        """Put obstacles where they are after the step, and all of worlds that are not tried where it is."""
        step, blocks, worlds = self.step_of, self.net.blocks, self.net.worlds
        if worlds > 1:
            arrays.sweep(self._wait, blocks, [self._told, blocks, before.q], [after.q], self.net.device, worlds=worlds)
        if not len(self._obstacles):
            return
        dim = len(self._obstacles), worlds
        self._launch(self._stay, dim, [self._obstacles, blocks, before.q], [after.q])
        if step.motion:
            step.motion.place(step.islands, after.q)
        inputs = [self._obstacles, blocks, before.q, after.q, step.integrator._dt]
        self._launch(self._follow, dim, inputs, [after.v])

    def _check(self, before, after) -> None:
        """End the step of worlds in which nothing came near."""
        step = self.step_of
        contact = step.newton.contact
        search = contact.search
        search.update(before.q, after.q, search.every)
        for pairs in search.lists:
            self._launch(self._near, 1, [pairs.count], [self._some])
        wp.capture_if(self._some, lambda: self._measure(before, after))
        inputs = [self._some, search.gap, search.reach, search.crossed, search.overflow, step.rounded, self._told]
        outputs = [*step.islands.arrays, contact.tally.counts, step.tally, step.work, step.remaining]
        self._launch(self._judge, self.net.worlds, inputs, outputs)

    def _measure(self, before, after) -> None:
        search = self.step_of.newton.contact.search
        search.passing(before.q)
        search.measure(after.q)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)


class Places:
    """Where a net has the rods of a group.

    Attributes:
        rows (8, R): see `kernels.net.alone`; sizes: blocks, edges of rods, and elements of both sets in a world.
        whole: whether strains that the net keeps of these rods are those that the group keeps.
    """

    def __init__(self, net, group: Group):
        host, kind = net.host, group.kind
        by_rod = {rod.rod: rod for rod in host.rods}
        rods = [by_rod[rod] for rod in group.host.rods.tolist()]
        self._sets, elements = {}, {}
        for term in kind.terms:
            index = next(i for i, part in enumerate(net.sets) if part.term.law == term.law)
            self._sets[term.measure.span] = index
            elements[term.measure.span] = _of_rods(host.sets[index].owner[0], group.host.rods)
        none = [np.zeros(0, int)] * len(rods)
        lists = [rod.all_nodes for rod in rods], [rod.all_edges for rod in rods], elements.get(2, none), elements[1]
        rows = np.concatenate([np.transpose([_evenly(places) for places in each]) for each in lists])
        self.rows = wp.array(np.ascontiguousarray(rows, np.int32), dtype=int, device=net.device)
        sizes = [net.sets[self._sets[span]].elements if span in self._sets else 0 for span in (2, 1)]
        self.sizes = wp.vec4i(net.blocks, net.edges, *sizes)
        self.whole = all(
            net.sets[self._sets[term.measure.span]].term.density.lagged == term.density.lagged for term in kind.terms
        )

    def lagged(self, state) -> list[wp.array]:
        """Lagged data of a net's state: frames, own rows of bending, strains of bending and of stretch."""
        bending, stretch = self._sets.get(2, self._sets[1]), self._sets[1]
        return [state.frame, state.lag[bending], state.last[bending], state.last[stretch]]


def uncoupled(model) -> bool:
    """Whether the net of a model has open rods, and obstacles, that are coupled by contact alone."""
    host, scene = model.net.host, model.scene
    if not host.touching or not host.rods or any(rod.piece.kind.closed for rod in host.rods):
        return False
    return not any((scene.shells, scene.axisymmetric_shells, scene.joints, scene.attachments, scene.magnets))


def suits(integrator) -> bool:
    """Whether an integrator can step what is `uncoupled` rod by rod: by parameters as they were built, loads that no controls give, and
    solvers about which nothing is said."""
    usual = integrator.solver == "newton" and integrator.linear == "auto" and integrator.scheme == "implicit_euler"
    return usual and integrator.given is None and not integrator.whole and integrator.model.version == 0


def rods_of(model) -> list[Group]:
    """Rods of the model's net as groups of rods on their own."""
    real, device = model.types.real, model.wp_device
    chains: list[ChainGroup] = compile_chains(model.scene, net_rods(model.scene))
    return [Group(chain, model.scene, model.worlds, device, real) for chain in chains]


def _of_rods(owner: np.ndarray, rods: np.ndarray) -> list[np.ndarray]:
    """Elements of every one of some rods, of the rods (E,) that own them, in order."""
    order = np.argsort(owner, kind="stable")
    starts, ends = (np.searchsorted(owner[order], rods, side) for side in ("left", "right"))
    return [order[start:end] for start, end in zip(starts, ends, strict=True)]


def _evenly(places: np.ndarray) -> tuple[int, int]:
    """The first of some places, and how far each is from the one before."""
    if len(places) < 2:
        return (int(places[0]) if len(places) else 0), 0
    apart = np.diff(places)
    assert (apart == apart[0]).all(), "a net numbers what lies along a rod evenly"
    return int(places[0]), int(apart[0])
