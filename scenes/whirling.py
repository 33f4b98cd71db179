"""Whirling: a bowed rotating shaft deflects as its rate nears the first bending frequency.

With the deflection z = y + i z' in space and a bow a0 in its first mode the shaft obeys z" + w^2 z = w^2 a0 exp(i W t). Here w is
its first bending frequency, and the bow rotates with it (Jeffcott 1919). Below the critical rate W = w it can rotate steadily at
the amplitude a0 / (1 - (W / w)^2). Released unstretched at the rate W it beats around that; at W = w it grows without bound.
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 1.0  # m
SECTION = ddg.Circle(radius=0.005)
MATERIAL = ddg.Material(young=2.0e11, poisson=0.3, density=7800.0)
CRITICAL = {"pinned-pinned": 9.869604401, "clamped-free": 3.516015269, "clamped-clamped": 22.37328545}
SOURCE = "first bending frequency"
DEFLECTIONS = 10.0  # magnification in the picture
EXACT = "shaft with one mode"


def build(
    speed: float = 0.5, bow: float = 0.01, n: int = 40, periods: float = 4.0, steps: int = 120, start: str = "bowed"
) -> ddg.Scene:
    """Build a hinged shaft along x with one sliding hinge, rotated at both ends.

    Args:
        speed: rate of rotation over the critical one
        bow: largest deflection at rest over the length
        n: edges of the shaft, an even number
        periods: duration of the run in periods of the first bending mode
        steps: time steps in a period of that mode, or in a revolution if that is shorter
        start: bowed (rest shape) or riding (steady amplitude), both at the full rate
    """
    if start not in ("bowed", "riding") or (start == "riding" and not speed < 1.0):
        raise ValueError(f"start {start!r} at speed {speed}: it is 'bowed', or 'riding' below the critical speed 1")
    if n < 4 or n % 2:
        raise ValueError(f"n = {n}; it is an even number, 4 at least: the middle of the shaft is a node")
    critical = CRITICAL["pinned-pinned"] * bending_rate()
    rate = speed * critical  # rad/s
    dt = 2.0 * np.pi / (max(1.0, speed) * critical * steps)
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=dt, duration=round(periods * steps) * dt, scheme="implicit_midpoint"),
        initial=lambda model: turning(model, rate, 1.0 / (1.0 - speed**2) if start == "riding" else 1.0),
    )
    s = np.linspace(0.0, LENGTH, n + 1)
    points = np.stack([s, np.zeros(n + 1), bow * LENGTH * np.sin(np.pi * s / LENGTH)], axis=1)
    shaft = scene.add_rod(points, section=SECTION, material=MATERIAL, natural="shape", name="shaft")
    scene.fix(shaft, [0])
    scene.fix(shaft, [-1], components="yz")
    scene.fix_twist(shaft, [0, -1], motion=ddg.Motion(angle=lambda t: rate * t, axis=(1.0, 0.0, 0.0)))
    return scene


def bending_rate() -> float:
    """Return sqrt(EI / (rho A L^4)) [1/s]."""
    section = SECTION.stiffness(MATERIAL)
    return float(np.sqrt(section.EI1 / (section.mass_per_length * LENGTH**4)))


def turning(model, rate: float, factor: float):
    """Return the shaft with the bow times `factor`, rotating about the x axis at `rate` [rad/s]."""
    points = model.scene.batches[0].points[0].copy()
    points[:, 2] *= factor
    velocities = np.cross((rate, 0.0, 0.0), points)
    return model.state(points=points, velocities=velocities, spins=np.full(len(points) - 1, rate))


def straight(support: str, n: int) -> ddg.Scene:
    """Return a scene of a straight shaft at rest with a support of CRITICAL."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    shaft = scene.add_rod(points, section=SECTION, material=MATERIAL, name=support)
    for end, node, edge, kind in zip(("first", "last"), (0, -1), (0, -1), support.split("-"), strict=True):
        if kind == "clamped":
            scene.clamp_end(shaft, end)
        elif kind == "pinned":
            scene.fix(shaft, [node], components="xyz" if end == "first" else "yz")
            scene.fix_twist(shaft, [edge])
    return scene


def critical_rate(support: str, n: int, **options) -> float:
    """Return the critical rate over sqrt(EI / (rho A L^4)), from eigenvalues of the straight shaft; options of `Scene.build`."""
    from ddg_warp.solve.equilibrium.stability import spectrum

    model = straight(support, n).build(**options)
    return float(spectrum(model, model.state(), 1).frequencies[0] / bending_rate())


