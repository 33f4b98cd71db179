"""Gridshell dome: two families of steel rods cross, joined rigidly or hinged, and carry their weight and a load at the crown.

The crossings lie on z = rise (1 - x^2) (1 - y^2) over a square plan, x and y in half spans; every rod is pinned at both ends.
Reference: reactions carry all loads, and rods of twice as many segments sag alike. The grillage of two crossing beams of length L
under a force P at the crossing deflects by P L^3 / (96 EI), each beam carrying half (Timoshenko, Strength of Materials I).
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _pictures
from ddg_warp.solve.equilibrium.statics import solve

SPAN = 10.0  # m
RADIUS = 0.03  # m, of the solid round section
STEEL = ddg.Material(young=2.1e11, poisson=0.3, density=7850.0)
GRAVITY = 9.81  # m/s^2


def build(rods: int = 5, segments: int = 8, rise: float = 2.5, rigid: bool = True, load: float = 2000.0) -> ddg.Scene:
    """Build the dome under self-weight and a crown load.

    Args:
        rods: rods in either direction, an odd number
        segments: edges between two crossings
        rise: height of the crown [m]
        rigid: whether joints are rigid
        load: force at the crown, downwards [N]
    """
    if rods % 2 == 0 or rods < 3 or segments < 1:
        raise ValueError(
            f"rods = {rods}, segments = {segments}; give an odd number of rods from 3, and one segment at least"
        )
    scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY), analysis=ddg.Statics(load_steps=2))
    lines = np.linspace(-1.0, 1.0, rods + 2)[1:-1]
    s = np.linspace(-1.0, 1.0, (rods + 1) * segments + 1)
    along = [np.stack([s, np.full_like(s, y)], -1) for y in lines] + [
        np.stack([np.full_like(s, x), s], -1) for x in lines
    ]
    for plan in along:
        x, y = plan.T
        points = np.stack([0.5 * SPAN * x, 0.5 * SPAN * y, rise * (1.0 - x * x) * (1.0 - y * y)], -1)
        rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=STEEL, name="rib")
        scene.fix(rod, [0, -1])
    for i in range(rods):
        for j in range(rods):
            scene.join([(i, (j + 1) * segments), (rods + j, (i + 1) * segments)], rigid=rigid)
    scene.add_force(rods // 2, (rods + 1) // 2 * segments, (0.0, 0.0, -load))
    return scene


def grillage(rigid: bool, edges: int = 16, force: float = 1.0) -> float:
    """Return the deflection of two crossing beams under a force at the crossing, over P L^3 / (96 EI)."""
    section = ddg.Stiffness(EA=1e9, EI1=1e3, GJ=1e3, mass_per_length=1.0)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    s = np.linspace(-0.5, 0.5, edges + 1)
    for axis in np.eye(3)[:2]:
        beam = scene.add_rod(np.outer(s, axis), section=section)
        scene.fix(beam, [0])
        scene.fix(beam, [-1], components="z" + "xy".replace("xy"[int(axis[1])], ""))
        scene.fix_twist(beam, [0])
    scene.join([(0, edges // 2), (1, edges // 2)], rigid=rigid)
    scene.add_force(0, edges // 2, (0.0, 0.0, -force))
    model = scene.build(device="cpu", precision="float64")
    return float(-solve(model).points()[edges // 2, 2] * 96.0 * 1e3 / force)


def sag(scene) -> float:
    """Return the sag of the crown [m]."""
    model = scene.build(device="cpu", precision="float64")
    return crown(model, model.state()) - crown(model, solve(model))


def crown(model, state) -> float:
    """Return the height of the crown, the middle of the middle rib [m]."""
    ribs, nodes = len(model.curves.counts) // 2, int(model.curves.counts[0])
    return float(state.points()[ribs // 2 * nodes + nodes // 2, 2])


def observe(model, state) -> dict[str, float]:
    """Return the height of the crown [m]."""
    return {"crown": crown(model, state)}


def check(result) -> list[ddg.Check]:
    """Check reactions, refinement, the grillage, and the two kinds of joints against each other."""
    model, state = result.model, result.state
    ribs, nodes = len(model.curves.counts) // 2, int(model.curves.counts[0])
    segments = (nodes - 1) // (ribs + 1)
    rise, rigid = float(model.scene.batches[ribs // 2].points[0, nodes // 2, 2]), model.scene.joints[0].rigid
    host, load = model.coupled.host, -model.scene.loads[0].force[2]
    outer = float(host.mass[: host.nodes, 2].sum()) * GRAVITY + load
    lift = sum(reaction.force[2] for reaction in model.reactions(state))
    drop = result.series["crown"][0] - result.series["crown"][-1]
    fine = sag(build(ribs, 2 * segments, rise, rigid, load))
    opposite = sag(build(ribs, segments, rise, not rigid, load))
    stiff, soft = (drop, opposite) if rigid else (opposite, drop)
    source = "rods of twice as many segments"
    return [
        ddg.Check("vertical reactions over the loads", lift / outer, 1.0, 1e-6, "balance of forces"),
        ddg.Check("sag of the crown over that of a finer dome", drop / fine, 1.0, 0.03, source),
        ddg.Check("sag with rigid joints less than with hinged ones", float(stiff < soft), 1.0, 0.0, "stiffer joints"),
        ddg.Check("grillage with hinged joint, deflection 96 EI / P L^3", grillage(False), 1.0, 0.01, "beam theory"),
        ddg.Check("grillage with rigid joint, deflection 96 EI / P L^3", grillage(True), 1.0, 0.01, "beam theory"),
    ]


def picture(result, frames) -> dict:
    """Draw the dome without loads and with magnified sag, colored by the axial force."""
    rest, points = result.model.state().points(), result.state.points()
    factor = float(f"{0.08 * SPAN / np.abs(points - rest).max():.1g}")
    return {
        "points_by_time": {0.0: rest} | _pictures.magnified({1.0: points}, rest, factor),
        "values": 1e-3 * _pictures.at_points(result.model, result.state, "axial_force"),
        "label": "axial force, tension positive [kN]",
        "note": f"displacements times {factor:g}; grey: without loads",
    }


def benchmark() -> ddg.bench.Study:
    """Study the sag of the crown over the segments of a rib between crossings, against four times as many as the defaults."""
    return ddg.bench.Study(
        {"segments": (2, 4, 8, 16), "rigid": (True, False)},
        lambda result: result.series["crown"][0] - result.series["crown"][-1],
        {"segments": 32},
        series=("rigid",),
        unit="m",
    )
