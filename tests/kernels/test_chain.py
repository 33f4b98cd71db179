"""Block LDL^T sweep of a rod group against a dense solve, line search against energies, and planar rods of three kinds."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.geometry import polyline
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.rod_layout import rod_storage
from ddg_warp.solve.newton.rod_newton import NewtonOptions, RodNewton
from tests.rod_gradients import element_gradients

KINDS = {
    "full": {},
    "untwisted": {"twist": False},
    "planar": {"dimension": 2},
    "stretch": {"bend": False},
}
EVERY_KIND = pytest.mark.parametrize("name", KINDS)


class Problem:
    """Two open rods of 7 and 6 nodes in two worlds, at a random state, with supports, loads and rotary inertia."""

    def __init__(self, name, device, precision="float64", noise=0.15, inertia=2.0, seed=11, **options):
        rod_options = {"dimension": 3, "twist": True, "bend": True} | KINDS[name]
        random = np.random.default_rng(seed)
        dimension = rod_options.pop("dimension")
        across = 1.0 if dimension == 3 else 0.0
        self.scene = scene = ddg.Scene(gravity=(0.3, -0.5 * across, -2.0), dimension=dimension)
        section = ddg.Stiffness(EA=9.0, EI1=0.6, EI2=0.9, GJ=0.5, mass_per_length=0.7, rotary_inertia=0.2)
        if name != "full":
            section = ddg.Stiffness(EA=9.0, EI1=0.6, GJ=0.5, mass_per_length=0.7)
        for nodes in (7, 6):
            points = np.cumsum(np.array([1.0, 0.0, 0.2]) + 0.3 * random.normal(size=(nodes, 3)), axis=0)
            points[:, 1] *= across
            scene.add_rod(points, section=section, natural="straight", **rod_options)
        scene.fix(0, [0])
        scene.fix(0, [3, 6], components="z")
        scene.fix(1, [2], components="xy")
        scene.fix(1, [3], components="x")
        scene.add_force(0, 5, (0.4, 0.2 * across, -0.6))
        scene.add_force(1, 0, (-0.7, 0.1 * across, 0.3))
        if name == "full":
            scene.fix_twist(0, [0, 4])
            scene.fix_twist(1, [2])
            scene.add_twisting_moment(1, 4, 0.3)
        self.model = scene.build(device=device, precision=precision, worlds=2)
        (self.group,) = self.model.groups
        self.kind, self.device = self.group.kind, device
        self.count = np.tile(self.group.host.count, 2)
        newton = self.newton = RodNewton(self.model, self.group, NewtonOptions(**options))
        state = self.model.state().groups[0]
        x = device_arrays.download(state.x)
        device_arrays.assign(newton.iterates.x, x + noise * random.normal(size=x.shape))
        device_arrays.assign(newton.iterates.target, x + noise * random.normal(size=x.shape))
        if self.kind.twist:
            shape = newton.iterates.theta.shape
            wp.copy(newton.iterates.frame, state.frame)
            device_arrays.assign(newton.iterates.theta, 2.0 * noise * random.normal(size=shape))
            device_arrays.assign(newton.iterates.target_angle, 2.0 * noise * random.normal(size=shape))
        newton.islands.inertia_coefficient.assign(inertia * random.uniform(0.5, 1.5, size=4))
        newton.islands.inverse_step.fill_(1.0)
        newton.islands.drop_compression.fill_(
            1
        )  # these states are compressed so much that the matrix would be indefinite
        self.last = state.last

    def iterate(self):
        """Perform an iteration, and keep the factors and gradients of the iterate that it starts from."""
        self.newton.evaluate(self.last)
        self.factor = device_arrays.download(self.newton.elements.factor)
        self.gradient = element_gradients(self.newton, self.last)
        self.newton.sweep()

    def dofs(self, position, angle) -> np.ndarray:
        """Return device arrays of nodes and angles as (columns, n, dofs of a node)."""
        q = np.moveaxis(device_arrays.download(position), 0, 1)
        return np.concatenate([q, device_arrays.download(angle).T[..., None]], -1) if self.kind.twist else q

    def iterate_dofs(self) -> np.ndarray:
        return self.dofs(self.newton.iterates.x, self.newton.iterates.theta)

    def put(self, q) -> None:
        """Make q the iterate."""
        device_arrays.assign(self.newton.iterates.x, np.ascontiguousarray(np.moveaxis(q[..., : self.kind.dim], 0, 1)))
        if self.kind.twist:
            device_arrays.assign(self.newton.iterates.theta, np.ascontiguousarray(q[..., self.kind.dim].T))

    def direction(self) -> np.ndarray:
        return device_arrays.download(self.newton.direction).transpose(2, 1, 0)

    def age(self, q: np.ndarray, column: int):
        """Return cosines to lagged tangents, twist less lagged twist, and cosines of bends of a rod at q (n, dofs)."""
        n, frame = self.count[column], device_arrays.download(self.newton.iterates.frame)[:, :, column]
        t, (u0, t0) = polyline.unit(np.diff(q[:n, :3], axis=0)), (frame[row : row + 3, : n - 1].T for row in (0, 3))
        u = polyline.transport(u0, t0, t)
        twist = polyline.signed_angle(polyline.transport(u[:-1], t[:-1], t[1:]), u[1:], t[1:]) - frame[6, : n - 2]
        twist -= 2.0 * np.pi * np.round(twist / (2.0 * np.pi))
        return np.sum(t * t0, -1), twist, np.sum(t[1:] * t[:-1], -1)

    def windows(self, k: int, n: int) -> np.ndarray:
        """Return the matrix from dofs of a rod to local dofs of element k, zero beyond the end."""
        kind = self.kind
        B = np.zeros((kind.window, n, kind.block))
        for edge in range(kind.span):
            if k + edge + 1 < n:
                for d in range(kind.dim):
                    B[edge * kind.dim + d, k + edge + 1, d] = 1.0
                    B[edge * kind.dim + d, k + edge, d] = -1.0
                if kind.twist:
                    B[kind.dim * kind.span + edge, k + edge, kind.dim] = 1.0
        return B.reshape(kind.window, -1)

    def inertia(self, column: int):
        """Return the diagonal of inertia, target, and external force of a rod."""
        host, kind, n = self.group.host, self.kind, self.count[column]
        rod, c = column % 2, float(device_arrays.download(self.newton.islands.inertia_coefficient)[column])
        diagonal, force = np.zeros((n, kind.block)), np.zeros((n, kind.block))
        diagonal[:, : kind.dim] = c * host.mass[:n, rod, None]
        force[:, : kind.dim] = (
            host.mass[:n, rod, None] * self.group.gravity_host + device_arrays.download(self.group.load)[:n, rod]
        )
        if kind.twist:
            diagonal[:, kind.dim] = c * host.rotary[:n, rod]
            force[:, kind.dim] = device_arrays.download(self.group.load_angle)[:n, rod]
        target = self.dofs(self.newton.iterates.target, self.newton.iterates.target_angle)[column, :n]
        return diagonal.ravel(), target.ravel(), force.ravel()

    def free(self, column: int) -> np.ndarray:
        bits = self.group.host.fixed[: self.count[column], column % 2, None] >> np.arange(self.kind.block)
        return (bits & 1 == 0).ravel()

    def dense(self, column: int, q: np.ndarray):
        """Return Gauss-Newton matrix and residual of a rod at the last evaluated iterate, from factors and gradients."""
        kind, n = self.kind, self.count[column]
        F, g = self.factor, self.gradient
        diagonal, target, force = self.inertia(column)
        H, r = np.diag(diagonal), force - diagonal * (q - target)
        edge_row, tension_row = kind.vertex_strains * kind.window, kind.factor_rows - kind.tensions
        for k in range(n - 1):
            B = self.windows(k, n)
            rows = F[:, k, column]
            r -= B.T @ g[:, k, column]
            if k < n - 2:
                J = rows[:edge_row].reshape(-1, kind.window) @ B
                H += J.T @ J
            J = rows[edge_row:tension_row].reshape(-1, kind.dim) @ B[: kind.dim]
            H += J.T @ J + rows[tension_row:].sum() * B[: kind.dim].T @ B[: kind.dim]
        return H, r

    def energy(self, q: np.ndarray) -> np.ndarray:
        """Return the total energy of every column at q, with the elastic energy by the terms' own kernels."""
        kind, group, newton, real = self.kind, self.group, self.newton, self.model.types.real
        kept = self.iterate_dofs()
        self.put(q)
        total = np.zeros(group.columns)
        for i in range(len(kind.terms)):
            out = device_arrays.allocate((group.nodes, group.columns), real, self.device)
            wp.launch(
                element_path.term_kernels(rod_storage(kind, real), i, real)[0],
                (group.elements, group.columns),
                [group.element_inputs(newton.iterates, self.last, newton.islands.inverse_step)],
                [device_arrays.columns(out)],
                device=self.device,
            )
            total += device_arrays.download(out).sum(0)
        self.put(kept)
        for column in range(group.columns):
            diagonal, target, force = self.inertia(column)
            dofs = q[column, : self.count[column]].ravel()
            total[column] += 0.5 * diagonal @ (dofs - target) ** 2 - force @ dofs
        return total


