"""Dof maps of uncoupled and coupled rods: dof indices of nodes and edges against the scene."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.compile.dof_map import gathered
from ddg_warp.solve.equilibrium.tangent import Tangent

ROD = ddg.Stiffness(EA=1e3, EI1=0.5, EI2=0.8, GJ=0.4, mass_per_length=0.6, rotary_inertia=0.01)
KINDS = {"spatial": {}, "no twist": {"twist": False}, "planar": {"dimension": 2}, "closed": {"closed": True}}


def scene_of_rods(kind: str, is_coupled: bool) -> ddg.Scene:
    """Return two rods of one kind and a shorter one; `in_net` hinges another rod to each first node.

    The first rod is clamped at its last node.
    """
    options = dict(KINDS[kind])
    scene, closed = ddg.Scene(dimension=options.pop("dimension", 3)), options.get("closed", False)
    section = ddg.Stiffness(EA=1e3, EI1=0.5, mass_per_length=0.6) if kind == "no twist" else ROD
    for count in (9, 9, 8):
        angle = 2.0 * np.pi * np.arange(count) / count * (1.0 if closed else 0.4)
        points = np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], -1) + [3.0 * scene.rod_count, 0.0, 0.0]
        rod = scene.add_rod(points, section=section, natural="straight", **options)
        if is_coupled:
            line = np.outer(np.linspace(0.0, 1.0, 4), [0.0, 0.0, 1.0]) + points[0]
            second = scene.add_rod(line, section=section, natural="straight", **options | {"closed": False})
            scene.join([(rod, 0), (second, 0)], rigid=False)
    if not closed:
        scene.clamp_end(0, "last")
    return scene


@pytest.mark.parametrize("is_coupled", [False, True], ids=["uncoupled", "coupled"])
@pytest.mark.parametrize("kind", KINDS)
def test_dof_maps_give_the_positions_of_the_scene(device, kind, is_coupled):
    """Dofs of nodes give the positions of the scene, counted from either end; edges join neighbours."""
    scene, count = scene_of_rods(kind, is_coupled), 0
    model = scene.build(device, "float64")
    tangent = Tangent(model)
    for tangent_block in tangent.parts:
        dof_map, q = tangent_block.host.places, Tangent.of(tangent_block, tangent.dofs(model.state()))
        for row, rod in enumerate(dof_map.rods):
            (batch,) = [b for b in scene.batches if b.first == rod]
            for k in (*range(batch.nodes), -1, -batch.nodes):
                (index,) = dof_map.node(np.array([row]), k)
                expected = batch.points[0, k]
                np.testing.assert_allclose(
                    gathered(q, tangent_block.host.dofs(np.array([index])))[0], expected, atol=1e-12
                )
                np.testing.assert_allclose(tangent_block.host.points(np.array([index]))[0], expected, atol=1e-12)
            for k in (*range(batch.edges), -1):
                edge = np.concatenate([edges[0] for edges, _ in dof_map.edge(np.array([row]), k) if len(edges)])
                ends = batch.points[0][[k % batch.edges, (k % batch.edges + 1) % batch.nodes]]
                np.testing.assert_allclose(tangent_block.host.points(edge[:2]), ends, atol=1e-12)
                if len(edge) > 2:
                    np.testing.assert_array_equal(tangent_block.host.edge_ends(edge[2:])[0], edge[:2])
                    assert tangent_block.host.name(edge[2]) == f"edge {k % batch.edges} of rod {rod}"
            count += 1
    assert count == scene.rod_count
