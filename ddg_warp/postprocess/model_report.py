"""Report of a model: terms, elements, dofs, solver, kernels, memory, and terms that are absent."""

from collections.abc import Callable

import numpy as np

from ddg_warp.kernels.core.islands import FLAGS, SCALARS
from ddg_warp.kernels.linear import cyclic_reduction, rod_elimination
from ddg_warp.kernels.newton import rod_sweep
from ddg_warp.kernels.terms import ALL, FRICTION, Potential, contact_potential
from ddg_warp.scene.material import DRAWN
from ddg_warp.scene.obstacles import BALL, MESH, PLANE
from ddg_warp.scene.scene import Dynamics
from ddg_warp.solve.linear.rod_substructuring import RodSubstructuring
from ddg_warp.solve.linear.solver_selection import automatic, coupled_preconditioner
from ddg_warp.solve.linear.sparse_system import SparseSystem
from ddg_warp.solve.newton.rod_newton import has_natural_curvature, swept_ends
from ddg_warp.solve.stepping.decoupled_step import uncoupled
from ddg_warp.solve.stepping.step_driver import LinearSolverChoice, choose_solver

SOLVERS = {
    "sweep": "block LDL^T sweep, one Newton loop a rod",
    "cyclic_reduction": "cyclic reduction (few long rods), one Newton loop a rod",
}
CLOSED = "block LDL^T with a Schur complement (closed rods), one Newton loop a rod"


def report(model, absent: bool = False) -> str:
    """Return a summary of the model in a few lines of text; a test compares it with kernel launches.

    Args:
        model: the model; absent: whether to list the terms that it has not, too.
    """
    rods, nodes = model.scene.rod_count, int(model.curves.counts.sum())
    lines = [f"{rods} rods, {nodes} nodes, worlds {model.worlds}, {model.precision} on {model.device}"]
    present = set()
    for i, group in enumerate(model.groups):
        kind, host = group.kind, group.host
        shape = "closed" if kind.closed else "open"
        lines.append(
            f"group {i}: {group.rods} {shape} rods of {host.count.min()} to {host.count.max()} nodes, "
            f"{kind.block} dofs a node, {kind.window} a window"
        )
        for term in kind.terms:
            present.add(term.name)
            elements = int((host.count - (0 if kind.closed else term.measure.span)).sum()) * model.worlds
            lines.append(f"  {term.name}: {elements} elements, {term.measure.name} x {term.density.name}")
        lines += [f"  {name}, implicit" for name in host.coefficients]
        solver = CLOSED if kind.closed else SOLVERS[automatic(group)]
        lines.append(f"  solver: {solver}, linear algebra in {model.types.linear.__name__}")
        lines += step_lines(model, lambda s, group=group: (group.float32_errors(s), _split_errors(group, s)))
        lines.append(f"  memory: {bytes_per_node(model, group)} bytes a node")
    if model.coupled is not None:
        lines += coupled_lines(model)
        present |= {part.term.name for part in model.coupled.sets}
        if contact_parameters := model.coupled.host.contact_parameters:
            potentials = contact_potentials(contact_parameters)
            lines += contact_lines(contact_parameters)
            lines += [f"  {each.name}: {each.density.name}, {each.text}" for each in potentials]
            present |= {each.name for each in potentials}
    for name, item in model.fields.items.items():
        each = item.description
        owner = f"{len(each.rods)} rods" if each.shell is None else f"shell {each.shell}"
        lines.append(f"field '{name}': {each.parameter} of {owner}" + ("" if each.field.constant else ", a function"))
    bare = dict.fromkeys(batch.name for batch in model.scene.batches if batch.section.radius is None)
    if bare:
        lines.append(f"drawn {2.0 * DRAWN:g} m thick, as their section has no radius: {', '.join(bare)}")
    if not absent:
        return "\n".join(lines)
    lines.append("not in this scene: " + ", ".join(sorted({term.name for term in ALL.values()} - present)))
    if not any(group.kind.twist for group in model.groups) and (model.coupled is None or not model.coupled.edges):
        lines.append("no angles, no frames, no rotary inertia")
    return "\n".join(lines)


def _split_errors(group, s: float) -> np.ndarray:
    return np.array([np.inf]) if group.kind.closed else group.split_errors(s)


def step_lines(model, errors_of: Callable) -> list[str]:
    """Return lines on solver choices for steps of the scene's analysis, if any; `errors_of`: s -> errors, see `choose_solver`."""
    analysis = model.scene.analysis
    if not isinstance(analysis, Dynamics):
        return []
    errors = errors_of(analysis.dt * (0.5 if analysis.scheme == "implicit_midpoint" else 1.0))
    means = choose_solver(
        model.precision, LinearSolverChoice(model.types.linear), *(each.max(initial=0.0) for each in errors)
    )
    taken = ["edge-rotation update, exact Hessian"] * means.stiff
    taken += [f"linear algebra in {means}"] * (means.linear is not model.types.linear or means.mixed_axial)
    return [f"  over steps of {analysis.dt:g} s: {', '.join(taken)}"] if taken else []


