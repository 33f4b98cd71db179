"""Environment: episodes of a model's worlds with grips moved by actions; `gymnasium_env` and `torchrl_env` wrap it."""

import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.model.controls import Controls
from ddg_warp.torch.rotations import turned
from ddg_warp.torch.simulator import Parameters, Simulator, WorldState
from ddg_warp.torch.state_layout import along
from ddg_warp.torch.wrenches import WrenchTensors, without_gradient
from ddg_warp.typing import Names, Numbers

GOOD = CONVERGED, _ = tuple(outcome.NAMES[code] for code in (outcome.CONVERGED, outcome.NO_GRADIENT))
AXES = "xyz"


@dataclass(frozen=True)
class GripRates:
    """Velocities of a grip that an action sets, constant over a step of the environment.

    Attributes:
        grip: its index among `model.grips`.
        speed: largest velocity along each of the `axes` of space, in either sense [m/s].
        spin: largest angular velocity about each of the axes `about` [rad/s], through the current position of the grip's pivot.
    """

    grip: int = 0
    axes: str = ""
    speed: float = 1.0
    about: str = ""
    spin: float = 1.0

    def __post_init__(self):
        argument_checks.count("GripRates: grip", self.grip, 0)
        argument_checks.positive("GripRates: speed", self.speed, "m/s")
        argument_checks.positive("GripRates: spin", self.spin, "rad/s")
        if isinstance(self.axes, str) and isinstance(self.about, str) and not self.axes + self.about:
            raise SceneError("GripRates: no axes; give axes='xyz' to translate along, or about='z' to rotate about")
        for name in ("axes", "about"):
            letters = getattr(self, name)
            if not isinstance(letters, str) or letters:
                argument_checks.components(f"GripRates: {name}", letters)

    def entries(self) -> list[tuple[int, int, float, str]]:
        """Return grip, index in a pose, bound and name with unit of every entry of an action."""
        along = [(AXES.index(a), self.speed, f"grip {self.grip}: velocity {a} [m/s]") for a in self.axes]
        around = [(3 + AXES.index(a), self.spin, f"grip {self.grip}: spin {a} [rad/s]") for a in self.about]
        return [(self.grip, *entry) for entry in along + around]


@dataclass(frozen=True, repr=False)
class EpisodeState:
    """State of the episodes of B worlds, the argument of observations, rewards and terminations.

    Attributes:
        world: positions, velocities, angles; see `WorldState`.
        poses: of the grips (B, grips, 6) [m, rad], see `Grip`; rotation vectors are shorter than pi.
        goals: values drawn by `draw` for the episode of each world (B, n).
        actions: of the last step (B, actions); zero at the start of an episode.
        steps: number of steps of the episode (B,).
        outcomes: of the last step (B,), names as of `Integrator.outcomes`.
        wrenches: of supports, grips and obstacles in the last step of the simulator, in the order of `Model.reactions`; zero at the
            start of an episode, and None unless requested.
    """

    world: WorldState
    poses: torch.Tensor
    goals: torch.Tensor
    actions: torch.Tensor
    steps: torch.Tensor
    outcomes: Names
    wrenches: WrenchTensors | None = None

    def __repr__(self) -> str:
        return f"<EpisodeState after {self.steps.min()} to {self.steps.max()} steps, of {self.world!r}>"

    @property
    def failed(self) -> torch.Tensor:
        """Mask of worlds that failed in the last step (B,); failed worlds keep the state before the step."""
        return torch.as_tensor(~np.isin(self.outcomes, GOOD), device=self.poses.device)


