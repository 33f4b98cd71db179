"""One Newton iteration of a coupled system at a random state, with its matrices as dense arrays."""

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.newton.coupled_newton import CoupledNewton
from ddg_warp.solve.newton.rod_newton import NewtonOptions

SECTION = ddg.Stiffness(EA=300.0, EI1=0.6, EI2=0.9, GJ=0.5, mass_per_length=0.7, rotary_inertia=0.2)
CABLE = ddg.Stiffness(EA=300.0, mass_per_length=0.7)
RUBBER = ddg.Material(young=1e5, poisson=0.3, density=900.0)


def sheet(bending: str, cells: int = 3) -> ddg.Scene:
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene()
    shell = scene.add_shell(points, triangles, thickness=0.02, material=RUBBER, bending=bending)
    scene.hold(shell, [0, 1])
    scene.hold(shell, [4], "z")
    return scene


def membrane_with_springs() -> ddg.Scene:
    """Build a sheet with a row of springs along an edge: without stress all Hessians are constants of the geometry."""
    scene = sheet("isometric")
    points = scene.shells[0].points
    edge = np.flatnonzero(points[:, 0] == points[:, 0].max())
    edge = edge[np.argsort(points[edge, 1])]
    section = ddg.Stiffness(EA=300.0, mass_per_length=0.4)
    rod = scene.add_rod(points[edge], section=section, bend=False)
    scene.attach(rod, range(len(edge)), 0, edge)
    return scene


def frame_and_sheet(bending: str = "midedge_dof") -> ddg.Scene:
    """Build a sheet with a rod along an edge and a second rod joined rigidly at a corner: every kind of dof block."""
    scene = sheet(bending)
    points = scene.shells[0].points
    edge = np.flatnonzero(points[:, 0] == points[:, 0].max())
    edge = edge[np.argsort(points[edge, 1])]
    section = ddg.Stiffness(EA=300.0, EI1=0.6, EI2=0.9, GJ=0.5, mass_per_length=0.7, rotary_inertia=0.2)
    rim = scene.add_rod(points[edge], section=section)
    scene.attach(rim, range(len(edge)), 0, edge)
    post = scene.add_rod(np.linspace(points[edge[-1]], points[edge[-1]] + [0.2, 0.9, 0.3], 4), section=section)
    scene.join([(rim, -1), (post, 0)])
    return scene


def line(start, end, nodes: int) -> np.ndarray:
    return np.linspace(np.array(start, float), np.array(end, float), nodes)


def branches() -> ddg.Scene:
    """Build a clamped trunk with two branches and a twig across one, of 7, 5, 6 and 7 nodes; one inner node is fixed in x, z."""
    scene = ddg.Scene()
    trunk = scene.add_rod(line((0, 0, 0), (0.1, 0, 1), 7), section=SECTION)
    left = scene.add_rod(line((0.1, 0, 1), (0.5, 0.3, 1.6), 5), section=SECTION)
    rhs = scene.add_rod(line((0.1, 0, 1), (-0.4, 0.1, 1.7), 6), section=SECTION)
    tip = scene.batches[left].points[0, 2]
    twig = scene.add_rod(line(tip - [0.3, -0.3, 0.1], tip + [0.3, -0.3, 0.1], 7), section=SECTION)
    scene.clamp_end(trunk)
    scene.fix(rhs, [3], components="xz")
    scene.join([(trunk, -1), (left, 0), (rhs, 0)])
    scene.join([(left, 2), (twig, 3)])
    return scene


def ring_and_spokes() -> ddg.Scene:
    """Build a closed rod of ten nodes, two spokes joined rigidly to it, and a cable between the spokes."""
    scene = ddg.Scene()
    angle = 2.0 * np.pi * np.arange(10) / 10
    circle = np.column_stack([np.cos(angle), np.sin(angle), 0.1 * np.cos(2.0 * angle)])
    ring = scene.add_rod(circle, section=SECTION, closed=True)
    one = scene.add_rod(line(circle[2], 2.0 * circle[2], 5), section=SECTION)
    two = scene.add_rod(line(circle[6], 2.0 * circle[6], 4), section=SECTION)
    cable = scene.add_rod(line(2.0 * circle[2], 2.0 * circle[6], 6), section=CABLE, bend=False)
    scene.fix(one, [3])
    scene.join([(ring, 2), (one, 0)])
    scene.join([(ring, 6), (two, 0)])
    scene.join([(one, -1), (cable, 0)], rigid=False)
    scene.join([(two, -1), (cable, -1)], rigid=False)
    return scene


def hinged_grid() -> ddg.Scene:
    """Build a grid of three by two rods with hinged crossings: bending continues across the joints."""
    scene = ddg.Scene()
    along = [scene.add_rod(line((0, y, 0), (3, y, 0), 13), section=SECTION) for y in (0.5, 1.0, 1.5)]
    across = [scene.add_rod(line((x, 0, 0), (x, 2, 0), 9), section=SECTION) for x in (0.75, 2.0)]
    for i, rod in enumerate(along):
        scene.fix(rod, [0])
        for crossing, node in zip(across, (3, 8), strict=True):
            scene.join([(rod, node), (crossing, 2 * (i + 1))], rigid=False)
    return scene


