"""Policy: a grip learns to swing the free end of a cable to any goal, by gradients through the simulator.

A cable hangs from a grip with a range of a hand's breadth. After 0.6 s its free end shall be at a goal beyond the static range. A
network of two layers maps observations of cable and goal to the motion of the grip every 20 ms. By rotational symmetry all vectors
are expressed in directions towards the goal, aside from it and up, so that one learned motion serves all azimuths. `learn` rolls
out episodes with random goals in an `Environment`, one a world. It descends the gradient of the final error through all steps
(analytic policy gradients: Freeman et al., Brax, 2021; Xu et al., Accelerated policy learning with parallel differentiable
simulation, 2022). The policy is validated on goals of another seed, and on a finer cable in shorter steps. The run repeats the grip
motions of the first of these goals.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH = 0.5  # m
SECTION = ddg.Stiffness(
    EA=500.0, EI1=2e-3, GJ=1e-3, mass_per_length=0.05, rotary_inertia=1e-6, radius=0.005, viscosity=0.01
)
REACH = 0.15  # m, range of the grip along each axis
SPEED = 1.5  # m/s, largest speed of the grip along each axis
TURN, TURNS = 0.02, 30  # s between decisions, and number of decisions
END = TURN * TURNS  # s
ASIDE = (
    0.2,
    0.35,
)  # m, horizontal distance of goals from the grip; the total distance is 0.9 to 1 cable lengths
EDGES, STEP = 10, 0.01  # edges and time step [s] of the training cable
WORLDS, ROUNDS = 32, 60  # worlds, and rounds of the search
RATE = 5e-3  # largest learning rate of Adam
FINE = {"n": 20, "step": 0.01}  # of the validation cable
TRIED = 64  # number of validation goals
BETTER = 6.0  # least ratio of errors of the untrained and the trained policy
SWING = 2.0  # least ratio of errors of a cable that hangs still and the trained policy
APART = 0.7  # m, between cables in pictures
BALL = 0.02  # m, radius of the drawn goals


def build(n: int = 20, step: float = 0.01, count: int = 4) -> ddg.Scene:
    """Build cables with the grip motions of the policy; building includes the training.

    Args:
        n: edges of a cable
        step: time step [s]
        count: number of cables, each with its goal
    """
    if n < 4 or not 1 <= count <= TRIED:
        raise ValueError(f"n = {n}, count = {count}: take 4 edges at least, and 1 to {TRIED} cables")
    _learn.require_torch("policy")
    paths = tried()["paths"]
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=step, duration=END), mass_damping=0.3)
    times = TURN * np.arange(TURNS + 1)
    for number in range(count):
        path = paths[:, number]
        motion = ddg.Motion(
            translation=lambda t, path=path: tuple(np.interp(t, times, path[:, axis]) for axis in range(3))
        )
        add_cable(scene, n, APART * number, motion)
    return scene


def add_cable(scene: ddg.Scene, n: int, x: float, motion) -> None:
    """Add a cable of n edges that hangs at x, clamped at its upper end."""
    rod = scene.add_rod(np.linspace((x, 0.0, 0.0), (x, 0.0, -LENGTH), n + 1), section=SECTION, twist=False)
    scene.clamp(rod, motion=motion)


def draw(random) -> np.ndarray:
    """Return a goal (3,) [m]."""
    angle, aside, length = random.uniform(-np.pi, np.pi), random.uniform(*ASIDE), LENGTH * random.uniform(0.9, 1.0)
    return np.array([aside * np.cos(angle), aside * np.sin(angle), -np.sqrt(length**2 - aside**2)])


def towards(goals):
    """Return directions (worlds, 3, 3) of goals (worlds, 3) in rows: horizontal towards the goal, horizontal aside, up."""
    import torch

    x, y = torch.nn.functional.normalize(goals[:, :2]).unbind(1)
    none, one = torch.zeros_like(x), torch.ones_like(x)
    return torch.stack([x, y, none, -y, x, none, none, none, one], 1).reshape(-1, 3, 3)


def seen(episode_state):
    """Return observations (worlds, 22) of order one, in the directions of the goal.

    Goal, free end, middle and grip, velocities, and remaining time.
    """
    import torch

    points, velocities = episode_state.world.positions, episode_state.world.velocities
    middle, left = points.shape[1] // 2, 1.0 - episode_state.steps[:, None] / TURNS
    positions = [
        episode_state.goals,
        points[:, -1] - episode_state.goals,
        points[:, middle] - points[:, 0],
        points[:, -1] - points[:, 0],
    ]
    rates = [velocities[:, -1], velocities[:, middle]]
    vectors = torch.stack([*(4.0 * position for position in positions), *rates, 8.0 * episode_state.poses[:, 0, :3]], 1)
    return torch.cat([(vectors @ towards(episode_state.goals).mT).flatten(1), left], 1)


def off(episode_state):
    """Return distances of free ends from goals (worlds,) [m]."""
    return (episode_state.world.positions[:, -1] - episode_state.goals).norm(dim=1)


def environment(n: int, step: float, worlds: int):
    """Return episodes of a cable of n edges with a time step [s]."""
    from ddg_warp.rl.environment import Environment, GripRates
    from ddg_warp.torch import Simulator

    scene = ddg.Scene(mass_damping=0.3)
    add_cable(scene, n, 0.0, ddg.Grip())
    return Environment(
        Simulator(scene.build("cpu", "float64"), step),
        worlds,
        GripRates(axes="xyz", speed=SPEED),
        observe=seen,
        reward=lambda state: -((10.0 * off(state)) ** 2) * (state.steps == TURNS),
        draw=draw,
        steps=TURNS,
        substeps=round(TURN / step),
    )


def network():
    """Return a network from observations to the target of the grip, in the directions of the goal."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        first, second, last = torch.nn.Linear(22, 64), torch.nn.Linear(64, 64), torch.nn.Linear(64, 3)
    layers = torch.nn.Sequential(first, torch.nn.Tanh(), second, torch.nn.Tanh(), last).double()
    with torch.no_grad():
        layers[-1].weight.mul_(0.1)  # small initial motion of the grip
        layers[-1].bias.zero_()
    return layers


