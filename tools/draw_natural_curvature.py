"""Draw the direction of positive natural curvatures and twist of a rod: tools/results/natural_curvature.png.

python tools/draw_natural_curvature.py
"""

from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.solve.equilibrium import statics

CASES = {
    "at rest, natural = (0, 0, 0)": (0.0, 0.0, 0.0),
    "curvature 1 > 0: towards d1": (1.2, 0.0, 0.0),
    "curvature 2 > 0: towards d2 = t x d1": (0.0, 1.2, 0.0),
    "twist > 0: right-handed about t": (0.0, 0.0, 2.5),
}
COLORS = ("#c0392b", "#2471a3")


def shape(natural):
    """Return points and directors of a rod in natural shape, clamped at the first end along x with director y."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 25)
    section = ddg.Stiffness(EA=1e6, EI1=1.0, GJ=1.0)
    scene.clamp_end(scene.add_rod(points, section=section, natural=natural, director=(0.0, 1.0, 0.0)))
    state = statics.solve(scene.build("cpu"), load_steps=4)
    return state.points(), state.directors()


def main() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    for number, (title, natural) in enumerate(CASES.items(), 1):
        plot = figure.add_subplot(1, len(CASES), number, projection="3d")
        points, first = shape(natural)
        edges = np.diff(points, axis=0)
        tangents = edges / np.linalg.norm(edges, axis=1)[:, None]
        middle = 0.5 * (points[1:] + points[:-1])
        plot.plot(*points.T, color="0.2", linewidth=2.0)
        for vectors, color, name in ((first, COLORS[0], "d1"), (np.cross(tangents, first), COLORS[1], "d2")):
            chosen = slice(0, None, 4)
            plot.quiver(
                *middle[chosen].T, *(0.18 * vectors[chosen]).T, color=color, linewidth=1.1, arrow_length_ratio=0.25
            )
            plot.text(*(middle[0] + 0.24 * vectors[0]), name, color=color, fontsize=8)
        plot.quiver(*points[-1], *(0.2 * tangents[-1]), color="0.2", linewidth=1.4)
        plot.text(*(points[-1] + 0.25 * tangents[-1]), "t", fontsize=8)
        plot.set(xlim=(0.0, 1.2), ylim=(-0.35, 0.75), zlim=(-0.35, 0.75), xlabel="x", ylabel="y", zlabel="z")
        plot.set_box_aspect((1.2, 1.1, 1.1))
        plot.set_proj_type("ortho")
        plot.view_init(elev=24.0, azim=-62.0)
        plot.set_xticks([]), plot.set_yticks([]), plot.set_zticks([])
        plot.set_title(title, fontsize=8)
    FigureCanvasAgg(figure)
    figure.savefig(Path(__file__).parent / "results" / "natural_curvature.png", dpi=130)


if __name__ == "__main__":
    main()
