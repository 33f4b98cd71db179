"""Drawn rod: a soft rod on a rough floor is drawn by its end and let back; friction depends on the load path.

A rod with stretching stiffness EA lies along x with the weight w a length. Drawn by its last end, it slides over the length at which
friction balances the pull F. Tension falls by mu w along the sliding length, and the end moves by

    u = F^2 / (2 EA mu w) .

Let back, it slides in reverse from its end on, where friction changes sign: with u_0 and F_0 at the reversal

    u_0 - u = (F_0 - F)^2 / (4 EA mu w) ,

so that the force reverses long before its end has returned. Every state is an equilibrium, found from the one before. Friction is
fully mobilised, as all sliding is much faster than the stick threshold.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

LENGTH = 1.0  # m
RADIUS = 0.01  # m
WEIGHT = 2.0  # N/m
FAR = 0.2  # m, largest displacement of the end
SLIDES = 0.7  # fraction of the rod that then slides
BACK = 0.6  # fraction of the displacement that is let back
LAID, TURN = 0.1, 0.6  # load parameter at full weight, and at the reversal
B = 1e-3  # N m^2
RANGE = 1e-3  # m, activation distance
CLOSE = 0.5  # initial gap over the activation distance
SOURCE = "friction along what slides, exact"


def build(
    friction: float = 0.5,
    n: int = 50,
    load_steps: int = 20,
    velocity: float = 1e-5,
    range: float = RANGE,
    seed: int = -1,
) -> ddg.Scene:
    """Build the rod along x, at half the activation distance above the floor z = 0.

    Args:
        friction: friction coefficient, positive
        n: edges of the rod
        load_steps: equilibria, a multiple of 10; the weight is applied in the first tenth, and the rod is let back after six
        velocity: stick threshold nu of the friction law [m/s]; the load parameter counts as time
        range: activation distance of contact [m]
        seed: seed of the initial jitter of nodes, a fifth of the activation distance; no jitter below 0
    """
    if not friction > 0.0:
        raise ValueError(f"friction = {friction}; without friction no force restrains the rod, give more than 0")
    if load_steps < 10 or load_steps % 10:
        raise ValueError(
            f"load_steps = {load_steps}; the rod is laid down and let back at tenths of the run, so give a multiple of 10"
        )
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Statics(load_steps=load_steps),
        initial=lambda model: _many_rods.jittered(model, seed),
    )
    points = np.zeros((n + 1, 3))
    points[:, 0], points[:, 2] = np.linspace(0.0, LENGTH, n + 1), RADIUS + CLOSE * range
    section = ddg.Stiffness(EA=friction * WEIGHT * (SLIDES * LENGTH) ** 2 / (2.0 * FAR), EI1=B, GJ=B, radius=RADIUS)
    rod = scene.add_rod(points, section=section, name="rod")
    for k in np.arange(n + 1):
        length = LENGTH / n * (0.5 if k in (0, n) else 1.0)
        scene.add_force(rod, k, (0.0, 0.0, -WEIGHT * length), amplitude=lambda t: min(1.0, t / LAID))
    scene.fix(rod, [-1], "xy", motion=ddg.Motion(translation=lambda t: (drawn(t), 0.0, 0.0)))
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(range=range, friction=friction, velocity=velocity)
    return scene


def drawn(t: float) -> float:
    """Return the prescribed displacement of the end [m] at load parameter t."""
    return FAR * np.interp(t, [LAID, TURN, 1.0], [0.0, 1.0, 1.0 - BACK])


def expected(u: float, turned: bool) -> float:
    """Return the end force over mu w L at a displacement u [m], before or after the reversal at `FAR`."""
    EA = SLIDES**2 * LENGTH / (2.0 * FAR)  # over mu w L
    if not turned:
        return np.sqrt(2.0 * EA * u / LENGTH)
    return SLIDES - 2.0 * np.sqrt(EA * (FAR - u) / LENGTH)


def observe(model, state) -> dict[str, float]:
    """Return displacements of the last and first end [m], the end force over mu w L, and the smallest gap [m]."""
    moved = (state.points() - model.state().points())[:, 0]
    pull = np.reshape(model.reactions(state, factor=state.time)[0].force, (-1, 3))[0, 0]
    return {
        "drawn": moved[-1],
        "crept": moved[0],
        "force": pull / (model.scene.contact_settings.friction * WEIGHT * LENGTH),
        "gap": _many_rods.smallest_gap(model, state),
    }


def check(result) -> list[ddg.Check]:
    """Check the force at the reversal, after it and along the path, and rest of the first end."""
    names = (
        "force over mu w L, drawn",
        "force over mu w L, let back",
        "error of the force on the way",
        "creep of the first end [m]",
    )
    return once_reached(result, 1.0, names, lambda: _checks(result, names))


def _checks(result, names) -> list[ddg.Check]:
    times, series = np.array(result.times), {name: np.array(values) for name, values in result.series.items()}
    exact = np.array([expected(u, t > TURN + 1e-9) for t, u in zip(times, series["drawn"], strict=True)])
    turn, velocity = int(np.argmax(series["drawn"])), result.model.scene.contact_settings.velocity
    errors, crept = np.abs(series["force"] - exact)[times > LAID + 1e-9], series["crept"][times > LAID - 1e-9]
    n = result.model.curves.counts[0] - 1
    return [
        ddg.Check(names[0], series["force"][turn], exact[turn], 0.1 / n, SOURCE, True),
        ddg.Check(names[1], series["force"][-1], exact[-1], 0.1 / n, SOURCE),
        ddg.Check(names[2], errors.max(), 0.0, 0.1 / n, SOURCE),
        ddg.Check(names[3], abs(crept[-1] - crept[0]), 0.0, velocity, "nu times the load parameter"),
        ddg.Check("overlap of surfaces [m]", max(0.0, -series["gap"].min()), 0.0, 0.0, "the barrier"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the force after the reversal over edges, load steps, stick threshold and activation distance, one by one."""
    grid = {"n": (12, 25, 50, 100, 200), "load_steps": (10, 20, 40, 80), "velocity": (1e-6, 1e-5, 1e-4, 1e-3)}
    return ddg.bench.Study(
        grid | {"range": (2.5e-4, 5e-4, RANGE, 2e-3)}, "force over mu w L, let back", one_by_one=True
    )