class Environment:
    """Episodes of the worlds of a model under motions of grips, as pure functions of episode states.

        environment = Environment(simulator, 64, GripRates(axes="xz", speed=2.0), steps=40, observe=..., reward=...)
        generators = environment.generators(seed=0)
        now = environment.begin(generators)
        now = environment.step(now, actions)  # (64, 2) [m/s]; differentiable, as the simulator is
        reward, (terminated, truncated) = environment.reward(now), environment.ended(now)
        now = environment.begin(generators, now, terminated | truncated)  # ended worlds restart, others continue bit for bit

    A restarted world equals, bit for bit, one of a new simulator with the same seed. Time is common to all worlds and continues:
    loads of the scene that are functions of time do not restart.

    Args:
        simulator: a `Simulator` of a model with grips.
        worlds: B, number of simultaneous episodes.
        rates: a `GripRates`, or several: velocities set by an action; `names` and `bounds` list its entries.
        observe: EpisodeState -> (B, n).
        reward: EpisodeState after a step -> (B,).
        steps: number of steps after which an episode is truncated.
        terminated: EpisodeState after a step -> bools (B,); by default never. Failed worlds are always terminated.
        draw: numpy's Generator -> numbers (n,) of one episode, such as its goal. Every world has a generator of its own, so that
            its episodes do not depend on other worlds.
        start: start of episodes: a `WorldState` of B worlds, or goals (B, n) -> WorldState; by default the state at rest.
        substeps: steps of the simulator in one of the environment.
        parameters: as of `Simulator.step`.
        wrenches: True to give wrenches to observations and rewards, see `EpisodeState`. They are differentiable where
            `Simulator.wrenches` is, otherwise constants.

    Attributes:
        names, bounds: name and largest absolute value of every entry of an action (actions,).

    Raises:
        SceneError: the model has no such grip, or supports moved by a `Motion`, which cannot restart; a rate is given twice, or a
            function returns another shape.
    """

    def __init__(
        self,
        simulator: Simulator,
        worlds: int,
        rates: GripRates | Sequence[GripRates],
        *,
        observe: Callable[[EpisodeState], torch.Tensor],
        reward: Callable[[EpisodeState], torch.Tensor],
        steps: int,
        terminated: Callable[[EpisodeState], torch.Tensor] | None = None,
        draw: Callable[[np.random.Generator], Numbers] | None = None,
        start: WorldState | Callable[[torch.Tensor], WorldState] | None = None,
        substeps: int = 1,
        parameters: Parameters | None = None,
        wrenches: bool = False,
    ):
        if not isinstance(simulator, Simulator):
            raise SceneError(f"Environment: {simulator!r} is no simulator; give a Simulator")
        for name, function in {"observe": observe, "reward": reward, "terminated": terminated, "draw": draw}.items():
            if not callable(function) and not (function is None and name in ("terminated", "draw")):
                raise SceneError(f"Environment: {name} is {function!r}; give a function")
        self.simulator, self.worlds = simulator, argument_checks.count("worlds", worlds)
        self.steps, self.substeps = argument_checks.count("steps", steps), argument_checks.count("substeps", substeps)
        self.parameters, self._draw = parameters, draw
        self._observe, self._reward, self._terminated = observe, reward, terminated
        self.model = model = simulator.engine(self.worlds).model
        self.dtype, self.device = wp.dtype_to_torch(model.types.real), str(wp.device_to_torch(model.wp_device))
        if len(model.grips) < len(model.motions):
            raise SceneError(
                "Environment: a Motion depends on time, which is common to all worlds; move its supports by a Grip"
            )
        rate_list = [rates] if isinstance(rates, GripRates) or not np.iterable(rates) else list(rates)
        for one in rate_list:
            if not isinstance(one, GripRates):
                raise SceneError(f"Environment: rates hold {one!r}; give a GripRates, or a list of them")
        entries = [entry for one in rate_list for entry in one.entries()]
        if not entries:
            raise SceneError("Environment: rates are empty; give one GripRates at least")
        self.names = [name for *_, name in entries]
        self._check(entries)
        self.bounds = torch.tensor([bound for _, _, bound, _ in entries], dtype=self.dtype, device=self.device)
        self._places = torch.tensor([6 * grip + place for grip, place, *_ in entries], device=self.device)
        self._turns = any(place >= 3 for _, place, *_ in entries)
        self._wrenches, self._constant = argument_checks.flag("wrenches", wrenches), False
        if wrenches:
            engine = simulator.engine(self.worlds)
            self._constant = bool(without_gradient(engine))
            engine.integrator.watch_wrenches()
        self._start = simulator.initial_state(self.worlds) if start is None else start
        first = self.begin(self.generators(0))
        self.observations, self.observation_dtype = self.observe(first).shape[1], self.observe(first).dtype

    def __repr__(self) -> str:
        names = ", ".join(self.names)
        worlds = argument_checks.number_of(self.worlds, "world")
        return f"<Environment of {worlds}, episodes of {self.steps} steps, actions {names}, on {self.device}>"

    def generators(self, seed: int) -> list[np.random.Generator]:
        """Return a random generator for each world, of independent streams.

        Raises:
            SceneError: the seed is not a nonnegative integer; at most 128 bits.
        """
        if not isinstance(seed, numbers.Integral) or isinstance(seed, bool) or seed < 0:
            raise SceneError(f"generators: seed = {seed!r}; it is a whole number of at least 0")
        return [np.random.default_rng(stream) for stream in np.random.SeedSequence(seed).spawn(self.worlds)]

    def begin(
        self, generators: list[np.random.Generator], now: EpisodeState | None = None, mask: torch.Tensor | None = None
    ) -> EpisodeState:
        """Begin episodes, in all worlds or in the worlds of a mask (B,); the others stay as in `now`.

        Raises:
            SceneError: there is not one generator a world, the mask does not fit, or a function returns another shape than before
                or for another world.
        """
        self._check_generators(generators)
        if now is None and mask is not None:
            raise SceneError("begin: a mask goes with the episodes that go on; give now, or leave the mask out")
        if now is not None:
            self._check_state("begin", now)
            mask = self._mask(mask)
        chosen = range(self.worlds) if now is None else torch.nonzero(mask).flatten().tolist()
        goals = (
            torch.zeros((self.worlds, 0), dtype=self.dtype, device=self.device) if now is None else now.goals.clone()
        )
        if self._draw is not None and len(chosen):
            drawn = [self._drawn(generators[world]) for world in chosen]
            sizes = {len(row) for row in drawn} | ({goals.shape[1]} if now is not None else set())
            if len(sizes) > 1:
                given_sizes = " and ".join(map(str, sorted(sizes)))
                raise SceneError(
                    f"Environment: draw gives {given_sizes} numbers; give as many for each world and episode"
                )
            values = torch.as_tensor(np.array(drawn), dtype=self.dtype, device=self.device)
            goals = values if now is None else goals.index_put((torch.tensor(chosen, device=self.device),), values)
        world = self._start(goals) if callable(self._start) else self._start
        if not isinstance(world, WorldState) or world.engine is not self.simulator.engine(self.worlds):
            raise SceneError(f"Environment: start is no WorldState of {self.worlds} worlds of its simulator")
        places = [field.name for field in world.engine.fields].index("grips/pose")
        poses = world.values[places].T.reshape(self.worlds, -1, 6)
        fresh = EpisodeState(
            world,
            poses.clone(),
            goals,
            torch.zeros((self.worlds, len(self.names)), dtype=self.dtype, device=self.device),
            torch.zeros(self.worlds, dtype=torch.long, device=self.device),
            np.full(self.worlds, CONVERGED),
            WrenchTensors.zeros(world.engine) if self._wrenches else None,
        )
        return fresh if now is None else self._chosen(mask, replace(fresh, goals=goals), now)

    def step(self, now: EpisodeState, actions: torch.Tensor) -> EpisodeState:
        """Return the episodes after actions (B, actions) [m/s, rad/s].

        Raises:
            SceneError: actions have another shape, are not finite, or exceed their bounds.
        """
        self._check_state("step", now)
        actions = self._actions(actions)
        rates = torch.zeros((self.worlds, 6 * len(self.model.grips)), dtype=self.dtype, device=self.device)
        rates = rates.index_copy(1, self._places, actions).reshape(self.worlds, -1, 6)
        world, poses, outcomes = now.world, now.poses, np.full(self.worlds, CONVERGED, dtype=object)
        failed, wrenches = torch.zeros(self.worlds, dtype=torch.bool, device=self.device), now.wrenches
        for _ in range(self.substeps):
            moved = self._moved(poses, rates)
            after = self.simulator.step(world, self.parameters, {"poses": moved})
            if self._wrenches:
                wrenches = self._wrenches_of(world, after, moved).where(~(failed | after.failed), wrenches)
            step_outcomes = after.outcomes()
            outcomes = np.where(np.isin(outcomes, GOOD) & (step_outcomes != CONVERGED), step_outcomes, outcomes)
            failed = failed | after.failed
            if failed.any():  # failed worlds keep their state and continue with the next step
                after, moved = _selected(failed, world, after), torch.where(failed[:, None, None], poses, moved)
            world, poses = after, moved
        return EpisodeState(world, poses, now.goals, actions, now.steps + 1, outcomes.astype(str), wrenches)

    def _wrenches_of(self, before: WorldState, after: WorldState, poses: torch.Tensor) -> WrenchTensors:
        """Return the wrenches of the step that was just made."""
        if self._constant or not any(value.requires_grad for value in after.values):
            return WrenchTensors.watched(after.engine)
        return self.simulator.wrenches(before, after, self.parameters, {"poses": poses})

    def observe(self, now: EpisodeState) -> torch.Tensor:
        """Return observations (B, n)."""
        self._check_state("observe", now)
        observations = self._observe(now)
        if not isinstance(observations, torch.Tensor) or observations.ndim != 2 or len(observations) != self.worlds:
            raise SceneError(f"Environment: observe gives {_shape(observations)}; give a tensor ({self.worlds}, n)")
        return observations

    def reward(self, now: EpisodeState) -> torch.Tensor:
        """Return rewards (B,)."""
        self._check_state("reward", now)
        return self._one_each("reward", self._reward(now))

    def ended(self, now: EpisodeState) -> tuple[torch.Tensor, torch.Tensor]:
        """Return masks of terminated and of truncated episodes (B,)."""
        self._check_state("ended", now)
        terminated = now.failed
        if self._terminated is not None:
            terminated = terminated | self._one_each("terminated", self._terminated(now)).bool()
        return terminated, now.steps >= self.steps

    def _one_each(self, name: str, values) -> torch.Tensor:
        if not isinstance(values, torch.Tensor) or tuple(values.shape) != (self.worlds,):
            raise SceneError(f"Environment: {name} gives {_shape(values)}; give a tensor ({self.worlds},)")
        return values

    def _check_generators(self, generators) -> None:
        """Refuse anything but one NumPy generator for each world."""
        several = isinstance(generators, list | tuple)
        if (
            not several
            or len(generators) != self.worlds
            or not all(hasattr(generator, "random") for generator in generators)
        ):
            shown = f"{len(generators)} values" if several else repr(generators)
            raise SceneError(
                f"begin: generators are {shown}; give a list of {self.worlds}, one a world, as environment.generators(seed) does"
            )

    def _check_state(self, call: str, state) -> None:
        """Refuse anything but an episode state with one entry a world."""
        if not isinstance(state, EpisodeState) or len(state.steps) != self.worlds:
            shown = f"of {len(state.steps)} worlds" if isinstance(state, EpisodeState) else repr(state)
            raise SceneError(
                f"{call}: now is {shown}; give an EpisodeState of {self.worlds} worlds, as begin and step do"
            )

    def _mask(self, mask) -> torch.Tensor:
        """Return a mask of the worlds (B,)."""
        bools = tensor_of(mask)
        if bools is None or bools.dtype != torch.bool or tuple(bools.shape) != (self.worlds,):
            raise SceneError(f"begin: mask is {mask!r}; give bools ({self.worlds},), one a world")
        return bools.to(self.device)

    def _drawn(self, generator) -> np.ndarray:
        drawn = self._draw(generator)
        values = argument_checks.floats(drawn)
        if values.ndim != 1 or not np.isfinite(values).all():
            raise SceneError(f"Environment: draw gives {drawn!r:.60}; give finite numbers (n,)")
        return values

    def _check(self, entries: list) -> None:
        """Refuse rates of grips that do not exist, are given twice, or lead out of the plane of a planar scene."""
        grips = len(self.model.grips)
        for grip, _, _, name in entries:
            if grip >= grips:
                raise SceneError(f"Environment: {name}: the model has {grips} grips; see model.grips")
            if self.names.count(name) > 1:
                raise SceneError(f"Environment: {name} is given twice; give it once")
        poses = np.zeros((grips, 6))
        poses[[grip for grip, *_ in entries], [place for _, place, *_ in entries]] = 1.0
        Controls(poses).checked(self.model)

    def _actions(self, actions) -> torch.Tensor:
        original, actions = actions, tensor_of(actions)
        if actions is None or actions.dtype in (torch.bool, torch.complex64, torch.complex128):
            raise SceneError(f"actions are {original!r:.60}, no numbers; give a tensor or an array of them")
        actions, shape = actions.to(device=self.device, dtype=self.dtype), (self.worlds, len(self.names))
        if tuple(actions.shape) != shape:
            raise SceneError(f"actions have shape {tuple(actions.shape)}; they are {shape}: {', '.join(self.names)}")
        over = ~(actions.abs() <= self.bounds * (1.0 + 1e-6))  # tolerance of rounding to float32
        if over.any():
            world, entry = torch.nonzero(over)[0].tolist()
            raise SceneError(
                f"actions: {self.names[entry]} is {actions[world, entry]:g} in world {world}, but at most {self.bounds[entry]:g}; clip "
                "actions, by a ClipAction or by tanh"
            )
        return actions

    def _moved(self, poses: torch.Tensor, rates: torch.Tensor) -> torch.Tensor:
        """Return the poses after a step of the simulator at given rates."""
        shift = poses[..., :3] + self.simulator.dt * rates[..., :3]
        turn = turned(poses[..., 3:], self.simulator.dt * rates[..., 3:]) if self._turns else poses[..., 3:]
        return torch.cat([shift, turn], -1)

    @staticmethod
    def _chosen(mask: torch.Tensor, new: EpisodeState, old: EpisodeState) -> EpisodeState:
        """Select new episodes in worlds of a mask, old ones elsewhere."""
        return EpisodeState(
            _selected(mask, new.world, old.world),
            torch.where(mask[:, None, None], new.poses, old.poses),
            new.goals,
            torch.where(mask[:, None], new.actions, old.actions),
            torch.where(mask, new.steps, old.steps),
            np.where(mask.cpu().numpy(), new.outcomes, old.outcomes),
            new.wrenches and new.wrenches.where(mask, old.wrenches),
        )


def _selected(mask: torch.Tensor, new: WorldState, old: WorldState) -> WorldState:
    """Select worlds of one state where a mask (B,) is True, else of another; time is that of the latter."""
    values = []
    for field, a, b in zip(old.engine.fields, new.values, old.values, strict=True):
        values.append(torch.where(along(mask, field, b), a, b))
    flags = (torch.where(mask, a, b) for a, b in ((new.codes, old.codes), (new.differentiable, old.differentiable)))
    return WorldState(tuple(values), old.time, old.engine, *flags)


def check_environment(wrapper: str, environment) -> None:
    """Refuse anything but an environment; `wrapper` names the wrapping class.

    Raises:
        SceneError: names class and value.
    """
    if not isinstance(environment, Environment):
        raise SceneError(f"{wrapper}: {environment!r} is no environment; give an Environment")


def tensor_of(values) -> torch.Tensor | None:
    """Return values as a tensor, or None if they are no array of numbers or bools."""
    try:
        return torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError):
        return None


def _shape(values) -> str:
    return f"shape {tuple(values.shape)}" if hasattr(values, "shape") else repr(values)