def second_order(x: np.ndarray, step: np.ndarray) -> float:
    """Return a bound of the difference between edge-rotation and straight updates: squared rotations, summed along the rod."""
    edges, edge_steps = np.diff(x, axis=0), np.diff(step, axis=0)
    return len(x) * (np.sum(edge_steps**2, -1) / np.linalg.norm(edges, axis=-1)).max() + 1e-14


@pytest.mark.parametrize(("name", "precision"), [*((name, "float64") for name in KINDS), ("full", "mixed")])
def test_sweep_equals_a_dense_solve(device, name, precision):
    """Direction and predicted decrease agree, from the same factors and forces."""
    problem = Problem(name, device, precision)
    before = problem.iterate_dofs()
    problem.iterate()
    direction, decrement = problem.direction(), device_arrays.download(problem.newton.islands.predicted_decrease)
    tolerance = 1e-12 if precision == "float64" else 1e-4
    for column, n in enumerate(problem.count):
        H, r = problem.dense(column, before[column, :n].ravel())
        free = problem.free(column)
        assert 0 < (~free).sum() < free.sum()
        expected = np.zeros(len(r))
        expected[free] = np.linalg.solve(H[np.ix_(free, free)], r[free])
        scale = np.abs(expected).max()
        assert scale > 0.01
        np.testing.assert_allclose(direction[column, :n].ravel(), expected, rtol=0, atol=tolerance * scale)
        np.testing.assert_allclose(decrement[column], r[free] @ expected[free], rtol=tolerance)
    assert (device_arrays.download(problem.newton.islands.status) == outcome.ACTIVE).all()
    assert (device_arrays.download(problem.newton.islands.lost_pivots_total) == 0).all()


