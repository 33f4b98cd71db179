"""Kinds of USD curves, each with the right strands or the message that names prim, curve and remedy.

Kinds of public files: OpenUSD #2775 (pinned B-splines), #2445 (Blender's pinned Catmull-Rom), Maya-USD #3017 (NURBS), OpenUSD's own
test files of pinned curves, varying topology and widths of 0, instances, point instancers, guides.
"""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import ddg_warp as ddg
from ddg_warp.io import cubic
from ddg_warp.io.paths import CurveError

BASES, WRAPS = ("bezier", "bspline", "catmullRom"), ("nonperiodic", "periodic", "pinned")
POINTS = [(0, 0, 0), (1, 1, 0), (1, 2, 0), (0, 3, 0.5), (-1, 4, 0), (-1, 5, 0), (0, 6, 0), (1, 7, 1)]
COUNTS = {"bezier": (4, 7), "bspline": (4, 5), "catmullRom": (4, 6)}  # (periodic Bezier: one less)
HEAD = '#usda 1.0\n(\n metersPerUnit = {unit}\n upAxis = "{up}"\n startTimeCode = 1\n endTimeCode = 5\n timeCodesPerSecond = 24\n)\n'


def curves(name="c", points=POINTS[:4], counts=None, kind="linear", basis="bezier", wrap="nonperiodic", more="") -> str:
    counts = [len(points)] if counts is None else list(counts)
    lines = [
        f'uniform token type = "{kind}"',
        f'uniform token basis = "{basis}"',
        f'uniform token wrap = "{wrap}"',
        f"int[] curveVertexCounts = {counts}",
        f"point3f[] points = {list(map(tuple, points))}",
    ]
    return "\n ".join([f'def BasisCurves "{name}"\n{{', *lines, more]) + "\n}\n"


def xform(inside: str, name="x", op="double3 xformOp:translate = (0, 10, 0)", more="") -> str:
    order = op.split()[1].removesuffix(".timeSamples")
    return f'def Xform "{name}" {more}\n{{\n {op}\n uniform token[] xformOpOrder = ["{order}"]\n{inside}}}\n'


def write(path, body: str, unit=1.0, up="Z"):
    path.write_text(HEAD.format(unit=unit, up=up) + body)
    return path


def opened(tmp_path, body: str, prim=None, samples="interpolating", **head) -> ddg.usd.Groom:
    return ddg.usd.open_groom(write(tmp_path / "a.usda", body, **head), prim, samples=samples)


def bezier_points(basis: str, wrap: str, vertices: np.ndarray, samples: int) -> np.ndarray:
    """Return points on a curve by polynomials, with phantom vertices at pinned ends."""
    if wrap == "pinned" and basis != "bezier":
        vertices = np.concatenate([[2 * vertices[0] - vertices[1]], vertices, [2 * vertices[-1] - vertices[-2]]])
    step, closed = 3 if basis == "bezier" else 1, wrap == "periodic"
    number = len(vertices) // step if closed else (len(vertices) - 4) // step + 1
    u = np.arange(samples) / samples
    result = []
    for segment in range(number):
        first = step * segment - (closed and basis != "bezier")
        four = vertices[np.arange(first, first + 4) % len(vertices)]
        result.append(np.stack([u**k for k in range(4)], 1) @ cubic.BASES[basis] @ four)
        last = np.ones(4) @ cubic.BASES[basis] @ four
    return np.concatenate([*result, *([] if closed else [last[None]])])