def episode(episodes, policy, generators) -> list:
    """Return all states of an episode in every world."""
    states = [episodes.begin(generators)]
    directions = towards(states[0].goals)
    for _ in range(TURNS):
        actions = policy(episodes.observe(states[-1]))[:, None] @ directions
        targets = REACH * actions[:, 0].tanh()
        if (
            targets.requires_grad
        ):  # a world whose step was halved has no gradient with respect to earlier steps and is left out there
            targets.register_hook(lambda gradient: gradient.nan_to_num(0.0))
        rates = (targets - states[-1].poses[:, 0, :3]) / TURN
        states.append(episodes.step(states[-1], SPEED * (rates / SPEED).tanh()))
    return states


@cache
@_learn.one_thread()
def learn() -> tuple:
    """Train the policy; return also the mean error of free ends in every round of the search [m]."""
    import torch

    episodes, policy, errors = environment(EDGES, STEP, WORLDS), network(), []
    search = torch.optim.Adam(policy.parameters(), lr=RATE)
    rates = torch.optim.lr_scheduler.OneCycleLR(search, RATE, total_steps=ROUNDS, pct_start=0.1)
    generators = episodes.generators(seed=0)
    for _ in range(ROUNDS):
        last = episode(episodes, policy, generators)[-1]
        search.zero_grad()
        (-episodes.reward(last).mean()).backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0, error_if_nonfinite=True)
        search.step()
        rates.step()
        errors.append(off(last).mean().item())
    return policy, errors