@pytest.mark.parametrize(("name", "psd"), [*((name, "gauss_newton") for name in KINDS), ("full", "none")])
def test_elements_of_runs_equal_single_elements(device, name, psd):
    """Compare factors, second derivatives, energies and stiffnesses of runs of elements with single elements."""
    problem = Problem(name, device, psd=psd)
    newton, kind, real = problem.newton, problem.kind, problem.newton.real
    newton.islands.drop_compression.fill_(0)
    newton.evaluate(problem.last)
    results = element_path.results_type(real, real)()
    arrays = {field: getattr(newton.elements, field) for field in ("factor", "geometric", "energy", "stiffness")}
    alone = {field: device_arrays.allocate(array.shape, array.dtype, device) for field, array in arrays.items()}
    results.factor = results.tension = device_arrays.columns(alone["factor"])
    results.second, results.energy = device_arrays.columns(alone["geometric"]), device_arrays.columns(alone["energy"])
    results.stiffness = device_arrays.columns(alone["stiffness"])
    results.gradient = device_arrays.columns(
        device_arrays.allocate((kind.window, *newton.elements.stiffness.shape), real, device)
    )
    inputs = problem.group.element_inputs(newton.iterates, problem.last, newton.islands.inverse_step)
    kernel = element_path.evaluate_kernel(rod_storage(kind, real), real, real, newton.exact)
    wp.launch(kernel, problem.group.element_threads, [inputs, *newton.islands.arrays, 0], [results], device=device)
    for field, array in alone.items():
        expected, got = device_arrays.download(array), device_arrays.download(arrays[field])
        assert field == "geometric" or np.abs(expected).max() > 0.0
        np.testing.assert_allclose(
            got, expected, rtol=0, atol=1e-12 * max(1e-30, np.abs(expected).max()), err_msg=field
        )


