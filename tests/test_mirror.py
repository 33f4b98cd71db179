"""Mirror of the package in the tests: modules of kernels and solvers have a test of that name, an import, or an entry below."""

import ast
from functools import cache
from pathlib import Path

import pytest

import ddg_warp
import ddg_warp.kernels

TESTS = Path(__file__).parent
KERNELS, SOLVE = Path(ddg_warp.kernels.__file__).parent, Path(ddg_warp.__file__).parent / "solve"
MODULES = {
    f"{root.name}/{path.relative_to(root).with_suffix('')}"
    for root in (KERNELS, SOLVE)
    for path in root.rglob("*.py")
    if path.stem != "__init__"
}
# Folder or module -> test file of its modules without a test of their name, and a word of that file for the tested feature.
# The longest entry counts.
TESTED_BY = {
    "kernels/adjoint": ("adjoint/test_adjoint.py", "vjp_of_steps"),
    "kernels/adjoint/contact_parameters": ("adjoint/test_contact_adjoint.py", "number_shifts"),
    "kernels/adjoint/coupled_linear_solve": ("adjoint/test_coupled_solve.py", "ExactSystem"),
    "kernels/collision/broad_phase": ("collision/test_broad_phase.py", "BroadPhase"),
    "kernels/collision/contact": ("collision/test_pair_terms.py", "hessian_product"),
    "kernels/collision/contact/query": ("collision/test_hard_contacts.py", "model.contacts"),
    "kernels/collision/contact/statistics": ("collision/test_hard_contacts.py", "smallest_gap"),
    "kernels/collision/friction": ("collision/test_pair_friction.py", "friction_terms"),
    "kernels/collision/friction/surface_rotation": ("collision/test_rolling.py", "rolling=True"),
    "kernels/core/division": ("kernels/test_shell_measures.py", "degenerate"),
    "kernels/core/dof_map": ("test_gyroscopic.py", "Integrator"),
    "kernels/core/inertia": ("test_drag.py", "drag"),
    "kernels/core/nodes": ("test_warm_start.py", "Integrator"),
    "kernels/densities": ("kernels/test_terms.py", "REGISTRY"),
    "kernels/elements": ("kernels/test_terms.py", "REGISTRY"),
    "kernels/forces": ("test_controls.py", "Controls"),
    "kernels/forces/follower_loads": ("test_edge_rotation_of_rods.py", "add_couple"),
    "kernels/linear": ("linear/test_rod_substructuring.py", "substructuring"),
    "kernels/linear/exact_hessian": ("adjoint/test_coupled_solve.py", "ExactSystem"),
    "kernels/linear/geometric_stiffness": ("linear/test_psd.py", "project"),
    "kernels/linear/mixed_axial_force": ("linear/test_tension.py", "axial"),
    "kernels/linear/mixed_pairs": ("linear/test_tension.py", "cyclic_reduction"),
    "kernels/linear/prefetch": ("kernels/test_chain.py", "test_sweep_equals_a_dense_solve"),
    "kernels/linear/skew_supports": ("contracts/test_inputs.py", "oblique_symmetry"),
    "kernels/measures": ("kernels/test_terms.py", "REGISTRY"),
    "kernels/newton": ("linear/test_partitioned.py", "test_iterations_match_sweep"),
    "kernels/newton/contact_newton": ("collision/test_steps.py", "contact"),
    "kernels/residual": ("test_tolerance.py", "subset_residual_test"),
    "kernels/residual/rod_residual": ("kernels/test_chain.py", "rotary_inertia"),
    "kernels/rigid_bodies": ("test_rigid_bodies.py", "heavy_top"),
    "kernels/stepping": ("test_warm_start.py", "further"),
    "kernels/stepping/decoupled_rods": ("collision/test_decoupled_step.py", "decoupled"),
    "kernels/stepping/local_error": ("test_step_control.py", "error"),
    "kernels/stepping/energy_drift": ("test_midpoint_energy.py", "drift"),
    "kernels/stepping/world_reset": ("test_resets.py", "reset"),
    "solve/collision": ("collision/test_pair_terms.py", "hessian_product"),
    "solve/collision/ccd_bodies": ("collision/test_step_filter.py", "ccd_bodies"),
    "solve/collision/friction_set": ("collision/test_pair_friction.py", "friction_terms"),
    "solve/collision/parameter_tables": ("torch/test_contact_torch.py", "contact_stiffness"),
    "solve/collision/rolling_rotation": ("collision/test_rolling.py", "rolling=True"),
    "solve/collision/statistics": ("collision/test_hard_contacts.py", "smallest_gap"),
    "solve/collision/surface_rotation": ("collision/test_moved_obstacles.py", "rotating"),
    "solve/collision/swept_surfaces": ("collision/test_turns.py", "substeps"),
    "solve/equilibrium": ("test_equilibrium_search.py", "solve"),
    "solve/equilibrium/friction_jacobian": ("adjoint/test_contact_equilibria.py", "friction"),
    "solve/equilibrium/friction_newton": ("collision/test_friction_statics.py", "Equilibrium"),
    "solve/equilibrium/rest_path": ("test_rest_shapes.py", "rest"),
    "solve/forces": ("test_controls.py", "Controls"),
    "solve/linear": ("linear/test_rod_substructuring.py", "substructuring"),
    "solve/linear/bordered": ("test_continuation.py", "bifurcations"),
    "solve/linear/exact_contact": ("adjoint/test_contact_adjoint.py", "ExactSystem"),
    "solve/linear/skew_supports": ("contracts/test_inputs.py", "oblique_symmetry"),
    "solve/newton": ("test_tolerance.py", "rtol"),
    "solve/newton/frozen_hessian": ("test_tolerance.py", "projective"),
    "solve/stepping": ("test_coupled_steps.py", "Integrator"),
    "solve/stepping/energy_drift": ("test_midpoint_energy.py", "drift"),
    "solve/stepping/local_error": ("test_step_control.py", "error"),
    "solve/stepping/world_reset": ("test_resets.py", "reset"),
}


def imported(path: Path) -> set[str]:
    """Return all modules and objects imported by a file, with slashes for dots."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
    return {name.removeprefix("ddg_warp.").replace(".", "/") for name in names}


@cache
def named() -> set[str]:
    """Return modules with a test of the same name, and modules imported by a test."""
    files = sorted(TESTS.rglob("*.py"))
    imports, stems = set().union(*map(imported, files)), {path.stem for path in files}
    return {name for name in MODULES if name in imports or f"test_{name.rpartition('/')[2]}" in stems}


def entry(name: str) -> str:
    """Return the longest entry of the table for a module; "" without."""
    return max((key for key in TESTED_BY if f"{name}/".startswith(f"{key}/")), key=len, default="")


def test_every_module_has_a_test():
    assert not [name for name in sorted(MODULES - named()) if not entry(name)]


def test_the_table_has_no_idle_entries():
    """Each entry serves at least one module without a named test."""
    assert set(TESTED_BY) == {entry(name) for name in MODULES - named()}


@pytest.mark.parametrize("key", TESTED_BY)
def test_tests_of_the_table_exist_and_name_their_subject(key):
    test, word = TESTED_BY[key]
    assert word in (TESTS / test).read_text()