@cache
@_learn.one_thread()
def tried() -> dict[str, np.ndarray]:
    """Validate the policy on goals of another seed, with a finer cable.

    Returns:
        "goals" (64, 3) [m]. Motion of the grip, "paths", and the free end, "ends" (31, 64, 3) [m]. Final errors (64,) [m]: "learned",
        "untrained", and "hanging", of a cable that hangs from the nearest position within range.
    """
    import torch

    episodes, policies = environment(**FINE, worlds=TRIED), (learn()[0], network())
    with torch.no_grad():
        states, untrained = (episode(episodes, policy, episodes.generators(seed=1)) for policy in policies)
        goals = states[0].goals.numpy()
        below = goals + [0.0, 0.0, LENGTH]
        return {
            "goals": goals,
            "paths": np.array([state.poses[:, 0, :3].numpy() for state in states]),
            "ends": np.array([state.world.positions[:, -1].numpy() for state in states]),
            "learned": off(states[-1]).numpy(),
            "untrained": off(untrained[-1]).numpy(),
            "hanging": np.linalg.norm(below - np.clip(below, -REACH, REACH), axis=1),
        }


def free_ends(model, points: np.ndarray) -> np.ndarray:
    """Return free ends (count, 3) [m], relative to the initial positions of grips."""
    counts = model.curves.counts
    return points[np.cumsum(counts) - 1] - APART * np.arange(len(counts))[:, None] * [1.0, 0.0, 0.0]


def check(result) -> list[ddg.Check]:
    """Check validation goals against the untrained policy and a hanging cable, and the run against the validation."""
    validation, result.learned = tried(), learn()[1]
    mean = {name: validation[name].mean() for name in ("learned", "untrained", "hanging")}
    note = f"{TRIED} goals of another seed; {1e3 * mean['learned']:.0f} mm on average"
    name = "free ends off where the policy had them [m]"

    def ran() -> list[ddg.Check]:
        if (result.model.curves.counts[0] - 1, result.dt) != tuple(FINE.values()):
            return [
                ddg.Check.skip(name, f"needs n = {FINE['n']} and steps of {FINE['step']} s, with which it was tried")
            ]
        ends = free_ends(result.model, result.state.points())
        return [ddg.Check(name, np.abs(ends - validation["ends"][-1, : len(ends)]).max(), 0.0, 1e-3, "environment")]

    return [
        ddg.Check(
            "distance from goals over that untrained", mean["learned"] / mean["untrained"], 0.0, 1.0 / BETTER, note
        ),
        ddg.Check("the same over that of a hanging cable", mean["learned"] / mean["hanging"], 0.0, 1.0 / SWING, note),
        *once_reached(result, END, [name], ran),
    ]


def picture(result, frames) -> dict:
    """Draw cables at a few times, with goals as balls."""
    ball, triangles = meshes.sphere(2)
    count = len(result.model.curves.counts)
    goals = tried()["goals"][:count] + APART * np.arange(count)[:, None] * [1.0, 0.0, 0.0]
    balls = (goals[:, None] + BALL * ball).reshape(-1, 3)
    cells = (triangles[None] + len(ball) * np.arange(count)[:, None, None]).reshape(-1, 3)
    return {"points_by_time": frames, "bodies": {max(frames): (balls, cells)}}


def plot(result) -> dict:
    """Plot errors of free ends in every round, and in validation."""
    validation, rounds = tried(), np.arange(1, ROUNDS + 1)
    kinds = (
        ("untrained", "untrained, other goals", ":"),
        ("hanging", "hanging still", "-."),
        ("learned", "learned, other goals", "--"),
    )
    lines = [("in training", rounds, 1e3 * np.array(result.learned), "-")]
    lines += [
        (label, rounds[[0, -1]], np.full(2, 1e3 * validation[name].mean()), style) for name, label, style in kinds
    ]
    return {
        "lines": lines,
        "x": "rounds of the search, an episode each in 32 worlds",
        "y": "from the goal at the end, on average [mm]",
        "title": "What is learned: to swing the end of a cable to a goal",
        "log": True,
    }


def benchmark() -> ddg.bench.Study:
    """Study the free end of a moved cable over edges and steps."""
    return ddg.bench.Study(
        {"n": (10, 20, 40), "dt": (0.02, 0.01, 0.005)},
        lambda result: result.state.points()[-1],
        {"n": 80, "dt": 0.0025},
        series=("dt",),
        unit="m",
        fixed={"count": 1},
    )
