"""Curves of other programs: files written here are read back, and contents that are not read are listed."""

import struct
from importlib.util import find_spec

import numpy as np
import pytest

from ddg_warp.io import CurveError, read

POINTS = np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0.5], [3, 0, 0], [3, 1, 1], [5, 0, 0]], np.float32)


def hair_file(path, segments=(2, 1), thickness=(), colors=False, points=POINTS[:5], default=0.5):
    """Write strands of a HAIR file: segments of each, or one number for all, and the thickness at each point."""
    array = lambda values, kind: np.asarray(values, kind).tobytes()  # noqa: E731
    bits = 2 + (not isinstance(segments, int)) + 4 * bool(len(thickness)) + 16 * colors
    strands = len(points) // (segments + 1) if isinstance(segments, int) else len(segments)
    of_all = segments if isinstance(segments, int) else 0
    header = (
        b"HAIR" + struct.pack("<IIIIf", strands, len(points), bits, of_all, default) + struct.pack("<4f", 0, 1, 1, 1)
    )
    arrays = b"" if isinstance(segments, int) else array(segments, "<u2")
    arrays += array(points, "<f4") + array(thickness, "<f4") + colors * array(np.zeros((len(points), 3)), "<f4")
    path.write_bytes(header.ljust(128, b"\0") + arrays)
    return path


def test_hair_files_read_back(tmp_path):
    thickness = np.array([1, 2, 3, 4, 5], np.float32)
    path = hair_file(tmp_path / "a.hair", thickness=thickness, colors=True)
    (curves,) = read(path, unit=0.01, up="y")
    assert curves.counts.tolist() == [3, 2] and not curves.closed.any() and curves.path == "a"
    x, y, z = 0.01 * POINTS[:5].astype(float).T
    np.testing.assert_allclose(curves.points, np.stack([x, -z, y], 1), atol=1e-15)
    np.testing.assert_allclose(curves.radius, 0.005 * thickness)
    assert curves.unread == ("color of points", "default transparency and color")
    (curves,) = read(hair_file(tmp_path / "b.hair", segments=1, points=POINTS[:4]))
    assert curves.counts.tolist() == [2, 2] and (curves.radius == 0.25).all()
    (curves,) = read(hair_file(tmp_path / "c.hair", segments=(0, 1, 1), default=0.0))
    assert curves.attributes["strand"].tolist() == [1, 2] and curves.radius is None
    assert curves.unread[1:] == ("thickness, as it is 0 everywhere", "1 strands of one point, the first of them 0")


def bcc_file(path, counts=(3, -3), kind=b"C0", up=2, announced=6):
    header = (
        b"BCC"
        + bytes([0x44])
        + kind
        + bytes([3, up])
        + struct.pack("<QQ", len(counts), announced)
        + b"yarn".ljust(40, b"\0")
    )
    rows = np.split(POINTS, np.cumsum(np.abs(counts))[:-1])
    pieces = [struct.pack("<i", count) + row.tobytes() for count, row in zip(counts, rows, strict=True)]
    path.write_bytes(header + b"".join(pieces))
    return path


def test_bcc_files_read_back(tmp_path):
    (curves,) = read(bcc_file(tmp_path / "a.bcc"))
    np.testing.assert_array_equal(curves.points, POINTS)
    assert curves.closed.tolist() == [False, True] and curves.unread == ("info 'yarn'",)
    (curves,) = read(bcc_file(tmp_path / "a.bcc", up=1), unit=0.1)
    np.testing.assert_allclose(curves.points[:, 2], 0.1 * POINTS[:, 1])
    (curves,) = read(bcc_file(tmp_path / "a.bcc", up=0))
    np.testing.assert_array_equal(curves.points[:, [2, 0, 1]], POINTS)
    with pytest.raises(CurveError, match=r"up = 'y', but the file states its own"):
        read(tmp_path / "a.bcc", up="y")