@EVERY_KIND
@pytest.mark.parametrize(("noise", "inertia"), [(0.15, 2.0), (1e-3, 1e4)], ids=["far", "near"])
def test_step_follows_the_direction(device, name, noise, inertia):
    """Positions move along the direction to second order in edge rotations, angles exactly, fixed dofs not at all."""
    problem = Problem(name, device, noise=noise, inertia=inertia)
    before, dim = problem.iterate_dofs(), problem.kind.dim
    problem.iterate()
    taken = device_arrays.download(problem.newton.islands.step_length)[:, None, None]
    moved, step = problem.iterate_dofs() - before, problem.direction() * taken
    for column, n in enumerate(problem.count):
        fixed = ~problem.free(column).reshape(n, -1)
        assert np.abs(step[column, :n]).max() > 1e-6
        assert (moved[column, :n][fixed] == 0.0).all()
        np.testing.assert_allclose(moved[column, :n, dim:], step[column, :n, dim:], rtol=0, atol=1e-14)
        error = np.abs(moved[column, :n] - step[column, :n]).max()
        assert error <= second_order(before[column, :n, :dim], step[column, :n, :dim])


@EVERY_KIND
def test_no_edge_rotates_beyond_the_cap(device, name):
    """No edge rotates by more than the cap in an update, and no update is shortened needlessly."""
    cap = 0.02
    problem = Problem(name, device, rotation_cap=cap)
    before, dim = problem.iterate_dofs(), problem.kind.dim
    problem.iterate()
    direction, taken = problem.direction(), device_arrays.download(problem.newton.islands.step_length)
    for column, n in enumerate(problem.count):
        edges, edge_steps = (np.diff(v[column, :n, :dim], axis=0) for v in (before, direction))
        worst = (np.linalg.norm(edge_steps, axis=1) / np.linalg.norm(edges, axis=1)).max()
        np.testing.assert_allclose(taken[column], min(1.0, cap / worst), rtol=1e-12)


@EVERY_KIND
def test_overshooting_step_is_backtracked_by_the_energy(device, name):
    """Thrice the Newton step overshoots. The sweep goes back to the minimum of a parabola, which gives the energy change."""
    problem = Problem(name, device, noise=0.05, inertia=1e3)
    newton, start = problem.newton, problem.iterate_dofs()
    problem.iterate()
    direction, decrement = problem.direction(), device_arrays.download(newton.islands.predicted_decrease)
    problem.put(start + 3.0 * direction)
    newton.islands.step_length.fill_(3.0)
    change = problem.energy(start + 3.0 * direction) - problem.energy(start)
    assert (change > 0.0).all()
    problem.iterate()
    shorter = device_arrays.download(newton.islands.step_length)
    assert (device_arrays.download(newton.islands.backtracks) == 1).all()
    assert (device_arrays.download(newton.islands.iteration) == 1).all()
    assert (
        (0.31 < shorter) & (shorter < 1.49)
    ).all()  # strictly between a tenth and half, so that the parabola decided
    model_change = 3.0 * decrement * (1.5 / shorter - 1.0)  # shorter = -slope / 2 (change - slope) of the step
    np.testing.assert_allclose(model_change, change, rtol=1e-10)
    moved, step, dim = problem.iterate_dofs() - start, shorter[:, None, None] * direction, problem.kind.dim
    for column, n in enumerate(problem.count):
        error = np.abs(moved[column, :n] - step[column, :n]).max()
        assert error <= second_order(start[column, :n, :dim], step[column, :n, :dim])
    problem.iterate()
    assert (device_arrays.download(newton.islands.backtracks) == 0).all()  # the shorter step is taken
    assert (device_arrays.download(newton.islands.iteration) == 2).all()


