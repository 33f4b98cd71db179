"""Newton on a net by preconditioned conjugate gradients; every world has its own loop, all on the device."""

import math

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.compile.tolerance import outer_forces
from ddg_warp.errors import SceneError
from ddg_warp.kernels.drag import block_inertia
from ddg_warp.kernels.islands import Islands
from ddg_warp.kernels.net import elements, newton
from ddg_warp.kernels.solve import krylov, pcg
from ddg_warp.solve.chains.newton import EARLY, NewtonOptions
from ddg_warp.solve.net.balance import Balance
from ddg_warp.solve.net.chains import Chains
from ddg_warp.solve.net.multilevel import Multilevel
from ddg_warp.solve.net.planes import DevicePlanes
from ddg_warp.solve.net.system import Assembly, NetSystem, Sums
from ddg_warp.solve.net.tolerance import Allowed

PRECONDITIONERS = ("block_jacobi", "chain", "multilevel", "chain_multilevel")
SPARE = 0.5  # of the tolerance, what the last linear solve of a step may leave
STRAIGHT = 1e-9  # turn between edges of a rod at rest that may be rounding [rad]
LOOSEST = 0.1  # largest reduction of the residual that a direction is solved to (Eisenstat and Walker's forcing term)


class NetNewton:
    """Newton's method on all worlds of a net. Owns what is needed while a solve runs; attributes as of `ChainNewton`.

    Args:
        preconditioner: of conjugate gradients: "block_jacobi", "chain" (rods between their joints are eliminated, see
            `kernels.solve.elimination`), "multilevel" (see `kernels.solve.levels`), or "chain_multilevel", both.
        linear: scalar type of the linear algebra; that of the model by default.
        drag: whether a block has more than a mass; see `kernels.drag`.
    """

    banded = True  # whether chains keep their part of H, which holds on free dofs alone

    def __init__(
        self, model, options: NewtonOptions, preconditioner: str = "block_jacobi", linear=None, drag: bool = False
    ):
        if preconditioner not in PRECONDITIONERS:
            raise SceneError(f"preconditioner {preconditioner!r}: of a net it is one of {', '.join(PRECONDITIONERS)}")
        net = model.net
        self.net, self.options, self.device = net, options, net.device
        self.real, self.linear = model.types.real, linear or model.types.linear
        self.eps = model.types.eps
        worlds, blocks, host, device = net.worlds, net.blocks, net.host, net.device
        serial = arrays.serial(device)
        self.worlds, self.all = worlds, worlds * blocks
        V, H = net.vector, wp.types.vector(3, self.linear)
        M = wp.types.matrix((3, 3), self.linear)
        self.chains = None
        if preconditioner in ("chain", "chain_multilevel"):
            self.chains = Chains(net, self.banded and preconditioner == "chain" and not host.frames)
        self.system = NetSystem(net, self.chains and self.chains.kept)

        def make(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        def flags(count=1):
            return [make(worlds, int) for _ in range(count)]

        def scalars(count=1, dtype=None):
            return [make(worlds, dtype or self.real) for _ in range(count)]

        self.q, self.base, self.target = (make(self.all, V) for _ in range(3))
        self.load = wp.array(np.tile(host.constant_loads(), (worlds, 1)), dtype=V, device=device)
        self._weights, self._weight = make((3, worlds, blocks), self.real), make((3, worlds), self.real)
        self.change, self.noise, self.square = (self._weights[i] for i in range(3))
        self.dots = make((worlds, blocks), self.real)
        self.mass = (
            make((worlds, blocks), block_inertia(self.real)) if drag else wp.array(host.mass, dtype=V, device=device)
        )
        bits = (host.fixed * [1, 2, 4]).sum(1).astype(np.uint8)
        self.fixed = wp.array(bits, dtype=wp.uint8, device=device)
        self.held = self.fixed  # components in space, for predictors: rates along oblique planes stay in them
        self.planes = DevicePlanes(net, self.system, self.real, self.linear) if host.frames else None
        if self.planes:
            bits[list(host.frames)] = 0
            self.held = wp.array(bits, dtype=wp.uint8, device=device)
        gravity = np.asarray(model.scene.gravity, float)
        self.gravity = wp.array(gravity[None], dtype=V, device=device)
        self.right, self.rest, self.z, self.p, self.product, self.direction = (make(self.all, H) for _ in range(6))
        self.inverse = make(self.all, M)
        self.matrix = make((9, worlds * self.system.positions), self.linear)
        self.krylov_dots = make((worlds, blocks), self.linear)
        self.islands = Islands(worlds, self.real, device)
        self.iterations, self.stalled = flags(2)
        self.best, self.decrease, self.turn, self.worst, self.goal = scalars(5)
        self.goal.fill_(math.inf)
        self.forcing, self.rho, self.rho_first, self.total, self.curvature = scalars(5, self.linear)
        self.busy = make(1, int)
        self.pcg_work = make(1, wp.int64)
        self.psd = self.automatic_psd() if options.psd == "auto" else options.psd
        exact = [self.psd == "progressive" and part.term.measure.packed > 0 for part in net.sets]
        self.exact_from = tuple(EARLY if wanted else None for wanted in exact)
        banded = self.chains is not None and self.chains.banded
        self.local = tuple(banded and part.host.along for part in net.sets)  # whether derivatives are of the local dofs
        self.parts = [self._part(*given, make, H) for given in zip(net.sets, exact, self.local, strict=True)]
        ends = host.edges
        self.ends = wp.array(np.ascontiguousarray(ends, np.int32), dtype=int, device=device)
        # curvature is linear in the angles of mesh edges: they need no cap, which would shorten the steps of all else
        capless = np.concatenate([np.zeros(0, int), *(shell.edges for shell in host.shells)])
        spins = np.arange(host.nodes, blocks)
        spins = spins[~np.isin(spins, capless)]
        self.spins = wp.array(spins.astype(np.int32), dtype=int, device=device)
        turning = len(ends) + len(spins)
        self.turns = make((worlds, turning), self.real)
        self._sum, self._sum_linear = (Sums(worlds, blocks, dtype, device) for dtype in (self.real, self.linear))
        self._sum_weights = Sums(3 * worlds, blocks, self.real, device)
        self._largest = Sums(worlds, turning, self.real, device, largest=True)
        lengths = host.edge_lengths
        self.arm, self.longest = float(lengths.mean()), float(lengths.max())
        self._evaluate = [
            elements.evaluate_kernel(part.term, self.real, self.linear, *kind, serial)
            for part, *kind in zip(net.sets, self.exact_from, self.local, strict=True)
        ]
        if self.chains:
            self.chains.bind(self.system, self.parts, self.real, self.linear, self.exact_from, drag)
        self._direct = self.chains is not None and self.chains.exact
        self._repeat = pcg.repeat_kernel(self.real, False) if any(exact) or self._direct else None
        self.negative = make(worlds, int)
        self._assembly = Assembly(
            net, self.system, self.parts, self.real, self.linear, self.exact_from, self.local, drag
        )
        self._judge, self._measure, self._rotate, self._take, self._move = newton.search_kernels(
            self.real, self.linear, serial
        )
        self._invert, self._start, self._begin, *self._cycle = krylov.solver_kernels(self.linear)
        self._compare, self._confirm = krylov.confirm_kernels(self.real, self.linear)
        self.allowed = Allowed(net, self.real, self.linear)
        self._unread = flags(2)
        outer = outer_forces(host, gravity)
        self.outer = self.allowed.assign(self.allowed.bodies.loads(outer)[None])
        self._balance = Balance(self, drag)
        self._worst = Sums(worlds, self.allowed.ratio.shape[1], self.real, device, largest=True)
        several = preconditioner in ("multilevel", "chain_multilevel")
        self.levels = Multilevel(net, self.system, self.linear) if several else None
        self._limit = max(200, 100 * math.isqrt(blocks))

    def automatic_psd(self) -> str:
        """The mode that suits the rods; see `ChainNewton.automatic_psd`. Curvature that is rounding counts as none."""
        bending = [part for part in self.net.sets if part.term.measure.packed]
        turns = (part.parameters[name] * part.parameters["measure"] for part in bending for name in part.term.rest)
        return "progressive" if any(np.abs(turn).max() > STRAIGHT for turn in turns) else "gauss_newton"

    def _part(self, part, exact: bool, local: bool, make, H) -> dict:
        """What the elements of a set write."""
        measure, count = part.term.measure, self.worlds * part.elements
        rows, factor, gradient = (
            (measure.size, self.linear, self.real) if local else (measure.slots, H, self.net.vector)
        )

        def lay(rows, dtype):
            return arrays.allocate((rows, count), dtype, self.device)

        return {
            "factor": lay(len(measure.strains) * rows, factor),
            "tension": lay(max(1, measure.tensions), self.linear),
            "second": lay(measure.packed, self.linear) if exact else make((1, 1), self.linear),
            "gradient": lay(rows, gradient),
            "energy": lay(2, self.real),
            "stiffness": make(count, self.linear),
        }

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        own = [*self._balance.kernels, self._judge, self._measure, self._rotate, self._take]
        own += [*self.allowed.kernels, *([self._repeat] if self._repeat else [])]
        cycle = [self._move, self._invert, self._start, self._begin, *self._cycle, self._compare, self._confirm]
        parts = [k for part in (self.chains, self.levels, self.planes) if part for k in part.kernels]
        evaluate = [(kernel, 128) for kernel in self._evaluate]
        sums = (self._sum, self._sum_linear, self._sum_weights, self._largest, self._worst)
        sums = [(k, krylov.THREADS) for part in sums for k in part.kernels]
        return [*own, *cycle, *evaluate, *self._assembly.kernels, *parts, *sums]

    def pcg_iterations(self) -> int:
        """Iterations of all solves so far."""
        return int(self.pcg_work.numpy()[0])

    def solve(self, state) -> None:
        """Iterate until no world is active, with the lagged data of `state`; can be captured."""
        wp.capture_while(self.islands.active, lambda: self.iterate(state))

    def iterate(self, state) -> None:
        """One iteration of every active world."""
        self.islands.active.zero_()
        self.evaluate(state)
        self.balance()
        self.judge()
        self.move()  # where a step has been shortened
        self.assemble()
        self.direct()
        self.take()
        self.move()

    def evaluate(self, state) -> None:
        """Energies, gradients and factors of all elements at the iterate."""
        for index, (part, own, kernel) in enumerate(zip(self.net.sets, self.parts, self._evaluate, strict=True)):
            arrays.sweep(
                kernel,
                self.worlds * part.elements,
                [self.net.elements(state, index, self.q, self.islands.rate), *self.islands.arrays],
                [own["factor"], own["tension"], own["second"], own["gradient"], own["energy"], own["stiffness"]],
                self.device,
                128,
            )

    def balance(self) -> None:
        """Residuals, the change of the energy, and the worlds that are out of equilibrium."""
        islands = self.islands
        self._balance()
        self.allowed.sum_up(self.right, self.options.rtol, islands, islands.unbalanced, islands.drowned)

    def judge(self) -> None:
        """Stop worlds, reject their iterates, or ask for a direction."""
        options = self.options
        self._sum_weights(self._weights.reshape((3 * self.worlds, -1)), self._weight.flatten())
        self._worst(self.allowed.ratio, self.worst)
        wp.launch(
            self._judge,
            self.worlds,
            [*(self._weight[i] for i in range(3)), self.worst, options.rtol]
            + [options.floor_factor * self.eps]
            + [options.max_iterations, options.max_halvings, LOOSEST, options.linear_rtol, SPARE]
            + [*self.islands.arrays, self.best, self.stalled, self.forcing, self.goal],
            device=self.device,
        )

    def assemble(self) -> None:
        """H of the worlds that want a direction."""
        self._assembly(self.mass, self.islands, self.matrix)
        if self.planes:
            self.planes.matrix(self.matrix, self.islands.wanted)
        if self.chains:
            self.chains.assemble(self.matrix, self.mass, self.islands)

    def direct(self) -> None:
        """Directions: by elimination where that is exact, else by conjugate gradients."""
        wanted = self.islands.wanted
        if self._direct:
            self.negative.zero_()
            self.forcing.zero_()  # what is left is rounding
            self.chains.prepare(self.matrix, self.fixed, wanted, self.negative)
            self.chains.apply(self.matrix, self.right, wanted, self.direction, self.krylov_dots)
        else:
            self.iterate_pcg()
        if self._repeat:  # what was indefinite comes again, without second derivatives and compression
            wp.launch(self._repeat, self.worlds, [1, *self.islands.arrays, self.negative], device=self.device)

    def iterate_pcg(self) -> None:
        """Directions by conjugate gradients."""
        table, blocks = self.system, self.net.blocks
        self._launch(
            self._invert,
            [self.matrix, table.diagonal, self.fixed, self.islands.wanted, blocks, table.positions],
            [self.inverse],
        )
        self._launch(
            self._start,
            [self.right, self.inverse, self.islands.wanted, blocks],
            [self.rest, self.direction, self.p, self.krylov_dots],
        )
        if self.chains:
            self.chains.prepare(self.matrix, self.fixed, self.islands.wanted, self._unread[0])
        if self.levels:
            self.levels.prepare(self.matrix, self.fixed, self.islands.wanted)
        self.precondition(self.p)
        self._sum_linear(self.krylov_dots, self.total)
        self.busy.zero_()
        wp.launch(
            self._begin,
            self.worlds,
            [self.total],
            [self.islands.wanted, self.rho, self.rho_first, self.iterations, self._indefinite, self.busy],
            device=self.device,
        )
        wp.capture_while(self.busy, self.reduce)

    @property
    def _indefinite(self) -> wp.array:
        """Where conjugate gradients note negative curvature: the iterate comes again, or the next one leaves out compression."""
        return self.negative if self._repeat else self.islands.clamped

    def reduce(self) -> None:
        """Iterate until the residual is small in the norm of the preconditioner, and go on where the tolerance says that it is not."""
        wp.capture_while(self.busy, self.cycle)
        self._launch(
            self._compare, [self.rest, self.allowed.blocks, self.islands.wanted, self.net.blocks], [self.allowed.ratio]
        )
        self.allowed.sum_up(self.rest, self.options.rtol, self.islands, *self._unread)
        self._worst(self.allowed.ratio, self.worst)
        wp.launch(
            self._confirm,
            self.worlds,
            [self.worst, self.goal, self.options.linear_rtol],
            [self.forcing, self.islands.wanted, self.busy],
            device=self.device,
        )

    def precondition(self, z: wp.array) -> None:
        """What chains and levels make of z, which holds the residual times the inverses of the diagonal blocks."""
        if self.chains:
            self.chains.apply(self.matrix, self.rest, self.islands.wanted, z, self.krylov_dots)
        if self.levels:
            self.levels.apply(self.rest, self.fixed, self.islands.wanted, z, self.krylov_dots)

    def cycle(self) -> None:
        """One iteration of conjugate gradients."""
        blocks = self.net.blocks
        _, advance, turn, test = self._cycle
        self.busy.zero_()
        if self.chains and self.chains.banded:
            self.chains.product(self.matrix, self.p, self.fixed, self.islands.wanted, self.product, self.krylov_dots)
        else:
            self.multiply(self.p)
        self._sum_linear(self.krylov_dots, self.curvature)
        self._launch(
            advance,
            [
                self.p,
                self.product,
                self.inverse,
                self.rho,
                self.curvature,
                self.iterations,
                self.islands.wanted,
                blocks,
            ],
            [self.direction, self.rest, self.z, self.krylov_dots],
        )
        self.precondition(self.z)
        self._sum_linear(self.krylov_dots, self.total)
        self._launch(turn, [self.z, self.total, self.rho, self.islands.wanted, blocks], [self.p])
        wp.launch(
            test,
            self.worlds,
            [self.total, self.curvature, self.rho_first, self.forcing, self._limit],
            [self.rho, self.iterations, self._indefinite, self.islands.wanted, self.busy],
            device=self.device,
        )

    def multiply(self, p: wp.array) -> None:
        """H p on free dofs where none of H lies in bands, and p . H p block by block."""
        table = self.system
        self._launch(
            self._cycle[0],
            [
                self.matrix,
                table.columns,
                table.slices,
                self.fixed,
                p,
                self.islands.wanted,
                self.net.blocks,
                table.positions,
            ],
            [self.product, self.krylov_dots],
        )

    def take(self) -> None:
        """Lengths of the steps along the directions."""
        blocks = self.net.blocks
        arrays.sweep(
            self._measure, self.all, [self.right, self.direction, self.islands.wanted, blocks], [self.dots], self.device
        )
        self._sum(self.dots, self.decrease)
        self.measure_turns()
        wp.launch(
            self._take,
            self.worlds,
            [self.decrease, self.turn, self.options.rotation_cap, self.iterations],
            [*self.islands.arrays, self.pcg_work],
            device=self.device,
        )

    def measure_turns(self) -> None:
        """Largest turn that the directions make, squared; these are in space then."""
        if self.planes:
            self.planes.back(self.direction, self.islands.wanted)
        arrays.sweep(
            self._rotate,
            self.turns.size,
            [self.q, self.direction, self.ends, self.spins, self.islands.wanted, self.net.blocks],
            [self.turns],
            self.device,
        )
        self._largest(self.turns, self.turn)

    def move(self) -> None:
        """Take the step that is to be taken."""
        arrays.sweep(
            self._move,
            self.all,
            [self.direction, self.islands.step_length, self.islands.todo, self.net.blocks],
            [self.base, self.q],
            self.device,
        )

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        """One thread for each block of every world."""
        wp.launch(kernel, self.all, inputs, outputs, device=self.device)
