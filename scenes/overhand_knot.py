"""Overhand knot: a knot of n turns in a long rod is drawn tight; n = 1 is the trefoil, n = 2 the double overhand knot.

A loose knot is a loop of radius R and a braid, where the two strands wind about each other by some 2 n + 1 half turns. Drawn by a
traction F, a rod of radius h and bending stiffness B needs, by matched expansions in epsilon = sqrt(h / R),

    F h^2 / B = epsilon^4 / 2 + c epsilon^5 + mu P h^2 / B ,    P h^2 / B = sigma epsilon^3 + O(epsilon^4) :

half of the loop's squared curvature, the energy of the braid, and friction of the normal force P in the braid. Source: Audoly,
Clauvelin and Neukirch, Elastic knots, PRL 99, 164301, 2007; sigma = 0.492 of the trefoil. In the braid half the distance of the
strands is h v(s / sqrt(h R)). This curve around the unit disc minimises the integral of |v''|^2 / 2, with curvatures of opposite
sign and size 1/2 beyond. Here sigma is the total force of the disc on it, and c follows from its energy (by finite
differences, `tests/accuracy/test_braid.py`). Another turn adds nearly 2 pi / 12^(3/4) to sigma, as the braid becomes a helix.

Long braids have another law (Jawed, Dieleman, Audoly and Reis, PRL 115, 118302, 2015; `_knots`), for many turns. In a loose knot
its sigma is n times 2 pi / 12^(3/4). The braid computed here has n - 0.495 and n - 0.494 times that, as the ends of the braid take
half a turn from the helix. The law is therefore evaluated at n - 1/2 turns. It leaves out that friction's traction bends the tails,
which shortens the braid: at two turns the normal force grows by a tenth with mu = 0.02 and by half with 0.3. Where this effect is
small, traction above the elastic one is compared with the law. In all cases, total traction is compared with a braid between
bending tails.

R is the rod's length minus the distance of its ends over 2 pi, h half of the distance of strands in contact. Edges grow along the
rod, so that nodes of one strand pass the other's at different times; equal edges would lock.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _knots, _many_rods

RADIUS = 1e-3  # m
B = 1e-4  # N m^2
STIFF = 10.0  # EA h^2 / B
RANGE = 0.4 * RADIUS  # m, activation distance
CLOSE = 1.15  # radii, initial half distance of the strands
LOOSE = 300.0  # initial R / h of one turn
TAIL = 0.7  # initial length of either end beyond the loop, over R
GROWS = 0.3  # relative growth of edges either way from the middle of the rod
STEP_TIME = 1.0  # s, long against all periods: motion is quasi-static
INERTIA = 1e-3  # inertial force over the traction
SATURATED = 0.2  # stick threshold over the slowest sliding speed of strands
SETTLED = 0.1  # fraction of the run after which results are compared
LATE = 0.5  # the same for long braids
UNBENT = 0.05  # largest effect of bending tails on friction for the comparison with Jawed's law
SIGMA = {1: 0.492, 2: 1.468}  # P h^2 / (B epsilon^3)
BRAID = {1: 0.472, 2: 1.402}  # c
SOURCE = "Audoly, Clauvelin and Neukirch, 2007"
LONG = "Jawed, Dieleman, Audoly and Reis, 2015, for many turns: n - 1/2 as the braid's ends take half a turn"
BENT = "their braid and loop, for n - 1/2 turns, with tails that traction bends: scenes/_knots.py"
NAMES = (
    "traction over that of a loose knot",
    "P h^2 / (B epsilon^3) at epsilon = 0",
    "friction over Jawed's law for n - 1/2 turns",
    "traction over that of n - 1/2 turns between tails that bend",
)


def build(
    n: int = 1, friction: float = 0.1, tighter: float = 4.0, edge: float = 2.0, steps: int = 150, seed: int = -1
) -> ddg.Scene:
    """Build the knot, its ends along x and its loop in the plane of x and y.

    Args:
        n: turns, 1 or 2
        friction: friction coefficient; without friction the knot slides off the end of the rod
        tighter: ratio by which R shrinks from 300 n^2 radii of the rod
        edge: length of an edge in the middle over n radii of the rod
        steps: time steps
        seed: seed of the initial jitter of nodes, a twentieth of the activation distance; no jitter below 0
    """
    if n not in SIGMA:
        raise ValueError(f"n = {n}; there are references for 1 and 2 turns")
    if not friction > 0.0:
        raise ValueError(f"friction = {friction}; a knot without friction slides off the rod, give more than 0")
    if not tighter > 1.0:
        raise ValueError(f"tighter = {tighter}; R shrinks by more than 1")
    if not 0.0 < edge <= 8.0:
        raise ValueError(f"edge = {edge}; edges are 8 n radii of the rod at most")
    R = LOOSE * n**2 * RADIUS
    points = tied(n, R, edge * n * RADIUS)
    duration = steps * STEP_TIME
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=STEP_TIME, duration=duration),
        initial=lambda model: model.state(
            points=points + 0.05 * RANGE * _inner(points) * _many_rods.jitter(points.shape, seed)
        ),
    )
    speed = np.pi * R * np.log(tighter) / duration
    section = ddg.Stiffness(
        EA=STIFF * B / RADIUS**2, EI1=B, mass_per_length=INERTIA * B / (R * speed) ** 2, radius=RADIUS
    )
    rod = scene.add_rod(points, section=section, natural="straight", twist=False, name="rod")

    def drawn(t: float) -> float:
        return np.pi * R * (1.0 - tighter ** -(t / duration))

    scene.fix(rod, [0], motion=ddg.Motion(translation=lambda t: (-drawn(t), 0.0, 0.0)))
    scene.fix(rod, [-1], motion=ddg.Motion(translation=lambda t: (drawn(t), 0.0, 0.0)))
    # contacts carry some B h n / R^2 an edge at a gap of about half the activation distance
    stiffness = 3.0 * B * n / R**2 / RADIUS
    scene.contact(range=RANGE, stiffness=stiffness, friction=friction, velocity=SATURATED * speed / tighter)
    return scene


def tied(n: int, R: float, edge: float) -> np.ndarray:
    """Return points (m, 3) [m] of a loose knot with edges of a length [m] in the middle of the rod.

    It consists of two straight ends, a circle of radius R [m], and strands that wind about each other where these meet.
    """
    around, reach = 0.6 * R, (3.8 + 5.86 * (n - 1)) * np.sqrt(RADIUS * R)
    x = np.linspace(-around, around, 8001)
    height = R - np.sqrt(R**2 - x**2)
    fraction = np.clip(0.5 * (x / min(reach, 0.9 * around) + 1.0), 0.0, 1.0)
    angle = (2 * n + 1) * np.pi * fraction**2 * (3.0 - 2.0 * fraction)
    distance = np.hypot(height, 2.0 * CLOSE * RADIUS * (1.0 - (x / around) ** 2) ** 2)
    half = 0.5 * distance[:, None] * np.stack([0.0 * x, np.cos(angle), np.sin(angle)], axis=1)
    middle = np.stack([x, 0.5 * height, 0.0 * x], axis=1)
    arc = np.linspace(np.arcsin(0.6), 2.0 * np.pi - np.arcsin(0.6), 8001)[1:-1]
    loop = R * np.stack([np.sin(arc), 1.0 - np.cos(arc), 0.0 * arc], axis=1)
    end = np.zeros((2001, 3))
    end[:, 0] = np.linspace(-TAIL * R, 0.0, 2001) - around
    curve = np.concatenate([end[:-1], middle - half, loop, middle + half, -end[-2::-1]])
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
    k = np.linspace(0.0, 1.0, int(np.ceil(along[-1] / edge)) + 1)
    position = (k - GROWS * k * (1.0 - k)) * along[-1]
    return np.stack([np.interp(position, along, component) for component in curve.T], axis=1)


def _inner(points: np.ndarray) -> np.ndarray:
    return np.pad(np.ones(len(points) - 2), 1)[:, None]


def observe(model, state) -> dict[str, float]:
    """Return traction F [N], normal force P in the braid [N], R [m], half distance of strands in contact, and smallest gap [m]."""
    points, contacts = state.points().reshape(-1, 3), model.contacts(state)
    first, last = (np.reshape(reaction.force, (-1, 3))[0] for reaction in model.reactions(state))
    forces = np.linalg.norm(contacts.force, axis=1)
    slack = np.linalg.norm(np.diff(points, axis=0), axis=1).sum() - np.linalg.norm(points[-1] - points[0])
    return {
        "traction": 0.5 * (last[0] - first[0]),
        "normal": forces.sum(),
        "radius": slack / (2.0 * np.pi),
        "half": RADIUS + 0.5 * float((forces * contacts.gap).sum() / max(forces.sum(), 1e-300)),
        "gap": _many_rods.smallest_gap(model, state),
    }


def check(result) -> list[ddg.Check]:
    """Check traction against the loose knot, normal force against its limit, and both laws of long braids."""
    checks = once_reached(result, result.model.scene.analysis.duration, NAMES, lambda: _checks(result))
    return checks + _many_rods.kept_apart(result)


def _checks(result) -> list[ddg.Check]:
    friction, times = result.model.scene.contact_settings.friction, np.array(result.times)
    R, traction, normal, h = (np.array(result.series[k]) for k in ("radius", "traction", "normal", "half"))
    n = round(float(np.sqrt(R[0] / RADIUS / LOOSE)))
    epsilon, traction, normal = np.sqrt(h / R), traction * h**2 / B, normal * h**2 / B
    elastic = 0.5 * epsilon**4 + BRAID[n] * epsilon**5
    settled, second_half = times > SETTLED * times[-1], times > LATE * times[-1]
    loose = (traction / (elastic + friction * normal))[settled].mean()
    limit = np.polyfit(epsilon[settled], (normal / epsilon**3)[settled], 1)[1]

    turns, slack = n - 0.5, 2.0 * np.pi * (R / h)[second_half]
    law = np.array([_knots.jawed(turns, each, friction) for each in slack])
    drawn, pressed = np.array([_knots.drawn(turns, each, friction) for each in slack]).T
    ratio, bent = ((traction - elastic)[second_half] / law).mean(), (friction * pressed / law).mean()
    return [
        ddg.Check(NAMES[0], loose, 1.0, 0.1, SOURCE, True),
        ddg.Check(NAMES[1], limit, SIGMA[n], 0.1, SOURCE, True),
        ddg.Check(NAMES[2], ratio, 1.0, 0.1, LONG, True)
        if abs(bent - 1.0) < UNBENT
        else ddg.Check.skip(NAMES[2], f"{ratio:.3f}, of which tails that bend explain {bent:.3f}"),
        ddg.Check(NAMES[3], (traction[second_half] / drawn).mean(), 1.0, 0.1, BENT, True),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the normal force in the braid over the length of edges."""
    return ddg.bench.Study({"edge": (8.0, 4.0, 2.0)}, "P h^2 / (B epsilon^3)", whole=True)


def picture(result, frames) -> dict:
    """Draw the second half of the run, without the ends of the rod."""
    shown = {t: points.copy() for t, points in frames.items() if t >= 0.5 * max(frames)}
    reach = 0.9 * np.ptp(shown[min(shown)][:, 1])
    for points in shown.values():
        points[:, 0] = points[:, 0].clip(-reach, reach)
    return {"points_by_time": shown}
