"""Policy: a grip learns to swing the free end of its cable to any goal, by gradients through the simulator.

A cable hangs from a grip that may move by a hand's breadth only, and its free end is to be at a goal, further aside than the grip could
carry it, when 0.6 s are over. What the grip does follows from what it sees of cable and goal, twenty milliseconds by twenty
milliseconds, through a network of two layers. The cable is alike all around, so that the network sees everything in the directions
towards the goal, aside from it and up, and what it learns for one goal holds for all around. `learn` rolls episodes with random goals
out in an `Environment`, all worlds at once, and moves the weights down the gradient of what is off at the end, which goes back through
all steps (analytic policy gradients: Freeman et al., Brax, 2021; Xu et al., Accelerated policy learning with parallel differentiable
simulation, 2022). It is tried on goals of another seed, and on a finer cable in shorter steps; what runs are cables that are moved as
its grip was for the first of these goals.
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
REACH = 0.15  # m, of the grip along each axis
SPEED = 1.5  # m/s, of the grip along each axis, at most
TURN, TURNS = 0.02, 30  # s between decisions, and how many there are
END = TURN * TURNS  # s
ASIDE = (
    0.2,
    0.35,
)  # m, of goals from below the grip; they are as far from it as the cable is long, or up to a tenth nearer
EDGES, STEP = 10, 0.01  # of the learner's cable, and of its steps [s]
WORLDS, ROUNDS = 32, 60  # cables at once, and rounds of the search
RATE = 5e-3  # of Adam, at most
FINE = {"n": 20, "step": 0.01}  # of the cable that tries what was learned
TRIED = 64  # goals of another seed
BETTER = 6.0  # how much closer the free end comes by what is learned, at least
SWING = 2.0  # how much closer than a cable that hangs from the grip, wherever that is
APART = 0.7  # m, between cables that are shown
BALL = 0.02  # m, radius of the goals drawn


def build(n: int = 20, step: float = 0.01, count: int = 4) -> ddg.Scene:
    """Cables, moved as the policy moves its grip; building takes as long as learning it.

    Args:
        n: edges of a cable
        step: time step [s]
        count: cables, each with its goal
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
    """Hang a cable of n edges at x, held at its upper end."""
    rod = scene.add_rod(np.linspace((x, 0.0, 0.0), (x, 0.0, -LENGTH), n + 1), section=SECTION, twist=False)
    scene.clamp(rod, motion=motion)


def draw(random) -> np.ndarray:
    """A goal (3,) [m]."""
    angle, aside, length = random.uniform(-np.pi, np.pi), random.uniform(*ASIDE), LENGTH * random.uniform(0.9, 1.0)
    return np.array([aside * np.cos(angle), aside * np.sin(angle), -np.sqrt(length**2 - aside**2)])


def towards(goals):
    """Directions (worlds, 3, 3) of goals (worlds, 3), one a row: level and towards it, level and aside, up."""
    import torch

    x, y = torch.nn.functional.normalize(goals[:, :2]).unbind(1)
    none, one = torch.zeros_like(x), torch.ones_like(x)
    return torch.stack([x, y, none, -y, x, none, none, none, one], 1).reshape(-1, 3, 3)


def seen(now):
    """Goal, free end, middle and grip, and velocities, in the directions of the goal; time that is left (worlds, 22); of order one."""
    import torch

    points, velocities = now.world.positions, now.world.velocities
    middle, left = points.shape[1] // 2, 1.0 - now.steps[:, None] / TURNS
    places = [now.goals, points[:, -1] - now.goals, points[:, middle] - points[:, 0], points[:, -1] - points[:, 0]]
    rates = [velocities[:, -1], velocities[:, middle]]
    vectors = torch.stack([*(4.0 * place for place in places), *rates, 8.0 * now.poses[:, 0, :3]], 1)
    return torch.cat([(vectors @ towards(now.goals).mT).flatten(1), left], 1)


def off(now):
    """How far free ends are from their goals (worlds,) [m]."""
    return (now.world.positions[:, -1] - now.goals).norm(dim=1)


def environment(n: int, step: float, worlds: int):
    """Episodes of a cable of n edges in steps of so many seconds."""
    from ddg_warp.learn.environment import Environment, GripRates
    from ddg_warp.torch import Simulator

    scene = ddg.Scene(mass_damping=0.3)
    add_cable(scene, n, 0.0, ddg.Grip())
    return Environment(
        Simulator(scene.build("cpu", "float64"), step),
        worlds,
        GripRates(axes="xyz", speed=SPEED),
        observe=seen,
        reward=lambda now: -((10.0 * off(now)) ** 2) * (now.steps == TURNS),
        draw=draw,
        steps=TURNS,
        substeps=round(TURN / step),
    )


