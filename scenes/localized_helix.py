"""Localised helix: a rod twisted by 27 turns buckles into a helix in its middle as its ends approach.

The test of Bergou et al. (Discrete Elastic Rods, ACM Trans. Graph. 27, 2008): clamped ends, 27 turns, shortening 0.3. In the
infinite rod (Coyne, IEEE J. Oceanic Eng. 15, 1990; van der Heijden & Thompson, Nonlinear Dynamics 21, 2000) the angle phi between
tangent and axis, at most p, follows

    (cos phi - cos p) / (1 - cos p) = tanh^2(s / s*) ,  s* = (2B / M) cot(p / 2) ,  T = M^2 / (2B (1 + cos p)) ,
    shortening D = (4B / M) sin p ,  end rotation R = M L / C + 2 p .
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 9.29  # m
B, C = 1.345, 0.789  # bending and twisting stiffness [N m^2]
TAUT = 80.0  # N, initial tension above M^2 / 4B, at which the twisted rod is straight
NUDGE = 0.1  # N, in the middle; localises the buckle
SHOWN = 1.5  # m, half the length of the picture
SOURCE = "localised helix of the infinite rod (Coyne 1990)"


def build(turns: float = 27.0, shortening: float = 0.3, axial: float = 1.0e6, n: int = 400) -> ddg.Scene:
    """Build the rod along x, twisted under tension, with ends that then approach.

    Args:
        turns: turns of twist between the ends
        shortening: approach of the ends [m], beyond the stretch by tension
        axial: EA L^2 / B; the reference is inextensible
        n: edges of the rod, an even number
    """
    if n < 4 or n % 2:
        raise ValueError(f"n = {n}; it is an even number, 4 at least: the middle of the helix is a node")
    EA = axial * B / LENGTH**2
    taut, slack = TAUT * LENGTH / EA, exact(turns, shortening)[3] * LENGTH / EA - shortening
    steps = 2 * int(np.ceil((taut - slack) / (LENGTH / n)))  # half an edge each
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=max(30, steps)))
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    # End rotation of an isotropic rod is equivalent to natural twist of opposite sign. With the latter, material frames
    # do not rotate from edge to edge; rotations of 27 / 200 of a revolution would cost a sixth of the bending
    # stiffness.
    rod = scene.add_rod(
        points,
        section=ddg.Stiffness(EA=EA, EI1=B, GJ=C, radius=0.03),
        natural=(0.0, 0.0, -2.0 * np.pi * turns / LENGTH),
        name="rod",
    )
    slide = ddg.Motion(translation=lambda t: (taut + (slack - taut) * t, 0.0, 0.0))
    scene.clamp_end(rod, "first")
    scene.clamp_end(rod, "last", motion=slide)
    scene.add_force(rod, n // 2, (0.0, 0.0, NUDGE), amplitude=lambda t: 1.0 - t)
    return scene


def exact(turns: float, shortening: float) -> tuple[float, float, float, float]:
    """Return largest angle p [rad], s* [m], moment [N m] and tension [N] on the branch from the straight rod."""
    from scipy.optimize import brentq

    def moment(angle):
        return C * (2.0 * np.pi * turns - 2.0 * angle) / LENGTH

    p = brentq(lambda a: 4.0 * B / moment(a) * np.sin(a) - shortening, 0.0, 0.5 * np.pi)
    M = moment(p)
    return p, 2.0 * B / M / np.tan(0.5 * p), M, M**2 / (2.0 * B * (1.0 + np.cos(p)))


def envelope(state) -> tuple[np.ndarray, np.ndarray]:
    """Return the position s of edge midpoints from the middle [m], and their angle phi to the axis [rad]."""
    edges = np.diff(state.points(), axis=0)
    lengths = np.linalg.norm(edges, axis=1)
    s = (np.arange(len(edges)) + 0.5) * (LENGTH / len(edges)) - 0.5 * LENGTH
    return s, np.arccos(np.clip(edges[:, 0] / lengths, -1.0, 1.0))


def measure(model, state) -> tuple[float, float, float, float]:
    """Return the values of `exact`: p and s* by least squares over all edges, moment and tension from end reactions."""
    from scipy.optimize import curve_fit

    from ddg_warp.solve.equilibrium.tangent import Tangent

    s, phi = envelope(state)

    def cosine(s, p, width, middle):
        return np.cos(p) + (1.0 - np.cos(p)) * np.tanh((s - middle) / width) ** 2

    (p, width, _), _ = curve_fit(cosine, s, np.cos(phi), (phi.max(), 0.05 * LENGTH, s[np.argmax(phi)]))
    tangent = Tangent(model)
    reactions, positions = (
        tangent.gradient(state).reshape(-1, 4)[-2:],
        tangent.dofs(state).reshape(-1, 4)[-2:, :3],
    )  # end and ghost
    moment = np.cross(positions, reactions[:, :3]).sum(axis=0)[0] + reactions[0, 3]
    return p, width, moment, reactions[:, 0].sum()


def check(result) -> list[ddg.Check]:
    """Check envelope, moment and tension against the infinite rod."""
    scene = result.model.scene
    turns = -scene.batches[0].natural[2] * LENGTH / (2.0 * np.pi)
    points = result.state.points()
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    values = exact(turns, length - (points[-1, 0] - points[0, 0]))
    measured = measure(result.model, result.state)
    tolerance = min(ddg.Check.COARSEST, 0.04 * max(0.25, (400.0 / (result.model.curves.counts[0] - 1)) ** 2))
    names = ("largest angle [rad]", "width of the envelope [m]", "moment [N m]", "tension [N]")
    return [ddg.Check(*entry, tolerance, SOURCE, relative=True) for entry in zip(names, measured, values, strict=True)]


def picture(result, frames) -> dict:
    """Draw the helix in the middle, with most of the ends cut off, and the angle of the tangent along the rod."""
    points, (s, angle) = result.state.points().copy(), envelope(result.state)
    middle = points[len(points) // 2, 0]
    points[:, 0] = points[:, 0].clip(middle - SHOWN, middle + SHOWN)
    return {
        "points_by_time": {1.0: points},
        "fixed": None,
        "note": f"the middle {2.0 * SHOWN:g} m",
        "chart": {
            "lines": [("", s, np.degrees(angle), "-")],
            "x": "arc length from the middle [m]",
            "y": "angle to the axis [degrees]",
        },
    }


def benchmark() -> ddg.bench.Study:
    """Study the moment over the nodes; the reference is an infinite rod."""
    return ddg.bench.Study({"n": (200, 400, 800)}, "moment")