def contact_lines(contact_parameters) -> list[str]:
    """Return a line on collision bodies and contact parameters."""
    law, still = contact_parameters.law, sum(body.still for body in contact_parameters.bodies)
    numbers = (
        (contact_parameters.range, "range", "m"),
        (contact_parameters.stiffness, "stiffness", "N/m"),
        (contact_parameters.friction[..., None] * contact_parameters.ways, "friction", ""),
    )
    said = [f"{name} {_between(values)}{unit and ' ' + unit}" for values, name, unit in numbers]
    said += ["rolling"] * law.rolling
    return [
        f"contact: {law.name} between {len(contact_parameters.bodies) - still} bodies and {still} obstacles, {', '.join(said)}"
    ]


def contact_potentials(contact_parameters) -> list[Potential]:
    """Return the potentials of all pair lists: two edges always, other collisions if such bodies are present."""
    law, kinds = contact_parameters.law, {body.kind for body in contact_parameters.bodies}
    optional = ((MESH, "point_triangle"), (BALL, "edge_point"), (PLANE, "point_plane"))
    pairs = ["edge_edge", *(name for kind, name in optional if kind in kinds)]
    balls = [body.still for body in contact_parameters.bodies if body.kind == BALL]
    pairs += ["point_point"] * (len(balls) > 1 and not all(balls))
    friction = [FRICTION[f"friction_{law.friction_law}_{pair}"] for pair in pairs if contact_parameters.has_friction]
    return [*(contact_potential(law.name, contact_parameters.density, pair) for pair in pairs), *friction]


def _between(values: np.ndarray) -> str:
    low, high = values.min(), values.max()
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"


def coupled_lines(model) -> list[str]:
    """Return lines on dofs, terms and matrix of the coupled system."""
    host, coupled = model.coupled.host, model.coupled
    name, linear = coupled_preconditioner(coupled), model.types.linear
    substructuring = RodSubstructuring.of(coupled, name)
    table = SparseSystem(coupled, substructuring and substructuring.kept)
    lines = [
        f"coupled system: {len(host.shells)} shells of {sum(len(s.surface.triangles) for s in host.shells)} triangles, "
        f"{len(host.rods)} rods; {host.nodes} nodes, {host.angles} angles, {host.spins} rigid joints, "
        f"{int((~host.fixed).sum())} free dofs"
    ]
    for part in coupled.sets:
        measure, density = part.term.measure.name, part.term.density.name
        lines.append(f"  {part.term.name}: {part.elements * model.worlds} elements, {measure} x {density}")
    lines += [f"  {name} on {values.shape[1]} edges of rods, implicit" for name, values in host.coefficients.items()]
    if len(host.drag_triangles):
        lines.append(f"  drag on {len(host.drag_triangles)} triangles of shells, implicit")
    for force in coupled.user_forces:
        kind = "all pairs of " if force.force.pairs else ""
        lines.append(
            f"  {force.name}: user-defined force on {kind}{len(force.blocks)} nodes, by {', '.join(force.values)}"
        )
    paired = any(force.force.pairs for force in coupled.user_forces)
    reals, solver, bands, mixed_axial = 9 * table.positions, f"PCG ({name})", "", False
    if substructuring and substructuring.banded:
        substructuring.plan.bind(host, table.rows.numpy(), table.columns.numpy(), substructuring.kept)
        solver = (
            "substructuring, exact"
            if substructuring.plan.complete and not (host.contact_parameters or paired)
            else solver
        )
        mixed_axial = substructuring.allows_mixed_axial
        places, block = int(substructuring.plan.count.sum()), substructuring.plan.block
        reals += 3 * block**2 * substructuring.plan.path.size
        bands = f" and {places} path nodes in bands of {block} x {block}"
    size = reals * model.worlds * (4 if linear.__name__ == "float32" else 8)
    lines.append(
        f"  solver: {solver}, one Newton loop a world, linear algebra in {linear.__name__}; "
        f"H: {table.entries} blocks of 3 x 3{bands}, {size / 1e6:.3g} MB"
    )
    if uncoupled(model):
        lines.append("  in steps without pairs in range: uncoupled rods, one Newton loop a rod")
    return lines + step_lines(
        model,
        lambda s: (model.coupled.rod_errors(s), model.coupled.split_errors(s) if mixed_axial else np.array([np.inf])),
    )


def bytes_per_node(model, group) -> int:
    """Return device memory for one node of a rod group: constants, two states, and the usual solver of its steps."""
    kind, nb, twist = group.kind, group.kind.block, group.kind.twist
    real, linear = (4 if t.__name__ == "float32" else 8 for t in (model.types.real, model.types.linear))
    state = 3 * kind.dim + (10 if twist else 0) + (kind.strain_rows if kind.viscous else 0)
    iterate = 4 * kind.dim + (10 if twist else 0) + 2  # with predictor and energies
    factor, solver = kind.factor_rows, 2 * nb + 1
    exact = has_natural_curvature(group) and kind.span == 2
    if exact:
        solver += kind.geometric_rows
    constant = 2 * real + 1
    if kind.closed:
        solver += 3 * nb**2 + rod_elimination.kept_rows(kind)
    elif automatic(group) == "sweep":
        sides = swept_ends(group, exact)
        kept = rod_sweep.kept_rows(kind, sides=sides)
        factor = max(factor, kept) if sides == 1 else factor + kept
    else:
        iterate += kind.dim + (7 if twist else 0) + 2
        solver += 3 * nb**2 + nb + sum(cyclic_reduction.level_rows(nb)) // 2
        constant += 8
    islands = (4 * len(FLAGS) + real * len(SCALARS)) // group.nodes
    return 2 * state * real + iterate * real + (factor + solver) * linear + constant + islands
