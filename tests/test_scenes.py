"""Checks of every scene at a small size; defaults and long scenes are slow tests."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.run.scene_registry import load_scene, parameters, scene_files
from ddg_warp.run.simulate import simulate

SMALL = {
    "active_gripper": {"n": 40, "dt": 0.02},
    "axisymmetric_dome": {"n": 40},
    "beads_on_a_string": {"beads": 3, "dt": 4e-3},
    "bend_45": {"n": 32},
    "bend_twist": {"n": 50},
    "bilayer_strip": {"cells": 4},
    "cable_gripped_at_both_ends": {"n": 40},
    "cable_on_table": {"n": 80},
    "cantilever": {},
    "cantilever_plate_shear": {"n": 16, "steps": 4},
    "capstan": {"n": 30, "steps": 40},
    "charged_loop": {},
    "cloth_on_sphere": {"cells": 8},
    "cloth_twist": {"around": 16, "along": 8, "turns": 0.2},
    "crossed_beams": {"n": 20},
    "deep_arch": {},
    "drawn_rod": {"n": 25, "load_steps": 10},
    "entangled_worms": {"n": 30, "dt": 0.02},  # one bundle of seven worms in fifty stays too loose
    "flag_on_pole": {"cells": 12},
    "flagellum": {"n": 25, "steps": 50},
    "flying_beam": {"n": 20},
    "greenhill": {"n": 100},
    "growing_strip": {},
    "groom_on_head": {"strands": 8, "frames": 3},
    "gridshell_dome": {"rods": 3},
    "hair": {"strands": 16},
    "hair_combed": {"gaps": 2, "rows": 2, "n": 24},
    "hanging_chain": {"n": 25},
    "hanging_sheet": {},
    "heavy_top": {"steps": 200},
    "helical_flagellum": {"n": 24},
    "helical_spring": {"n": 200},
    "hinged_roof": {"n": 6, "steps": 16},
    "identify_from_recording": {},
    "identify_from_statics": {},
    "identify_stiffness": {},
    "inverse_rest_shape": {"strands": 2},
    "leaf": {"cells": 20},
    "knit_patch": {"rows": 2, "columns": 2, "n": 16, "dt": 0.02},
    "lee_frame": {"n": 40},
    "localized_helix": {},
    "magnetic_buckling": {"over": 0.9},
    "magnetic_cantilever": {},
    "magnetic_shape": {"n": 16},
    "michell_ring": {"n": 100},
    "mobile": {"dt": 0.02},
    "morphing_bilayer": {"cells": 6},
    "noodles": {"count": 4, "nodes": 41, "duration": 0.3},
    "overhand_knot": {"tighter": 2.0, "edge": 3.0, "steps": 75},
    "parachute": {"rings": 3, "lines": 6},
    "pinched_cylinder": {"n": 12, "steps": 1, "load": 1e-3},
    "plate_buckling": {"cells": 12},
    "plate_square": {"cells": 16},
    "plectoneme": {"turns": 4.0, "steps": 110},
    "policy": {"count": 1},
    "post_buckling": {"n": 50},
    "pullout_cylinder": {"n": 12},
    "reach": {"n": 16},
    "reeds": {"n": 20},
    "residual_network": {"n": 24},
    "ribbon_bistable": {"n": 40},
    "ribbon_helix": {"n": 50},
    "right_angle_frame": {},
    "rod_and_payload": {"n": 20, "dt": 0.04},
    "rod_pile": {"count": 6, "duration": 0.3},
    "rod_on_floor": {"dt": 2e-3},
    "roll_up": {"n": 100},
    "rolling_ball_on_cloth": {"cells": 8},
    "rolling_rods": {"dt": 2e-3},
    "sag_free_groom": {"count": 8},
    "sedimenting_rod": {},
    "slit_annulus": {},
    "soft_gripper": {"fingers": 1},
    "sphere_indentation": {"rings": 16},
    "spinning_rod": {"steps": 100},
    "spinning_top": {"dt": 2e-3, "duration": 0.8},
    "spring_car": {"sides": 24},
    "steel_wire": {},
    "stick_slip": {},
    "strands": {"count": 16},
    "strands_random": {"count": 6},
    "tendon_gripper": {"sides": 16},
    "tether": {"n": 10, "dt": 0.01},
    "tip_load": {"n": 50},
    "vibration": {"n": 25},
    "walker": {"steps": 75},
    "whirling": {},
    "woven_cylinder": {"strands": 8, "rings": 5, "turns": 0.08, "dt": 0.02},
}
LONG = (
    "flag_on_pole",
    "cable_on_table",
    "helical_flagellum",
    "sedimenting_rod",
    "cable_gripped_at_both_ends",
    "hanging_sheet",
    "parachute",
    "ribbon_bistable",
    "pullout_cylinder",
    "slit_annulus",
    "hinged_roof",
    "lee_frame",
    "localized_helix",
    "deep_arch",
    "leaf",
    "morphing_bilayer",
    "policy",
    "residual_network",
    "identify_from_recording",
    "inverse_rest_shape",
    "magnetic_shape",
    "overhand_knot",
    "plectoneme",
    "soft_gripper",
)
LEARNED = (
    "identify_from_recording",
    "identify_from_statics",
    "identify_stiffness",
    "inverse_rest_shape",
    "magnetic_shape",
    "morphing_bilayer",
    "policy",
    "reach",
    "residual_network",
    "sag_free_groom",
    "soft_gripper",
)


def checked(name: str, device: str, **arguments) -> None:
    """Run a scene and require all checks, at least one, to pass."""
    if name in LEARNED:
        pytest.importorskip("torch")
    module = load_scene(name)
    assert set(arguments) <= set(parameters(module, {})), "the scene has no such parameter"
    result = simulate(
        module.build(**arguments), device=device, observe=getattr(module, "observe", None), progress=False
    )
    assert not result.failure
    checks = module.check(result)
    failed = [f"{check.name}: {check.error:.2e} > {check.tolerance:.2e}" for check in checks if not check.passed]
    assert checks, "nothing was checked"
    assert not failed, failed


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in SMALL])
def test_small(device, name):
    checked(name, device, **SMALL[name])


@pytest.mark.slow
def test_hair_in_contact(device):
    checked("strands", device, count=16, contact=True)


@pytest.mark.slow
def test_sag_free_hair_in_contact(device):
    checked("strands", device, count=16, contact=True, sag_free=True)


@pytest.mark.parametrize("contact", [False, True])
def test_sag_free_hair_hangs_as_drawn(device, contact):
    """Free fall would be g t^2 / 2 = 1.4 mm; sag-free hair moves by the head's rotation, and near initial contacts."""
    from ddg_warp.scenes import strands

    moved = {}
    for sag_free in (False, True):
        scene = strands.build(count=32, sway=0.0, contact=contact, sag_free=sag_free)
        model = scene.build(device, "float64")
        integrator, state = ddg.Integrator(model), model.state()
        for _ in range(4):
            state = integrator.step(state, 1 / 240)
        moved[sag_free] = np.linalg.norm(state.points() - model.state().points(), axis=1)
    batch = scene.batches[0]
    arm = np.linalg.norm(batch.points - batch.points[:, 0].mean(0), axis=-1).max()
    head_motion = arm * strands.head_motion(batch.points, 0.0).angle(4 / 240)
    assert np.median(moved[False]) > 1e-3
    assert np.percentile(moved[True], 75 if contact else 100) < head_motion + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, small in SMALL.items() if small])
def test_defaults(device, name):
    checked(name, device)


def test_no_scene_is_left_out():
    assert set(SMALL) == set(scene_files())


@pytest.mark.parametrize("name", ["capstan", "cloth_on_sphere", "cloth_twist", "flag_on_pole", "rod_pile"])
def test_scenes_build_without_friction(name):
    """A slip speed, which has no effect without friction, would be refused."""
    assert load_scene(name).build(friction=0.0).contact_settings.friction == 0.0
