"""DisMech text files: sections, bases, order of the edges, and messages."""

import numpy as np
import pytest

from ddg_warp.io import CurveError, MissingFileError, read
from ddg_warp.io.dismech import read_rods


def rods(tmp_path, text):
    path = tmp_path / "rods.txt"
    path.write_text(text)
    return read_rods(path)


NODES = "*Nodes\n0,0,0\n1, 0, 0\n2.0e+00 0 0\n3, 0, 0\n"


def test_node_numbers_may_start_at_one(tmp_path):
    curves = rods(tmp_path, NODES + "*Edges\n1,2\n2, 3\n3,4\n*elStretchRod\n1, 2\n*elBendRod\n1, 1, 2, 2, 3\n")
    assert list(curves.counts) == [4] and not curves.closed[0] and curves.radius is None
    np.testing.assert_array_equal(curves.points[:, 0], [0, 1, 2, 3])


def test_node_numbers_may_start_at_zero(tmp_path):
    curves = rods(tmp_path, NODES + "*rodEdges\n0,1\n1,2\n2,3\n")
    np.testing.assert_array_equal(curves.points[:, 0], [0, 1, 2, 3])


def test_edges_may_have_any_order_and_direction(tmp_path):
    curves = rods(tmp_path, "% comment\n" + NODES + "5,0,0\n6,0,0\n\n*Edges # two rods\n4,3\n6,5\n1,3\n2,4\n")
    assert list(curves.counts) == [4, 2]
    np.testing.assert_array_equal(curves.points[:, 0], [0, 2, 3, 1, 5, 6])


def test_a_cycle_is_closed(tmp_path):
    curves = rods(tmp_path, NODES + "*Edges\n1,2\n2,3\n3,4\n4,1\n")
    assert list(curves.counts) == [4] and curves.closed[0]
    np.testing.assert_array_equal(curves.points[:, 0], [0, 1, 2, 3])


def test_a_file_without_sections_is_one_rod(tmp_path):
    (tmp_path / "helix.txt").write_text("0.0 0.0 2.5e-02\n0 0 0\n0 4e-3 8e-5\n")
    (curves,) = read(tmp_path / "helix.txt")
    assert curves.points.shape == (3, 3) and list(curves.counts) == [3]
    assert curves.points[0, 2] == 0.025


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NODES + "*Edges\n1,2\n2,3\n2,4\n", r"node 2 .*joins 3 edges; networks are not supported yet"),
        ("*Nodes\n0,0,0\n1,0\n", r"rods.txt:3: `1,0` is not a line of \*nodes: 3 float values"),
        (NODES + "*Edges\n1,x\n", r"rods.txt:7: `1,x`"),
        (NODES + "*Edges\n1,2\n2,3\n", r"node 4 .*belongs to no edge"),
        (NODES + "*Edges\n1,2\n2,5\n", r"edge 2, 5 .*nodes run from 1 to 4"),
        (NODES + "*Edges\n0,1\n1,4\n", r"edge 1, 4 .*nodes run from 0 to 3"),
        (NODES + "*Edges\n1,1\n", r"joins node 1 to itself"),
        (NODES + "*Edges\n1,2\n2,1\n3,4\n", r"node 1: an edge is listed twice"),
        (NODES, r"there are no edges"),
        (NODES + "*Springs\n1,2\n", r"rods.txt:6: unknown section `\*Springs`"),
        (NODES + "*Triangles\n1,2,3\n*Edges\n1,2\n", r"node 4 belongs to no edge"),
        ("", r"there are no nodes"),
    ],
)
def test_bad_files_are_named(tmp_path, text, message):
    with pytest.raises(CurveError, match=message):
        rods(tmp_path, text)


def test_comments_may_have_any_encoding(tmp_path):
    path = tmp_path / "rods.txt"
    path.write_bytes(("% Länge 1 m, Höhe µ\n" + NODES + "*Edges\n1,2\n2,3\n3,4\n").encode("latin-1"))
    assert list(read_rods(path).counts) == [4]


def test_missing_files_are_named(tmp_path):
    with pytest.raises(MissingFileError, match="no such file"):
        read_rods(tmp_path / "none.txt")