def network():
    """From what is seen to where the grip is to go, in the directions of the goal."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        first, second, last = torch.nn.Linear(22, 64), torch.nn.Linear(64, 64), torch.nn.Linear(64, 3)
    found = torch.nn.Sequential(first, torch.nn.Tanh(), second, torch.nn.Tanh(), last).double()
    with torch.no_grad():
        found[-1].weight.mul_(0.1)  # the grip hardly moves at first
        found[-1].bias.zero_()
    return found


def episode(own, policy, generators) -> list:
    """All states of an episode in every world."""
    states = [own.begin(generators)]
    directions = towards(states[0].goals)
    for _ in range(TURNS):
        chosen = policy(own.observe(states[-1]))[:, None] @ directions
        wanted = REACH * chosen[:, 0].tanh()
        if (
            wanted.requires_grad
        ):  # a world whose step was made in halves has no gradient by what came before, and is left out there
            wanted.register_hook(lambda gradient: gradient.nan_to_num(0.0))
        rates = (wanted - states[-1].poses[:, 0, :3]) / TURN
        states.append(own.step(states[-1], SPEED * (rates / SPEED).tanh()))
    return states


@cache
@_learn.one_thread()
def learn() -> tuple:
    """The policy, and how far free ends were from their goals in every round of the search, on average [m]."""
    import torch

    own, policy, passed = environment(EDGES, STEP, WORLDS), network(), []
    search = torch.optim.Adam(policy.parameters(), lr=RATE)
    rates = torch.optim.lr_scheduler.OneCycleLR(search, RATE, total_steps=ROUNDS, pct_start=0.1)
    generators = own.generators(seed=0)
    for _ in range(ROUNDS):
        last = episode(own, policy, generators)[-1]
        search.zero_grad()
        (-own.reward(last).mean()).backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0, error_if_nonfinite=True)
        search.step()
        rates.step()
        passed.append(off(last).mean().item())
    return policy, passed


@cache
@_learn.one_thread()
def tried() -> dict[str, np.ndarray]:
    """The policy on goals of another seed, with a finer cable.

    Returns:
        "goals" (64, 3) [m]; where the grip, "paths", and the free end, "ends", went (31, 64, 3) [m]; how far the ends were from their
        goals at last (64,) [m]: "learned", by the "untrained" network, and "hanging", from the nearest place that the grip reaches.
    """
    import torch

    own, policies = environment(**FINE, worlds=TRIED), (learn()[0], network())
    with torch.no_grad():
        states, untrained = (episode(own, policy, own.generators(seed=1)) for policy in policies)
        goals = states[0].goals.numpy()
        below = goals + [0.0, 0.0, LENGTH]
        return {
            "goals": goals,
            "paths": np.array([now.poses[:, 0, :3].numpy() for now in states]),
            "ends": np.array([now.world.positions[:, -1].numpy() for now in states]),
            "learned": off(states[-1]).numpy(),
            "untrained": off(untrained[-1]).numpy(),
            "hanging": np.linalg.norm(below - np.clip(below, -REACH, REACH), axis=1),
        }


def free_ends(model, points: np.ndarray) -> np.ndarray:
    """Where cables end (count, 3) [m], each relative to where its grip was at first."""
    counts = model.curves.counts
    return points[np.cumsum(counts) - 1] - APART * np.arange(len(counts))[:, None] * [1.0, 0.0, 0.0]


def check(result) -> list[ddg.Check]:
    """Goals of another seed are met, better than untrained and than without a swing; what runs is what was tried."""
    found, result.learned = tried(), learn()[1]
    mean = {name: found[name].mean() for name in ("learned", "untrained", "hanging")}
    told = f"{TRIED} goals of another seed; {1e3 * mean['learned']:.0f} mm on average"
    name = "free ends off where the policy had them [m]"

    def ran() -> list[ddg.Check]:
        if (result.model.curves.counts[0] - 1, result.dt) != tuple(FINE.values()):
            return [
                ddg.Check.skip(name, f"needs n = {FINE['n']} and steps of {FINE['step']} s, with which it was tried")
            ]
        ends = free_ends(result.model, result.state.points())
        return [ddg.Check(name, np.abs(ends - found["ends"][-1, : len(ends)]).max(), 0.0, 1e-3, "environment")]

    return [
        ddg.Check(
            "distance from goals over that untrained", mean["learned"] / mean["untrained"], 0.0, 1.0 / BETTER, told
        ),
        ddg.Check("the same over that of a hanging cable", mean["learned"] / mean["hanging"], 0.0, 1.0 / SWING, told),
        *once_reached(result, END, [name], ran),
    ]


def picture(result, frames) -> dict:
    """Cables at a few times, with their goals as balls."""
    ball, triangles = meshes.sphere(2)
    count = len(result.model.curves.counts)
    goals = tried()["goals"][:count] + APART * np.arange(count)[:, None] * [1.0, 0.0, 0.0]
    balls = (goals[:, None] + BALL * ball).reshape(-1, 3)
    own = (triangles[None] + len(ball) * np.arange(count)[:, None, None]).reshape(-1, 3)
    return {"points_by_time": frames, "bodies": {max(frames): (balls, own)}}


def plot(result) -> dict:
    """How far free ends were from their goals in every round, and from others than those that it learned with."""
    found, rounds = tried(), np.arange(1, ROUNDS + 1)
    kinds = (
        ("untrained", "untrained, other goals", ":"),
        ("hanging", "hanging still", "-."),
        ("learned", "learned, other goals", "--"),
    )
    lines = [("in training", rounds, 1e3 * np.array(result.learned), "-")]
    lines += [(label, rounds[[0, -1]], np.full(2, 1e3 * found[name].mean()), style) for name, label, style in kinds]
    return {
        "lines": lines,
        "x": "rounds of the search, an episode each in 32 worlds",
        "y": "from the goal at the end, on average [mm]",
        "title": "What is learned: to swing the end of a cable to a goal",
        "log": True,
    }


def benchmark() -> ddg.bench.Study:
    """The free end of a cable moved as was learned over its edges and steps."""
    return ddg.bench.Study(
        {"n": (10, 20, 40), "dt": (0.02, 0.01, 0.005)},
        lambda result: result.state.points()[-1],
        {"n": 80, "dt": 0.0025},
        series=("dt",),
        unit="m",
        fixed={"count": 1},
    )