# All bases, wraps and samplings: nodes against the polynomials, error against dense points, and the vertices back from the layer.
@pytest.mark.parametrize("samples", ["interpolating", "vertices", 4])
@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("basis", BASES)
def test_bases_and_wraps(tmp_path, basis, wrap, samples):
    counts = [count - (basis == "bezier" and wrap == "periodic") for count in COUNTS[basis]]
    points = np.array([*POINTS, *POINTS])[: sum(counts)] * [1.0, 1.0, 2.0]
    body = curves(points=points.tolist(), counts=counts, kind="cubic", basis=basis, wrap=wrap)
    groom = opened(tmp_path, body, samples=samples, unit=0.01, up="Y")
    world = 0.01 * np.stack([points[:, 0], -points[:, 2], points[:, 1]], 1)
    each = np.split(world, [counts[0]])
    assert groom.closed.all() == (wrap == "periodic")
    for rod, vertices, error in zip(groom.rods(), each, groom.error, strict=True):
        exact = bezier_points(basis, wrap, vertices, 4)
        if samples == 4:
            np.testing.assert_allclose(rod, exact, atol=1e-8)
        else:
            assert len(rod) == len(vertices)
        dense = bezier_points(basis, wrap, vertices, 50)
        ends = np.concatenate([rod, rod[:1]]) if wrap == "periodic" else rod
        a, b = ends[:-1, None], ends[1:, None]
        t = np.clip(((dense - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1), 0.0, 1.0)[..., None]
        assert np.linalg.norm(a + t * (b - a) - dense, axis=2).min(0).max() <= 1.02 * error + 1e-9
        if samples == "interpolating":
            assert np.linalg.norm(dense[:, None] - rod, axis=2).min(0).max() < 0.05 * np.ptp(
                dense
            )  # nodes lie on the curve
    layer = tmp_path / "layer.usda"
    moved = groom.points @ np.diag([1.0, 1.5, 0.5]) + [0.1, 0.0, 0.0]
    with ddg.usd.GroomLayer(groom, layer) as writer:
        writer.write(0.0, moved, velocities=moved)
    assert writer.error < 1e-12
    again = ddg.usd.open_groom(layer, samples=samples)
    np.testing.assert_allclose(again.points, moved, atol=1e-7)
    assert (again.prims[0].basis, again.prims[0].wrap, list(again.prims[0].counts)) == (basis, wrap, counts)
    affine = world @ np.diag([1.0, 1.5, 0.5]) + [
        0.1,
        0.0,
        0.0,
    ]  # vertices of an affine image are the image of the vertices
    file = 100.0 * np.stack([affine[:, 0], affine[:, 2], -affine[:, 1]], 1)
    np.testing.assert_allclose(again.prims[0].vertices, file, atol=2e-4)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (
            curves(points=POINTS[:5], kind="cubic"),
            ["/c", "curve 0 is a cubic bezier", "of 5 vertices", "4, 7, 10", "resample"],
        ),
        (
            curves(points=POINTS[:7], counts=[4, 3], kind="cubic", basis="bspline"),
            ["/c", "curve 1 is a cubic bspline", "of 3 vertices", "4, 5, 6"],
        ),
        (curves(points=POINTS[:5], counts=[2, 2]), ["/c", "sum to 4", "5 points", "time code 1"]),
        (curves(kind="cubic", basis="hermite"), ["/c", "basis 'hermite'", "bspline"]),
        (curves(points=[], counts=[]), ["/c", "not a single curve at time code 1"]),
        (
            'def BasisCurves "c"\n{\n int[] curveVertexCounts.timeSamples = {1: [], 3: [2]}\n'
            " point3f[] points.timeSamples = {1: [], 3: [(0, 0, 0), (1, 0, 0)]}\n}\n",
            ["/c", "not a single curve at time code 1", "set startTimeCode to 3"],
        ),
        (
            'def NurbsCurves "n"\n{\n int[] curveVertexCounts = [4]\n int[] order = [4]\n'
            " double[] knots = [0, 0, 0, 0, 1, 1, 1, 1]\n point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]\n}\n",
            ["no BasisCurves to read", "/n is a NurbsCurves"],
        ),
        (
            'def PointInstancer "p"\n{\n int[] protoIndices = [0, 0]\n point3f[] positions = [(0, 0, 0), (5, 0, 0)]\n'
            f" rel prototypes = </p/c>\n{curves()}}}\n",
            ["/p is a PointInstancer", "/p/c", "prims of their own"],
        ),
        (curves(more=" float[] widths = [0, 0, 0, 0]"), ["/c", "curve 0 has no width at all"]),
        (curves(more=" float[] widths = [1, 1, -1, 1]"), ["/c", "curve 0 has a width of -1"]),
        (curves(more=" float[] widths = [1, 1, 1]"), ["/c", "3 widths", "vertex interpolation takes 4"]),
        (curves(points=POINTS[:2], counts=[1, 1]), ["/c", "no curve has 2 vertices"]),
        (
            curves(more=' token visibility = "invisible"'),
            ["no BasisCurves to read", "/c is invisible; name it by prim"],
        ),
        (xform(curves(), op="float3 xformOp:scale = (1, 0, 1)"), ["/x/c", "scale volumes by 0.0"]),
        ('over "c"\n{\n}\n', ["no BasisCurves to read"]),
    ],
    ids=[
        *(
            "Bezier of 5",
            "B-spline of 3",
            "other counts",
            "Hermite",
            "no curves",
            "empty sample",
            "NURBS",
            "point instancer",
        ),
        *("no widths", "negative width", "too few widths", "points", "invisible", "flat scale", "only overs"),
    ],
)
def test_refused_kinds(tmp_path, body, words):
    with pytest.raises(CurveError) as caught:
        opened(tmp_path, body)
    assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize(
    ("body", "counts", "words"),
    [
        (
            curves(points=POINTS[:5], counts=[4, 1]),
            [4],
            ["/c: 1 curves of less than 2 vertices are skipped, the first is curve 1"],
        ),
        (curves(more=" float[] widths = [0, 1, 1, 0]"), [4], ["/c: widths of 1 curves fall below 0.1", "curve 0"]),
        (
            curves() + curves("g", more=' uniform token purpose = "guide"'),
            [4],
            ["/g is of purpose guide; name it by prim"],
        ),
        (curves() + curves("h", more=' token visibility = "invisible"'), [4], ["/h is invisible; name it by prim"]),
        (curves() + 'def Sphere "s"\n{\n}\n', [4], ["/s is a Sphere, no BasisCurves"]),
        (
            curves(more=" normal3f[] normals = [(0, 0, 1)]\n custom int strange = 3\n rel skel:skeleton = </c>"),
            [4],
            ["attribute 'normals' is not read", "attribute 'strange'", "'skel:skeleton' is not read: its deformation"],
        ),
        (
            curves(more=' int[] primvars:n = [1, 2] (interpolation = "uniform")'),
            [4],
            ["'n' has 2 values; uniform", "1 elements of 1"],
        ),
        (
            curves(more=" point3f[] points.timeSamples = {1: [(0,0,0),(1,0,0),(2,0,0),(3,0,0)], 2: []}"),
            [4],
            ["points have 2 time"],
        ),
    ],
    ids=["one vertex", "tips of 0", "guides", "invisible", "other shapes", "attributes", "bad primvar", "animated"],
)
def test_unread_content_is_listed(tmp_path, body, counts, words):
    groom = opened(tmp_path, body)
    assert list(groom.counts) == counts
    assert [word for word in words if not any(word in line for line in groom.unread)] == []


