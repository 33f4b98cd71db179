"""Environment: episodes of a model's worlds, whose grips are moved by actions. `gymnasium_env` and `torchrl_env` hand it to others."""

import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.learn.layout import along
from ddg_warp.learn.rotations import turned
from ddg_warp.learn.simulator import Simulator, WorldState
from ddg_warp.model.controls import Controls

GOOD = CONVERGED, _ = tuple(outcome.NAMES[code] for code in (outcome.CONVERGED, outcome.NO_GRADIENT))
AXES = "xyz"


@dataclass(frozen=True)
class GripRates:
    """Velocities of a grip that an action gives, constant over a step of the environment.

    Attributes:
        grip: its index among `model.grips`.
        speed: largest velocity along each of the `axes` of space, in either sense [m/s].
        spin: largest angular velocity about each of the axes `about` [rad/s], through the grip's pivot, wherever that has gone.
    """

    grip: int = 0
    axes: str = ""
    speed: float = 1.0
    about: str = ""
    spin: float = 1.0

    def __post_init__(self):
        arguments.count("GripRates: grip", self.grip, 0)
        arguments.positive("GripRates: speed", self.speed, "m/s")
        arguments.positive("GripRates: spin", self.spin, "rad/s")
        if isinstance(self.axes, str) and isinstance(self.about, str) and not self.axes + self.about:
            raise SceneError("GripRates: nothing moves; give axes='xyz' to move along, or about='z' to turn about")
        for name in ("axes", "about"):
            letters = getattr(self, name)
            if not isinstance(letters, str) or letters:
                arguments.components(f"GripRates: {name}", letters)

    def entries(self) -> list[tuple[int, int, float, str]]:
        """Of every number of the action: its grip, its place in a pose, its bound, its name with unit."""
        along = [(AXES.index(a), self.speed, f"grip {self.grip}: velocity {a} [m/s]") for a in self.axes]
        around = [(3 + AXES.index(a), self.spin, f"grip {self.grip}: spin {a} [rad/s]") for a in self.about]
        return [(self.grip, *entry) for entry in along + around]


@dataclass(frozen=True)
class EpisodeState:
    """Where the episodes of B worlds are: what observations, rewards and terminations are functions of.

    Attributes:
        world: positions, velocities, angles; see `WorldState`.
        poses: of the grips (B, grips, 6) [m, rad], see `Grip`; rotation vectors are shorter than pi.
        goals: what `draw` gave each world for its episode (B, n).
        actions: of the step that led here (B, actions); zero where an episode begins.
        steps: since the episode began (B,).
        outcomes: of the last step (B,), names as of `Integrator.outcomes`.
    """

    world: WorldState
    poses: torch.Tensor
    goals: torch.Tensor
    actions: torch.Tensor
    steps: torch.Tensor
    outcomes: np.ndarray

    @property
    def failed(self) -> torch.Tensor:
        """Worlds whose last step could not be solved (B,); they rest as they were before it."""
        return torch.as_tensor(~np.isin(self.outcomes, GOOD), device=self.poses.device)