def picture(result, frames) -> dict:
    """Draw the rod at a few load parameters, side by side, and the floor."""
    corners, cells = meshes.rectangle(1, 1)
    rows = {t: points + [0.0, -0.06 * i, 0.0] for i, (t, points) in enumerate(sorted(frames.items()))}
    wide = 0.06 * len(frames) + 0.06
    floor = np.column_stack([1.4 * corners[:, 0] - 0.1, 0.09 - wide * corners[:, 1], 0.0 * corners[:, 0]])
    drawn_by, turn = 1e3 * np.array(result.series["drawn"]), int(np.argmax(result.series["drawn"]))
    pull, steps = np.array(result.series["force"]), len(result.times)
    exact = [expected(1e-3 * u, i > turn) for i, u in enumerate(drawn_by)]
    laid = np.array(result.times) > LAID - 1e-9
    return {
        "points_by_time": rows,
        "bodies": {min(frames): (floor, cells)},
        "loads": None,
        "note": "from the back to the front by load parameter",
        "chart": {
            "lines": [
                ("exact", drawn_by[laid], np.array(exact)[laid], "-"),
                ("drawn", drawn_by[: turn + 1], pull[: turn + 1], "o"),
                ("let back", drawn_by[turn:steps], pull[turn:steps], "s"),
            ],
            "x": "displacement of the end [mm]",
            "y": "force over µ w L",
        },
    }