def test_guides_and_invisible_prims_are_read_by_name(tmp_path):
    body = curves("g", more=' uniform token purpose = "guide"') + curves("h", more=' token visibility = "invisible"')
    guide, hidden = (opened(tmp_path, body, prim) for prim in ("/g", "/h"))
    assert guide.guides.all() and not hidden.guides.any()
    assert guide.prims[0].visible and not hidden.prims[0].visible


# Primvars of all interpolations and element sizes at the 5 nodes of nonperiodic B-splines of 5 vertices and 3 knots.
def test_primvars(tmp_path):
    more = """ float[] primvars:a = [7] (interpolation = "constant")
 int[] primvars:groom_id = [42, 43] (interpolation = "uniform")
 string[] primvars:groom_group_name = ["left", "right"] (interpolation = "uniform")
 int[] primvars:groom_guide = [0, 1] (interpolation = "uniform")
 float[] primvars:v = [0, 1, 2, 0, 1, 2] (interpolation = "varying")
 float[] primvars:w = [0, 1, 2, 3, 4, 0, 1, 2, 3, 4] (interpolation = "vertex")
 float[] primvars:pair = [1, 2, 3, 4] (interpolation = "uniform" elementSize = 2)
 int[] primvars:whole = [0, 1, 2, 3, 4, 0, 1, 2, 3, 4] (interpolation = "vertex")"""
    line = [(k, 0, 0) for k in range(5)]
    body = curves(points=[*line, *line], counts=[5, 5], kind="cubic", basis="bspline", more=more.replace("\n ", "\n "))
    groom = opened(tmp_path, body.replace('" elementSize', '"\n elementSize'))
    # knots of a B-spline of equal steps are its inner vertices, and varying values belong to knots
    along = [1.0, 1.5, 2.0, 2.5, 3.0]
    np.testing.assert_allclose(groom.at_nodes("w")[:5], along, atol=1e-12)
    np.testing.assert_allclose(groom.at_nodes("v")[:5], [0.0, 0.5, 1.0, 1.5, 2.0], atol=1e-12)
    np.testing.assert_allclose(groom.at_nodes("a"), 7.0)
    assert (
        list(groom.ids) == [42, 43] and list(groom.groups) == ["left", "right"] and list(groom.guides) == [False, True]
    )
    assert groom.of_strands("pair").tolist() == [[1, 2], [3, 4]] and groom.prims[0].primvars["pair"].element_size == 2
    assert set(groom.at_nodes("whole")) <= set(range(5)) and groom.at_nodes("whole").dtype.kind == "i"
    assert groom.curves().attributes["groom_id"].tolist() == [42, 43]
    with pytest.raises(CurveError, match="'v' is varying; give one of strands"):
        groom.of_strands("v")