class Environment:
    """Episodes of the worlds of a model under motions of its grips. It keeps no state: episodes go in and come out.

        environment = Environment(simulator, 64, GripRates(axes="xz", speed=2.0), steps=40, observe=..., reward=...)
        generators = environment.generators(seed=0)
        now = environment.begin(generators)
        now = environment.step(now, actions)  # (64, 2) [m/s]; differentiable, as the simulator is
        reward, (terminated, truncated) = environment.reward(now), environment.ended(now)
        now = environment.begin(generators, now, terminated | truncated)  # those start anew, the others go on, bit for bit

    A world that starts anew is bit for bit one of a new simulator with its seed; but time is one for all worlds, and goes on: loads
    that the scene has as functions of time do not start anew.

    Args:
        simulator: a `Simulator` of a model with grips.
        worlds: B, how many episodes run at once.
        rates: a `GripRates`, or several: which velocities an action gives; `names` and `bounds` say them one by one.
        observe: EpisodeState -> (B, n).
        reward: EpisodeState after a step -> (B,).
        steps: after so many an episode is truncated.
        terminated: EpisodeState after a step -> bools (B,); by default never. A world whose step failed is terminated in any case.
        draw: numpy's Generator -> numbers (n,) of one episode, such as its goal. Every world has a generator of its own, so that its
            episodes do not depend on those of the others.
        start: what episodes begin with: a `WorldState` of B worlds, or goals (B, n) -> WorldState; by default the state at rest.
        substeps: steps of the simulator in one of the environment.
        parameters: as of `Simulator.step`.

    Attributes:
        names, bounds: of the numbers of an action: what they are, and how large at most (actions,).

    Raises:
        SceneError: the model has no such grip, or supports that a `Motion` moves, which do not start anew; a rate is given twice; a
            function gives what has another shape.
    """

    def __init__(
        self,
        simulator: Simulator,
        worlds: int,
        rates: GripRates | Sequence[GripRates],
        *,
        observe: Callable,
        reward: Callable,
        steps: int,
        terminated: Callable | None = None,
        draw: Callable | None = None,
        start: WorldState | Callable | None = None,
        substeps: int = 1,
        parameters: dict | None = None,
    ):
        if not isinstance(simulator, Simulator):
            raise SceneError(f"Environment: {simulator!r} is no simulator; give a Simulator")
        for name, function in {"observe": observe, "reward": reward, "terminated": terminated, "draw": draw}.items():
            if not callable(function) and not (function is None and name in ("terminated", "draw")):
                raise SceneError(f"Environment: {name} is {function!r}; give a function")
        self.simulator, self.worlds = simulator, arguments.count("worlds", worlds)
        self.steps, self.substeps = arguments.count("steps", steps), arguments.count("substeps", substeps)
        self.parameters, self._draw = parameters, draw
        self._observe, self._reward, self._terminated = observe, reward, terminated
        self.model = model = simulator.engine(self.worlds).model
        self.dtype, self.device = wp.dtype_to_torch(model.types.real), str(wp.device_to_torch(model.wp_device))
        if len(model.grips) < len(model.motions):
            raise SceneError(
                "Environment: a Motion goes on with time, which worlds share; hold what it moves by a Grip"
            )
        given = [rates] if isinstance(rates, GripRates) or not np.iterable(rates) else list(rates)
        for one in given:
            if not isinstance(one, GripRates):
                raise SceneError(f"Environment: rates hold {one!r}; give a GripRates, or a list of them")
        entries = [own for one in given for own in one.entries()]
        if not entries:
            raise SceneError("Environment: rates are empty; give one GripRates at least")
        self.names = [name for *_, name in entries]
        self._check(entries)
        self.bounds = torch.tensor([bound for _, _, bound, _ in entries], dtype=self.dtype, device=self.device)
        self._places = torch.tensor([6 * grip + place for grip, place, *_ in entries], device=self.device)
        self._turns = any(place >= 3 for _, place, *_ in entries)
        self._start = simulator.initial_state(self.worlds) if start is None else start
        first = self.begin(self.generators(0))
        self.observations, self.observation_dtype = self.observe(first).shape[1], self.observe(first).dtype

    def generators(self, seed: int) -> list[np.random.Generator]:
        """A generator for each world, of independent streams.

        Raises:
            SceneError: the seed is no whole number that is not negative; it may be as large as NumPy's own, of 128 bits.
        """
        if not isinstance(seed, numbers.Integral) or isinstance(seed, bool) or seed < 0:
            raise SceneError(f"generators: seed = {seed!r}; it is a whole number of at least 0")
        return [np.random.default_rng(own) for own in np.random.SeedSequence(seed).spawn(self.worlds)]

    def begin(
        self, generators: list, now: EpisodeState | None = None, mask: torch.Tensor | None = None
    ) -> EpisodeState:
        """Episodes that begin, in all worlds or those of a mask (B,); the others are as they are `now`.

        Raises:
            SceneError: there is not one generator a world, the mask is no mask of the worlds, or a function gives what has another
                shape, other than before or from one world to the next.
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
            sizes = {len(own) for own in drawn} | ({goals.shape[1]} if now is not None else set())
            if len(sizes) > 1:
                told = " and ".join(map(str, sorted(sizes)))
                raise SceneError(f"Environment: draw gives {told} numbers; give as many for each world and episode")
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
        )
        return fresh if now is None else self._chosen(mask, replace(fresh, goals=goals), now)

    def step(self, now: EpisodeState, actions: torch.Tensor) -> EpisodeState:
        """The episodes after actions (B, actions) [m/s, rad/s].

        Raises:
            SceneError: actions have another shape, are not finite, or exceed their bounds.
        """
        self._check_state("step", now)
        actions = self._actions(actions)
        rates = torch.zeros((self.worlds, 6 * len(self.model.grips)), dtype=self.dtype, device=self.device)
        rates = rates.index_copy(1, self._places, actions).reshape(self.worlds, -1, 6)
        world, poses, outcomes = now.world, now.poses, np.full(self.worlds, CONVERGED, dtype=object)
        rest = torch.zeros(self.worlds, dtype=torch.bool, device=self.device)
        for _ in range(self.substeps):
            moved = self._moved(poses, rates)
            after = self.simulator.step(world, self.parameters, {"poses": moved})
            told = after.outcomes()
            outcomes = np.where(np.isin(outcomes, GOOD) & (told != CONVERGED), told, outcomes)
            rest = rest | after.failed
            if rest.any():  # they stay where they were, and would set out again with the next step
                after, moved = _selected(rest, world, after), torch.where(rest[:, None, None], poses, moved)
            world, poses = after, moved
        return EpisodeState(world, poses, now.goals, actions, now.steps + 1, outcomes.astype(str))

    def observe(self, now: EpisodeState) -> torch.Tensor:
        """Observations (B, n)."""
        self._check_state("observe", now)
        found = self._observe(now)
        if not isinstance(found, torch.Tensor) or found.ndim != 2 or len(found) != self.worlds:
            raise SceneError(f"Environment: observe gives {_shape(found)}; give a tensor ({self.worlds}, n)")
        return found

    def reward(self, now: EpisodeState) -> torch.Tensor:
        """Rewards (B,)."""
        self._check_state("reward", now)
        return self._one_each("reward", self._reward(now))

    def ended(self, now: EpisodeState) -> tuple[torch.Tensor, torch.Tensor]:
        """Episodes that are terminated, and those that are truncated (B,)."""
        self._check_state("ended", now)
        terminated = now.failed
        if self._terminated is not None:
            terminated = terminated | self._one_each("terminated", self._terminated(now)).bool()
        return terminated, now.steps >= self.steps

    def _one_each(self, name: str, found) -> torch.Tensor:
        if not isinstance(found, torch.Tensor) or tuple(found.shape) != (self.worlds,):
            raise SceneError(f"Environment: {name} gives {_shape(found)}; give a tensor ({self.worlds},)")
        return found

    def _check_generators(self, generators) -> None:
        """Refuse what is not one generator of NumPy's for each world."""
        several = isinstance(generators, list | tuple)
        if not several or len(generators) != self.worlds or not all(hasattr(own, "random") for own in generators):
            shown = f"{len(generators)} values" if several else repr(generators)
            raise SceneError(
                f"begin: generators are {shown}; give a list of {self.worlds}, one a world, as environment.generators(seed) does"
            )

    def _check_state(self, call: str, now) -> None:
        """Refuse what is no state of episodes of these worlds."""
        if not isinstance(now, EpisodeState) or len(now.steps) != self.worlds:
            shown = f"of {len(now.steps)} worlds" if isinstance(now, EpisodeState) else repr(now)
            raise SceneError(
                f"{call}: now is {shown}; give an EpisodeState of {self.worlds} worlds, as begin and step do"
            )

    def _mask(self, mask) -> torch.Tensor:
        """A mask of the worlds (B,)."""
        found = tensor_of(mask)
        if found is None or found.dtype != torch.bool or tuple(found.shape) != (self.worlds,):
            raise SceneError(f"begin: mask is {mask!r}; give bools ({self.worlds},), one a world")
        return found.to(self.device)

    def _drawn(self, generator) -> np.ndarray:
        given = self._draw(generator)
        values = arguments.floats(given)
        if values.ndim != 1 or not np.isfinite(values).all():
            raise SceneError(f"Environment: draw gives {given!r:.60}; give finite numbers (n,)")
        return values

    def _check(self, entries: list) -> None:
        """Refuse rates of grips that there are not, given twice, or out of the plane of a planar scene."""
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
        given, actions = actions, tensor_of(actions)
        if actions is None or actions.dtype in (torch.bool, torch.complex64, torch.complex128):
            raise SceneError(f"actions are {given!r:.60}, no numbers; give a tensor or an array of them")
        actions, shape = actions.to(device=self.device, dtype=self.dtype), (self.worlds, len(self.names))
        if tuple(actions.shape) != shape:
            raise SceneError(f"actions have shape {tuple(actions.shape)}; they are {shape}: {', '.join(self.names)}")
        over = ~(actions.abs() <= self.bounds * (1.0 + 1e-6))  # by rounding to float32
        if over.any():
            world, entry = torch.nonzero(over)[0].tolist()
            raise SceneError(
                f"actions: {self.names[entry]} is {actions[world, entry]:g} in world {world}, but at most {self.bounds[entry]:g}; clip "
                "actions, by a ClipAction or by tanh"
            )
        return actions

    def _moved(self, poses: torch.Tensor, rates: torch.Tensor) -> torch.Tensor:
        """Poses after a step of the simulator at such rates."""
        shift = poses[..., :3] + self.simulator.dt * rates[..., :3]
        turn = turned(poses[..., 3:], self.simulator.dt * rates[..., 3:]) if self._turns else poses[..., 3:]
        return torch.cat([shift, turn], -1)

    @staticmethod
    def _chosen(mask: torch.Tensor, new: EpisodeState, old: EpisodeState) -> EpisodeState:
        """New episodes in worlds of a mask, old ones elsewhere."""
        return EpisodeState(
            _selected(mask, new.world, old.world),
            torch.where(mask[:, None, None], new.poses, old.poses),
            new.goals,
            torch.where(mask[:, None], new.actions, old.actions),
            torch.where(mask, new.steps, old.steps),
            np.where(mask.cpu().numpy(), new.outcomes, old.outcomes),
        )


def _selected(mask: torch.Tensor, new: WorldState, old: WorldState) -> WorldState:
    """A state of worlds from one state where a mask (B,) is True, else from another, whose time it has."""
    values = []
    for field, a, b in zip(old.engine.fields, new.values, old.values, strict=True):
        values.append(torch.where(along(mask, field, b), a, b))
    own = (torch.where(mask, a, b) for a, b in ((new.codes, old.codes), (new.differentiable, old.differentiable)))
    return WorldState(tuple(values), old.time, old.engine, *own)


def check_environment(what: str, environment) -> None:
    """Refuse what is no environment, by the name of the class that is to wrap it.

    Raises:
        SceneError: names class and value.
    """
    if not isinstance(environment, Environment):
        raise SceneError(f"{what}: {environment!r} is no environment; give an Environment")


def tensor_of(values) -> torch.Tensor | None:
    """Return values as a tensor, or None where they are no array of numbers or bools."""
    try:
        return torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError):
        return None


def _shape(found) -> str:
    return f"shape {tuple(found.shape)}" if hasattr(found, "shape") else repr(found)