class Problem:
    """Newton iteration at a random state of two worlds, with dense matrices."""

    def __init__(
        self,
        scene,
        device,
        stretch=1.0,
        precision="float64",
        preconditioner="block_jacobi",
        rounding_error=0.02,
        seed=3,
        psd="auto",
    ):
        random = np.random.default_rng(seed)
        self.model = scene.build(device, precision, worlds=2)
        coupled, self.state = self.model.coupled, self.model.state()
        self.coupled, self.worlds, self.blocks = coupled, 2, coupled.blocks
        q = self.state.coupled.q.numpy().astype(float)
        free = np.tile(~coupled.host.fixed, (2, 1))
        q[:] = q * stretch + rounding_error * random.normal(size=q.shape) * free
        self.state.coupled.q.assign(q)
        newton = self.newton = CoupledNewton(self.model, NewtonOptions(psd=psd), preconditioner)
        wp.copy(newton.iterates.q, self.state.coupled.q)
        wp.copy(newton.iterates.base, self.state.coupled.q)
        newton.iterates.target.assign(q + 5.0 * rounding_error * random.normal(size=q.shape) * free)
        newton.islands.inertia_coefficient.assign([30.0, 50.0])
        newton.islands.inverse_step.fill_(1.0)
        newton.islands.needs_direction.fill_(1)

    def assemble(self):
        newton = self.newton
        newton.evaluate(self.state.coupled)
        newton.balance()
        newton.assemble()
        if newton.substructuring and newton.substructuring.exact:  # direct substructuring assembles during the solve
            newton.substructuring.bands.assemble(newton.system.matrix, newton.loading.mass, newton.islands)
        return self

    def iterate(self, forcing: float):
        newton = self.assemble().newton
        newton.system.forcing.fill_(forcing)
        newton.direct()
        return self

    def matrix(self, world: int) -> np.ndarray:
        """Return the assembled H of a world (3 N, 3 N) from slices and bands; fixed dofs have identity rows.

        Bands must not have been factorised.
        """
        table, N = self.newton.sparsity, self.blocks
        rows, columns = table.rows.numpy(), table.columns.numpy()
        values = self.newton.system.matrix.numpy().reshape(9, 2, -1)[:, world].copy()
        padding = rows < 0
        assert not values[:, padding].any()
        if self.newton.substructuring and self.newton.substructuring.exact:
            values[:, self.newton.substructuring.plan.taken] = 0.0  # never cleared: the bands hold these blocks
        H = np.zeros((N, 3, N, 3))
        for p in np.flatnonzero(~padding):
            H[rows[p], :, columns[p]] += values[:, p].reshape(3, 3)
        H = H.reshape(3 * N, 3 * N)
        chains = self.newton.substructuring
        if chains is None or not chains.banded:
            return H
        plan, bands = chains.plan, chains.bands.blocks.numpy()[:, :, world * chains.paths.width :]
        nb = 4 if plan.twist else 3
        node, angle = plan.places[0], plan.places[1] if plan.twist else None
        free = self.free()

        def dofs(k, c):
            node_dofs = [*(3 * node[k, c] + np.arange(3))] if node[k, c] >= 0 else [-1] * 3
            return np.array(node_dofs + ([3 * angle[k, c] if angle[k, c] >= 0 else -1] if plan.twist else []))

        for c, count in enumerate(plan.count):
            for k in range(count):
                for s in range(min(plan.span + 1, count - k)):
                    block = bands[s * nb**2 : (s + 1) * nb**2, k, c].reshape(nb, nb)
                    row_dofs, column_dofs = dofs(k, c), dofs(k + s, c)
                    valid = np.outer((row_dofs >= 0) & free[row_dofs], (column_dofs >= 0) & free[column_dofs])
                    i, j = np.nonzero(valid)
                    np.add.at(H, (row_dofs[i], column_dofs[j]), block[i, j])
                    if s:
                        np.add.at(H, (column_dofs[j], row_dofs[i]), block[i, j])
        return H

    def exact(self, world: int) -> np.ndarray:
        """Return the exact Hessian of elastic energy and inertia of a world (3 N, 3 N)."""
        size = 3 * self.blocks
        of_world = slice(world * size, (world + 1) * size)
        H = Tangent(self.model).hessian(self.state).toarray()[of_world, of_world]
        return H + np.diag(self.coupled.host.mass.ravel() * self.newton.islands.inertia_coefficient.numpy()[world])

    def free(self) -> np.ndarray:
        """Return the mask of free dofs (3 N,)."""
        return ~self.coupled.host.fixed.ravel()