@EVERY_KIND
@pytest.mark.parametrize(("decrease", "accepted"), [(0.0, 0), (2e-4, 1)])
def test_armijo_rule_asks_for_a_decrease(device, name, decrease, accepted):
    """A step decreases the energy by a fraction of the predicted decrease, below or above Armijo's constant of 1e-4."""
    problem = Problem(name, device, noise=0.05, inertia=1e3)
    newton, start = problem.newton, problem.iterate_dofs()
    problem.iterate()
    direction, decrement = problem.direction(), device_arrays.download(newton.islands.predicted_decrease)

    def excess(length):
        change = problem.energy(start + length[:, None, None] * direction) - problem.energy(start)
        return change + decrease * length * decrement

    before, length = np.full(4, 1.9), np.full(4, 2.0)
    for _ in range(2):  # secant method
        values = excess(before), excess(length)
        before, length = length, length - values[1] * (length - before) / (values[1] - values[0])
    problem.put(start + length[:, None, None] * direction)
    newton.islands.step_length.assign(length)
    problem.iterate()
    assert (device_arrays.download(newton.islands.iteration) == 1 + accepted).all()


@EVERY_KIND
def test_accepted_steps_lower_the_energy(device, name):
    """Rejected steps from far away get shorter, accepted steps decrease the energy, and all rods converge."""
    problem = Problem(name, device, noise=0.6, inertia=0.02, rotation_cap=100.0, max_iterations=100)
    newton = problem.newton
    trial = problem.iterate_dofs()
    lowest = np.full(4, np.inf)
    length, iteration, rejected = np.zeros(4), np.zeros(4, int), 0
    for _ in range(400):
        problem.iterate()
        active = device_arrays.download(newton.islands.status) == outcome.ACTIVE
        if not active.any():
            break
        energy, new_length = problem.energy(trial), device_arrays.download(newton.islands.step_length)
        current = device_arrays.download(newton.islands.iteration)
        for column in np.flatnonzero(active):
            if current[column] > iteration[column]:
                assert energy[column] <= lowest[column] + 1e-12 * abs(lowest[column])
                lowest[column] = energy[column]
            else:
                assert new_length[column] <= 0.5 * length[column]
                rejected += 1
        trial, length, iteration = problem.iterate_dofs(), new_length, current
    assert set(device_arrays.download(newton.islands.status)) <= {outcome.CONVERGED, outcome.CONVERGED_TO_ROUNDING}
    assert rejected > 0 or name == "untwisted"  # where every step is a good one
    assert (iteration > 2).all()


def degenerate_frames(problem, aim) -> np.ndarray:
    """Return an iterate with the last two edges of every rod rotated at random until aim(cosine, twist) holds."""
    rng = np.random.default_rng(0)
    start = problem.iterate_dofs()
    iterate = start.copy()
    for column, n in enumerate(problem.count):
        for _ in range(20000):
            q = start[column].copy()
            edges = np.diff(q[:n, :3], axis=0)
            length = np.linalg.norm(edges[-2:], axis=-1, keepdims=True)
            edges[-2:] = length * polyline.unit(edges[-2:] / length + 1.5 * rng.normal(size=(2, 3)))
            q[1:n, :3] = q[0, :3] + np.cumsum(edges, axis=0)
            cosine, twist, fold = problem.age(q, column)
            if aim(cosine, twist) and fold.min() > -0.95:
                iterate[column] = q
                break
        else:
            raise AssertionError("no such state")
    problem.put(iterate)
    return iterate


