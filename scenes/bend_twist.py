"""Bend-twist: a naturally curved rod hangs in a plane until weight and curvature buckle it out of plane.

The top of an arc of natural curvature k0 is clamped with its tangent straight down; its weight per length w grows, G = w L^3 / B.
The equilibrium in the plane of the arc loses its stability to bending out of the plane with twist (Miller et al., Phys. Rev. Lett.
112, 2014; Romero et al., ACM Trans. Graph. 40, 2021), and below k0 L of about 5.5 it never does. Reference: second variation of the
inextensible Kirchhoff rod, by a spectral method and by a determinant.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.postprocess.mode_shape import buckled_points

LENGTH = 1.0  # m
B, C = 1.0, 2.0 / 3.0  # bending and twisting stiffness [N m^2] at a Poisson's ratio of 0.5
EA = 1.0e7  # N; nearly inextensible
GRAVITY = 9.81  # m/s^2
SOURCE = "second variation of the Kirchhoff rod, spectral against determinant to 1e-7"

# k0 L -> G at which the planar equilibrium loses stability, regains it, and so on, with growing G.
FLIPS = {
    4.0: (),
    5.0: (),
    5.5: (),
    6.0: (11.86875074, 37.76390898),
    7.0: (14.53972482,),
    8.0: (19.24842318,),
    10.0: (28.7697064,),
}


def build(curvature: float = 7.0, weight: float = 14.0, n: int = 100) -> ddg.Scene:
    """Build the arc in the plane of x and z, under its weight.

    Args:
        curvature: natural curvature over 1 / L; there are reference numbers for 4, 5, 5.5, 6, 7, 8 and 10
        weight: G = w L^3 / B
        n: edges of the rod
    """
    gravity = (0.0, 0.0, -GRAVITY)
    scene = ddg.Scene(gravity=gravity, analysis=ddg.Statics(load_steps=max(2, round(0.5 * weight))))
    angle = curvature * np.linspace(0.0, 1.0, n + 1)
    points = LENGTH / curvature * np.stack([1.0 - np.cos(angle), 0.0 * angle, -np.sin(angle)], axis=1)
    density = weight * B / (LENGTH**3 * GRAVITY)
    section = ddg.Stiffness(EA=EA, EI1=B, GJ=C, mass_per_length=density, radius=0.01)
    rod = scene.add_rod(points, section=section, name="curl")
    scene.clamp_end(rod, "first")
    return scene


class PlanarBranch:
    """Planar equilibria of one arc, and stability; symmetry keeps iterates in the plane.

    Attributes:
        unit: G at load parameter 1.
    """

    def __init__(self, curvature: float, n: int, device: str = "cpu", unit: float = 1000.0):
        from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions
        from ddg_warp.solve.equilibrium.tangent import Tangent

        self.unit = unit
        self.model = build(curvature, unit, n).build(device, "float64")
        self.tangent = Tangent(self.model)
        self._equilibrium = Equilibrium(self.model, StaticsOptions(mode="follow"))
        self._known = {0.0: self.model.state()}

    def at(self, weight: float):
        """Return model and equilibrium at G = weight, followed from the nearest known one below."""
        below = max(level for level in self._known if level <= weight)
        if below < weight:
            steps = max(1, int(np.ceil((weight - below) / (1.0 + 0.1 * below))))
            start = self._known[below]
            self._known[weight] = self._equilibrium.load(start, steps, below / self.unit, weight / self.unit)
        return self.model, self._known[weight]

    def lowest(self, weight: float) -> float:
        """Return the lowest eigenvalue of the tangent at G = weight."""
        from ddg_warp.solve.equilibrium import stability

        return float(stability.spectrum(*self.at(weight), 1, "unit", self.tangent).eigenvalues[0])

    def flip(self, low: float, high: float) -> float:
        """Return the G between low and high of a zero lowest eigenvalue."""
        from ddg_warp.solve.equilibrium import stability

        return stability.critical(self.at, low, high)


def check(result) -> list[ddg.Check]:
    """Check the loads of lost and regained planar stability at curvatures with a reference."""
    first, second = np.diff(result.model.scene.batches[0].points[0], axis=0)[:2]
    n = result.model.curves.counts[0] - 1
    turn = np.arccos(first @ second / np.linalg.norm(first) ** 2)
    flips = FLIPS.get(float(np.round(turn * n, 6)), ())
    if not flips:
        return [
            ddg.Check.skip(
                "critical weight [B/L^3]", f"there are reference numbers for {', '.join(map('{:g}'.format, FLIPS))}"
            )
        ]
    branch = PlanarBranch(turn * n, n, result.model.device)
    return [
        ddg.Check(f"critical weight {i} [B/L^3]", branch.flip(0.8 * G, 1.2 * G), G, 0.02, SOURCE, relative=True)
        for i, G in enumerate(flips, 1)
    ]


def picture(result, frames) -> dict:
    """Draw the lowest mode, out of the plane, next to the planar equilibrium."""
    mode = buckled_points(result.model, result.state, 0.08 * LENGTH)
    return {"points_by_time": {0.0: result.state.points(), 1.0: mode}, "label": "amplitude of the lowest mode"}


def benchmark() -> ddg.bench.Study:
    """Study the lowest critical weight over the nodes of the rod."""
    return ddg.bench.Study({"n": (25, 50, 100, 200)}, "critical weight 1")
