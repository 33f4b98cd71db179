"""Simulator: a model as a torch module. States go in and come out; nothing is kept between calls."""

import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
import warp as wp

from ddg_warp import arguments
from ddg_warp.errors import GradientWarning, SceneError
from ddg_warp.learn.adjoint import refuse_gyroscopic
from ddg_warp.learn.engine import LOAD, Engine
from ddg_warp.learn.layout import copies, tensors
from ddg_warp.learn.rollout import Plan, bytes_of, plan, roll
from ddg_warp.learn.step import Balance, Call, Step
from ddg_warp.learn.world_state import WorldState, outcome_names
from ddg_warp.model import validate
from ddg_warp.model.controls import Controls, require_acting, shapes
from ddg_warp.solve import statics
from ddg_warp.solve.chains.newton import NewtonOptions
from ddg_warp.solve.dynamics import SCHEMES, Integrator
from ddg_warp.threads import alone

SETTLED = {"failures", "check_every", "energy_bound"}  # of the arguments of `Integrator`, by the engine


class Simulator(torch.nn.Module):
    """Steps of a model as a differentiable module, by the parameters and rest shapes that the model has when they are made
    (`Model.set_parameter`, `Model.set_rest`).

        simulator = Simulator(model, dt=0.01)
        state = simulator.initial_state(batch=8)
        state = simulator.step(state, {"rod_bend_twist.stiffness_1": stiffness})
        loss = ((state.positions - goal) ** 2).sum()
        loss.backward()

    Args:
        model: what to step. Worlds of a batch are copies of it: it is built anew with as many as a state has.
        dt: length of the steps [s].
        scheme, options: as of `Integrator`. A world in which a step fails is not a number from there on; gradients that go through a
            step that failed, was made in parts or renewed its frames (as edges turned by more than 90 degrees) are not, in these worlds
            alone. Both are told by `outcomes`, by `WorldState.differentiable`, and the first time by a `GradientWarning`, which on CUDA
            comes with a later call, as nothing waits for the device.

    Parameters are dictionaries from "term.parameter" (see `Model.set_parameter`), or names of masses and of coefficients of drag (see
    `ddg_warp.learn.constants`), to tensors (), (B, 1), (1, E) or (B, E), E the elements that have it. Controls are dictionaries
    of "forces" (B, P, 3) or (P, 3), "moments" (B, edges), "gravity" and "field" (B, 3) or (3,), and "poses" (B, grips, 6), see
    `Controls`. A world that is given a value which `set_parameter` would refuse, or a control that is not finite, is not stepped: its
    outcome is "invalid_input".

    Raises:
        SceneError: the model has something that no gradient goes through, once one is asked for.
    """

    def __init__(self, model, dt: float, *, scheme: str = "implicit_euler", **options):
        super().__init__()
        validate.check_model("Simulator", model)
        arguments.choice("scheme", scheme, SCHEMES)
        self.dt = arguments.number("dt", dt, "a time step that is positive and finite [s]", lambda v: v > 0.0)
        for name in SETTLED & options.keys():
            raise SceneError(f"Simulator: {name} is settled, as worlds that fail are told by outcomes(); leave it out")
        others = set(arguments.names(Integrator)) - SETTLED - {"model", "scheme"}
        given = {name: value for name, value in options.items() if name not in others}
        arguments.options("Simulator", NewtonOptions, given, others)
        self.model, self.scheme, self.options = model, scheme, options
        self._engines: dict[int, Engine] = {}
        self._last: Engine | torch.Tensor | None = None  # what tells the outcomes of the last step
        self._warned = False

    def engine(self, worlds: int) -> Engine:
        """What steps so many worlds, by the parameters that the model has; made when it is first asked for."""
        engine = self._engines.get(worlds)
        if engine is None:
            with alone(self):
                if worlds not in self._engines:
                    self._engines[worlds] = Engine(self.model, worlds, self.scheme, self.options)
                engine = self._engines[worlds]
        engine.follow(self.model)
        return engine

    def __getstate__(self):
        return {name: value for name, value in self.__dict__.items() if name != "_lock"} | {
            "_engines": {},
            "_last": None,
        }

    def __deepcopy__(self, memo):
        return type(self)(self.model, self.dt, scheme=self.scheme, **self.options)

    @torch.compiler.disable
    def initial_state(self, batch: int | None = None, positions=None, velocities=None) -> WorldState:
        """The first state of so many worlds: at rest, or elsewhere.

        Args:
            batch: worlds; by default those of positions or velocities, else of the model.
            positions, velocities: (P, 3) or (B, P, 3); gradients go through both. Frames stay those of the rest state and are carried
                along by the first step: no edge may be further than 90 degrees from there. Strain-rate damping resists what led there
                from rest, within that step; states without that come from `world_state`.

        Raises:
            SceneError: shapes do not fit, or surfaces overlap that touch; under transforms of torch steps tell.
        """
        moved = {"positions": positions, "velocities": velocities}
        for name, values in moved.items():
            if not (values is None or isinstance(values, torch.Tensor) or np.isfinite(arguments.floats(values)).all()):
                raise SceneError(f"initial_state: {name} are {arguments.shown(values)}; give finite numbers")
        moved = {name: self._tensor(name, values) for name, values in moved.items() if values is not None}
        given = [len(values) for values in moved.values() if values.ndim == 3]
        worlds = given[0] if given else self.model.worlds
        worlds = worlds if batch is None else arguments.count("batch", batch)
        engine = self.engine(worlds)
        values = [tensor.clone() for tensor in tensors(engine.model.state(), engine.fields)]
        for name, arrays in (("positions", ("x", "q")), ("velocities", ("v", "v"))):
            if name in moved:
                values = engine.layout.put_points(values, *arrays, moved[name])
        engine.check(values)
        return WorldState.begun(values, 0.0, engine)

    def world_state(self, state) -> WorldState:
        """A `State` as one that steps start from, such as `model.state(points, velocities)` or a checkpoint; gradients begin there.

        Unlike by `initial_state`, frames are those of the state, and dampers have its strains behind them, not those at rest. A
        `WorldState` that was loaded (`torch.load`, pickle), or is of another simulator of the same scene, goes on in this one.

        Raises:
            SceneError: it is no state of this simulator's model, which has as many worlds; or surfaces overlap that touch; or it was
                given spins, and `gyroscopic` does not say whether these resist turns of their axes.
        """
        if isinstance(state, WorldState):
            return self._bound(state)
        validate.check_state("world_state", self.model, state)
        if "gyroscopic" not in self.options:
            refuse_gyroscopic("world_state", state.spun)
        engine = self.engine(self.model.worlds)
        values = copies(tensors(state, engine.fields))
        engine.check(values)
        return WorldState.begun(values, state.time, engine)

    def _bound(self, state: WorldState) -> WorldState:
        """A `WorldState` from elsewhere as one of this simulator."""
        engine = self.engine(len(state.codes))
        wanted = tensors(engine.before, engine.fields)
        if [tuple(value.shape) for value in wanted] != [tuple(value.shape) for value in state.values]:
            raise SceneError(
                "world_state: the state is of another model: its arrays have other shapes than those of this simulator; give one of "
                "the same scene"
            )
        values = [value.detach().to(like) for value, like in zip(state.values, wanted, strict=True)]
        engine.check(values)
        codes = state.codes.to(engine.device)
        return WorldState(tuple(values), state.time, engine, codes, torch.ones_like(codes, dtype=torch.bool))

    @torch.compiler.disable  # what is compiled goes on behind it: launches of Warp are nothing that a compiler sees
    def step(self, state: WorldState, parameters: dict | None = None, controls: dict | None = None) -> WorldState:
        """The state after a step of dt.

        Raises:
            SceneError: a name or shape does not fit, or a shell has a curved membrane, which is for equilibria alone.
        """
        engine = self._own(state)
        return self._step(state, self._full(engine, parameters), self._controls(engine, controls))

    forward = step

    @torch.compiler.disable
    def rollout(
        self,
        state: WorldState,
        parameters: dict | None = None,
        controls=None,
        *,
        steps: int,
        save: int = 1,
        checkpoint_every: int | None = None,
        memory: float | None = None,
    ) -> list[WorldState]:
        """States after every `save` steps of so many.

        Args:
            controls: of all steps, or a function of the number of the step that gives them.
            steps: how many.
            save: of which every so many are returned.
            checkpoint_every: keep only every so many states for gradients, and step again from there when they are asked for.
            memory: what may be kept for gradients [bytes]: checkpoints are set as it asks for; see `plan`.

        Returns:
            Trajectory, without the state that it began with.

        Raises:
            SceneError: a name or shape does not fit; so much memory is too little.
        """
        engine = self._own(state)

        def given(number: int) -> dict:
            return self._controls(engine, controls(number) if callable(controls) else controls)

        arguments.count("steps", steps)
        first = given(0)
        every = self._plan(state, first, steps, save, checkpoint_every, memory, callable(controls)).every
        full, version = self._full(engine, parameters), self.model.version

        def step(state: WorldState, full: list, controls: dict) -> WorldState:
            return self._step(state, full, controls, version)

        return roll(step, state, full, lambda number: given(number) if number else first, steps, save, every)

    def plan(
        self,
        state: WorldState,
        controls: dict | None = None,
        *,
        steps: int,
        save: int = 1,
        checkpoint_every: int | None = None,
        memory: float | None = None,
    ) -> Plan:
        """What such a roll-out keeps for gradients, and how; arguments are those of `rollout`. A function of controls is called once,
        for the first step."""
        several = callable(controls)
        own = self._controls(self._own(state), controls(0) if several else controls)
        return self._plan(state, own, arguments.count("steps", steps), save, checkpoint_every, memory, several)

    def _plan(self, state: WorldState, controls: dict, steps: int, save: int, every, memory, several: bool) -> Plan:
        """See `plan`; `several`: whether each step has controls of its own, which are kept all."""
        if arguments.count("save", save) > steps:
            raise SceneError(f"rollout: save = {save} of {steps} steps returns no state; give {steps} at most")
        if every is not None:
            arguments.count("checkpoint_every", every)
        if memory is not None:
            arguments.number("memory", memory, "bytes, more than none", lambda value: value > 0.0)
        flags = sum(len(part.islands) for part in state.engine.integrator._parts) * state.values[0].element_size()
        told = flags + 5 * len(state.codes) + sum(values.capacity for values in state.engine.solutions)
        shared = bytes_of(controls.values())
        return plan(bytes_of(state.values) + told, steps * shared if several else shared, steps, save, every, memory)

    @torch.compiler.disable
    def equilibrium(
        self,
        parameters: dict | None = None,
        controls: dict | None = None,
        *,
        state: WorldState | None = None,
        batch: int | None = None,
        **options,
    ) -> WorldState:
        """The equilibrium of every world, with gradients by parameters and controls.

        Angles are measured from frames that the search carries along, so that they depend on its way; their gradients are those of
        a search that begins in the equilibrium. Positions do not. With friction, gradients go through all increments of the load
        parameter, of which states are kept.

        Args:
            parameters: as of `step`.
            controls: the same; the load parameter scales loads as it does those of the scene, poses are those at the end.
            state: where the search begins; by default the first state of so many worlds (`batch`).
            options: as of `ddg_warp.statics.solve`.

        Raises:
            SolverError: there is none, in one of the worlds.
            SceneError: the state has a history of gradients, which would end here; a name or shape does not fit.
        """
        given = {name: value for name, value in options.items() if name not in LOAD}
        arguments.options("Simulator.equilibrium", statics.StaticsOptions, given, LOAD)
        if state is not None and torch.is_grad_enabled() and any(value.requires_grad for value in state.values):
            raise SceneError(
                "equilibrium: no gradient goes to the state where the search begins, which places what is held, yet; give "
                "state.detach()"
            )
        if state is not None and batch is not None and arguments.count("batch", batch) != self._own(state).model.worlds:
            raise SceneError(f"equilibrium: batch = {batch} of a state of {len(state.codes)} worlds; leave batch out")
        state = state if state is not None else self.initial_state(batch)
        engine, end = self._own(state), arguments.number("end", options.get("end", 1.0))
        full, controls = self._full(engine, parameters), self._controls(engine, controls)
        call = self._call(engine, end, full, controls)
        values = [*(value for _, own in full for value in own), *controls.values()]
        found = Balance.apply(call, tuple(options.items()), *(value.detach() for value in state.values), *values)
        return WorldState.begun(found[: len(engine.fields)], end, engine)

    def outcomes(self) -> np.ndarray:
        """What became of the last step of every world of the batch that was stepped last (B,); see `WorldState.outcomes`.

        Raises:
            SceneError: no step was made yet.
        """
        if self._last is None:
            raise SceneError("outcomes: no step was made yet; step or roll out first")
        return outcome_names(self._last.codes if isinstance(self._last, Engine) else self._last)

    def parameter(self, name: str, batch: int | None = None) -> torch.Tensor:
        """The values that the model has of a parameter (B, E)."""
        worlds = self.model.worlds if batch is None else arguments.count("batch", batch)
        return self.engine(worlds).tables.value(name)

    def _full(self, engine: Engine, parameters: dict | None) -> list:
        """Parameters as `Tables.full` has them; of plain numbers values are checked, as tensors may be on their way."""
        result = []
        for name, values in _named("parameters", "term.parameter", parameters).items():
            engine.tables.of(name)  # which refuses what there is not
            if isinstance(values, torch.Tensor):
                result.append((name, engine.tables.full_of(name, self._tensor(f"parameters: {name}", values))))
                continue
            try:
                values = engine.tables.valid(name, values)
            except ValueError as error:
                raise SceneError(f"parameters: {error}") from None
            result.append((name, engine.tables.full(name, self._tensor(f"parameters: {name}", values), True)))
        return result

    def _tensor(self, name: str, values) -> torch.Tensor:
        """Numbers as a tensor, in the precision of states where they have none of their own."""
        if isinstance(values, torch.Tensor):
            if values.layout != torch.strided or values.is_meta or values.is_complex() or values.dtype == torch.bool:
                kind = "meta" if values.is_meta else str(values.layout).removeprefix("torch.")
                raise SceneError(f"{name} is a {kind} tensor of {values.dtype}; give a dense one of real numbers")
            return values
        return torch.as_tensor(
            arguments.array(name, values, "give numbers or a tensor"), dtype=wp.dtype_to_torch(self.model.types.real)
        )

    def _own(self, state: WorldState) -> Engine:
        """The engine of a state, of this simulator."""
        if not isinstance(state, WorldState) or state.engine not in self._engines.values():
            what = "loaded, or another simulator's" if isinstance(state, WorldState) else f"{state!r:.80}"
            raise SceneError(
                f"the state is {what}; take one that initial_state, step or equilibrium of this one gave, or that world_state(...) "
                "makes of it"
            )
        return self.engine(state.engine.model.worlds)

    def _controls(self, engine: Engine, controls: dict | None) -> dict:
        model, worlds = engine.model, engine.model.worlds
        controls = _named("controls", "forces", controls)
        real = wp.dtype_to_torch(model.types.real)
        result, known = {}, shapes(model)
        for name, values in controls.items():
            if name not in known:
                raise SceneError(f"controls: there is no {name!r}; there are {', '.join(known)}")
            own, shape = self._tensor(f"controls: {name}", values), known[name]
            if tuple(own.shape) not in (shape, (worlds, *shape)):
                raise SceneError(
                    f"controls: {name} have shape {tuple(own.shape)}; they are {shape} or {(worlds, *shape)}"
                )
            require_acting(model, (name,))
            if not isinstance(values, torch.Tensor):  # finite, and on what it can act on
                Controls(**{name: own.cpu().numpy()}).checked(model)
            result[name] = own.to(device=str(wp.device_to_torch(model.wp_device)), dtype=real).expand(worlds, *shape)
        return result

    def _step(self, state: WorldState, full: list, controls: dict, version: int | None = None) -> WorldState:
        """A step, of a roll-out that began with a `version` of the model."""
        engine = state.engine
        call = self._call(engine, state.time, full, controls)
        if version is not None:
            call = replace(call, version=version)
            call.engine_as_then()
        values = [value for _, own in full for value in own]
        found = Step.apply(call, *state.values, *values, *controls.values())
        count, codes = len(engine.fields), found[len(engine.fields) + engine.parts]
        self._last = engine if torch._C._are_functorch_transforms_active() else codes
        self._tell(engine)
        differentiable = state.differentiable & (codes == 0) if call.graded else state.differentiable
        return WorldState(tuple(found[:count]), state.time + self.dt, engine, codes, differentiable)

    def _tell(self, engine: Engine) -> None:
        """Warn, once, of worlds that have no gradient."""
        if engine.lost and not self._warned:
            self._warned = True
            warnings.warn(
                "worlds have no gradient by what came before a step that failed, was made in parts or turned edges by more than 90 "
                "degrees, or whose reverse was not solved: there gradients are not numbers; leave these worlds out by "
                "state.differentiable (outcomes() names what became of them), or take shorter steps",
                GradientWarning,
                stacklevel=4,
            )

    def _call(self, engine: Engine, start: float, full: list, controls: dict) -> Call:
        return Call(
            simulator=self,
            worlds=engine.model.worlds,
            version=self.model.version,
            start=start,
            dt=self.dt,
            fields=tuple(engine.fields),
            parameters=tuple(name for name, _ in full),
            controls=tuple(controls),
            graded=torch.is_grad_enabled(),
        )


def _named(what: str, example: str, values) -> dict:
    """A dictionary by names; nothing for None."""
    if not (values is None or (isinstance(values, Mapping) and all(isinstance(name, str) for name in values))):
        raise SceneError(f"{what} are {arguments.shown(values)}; give a dictionary such as {{{example!r}: ...}}")
    return dict(values or {})