def deflection(t, speed: float, frequency: float, bow: float, start: float):
    """Return the exact deflection y + i z' over time in the rotating frame, of a mode with `frequency`, from `start`."""
    t, rate = np.asarray(t, float), speed * frequency
    if abs(speed - 1.0) < 1e-9:
        z = (start + 0.5 * bow * -1j * frequency * t) * np.exp(1j * rate * t)
        return (z + 0.5 * bow * np.sin(frequency * t) * 1j) * np.exp(-1j * rate * t)
    ride = bow / (1.0 - speed**2)
    # The rest of the initial deflection swings freely, forwards and backwards: z(0) = start and z'(0) = i W start.
    forward, backward = 0.5 * (1.0 + speed) * (start - ride), 0.5 * (1.0 - speed) * (start - ride)
    free = forward * np.exp(1j * frequency * t) + backward * np.exp(-1j * frequency * t)
    return ride + free * np.exp(-1j * rate * t)


def observe(model, state) -> dict[str, float]:
    """Return the amplitude of the middle [m], and the revolutions of the last edge."""
    points = state.points().reshape(-1, 3)[: model.curves.counts[0]]
    edges = len(points) - 1
    return {
        "amplitude": float(np.hypot(points[edges // 2, 1], points[edges // 2, 2])),
        "turns": float(state.angles().ravel()[edges - 1] / (2.0 * np.pi)),
    }


def check(result) -> list[ddg.Check]:
    """Check amplitude over time, rotation of the ends, and critical rates from eigenvalues."""
    model, times = result.model, np.array(result.times)
    edges = int(model.curves.counts[0]) - 1
    points = model.scene.batches[0].points[0]
    bow = points[edges // 2, 2]
    rate = model.scene.supports[-1].motion.angle(1.0)
    frequency = critical_rate("pinned-pinned", edges, device=model.device) * bending_rate()
    amplitude = np.array(result.series["amplitude"])
    exact = np.abs(deflection(times, rate / frequency, frequency, bow, amplitude[0]))
    # The midpoint rule slows a mode by (w h)^2 / 12, which accumulates over the run; slopes have a second-order effect.
    slope = np.pi * np.abs(exact).max() / LENGTH
    slower = (max(frequency, rate) * result.dt) ** 2 / 12.0 * frequency * times[-1]
    tolerance = (2e-3 + 0.5 * slower + 2.0 * slope**2) * np.abs(exact).max() / bow
    turns = rate * times[-1] / (2.0 * np.pi)
    turned = model.scene.supports[-1].motion.rotation(2.0 * np.pi * turns) @ model.state().directors()[edges - 1]
    director = result.state.directors().reshape(-1, 3)[edges - 1]
    tangent = np.diff(result.state.points().reshape(-1, 3)[edges - 1 : edges + 1], axis=0)[0]
    off = abs(np.linalg.det([tangent / np.linalg.norm(tangent), turned, director]))  # sine of the angle about the edge
    checks = [
        ddg.Check(
            "amplitude over the bow, largest error", np.abs(amplitude - exact).max() / bow, 0.0, tolerance, EXACT
        ),
        ddg.Check("largest amplitude over the bow", amplitude.max() / bow, exact.max() / bow, tolerance, EXACT),
        ddg.Check("turns of the driven end, counted", result.series["turns"][-1], turns, 0.1, "prescribed motion"),
        ddg.Check("director of the driven end, error", off, 0.0, 1e-4, "prescribed motion"),
    ]
    for support, value in CRITICAL.items():
        # Second order in the edges within a wave length.
        space = min(ddg.Check.COARSEST, 1e-3 * max(1.0, (50.0 / edges) ** 2) * max(1.0, value / 10.0))
        measured = critical_rate(support, edges, device=model.device)
        checks.append(ddg.Check(f"critical rate, {support}", measured, value, space, SOURCE, True))
    return checks


def picture(result, frames) -> dict:
    """Draw the shaft at a few times with magnified deflection, and the deflection against the shaft of one mode."""
    rate = result.model.scene.supports[-1].motion.angle(1.0)
    frequency = CRITICAL["pinned-pinned"] * bending_rate()
    times, amplitude = np.array(result.times), 1e3 * np.array(result.series["amplitude"])
    bow = result.model.scene.batches[0].points[0, len(frames[min(frames)]) // 2, 2]
    exact = 1e3 * np.abs(deflection(times, rate / frequency, frequency, bow, 1e-3 * amplitude[0]))
    return {
        "points_by_time": {t: points * [1.0, DEFLECTIONS, DEFLECTIONS] for t, points in list(frames.items())[:-1]},
        "note": f"deflections times {DEFLECTIONS:g}",
        "chart": {
            "lines": [(EXACT, times, exact, "-"), ("this shaft", times[::8], amplitude[::8], "o")],
            "x": "time [s]",
            "y": "deflection of the middle [mm]",
        },
    }


def benchmark() -> ddg.bench.Study:
    """Study the amplitude over the steps of a revolution and the nodes of the shaft."""
    return ddg.bench.Study({"steps": (30, 60, 120, 240), "n": (20, 40)}, "amplitude over the bow", series=("n",))