AGED = {
    "edge turned": lambda cosine, twist: cosine[-1] < -0.2 and cosine[:-1].min() > 0.2 and np.abs(twist).max() < 1.0,
    "twist grown": lambda cosine, twist: cosine.min() > 0.0 and 2.0 < np.abs(twist).max() < 2.9,
}


@pytest.mark.parametrize("case", AGED)
def test_frames_are_updated_before_they_degenerate(device, case):
    """Frames are updated where an edge, the last one too, has rotated by 90 degrees, or the twist nears the jump at pi.

    Energies stay, and the step goes downhill in the new frames by the predicted decrease.
    """
    problem = Problem("full", device, noise=0.1)
    newton, start = problem.newton, degenerate_frames(problem, AGED[case])
    energy = problem.energy(start)
    problem.iterate()
    if not device_arrays.download(newton.islands.step_length).any():
        problem.iterate()  # one to take new frames, one to step
    np.testing.assert_allclose(problem.energy(start), energy, rtol=1e-12)
    for column in range(4):
        cosine, twist, _ = problem.age(start[column], column)
        assert cosine.min() > 0.0
        assert np.abs(twist).max() < 1.8
    h = 1e-6 / np.abs(problem.direction()).max(axis=(1, 2))
    ends = [problem.energy(start + sign * h[:, None, None] * problem.direction()) for sign in (1.0, -1.0)]
    np.testing.assert_allclose(
        (ends[0] - ends[1]) / (2.0 * h), -device_arrays.download(newton.islands.predicted_decrease), rtol=1e-6
    )


def tip(device, **options) -> np.ndarray:
    """Return the tip of a cantilever in the plane of x and z after 20 steps."""
    chosen = dict(options)
    scene = ddg.Scene(gravity=(1.0, 0.0, -9.81), dimension=chosen.pop("dimension", 3))
    points = np.zeros((10, 3))
    points[:, 0] = np.linspace(0.0, 1.0, 10)
    section = ddg.Circle(radius=0.02)
    rod = scene.add_rod(points, section=section, material=ddg.Material(young=1e6), **chosen)
    scene.clamp(rod, edges=[0])
    model = scene.build(device=device, precision="float64")
    integrator = ddg.Integrator(model, rtol=1e-13)
    state = model.state()
    for _ in range(20):
        state = integrator.step(state, 0.02)
    return state.points()[-1]


def test_planar_untwisted_and_full_rods_agree(device):
    full, untwisted, planar = tip(device), tip(device, twist=False), tip(device, dimension=2)
    assert full[2] < -0.3  # it has fallen
    assert abs(full[1]) < 1e-12
    np.testing.assert_allclose(untwisted, full, atol=1e-12)
    np.testing.assert_allclose(planar, full, atol=1e-12)


def test_indefinite_matrix_drops_compression(device):
    """A rod is loaded beyond the buckling load in one step: the sweep takes the matrix without compression, then goes on."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -1e-3))
    points = np.zeros((12, 3))
    points[:, 0] = np.linspace(0.0, 1.0, 12)
    rod = scene.add_rod(
        points, section=ddg.Stiffness(EA=1e4, EI1=1.0, GJ=1.0, mass_per_length=1e-6, rotary_inertia=1e-9)
    )
    scene.clamp_end(rod)
    scene.add_force(rod, -1, (-50.0, 0.0, 0.0))
    integrator = ddg.Integrator(scene.build(device, "float64"), psd="gauss_newton")
    state = integrator.model.state(points=points * [0.99, 1.0, 1.0] + [0.0, 0.0, 1e-4] * np.arange(12)[:, None] ** 2)
    state = integrator.step(state, 1.0)
    newton = integrator._rod_steps[0].newton
    assert newton.islands.drop_compression.numpy()[0] == 1
    assert set(integrator.statistics()["outcomes"]) <= {"converged", "converged_to_rounding"}
    assert state.points()[-1, 0] < 0.5  # 50 is twenty times the load of Euler
