"""Reverse of a step of the coupled system; see `ddg_warp.adjoint.implicit`.

Why not shared with `ddg_warp.adjoint.rod_step`: kernels over elements and nodes are. Rods write windows that nodes gather, while here
contributions are assembled by lists, and friction lags solve several times.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import warp as wp

from ddg_warp.adjoint.contact import ContactAdjoint
from ddg_warp.adjoint.coupled_assembly import CoupledAssembly
from ddg_warp.adjoint.coupled_linear_solve import CoupledLinearSolve
from ddg_warp.adjoint.coupled_predictor import CoupledPredictor
from ddg_warp.adjoint.forces import ForceCotangents, force_adjoints, quadratic_of
from ddg_warp.adjoint.rigid_bodies import RigidBodyAdjoint, refuse
from ddg_warp.adjoint.supports import Supports
from ddg_warp.adjoint.user_force import UserForceAdjoint
from ddg_warp.kernels.adjoint import coupled_step, elements, time_step
from ddg_warp.kernels.elements.coupled_element import FRAME, coupled_storage
from ddg_warp.model.coupled_model import CoupledState
from ddg_warp.solve.linear.sparse_system import SparseSystem
from ddg_warp.solve.newton.rigid_bodies import RigidBodies


@dataclass
class CoupledSavedStep:
    """Data of a step for the reverse pass: the state `before`, and the solution of its solve with time-lagged data.

    `lagged` are the solutions at the friction lags (W N,), in this order; all other lagged data stay. For an equilibrium with
    friction, `before` is the state that slips are measured from, and `friction_rate` is the inverse increment of the load parameter
    since then. `virial` is the sum of f y^T over the carried nodes of each rigid body (W B,), and `moment` that of controls (W B,),
    None without.
    """

    before: CoupledState
    solved: CoupledState
    whole: wp.array | None
    retries: wp.array | None = None
    time: float = 0.0
    lagged: list[wp.array] = field(default_factory=list)
    friction_rate: float = 0.0
    virial: wp.array | None = None
    moment: wp.array | None = None

    @property
    def frame(self) -> wp.array:
        """Lagged frames at the solution."""
        return self.solved.frame


@dataclass
class CoupledInputs:
    """Gradients by the inputs of a step of the coupled system, other than its state.

    Attributes:
        parameters: of every element set (parameters, W E).
        data, end_data: by the constant data of every set in the solve and at the end of the step (rows, W E).
        mass: by the masses of the dofs of blocks (W N,).
        load: by the forces on them, zero at fixed dofs.
        held: by the prescribed positions of fixed dofs at the solution (W N,).
        coefficients: by coefficients of edges (rows, W edges), by name of the force.
        rate, damping, gravity: by the quantities common to all blocks, one entry per block (W N,).
        elements_rate: by the rate, of every set (W E,), of forces on edges, of user-defined forces (W N,) and of friction.
        user_forces: by the parameters of each user-defined force (worlds, nodes), all components.
        contact_parameters, radius: by the parameters of contact, see `ContactAdjoint`; None without contact.
        moments: by the principal moments of inertia of rigid bodies (W B,), or None.
        force, moment: by the controls of rigid bodies (W B,), or None.
    """

    parameters: list[wp.array]
    data: list[wp.array]
    end_data: list[wp.array]
    mass: wp.array
    load: wp.array
    held: wp.array
    rate: wp.array
    damping: wp.array
    gravity: wp.array
    coefficients: dict[str, wp.array]
    elements_rate: list[wp.array]
    contact_parameters: wp.array | None = None
    radius: wp.array | None = None
    moments: wp.array | None = None
    force: wp.array | None = None
    moment: wp.array | None = None
    user_forces: list[wp.array] = field(default_factory=list)


@dataclass
class CoupledCotangents:
    """Gradients by intermediate results of a step of the coupled system, and w of its adjoint system.

    Attributes:
        end: by the end positions, through frames and strains there (W N,).
        q: by the solution of the solve (W N,); lagged: by the one at a friction lag.
        w: solution of the adjoint system (W N,).
        stays: entries of `q` of fixed dofs without prescribed motion (W N,).
        end_frame: by the frames of the end state.
        frames, own_rows: by the frames (2) and own lagged rows (3) of the end state, of the solve, and of the start state.
    """

    end: wp.array
    q: wp.array
    w: wp.array
    stays: wp.array
    lagged: wp.array | None
    end_frame: wp.array
    frames: list[wp.array]
    own_rows: list[list[wp.array]]


class CoupledStepAdjoint:
    """Reverse of the steps and equilibria of a model's coupled system; `gravity` and `axes`: see `RodStepAdjoint`.

    Args:
        scheme, posed: see `RodStepAdjoint`.

    Raises:
        SceneError: a motion has no gradient, or contact; see `Supports` and `ContactAdjoint`.
    """

    def __init__(self, model, scheme: str | None, posed: bool = False):
        refuse(model, scheme)
        coupled, real = model.coupled, model.types.real
        self.model, self.coupled, self.real, self.device = model, coupled, real, model.wp_device
        host, count = coupled.host, coupled.worlds * coupled.blocks
        self.axes = host.axes
        midpoint = scheme == "implicit_midpoint"
        self.supports = Supports(model, coupled, midpoint) if (scheme or posed) and host.moves else None
        motion = self.supports.motion if self.supports else None
        self._midpoint = midpoint
        self.predictor = CoupledPredictor.of(model, coupled, motion, scheme)
        self._shares = CoupledAssembly(model)
        self.forces = force_adjoints(model, coupled, midpoint) if scheme else []
        self._quadratic = quadratic_of(self.forces)
        self.user_forces = None
        if coupled.user_forces:
            self.user_forces = UserForceAdjoint(model, self._quadratic is not None)
            self.forces.append(self.user_forces)
        self.contact = ContactAdjoint(coupled) if host.contact_parameters else None
        self.solve = CoupledLinearSolve(
            model,
            self._quadratic,
            self.contact and self.contact.system,
            scheme is not None,
            self.user_forces and self.user_forces.force,
        )
        self.gravity = wp.array(
            np.tile(model.scene.gravity, (coupled.worlds, 1)), dtype=coupled.vector, device=self.device
        )
        self._damping = wp.array([model.scene.mass_damping], dtype=real, device=self.device)
        storages = [coupled_storage(part.term, real) for part in coupled.sets]
        self._vjp = [elements.pull_kernel(storage, real, True, True) for storage in storages]
        self._strains = [
            elements.strain_vjp_kernel(storage, 0, real, True) if part.term.density.lagged else None
            for storage, part in zip(storages, coupled.sets, strict=True)
        ]
        self._solution, self._inertia, self._start = time_step.step_kernels(
            coupled.nodes, real, midpoint, self._quadratic is not None
        )
        self._ended = coupled_step.end_kernel(real)
        self._resisted = self._quadratic.inertia.transpose((1, 0)) if self._quadratic else None
        self._leaves = coupled.common(wp.zeros(coupled.blocks, dtype=wp.uint8, device=self.device))
        self._rates, self._friction_rate = (wp.zeros(coupled.worlds, dtype=real, device=self.device) for _ in range(2))

        def make(dtype=coupled.vector):
            return wp.zeros(count, dtype=dtype, device=self.device)

        def of_sets(rows):
            return [self._shares.make(rows(part.term), part.elements) for part in coupled.sets]

        self._end = make()
        end_frame, *frames = (self._shares.make(FRAME, coupled.edges) for _ in range(3))
        self._cotangents = CoupledCotangents(
            *(make() for _ in range(4)),
            make() if self.contact and self.contact.friction_iterations > 1 else None,
            end_frame,
            frames,
            [self._shares.make_own() for _ in range(3)],
        )
        self._start_state = coupled.empty()
        self._inputs = CoupledInputs(
            parameters=of_sets(lambda term: len(term.parameter_names)),
            data=of_sets(lambda term: term.measure.data_size),
            end_data=of_sets(lambda term: term.measure.data_size),
            mass=make(),
            load=make(),
            held=self._cotangents.q,
            rate=make(real),
            damping=make(real),
            gravity=make(),
            coefficients=self._quadratic.by_names if self._quadratic else {},
            elements_rate=[
                wp.zeros(part.elements * coupled.worlds, dtype=real, device=self.device) for part in coupled.sets
            ],
        )
        if self._quadratic:
            self._inputs.elements_rate += self._quadratic.rates
        if self.user_forces:
            self._inputs.user_forces = self.user_forces.by_parameters
            self._inputs.elements_rate.append(self.user_forces.by_rate)
        if self.contact:
            self._inputs.contact_parameters, self._inputs.radius = self.contact.by_groups, self.contact.by_radius
            self._inputs.elements_rate.append(self.contact.grad_inverse_step)
        self.bodies = None
        if coupled.bodies:
            bodies = scheme and self.solve.system.rigid_bodies
            bodies = bodies or RigidBodies(coupled.bodies, SparseSystem(coupled), wp.float64, False, False, False)
            self.bodies = RigidBodyAdjoint(model, bodies, self._shares, self._inputs.damping, scheme is not None)
            gradients = self.bodies.gradients
            for name in ("moments", "force", "moment"):
                setattr(self._inputs, name, getattr(gradients, name))
            self._inputs.elements_rate.append(gradients.rate)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        result = [*self._vjp, *(kernel for kernel in self._strains if kernel)]
        result += [self._solution, self._inertia, self._start, self._ended]
        parts = (self._shares, self.solve, self.supports, *self.forces, self.predictor, self.contact)
        parts += (self.bodies,)
        return result + [kernel for part in parts if part for kernel in part.kernels]

    def suit(self, step, s: float) -> bool:
        """Prepare for solves of a `CoupledStep` over s [s]; return True if kernels or arrays have changed."""
        return self.predictor is not None and self.predictor.suit(step, s)

    def upload(self, t0: float, t1: float) -> None:
        """Upload supports and forces between t0 and t1, the step to reverse."""
        for part in filter(None, (self.supports, *(adjoint.force for adjoint in self.forces))):
            part.upload(t0, t1)

    def lagged(self, before: CoupledState, states=None) -> wp.array:
        """Return the lagged frames of a step's solve before any frame update."""
        if self.predictor is None:
            return before.frame
        if self.supports:
            self.supports.follow(*states)
        self.predictor.find(before)
        return self.predictor.state.frame

    def keep(self, step, before: CoupledState) -> CoupledSavedStep:
        """Return the saved data of the last step of a `CoupledStep`; `before` must stay unchanged."""
        coupled, q = self.coupled, wp.clone(step.newton.iterates.q)
        data = {index: wp.clone(values) for index, values in step._data.items()}
        solved = replace(before, q=q, data=data)
        if coupled.edges:
            frame, lag = step._lagged
            solved = replace(solved, frame=wp.clone(frame), lag=[wp.clone(values) for values in lag])
        islands = step.islands
        lagged = [wp.clone(values) for values in step.newton.contact.solutions] if self.contact else []
        bodies = {}
        if self.bodies:
            struct = step.newton.rigid_bodies.bodies
            bodies = {
                "virial": wp.clone(struct.virial),
                "moment": wp.clone(struct.moment) if step.bodies.has_wrenches else None,
            }
        return CoupledSavedStep(
            before, solved, wp.clone(islands.substep_fraction), wp.clone(islands.retries), lagged=lagged, **bodies
        )

    def vjp(
        self,
        kept: CoupledSavedStep,
        after: CoupledState,
        cotangent: CoupledState,
        s: float,
        states=None,
        factors: bool = False,
    ) -> tuple[CoupledState, CoupledInputs]:
        """Return gradients by a step's start and inputs; see `RodStepAdjoint.vjp`.

        `factors`: see `CoupledLinearSolve`.
        """
        coupled, solved, before, shares = self.coupled, kept.solved, kept.before, self._shares
        rate, last = 1.0 / s, coupled.blocks - coupled.host.spins
        start, inputs, cotangents = self._start_state, self._inputs, self._cotangents
        by_end, grad_q, w = cotangents.end, cotangents.q, cotangents.w
        self._clear()
        frame, (carried, carried_first) = cotangents.end_frame, cotangents.frames
        of_end, own_rows, first = cotangents.own_rows
        wp.copy(frame, cotangent.frame)
        # strains of the end state, the reference of the next step's damping
        for i, kernel in enumerate(self._strains):
            if kernel:
                read = [coupled.elements(after, i), cotangent.last[i]]
                self._over(i, kernel, read, [shares.slots[i], shares.lags[i], inputs.parameters[i]])
        shares.collect(by_end, frame, inputs.end_data)
        coupled.reset_spins(by_end)  # rotations are zero at the end of every step: ghosts have them
        for part, rows, lag in zip(coupled.sets, of_end, cotangent.lag, strict=True):
            if part.term.measure.advance:
                wp.copy(rows, lag)
        shares.add_own(of_end)
        ended, predictor, by_predicted, tangents = solved.q, self.predictor, None, before.q
        if predictor:
            self.lagged(before, states)
            lagged, by_predicted = predictor.state, predictor.grad_q
            by_predicted.zero_()
            tangents = lagged.q if self._midpoint else tangents
            solved = replace(solved, frame=lagged.frame, lag=lagged.lag)
        self._rates.fill_(rate)
        step = self._rates, self._damping
        if self.bodies:
            solved = self.bodies.begin(kept, solved, rate, rate * (rate + self.model.scene.mass_damping))
        if self._midpoint:
            ended = self._end
            self._launch(self._ended, len(ended), [solved.q, before.q], [ended])
        shares.uncarry(solved, after, ended, frame, of_end, by_end, inputs.end_data, carried, own_rows)
        if self.bodies:
            cotangent = self.bodies.end(before, solved, after, cotangent, by_end, step)
        # the solve
        if self._quadratic:
            self._quadratic.resist(before, tangents, rate)
        if self.user_forces:
            self.user_forces.begin(before, kept.time if s == np.inf else None)
        points, components, grid = coupled.points, coupled.components, (coupled.worlds, coupled.blocks)
        end, out, began, more = *map(coupled.node_state, (cotangent, start, before)), components(by_end)
        masses = [coupled.mass.transpose((1, 0)), None]
        read = [end, more, *masses, self._resisted, coupled.count, last, self._rates]
        self._launch(self._solution, grid, read, [components(grad_q)])
        self._friction_rate.fill_(kept.friction_rate or rate)
        slips = self.bodies.begin_slip(before) if self.bodies and self.contact else before.q
        rough, lag_pairs = None, reversed(list(pairwise([before.q, *kept.lagged, solved.q])))
        if kept.friction_rate:  # normal forces of the equilibrium
            rough, lag_pairs = self.contact.matrix(solved.q, before.q, self._friction_rate), [(solved.q, solved.q)]
        for lag_q, q in lag_pairs:  # lag positions of friction, and the solution
            damped = replace(solved, q=q, last=before.last)
            if self.contact:
                rates = after.rate, before.rate if lag_q is before.q else None
                self.contact.system.find(lag_q, slips, q, self._friction_rate, rates)
            if self.bodies:
                self._solve_bodies(damped, rate, kept, grad_q, w, factors)
            else:
                self.solve(damped, rate, kept.time, grad_q, w, factors, rough)
            shares.clear()
            for i, kernel in enumerate(self._vjp):
                written = [shares.slots[i], shares.lags[i], inputs.parameters[i]]
                written += [start.last[i], inputs.elements_rate[i]]
                self._over(i, kernel, [coupled.elements(damped, i, rate=self._rates), w], written)
            shares.collect(grad_q, carried, inputs.data)
            shares.add_own(own_rows)
            pull = ForceCotangents(
                before, predictor and lagged.q, damped, w, self._rates, grad_q, start, None, by_predicted
            )
            for force in self.forces:
                force.vjp(pull)
            read = [points(q), None, began, components(w), *masses, coupled.count, coupled.host.nodes, last]
            read += [self._rates, self._damping, self.gravity, coupled.world]
            written = [out, points(inputs.mass), None, points(inputs.rate), points(inputs.damping)]
            self._launch(self._inertia, grid, read, [*written, points(inputs.gravity), components(inputs.load)])
            if self.contact:
                by_lagged = next(
                    gradient
                    for source, gradient in ((before.q, start.q), (q, grad_q), (lag_q, cotangents.lagged))
                    if source is lag_q
                )
                self.contact.vjp((lag_q, slips, q), w, self._friction_rate, (by_lagged, start.q, grad_q))
                if kept.friction_rate:
                    self.contact.roll(q, before.q, start.q, grad_q)
            if lag_q is not before.q and lag_q is not q:
                self.solve.vjp_by_lagged(cotangents.lagged, grad_q)
        if self.bodies:
            self.bodies.pull(solved, w, grad_q, step)
        if self.solve.held is not None:
            wp.map(wp.add, grad_q, self.solve.held, out=grad_q)
        if self.supports:
            self.supports.follow(*states)
            frame, by_frame = (coupled.frames(array) for array in (solved.frame, carried))
            force, angle = coupled.components(grad_q), coupled.angles(grad_q)
            self.supports.vjp(coupled.points(solved.q), frame, force, angle, by_frame)
        if predictor:
            if predictor.carries:
                written = by_predicted, inputs.data, carried_first, first
                shares.uncarry(before, lagged, lagged.q, carried, own_rows, *written)
                carried, own_rows = carried_first, first
            predictor.vjp(before, grad_q, start, inputs.rate)
        if self.bodies and s < np.inf:
            self.bodies.depart(before, solved, carried, own_rows, inputs.data, start, step)
        start.frame, start.lag = carried, own_rows
        if s < np.inf:
            self.solve.stays(grad_q, cotangents.stays)
        read = [end, more, points(solved.q), None, began, components(cotangents.stays), self._leaves, *masses]
        read += [self._resisted, coupled.count, last, self._rates]
        self._launch(self._start, grid, read, [out, points(inputs.rate)])
        return start, inputs

    def _solve_bodies(
        self, solved: CoupledState, rate: float, kept, grad_q: wp.array, w: wp.array, factors: bool
    ) -> None:
        """Write w with rigid bodies, carried nodes included."""
        skew = None if rate else self.bodies.skew(self.solve.tangent, kept.time)
        self.solve(solved, rate, kept.time, self.bodies.condense(grad_q), w, factors, skew)
        if kept.moment is not None:
            self.bodies.solve(self.solve.system, grad_q, solved, w)
        self.bodies.spread(w)

    def has_overflow(self, q: wp.array) -> bool:
        """Return True if the last `vjp`, to a solution q, overflowed the pair lists and must be repeated.

        Reads from the device with contact.
        """
        return self.contact is not None and self.contact.has_overflow(q)

    def _clear(self) -> None:
        """Zero the accumulated gradients."""
        inputs, start, cotangents = self._inputs, self._start_state, self._cotangents
        own_rows = [array for arrays in cotangents.own_rows for array in arrays]
        for array in (
            *(cotangents.end, start.q, start.v, *start.last, *cotangents.frames, *own_rows),
            *(inputs.load, inputs.mass, inputs.rate, inputs.damping, inputs.gravity, *inputs.elements_rate),
            *(*inputs.parameters, *inputs.data, *inputs.end_data),
            *inputs.coefficients.values(),
            *([self.contact.by_groups, self.contact.by_radius] if self.contact else []),
            *([self.solve.failed] if self.solve.failed is not None else []),
        ):
            array.zero_()
        self._shares.clear()

    def _over(self, index: int, kernel, inputs: list, outputs: list) -> None:
        self._launch(kernel, (self.coupled.worlds, self.coupled.sets[index].elements), inputs, outputs)

    def _launch(self, kernel, count: int | tuple[int, int], inputs: list, outputs: list) -> None:
        wp.launch(kernel, count, inputs, outputs, device=self.device)