def test_csv_columns_are_found_by_name(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "# two strands that alternate\nZ;Diameter;Strand;x;y;age\n0;2;7;0;0;1\n9;2;3;5;5;1\n\n1;2;7;0;1;1\n8;1;3;5;6;1\n"
    )
    (curves,) = read(path, unit=1e-3)
    np.testing.assert_allclose(curves.points, [[0, 0, 0], [0, 1e-3, 1e-3], [5e-3, 5e-3, 9e-3], [5e-3, 6e-3, 8e-3]])
    np.testing.assert_allclose(curves.radius, [1e-3, 1e-3, 1e-3, 5e-4])
    assert curves.attributes["id"].tolist() == [7, 3] and curves.unread == ("column 'age'",)
    path.write_text("x,y,z\n0,0,0\n1,0,0\n")
    (curves,) = read(path)
    assert curves.counts.tolist() == [2] and curves.radius is None and curves.attributes == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"a\.csv: the file is empty"),
        ("x,y\n0,0\n", "'x y' has no column 'z'"),
        ("x,y,z,x\n0,0,0,0\n", "two columns 'x'"),
        ("x,y,z\n0,0,0\n1,0,a\n", r"a\.csv:3: '1 0 a' cannot be read"),
        ("x,y,z\n0,0,0\n1,0\n", r"a\.csv:3: '1 0' cannot be read; a row has 3 values"),
        ("id,x,y,z\n0,0,0,0\n0,1,0,0\n1,1,1,1\n", "curve 1 has 1 vertices, it needs 2"),
    ],
)
def test_bad_csv_files_are_named(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(CurveError, match=message):
        read(tmp_path / "a.csv")


def test_bad_hair_and_bcc_files_are_named(tmp_path):
    whole = hair_file(tmp_path / "a.hair").read_bytes()
    for content, message in (
        (b"HARE" + whole[4:], "begin with HAIR"),
        (whole[:-1], "cut short, at 191 bytes instead of 192"),
    ):
        (tmp_path / "a.hair").write_bytes(content)
        with pytest.raises(CurveError, match=message):
            read(tmp_path / "a.hair")
    for options, message in (
        ({"segments": (2, 2)}, "2 strands take 6 points, but the file has 5"),
        ({"points": POINTS[:5] * np.nan}, "curve 0 has a point that is not finite"),
        ({"thickness": [1, -1, 1, 1, 1]}, "curve 0 has a radius of -0.5 m"),
    ):
        with pytest.raises(CurveError, match=message):
            read(hair_file(tmp_path / "a.hair", **options))
    for options, message in (
        ({"kind": b"PL"}, "curves of kind 'PL' in 3 dimensions"),
        ({"announced": 7}, "curves have 6 points, 7 are announced"),
        ({"counts": (3, -2, 1)}, "curve 1 has 2 vertices, it needs 3"),
    ):
        with pytest.raises(CurveError, match=message):
            read(bcc_file(tmp_path / "a.bcc", **options))


COMPOSITE = """<mujoco>
  <compiler angle="degree"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 1" euler="0 0 90">
      <composite prefix="rope_" type="cable" curve="s" count="5 1 1" size="1" offset="0 0 0.5" initial="none">
        <plugin plugin="mujoco.elasticity.cable">
          <config key="twist" value="2e6"/><config key="bend" value="4e6"/><config key="vmax" value="0"/>
        </plugin>
        <joint kind="main" damping=".015"/>
        <geom type="capsule" size=".005" density="1200"/>
      </composite>
    </body>
    <replicate count="2" offset="0 0 1">
      <composite type="cable" curve="cos(s) sin(s) 0" count="9 1 1" size="0.5 1 2"><geom type="box" size=".1 .1 .1"/></composite>
    </replicate>
  </worldbody>
</mujoco>
"""
BODIES = """<mujoco>
  <extension><plugin plugin="mujoco.elasticity.cable">
    <instance name="soft"><config key="bend" value="3e5"/></instance>
  </plugin></extension>
  <worldbody>
    <body name="first" pos="0 0 2"><freejoint/>
      <geom type="capsule" size="0.01 0.5" pos="0.5 0 0" quat="0.7071068 0 0.7071068 0"/>
      <plugin instance="soft"/>
      <body pos="1 0 0" quat="0.7071068 0 0 0.7071068"><joint type="ball"/>
        <geom type="capsule" size="0.01" fromto="0 0 0 2 0 0"/>
        <plugin instance="soft"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.skipif(not find_spec("mujoco"), reason="needs mujoco")
def test_cables_of_mujoco_become_rods(tmp_path):
    (tmp_path / "a.xml").write_text(COMPOSITE)
    rope, rings = read(tmp_path / "a.xml")
    s = np.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(
        rope.points, np.stack([0 * s, s, 0 * s + 1.5], 1), atol=1e-12
    )  # along y: rotated by 90 degrees
    assert rope.path == "rope" and (rope.radius == 0.005).all()
    assert {name: value.tolist() for name, value in rope.attributes.items()} == {
        "density": [1200],
        "young": [4e6],
        "shear": [2e6],
    }
    assert rope.unread == ("1 geom", "damping of joints", "vmax = 0 of the plugin")
    assert rings.counts.tolist() == [9, 9] and rings.radius is None
    angle = np.linspace(0.0, 2.0 * np.pi, 9)
    np.testing.assert_allclose(
        rings.points[9:], np.stack([np.cos(angle), np.sin(angle), 0 * angle + 1.0], 1), atol=1e-12
    )
    assert "section of geom type 'box', size .1 .1 .1" in rings.unread
    (tmp_path / "b.xml").write_text(BODIES)
    (chain,) = read(tmp_path / "b.xml")
    np.testing.assert_allclose(chain.points, [[0, 0, 2], [1, 0, 2], [1, 2, 2]], atol=1e-6)
    assert chain.attributes["young"].tolist() == [3e5] and chain.unread == ("1 joint", "1 freejoint")
    for text, message in (
        ("<mujoco>", "this is no XML"),
        ("<mujoco><worldbody/></mujoco>", "there are no cables"),
        (COMPOSITE.replace('"s"', '"tan(s)"'), r"composite 'rope': curve = 'tan\(s\)' cannot be read"),
        (COMPOSITE.replace('count="5 1 1"', 'count="1 1 1"'), "count = 1; a cable has 2 to"),
        (COMPOSITE.replace('euler="0 0 90"', 'euler="0 90"'), "MuJoCo refuses the poses"),
    ):
        (tmp_path / "c.xml").write_text(text)
        with pytest.raises(CurveError, match=message):
            read(tmp_path / "c.xml")