# Instances expand to strands of their own: each is written, and becomes editable in the layer.
def test_instances_are_expanded_and_written(tmp_path):
    prototype = f'class Xform "H"\n{{\n{curves()}}}\n'
    body = prototype + "".join(
        xform("", f"i{k}", f"double3 xformOp:translate = ({k}, 0, 0)", "(\n instanceable = true\n inherits = </H>\n)")
        for k in range(3)
    )
    groom = opened(tmp_path, body)
    assert [prim.path for prim in groom.prims] == ["/i0/c", "/i1/c", "/i2/c"] and groom.prims[1].instances == ("/i1",)
    assert [rod[0, 0] for rod in groom.rods()] == [0.0, 1.0, 2.0]
    layer = tmp_path / "layer.usda"
    moved = groom.points + np.repeat(np.arange(3.0), 4)[:, None]
    with ddg.usd.GroomLayer(groom, layer) as writer:
        writer.write(0.0, moved)
    np.testing.assert_allclose(ddg.usd.open_groom(layer).points, moved, atol=1e-6)


# Uneven scale of parents: points are scaled exactly, radii by the cube root of the determinant, and the layer undoes it.
def test_uneven_scale(tmp_path):
    inside = curves(more=' float[] widths = [0.2] (interpolation = "constant")')
    groom = opened(tmp_path, xform(inside, op="float3 xformOp:scale = (2, 1, 1)"))
    np.testing.assert_allclose(groom.radius, 0.1 * 2.0 ** (1.0 / 3.0), rtol=1e-6)
    layer = tmp_path / "layer.usda"
    with ddg.usd.GroomLayer(groom, layer) as writer:
        writer.write(0.0, groom.points + [2.0, 0.0, 0.0], velocities=0.0 * groom.points + [4.0, 0.0, 0.0])
    stage = Usd.Stage.Open(str(layer))
    prim = UsdGeom.PointBased(stage.GetPrimAtPath("/x/c"))
    np.testing.assert_allclose(np.array(prim.GetPointsAttr().Get(1)), np.array(POINTS[:4]) + [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(np.array(prim.GetVelocitiesAttr().Get(1))[:, 0], 2.0, atol=1e-6)


# Parents that move by one unit a time code, 24 a second: roots follow them, and strands at rest in space move back in their own space.
def test_moving_parents(tmp_path):
    op = "double3 xformOp:translate.timeSamples = {1: (0, 0, 0), 5: (4, 0, 0)}"
    body = xform(curves(more=' float[] widths = [0.02] (interpolation = "constant")'), op=op)
    groom = opened(tmp_path, body)
    layer = tmp_path / "layer.usda"
    with ddg.usd.GroomLayer(groom, layer) as writer:
        for code in (1, 3):
            writer.write((code - 1) / 24.0, groom.points, velocities=0.0 * groom.points)
    stage = Usd.Stage.Open(str(layer))
    prim = UsdGeom.PointBased(stage.GetPrimAtPath("/x/c"))
    np.testing.assert_allclose(np.array(prim.GetPointsAttr().Get(3)), np.array(POINTS[:4]) - [2.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(np.array(prim.GetVelocitiesAttr().Get(3)), np.tile([-24.0, 0.0, 0.0], (4, 1)), atol=1e-4)
    options = {"out": layer, "frames": 2, "device": "cpu", "progress": False}
    result = ddg.simulate_groom(tmp_path / "a.usda", young=1e6, **options)
    np.testing.assert_allclose(result.state.points()[:2], groom.points[:2] + [2.0, 0.0, 0.0], atol=1e-12)


def test_sampling_that_does_not_determine_vertices_is_refused(tmp_path):
    groom = opened(tmp_path, curves(points=POINTS[:7], kind="cubic"), samples=1)
    with pytest.raises(CurveError, match=r"curve 0 has 7 vertices, which 3 nodes do not determine; open .* samples=4"):
        ddg.usd.GroomLayer(groom, tmp_path / "layer.usda")
    with pytest.raises(CurveError, match="is the groom itself"):
        ddg.usd.GroomLayer(opened(tmp_path, curves()), tmp_path / "a.usda")
