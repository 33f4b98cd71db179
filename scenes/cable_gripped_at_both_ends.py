"""Gripped cable: two grips approach and rotate, loops form, and the cable returns as they separate.

Position and frame of both end nodes are prescribed. One end rotates about the axis of the cable by counted revolutions while the
ends approach. A rod without self-crossing keeps its link (Calugareanu 1959, White 1969, Fuller 1971): relative end rotation equals
twist plus writhe, however much of it the loops take up. The motion is slow and damped, so that it ends in the initial equilibrium.
The cable has no self-contact: at five turns its loops close and pass through themselves, which loses two turns for good.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

LENGTH = 1.0  # m
FAR = 1.0e4  # m, distance at which the cable, extended along its end tangents, is closed
HANG = 1.0  # s, end of the initial rest, in which the straight cable comes to hang
BACK = 7.0  # s, end of the motion, back at the initial ends
LINK = "turns of the ends = twist + writhe (Calugareanu, White, Fuller)"
MOTION = "prescribed motion"


def build(
    turns: float = 4.0,
    approach: float = 0.5,
    n: int = 80,
    stiffness: float = 0.05,
) -> ddg.Scene:
    """Build the cable along x, under its weight.

    Args:
        turns: revolutions of the last end about x, at half the time
        approach: approach of the ends over the length of the cable, at half the time
        n: edges of the cable
        stiffness: EI [N m^2]; GJ is a quarter of it, as of a stranded cable
    """
    scene = ddg.Scene(
        mass_damping=4.0,
        analysis=ddg.Dynamics(dt=0.01, duration=BACK + 1.0, scheme="implicit_euler"),
    )
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    cable = scene.add_rod(
        points,
        section=ddg.Stiffness(
            EA=8000.0,
            EI1=stiffness,
            GJ=0.25 * stiffness,
            mass_per_length=0.08,
            rotary_inertia=1e-6,
            radius=0.005,
            viscosity=0.01,
        ),
        name="cable",
    )

    def progress(t: float) -> float:
        """Return the progress of the motion: 0 until HANG, 1 in the middle, 0 from BACK on, smoothly."""
        s = min(1.0, max(0.0, 2.0 * min(t - HANG, BACK - t) / (BACK - HANG)))
        return s * s * (3.0 - 2.0 * s)

    shift = 0.5 * approach * LENGTH
    scene.clamp_end(cable, "first", motion=ddg.Motion(translation=lambda t: (shift * progress(t), 0.0, 0.0)))
    scene.clamp_end(
        cable,
        "last",
        motion=ddg.Motion(
            translation=lambda t: (-shift * progress(t), 0.0, 0.0),
            angle=lambda t: 2.0 * np.pi * turns * progress(t),
            axis=(1.0, 0.0, 0.0),
        ),
    )
    return scene


def equilibrium(model):
    """Return the hanging cable before the motion: statics loads from 0 to 1 s, while the ends are still."""
    from ddg_warp.solve.equilibrium.statics import solve

    return solve(model)


def writhe(points: np.ndarray) -> float:
    """Return the writhe of the cable (n, 3), extended along x and closed far away."""
    from ddg_warp.postprocess.quantities import writhe

    first, last = points[0], points[-1]
    along, aside = np.array([FAR, 0.0, 0.0]), np.array([0.0, 0.0, FAR])
    return writhe(np.vstack([points, last + along, last + along + aside, first - along + aside, first - along]))


def observe(model, state) -> dict[str, float]:
    """Return revolutions of the last end, twist and writhe, and the position error of end nodes [m]."""
    from ddg_warp.postprocess.quantities import total_twist

    points = state.points().reshape(-1, 3)[: model.curves.counts[0]]
    rest, supports = model.scene.batches[0].points[0], model.scene.supports
    ends = [
        rest[node] + support.motion.translation(state.time) for node, support in zip((0, -1), supports, strict=True)
    ]
    return {
        "turns": supports[1].motion.angle(state.time) / (2.0 * np.pi),
        "twist": total_twist(model, state),
        "writhe": writhe(points),
        "end_error": float(np.abs(points[[0, -1]] - ends).max()),
    }


def balance(model) -> float:
    """Return the largest rate of momentum that weight, damping and grips leave over, over the largest grip force.

    Steps go until the ends approach and rotate.
    """
    integrator, state, dt = ddg.Integrator(model, rtol=1e-9), equilibrium(model), model.scene.analysis.dt
    integrator.watch_wrenches()
    left, forces = [], []
    for _ in range(int(1.5 * HANG / dt)):
        before, state = state, integrator.step(state, dt)
        mass = model.groups[0].mass.numpy()[..., None]
        first, last = ((mass * each.groups[0].v.numpy()).sum((0, 1)) for each in (before, state))
        forces.append(sum(wrench.force for wrench in integrator.wrenches()))
        weight = mass.sum() * np.array(model.scene.gravity)
        left.append((last - first) / dt + model.scene.mass_damping * last - weight - forces[-1])
    return float(np.abs(left).max() / np.abs(forces).max())


def check(result) -> list[ddg.Check]:
    """Check end positions, turns = twist + writhe at all times, convergence, and the return to equilibrium."""
    series = {name: np.array(values) for name, values in result.series.items()}
    failed = sum(number for name, number in result.statistics["outcomes"].items() if not name.startswith("converged"))
    link = series["twist"] + series["writhe"] - series["turns"]
    passes = np.round(0.5 * link)  # a self-crossing changes the link of a curve by two
    model = result.model
    last = "cable from where it was, at the end [m]"

    def back() -> list[ddg.Check]:
        off = np.abs(result.state.points() - equilibrium(model).points()).max()
        return [ddg.Check(last, off, 0.0, 1e-5, "equilibrium")]

    return [
        ddg.Check("solves that did not converge", failed, 0.0, 0.0),
        ddg.Check("end nodes from where their motion has them [m]", series["end_error"].max(), 0.0, 1e-12, MOTION),
        ddg.Check("twist + writhe - turns, largest", np.abs(link - 2.0 * passes).max(), 0.0, 1e-5, LINK),
        ddg.Check("how often the cable passed through itself", np.abs(passes).max(), 0.0, 0.0, LINK),
        ddg.Check("rate of momentum over grip forces and weight", balance(model), 0.0, 1e-7, "balance of momentum"),
        *once_reached(result, BACK + 1.0, [last], back),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the writhe halfway over nodes and steps against a finer cable in shorter steps."""
    return ddg.bench.Study(
        {"n": (20, 40, 80), "dt": (0.02, 0.01)},
        lambda result: result.series["writhe"][-1],
        {"n": 240, "dt": 0.005},
        fixed={"duration": 2.0},
        series=("dt",),
    )
