"""Places of rods on their own and in nets: where they are among the dofs, and what a scene finds there."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.compile.storage import gathered
from ddg_warp.solve.tangent import Tangent

ROD = ddg.Stiffness(EA=1e3, EI1=0.5, EI2=0.8, GJ=0.4, mass_per_length=0.6, rotary_inertia=0.01)
KINDS = {"spatial": {}, "no twist": {"twist": False}, "planar": {"dimension": 2}, "closed": {"closed": True}}


def rods(kind: str, in_net: bool) -> ddg.Scene:
    """Two rods of one kind and a shorter one, the first clamped at its last node; in a net each has another one at its first node."""
    options = dict(KINDS[kind])
    scene, closed = ddg.Scene(dimension=options.pop("dimension", 3)), options.get("closed", False)
    section = ddg.Stiffness(EA=1e3, EI1=0.5, mass_per_length=0.6) if kind == "no twist" else ROD
    for count in (9, 9, 8):
        turn = 2.0 * np.pi * np.arange(count) / count * (1.0 if closed else 0.4)
        points = np.stack([np.cos(turn), 0.0 * turn, np.sin(turn)], -1) + [3.0 * scene.rod_count, 0.0, 0.0]
        rod = scene.add_rod(points, section=section, natural="straight", **options)
        if in_net:
            line = np.outer(np.linspace(0.0, 1.0, 4), [0.0, 0.0, 1.0]) + points[0]
            other = scene.add_rod(line, section=section, natural="straight", **options | {"closed": False})
            scene.join([(rod, 0), (other, 0)], rigid=False)
    if not closed:
        scene.clamp_end(0, "last")
    return scene


@pytest.mark.parametrize("in_net", [False, True], ids=["alone", "in a net"])
@pytest.mark.parametrize("kind", KINDS)
def test_places_are_those_of_the_scene(device, kind, in_net):
    """Positions at the dofs of nodes are those of the scene, counted from either end; edges join neighbours."""
    scene, found = rods(kind, in_net), 0
    model = scene.build(device, "float64")
    tangent = Tangent(model)
    for part in tangent.parts:
        places, q = part.host.places, Tangent.of(part, tangent.dofs(model.state()))
        for row, rod in enumerate(places.rods):
            (batch,) = [b for b in scene.batches if b.first == rod]
            for k in (*range(batch.nodes), -1, -batch.nodes):
                (place,) = places.node(np.array([row]), k)
                expected = batch.points[0, k]
                np.testing.assert_allclose(gathered(q, part.host.dofs(np.array([place])))[0], expected, atol=1e-12)
                np.testing.assert_allclose(part.host.points(np.array([place]))[0], expected, atol=1e-12)
            for k in (*range(batch.edges), -1):
                edge = np.concatenate([edges[0] for edges, _ in places.edge(np.array([row]), k) if len(edges)])
                ends = batch.points[0][[k % batch.edges, (k % batch.edges + 1) % batch.nodes]]
                np.testing.assert_allclose(part.host.points(edge[:2]), ends, atol=1e-12)
                if len(edge) > 2:
                    np.testing.assert_array_equal(part.host.edge_ends(edge[2:])[0], edge[:2])
                    assert part.host.name(edge[2]) == f"edge {k % batch.edges} of rod {rod}"
            found += 1
    assert found == scene.rod_count
