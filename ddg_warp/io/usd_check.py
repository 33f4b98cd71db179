"""Validation of USD files: the validators of USD, plus checks of counts, extents and NaN."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from ddg_warp.io.paths import CurveError, MissingFileError, existing
from ddg_warp.io.usd_read import opened
from ddg_warp.typing import FilePath

EXTENT_SLACK = 1e-5  # of the extent's size: positions and extents are float32
RIGID_SLACK = 1e-5  # of entries of R R^T: quaternions may be float32


def validate(path: FilePath, outside: bool = False) -> list[str]:
    """Return the problems of a USD file, one sentence each; empty for a valid file.

    USD's own validators run if the installed USD has them. In addition every time sample of every BasisCurves and Mesh is checked.
    Counts match the points, values are finite, widths are positive except for tips of 0, normals (if any) are unit vectors or 0, and
    the extent contains the points. Points have as many widths as points, positive, and finite values. Transforms of rigid bodies are
    finite and rigid.

    Args:
        path: The file.
        outside: Whether layers, references and payloads outside the folder of the file may be opened.
    """
    try:
        with opened(existing(path), CurveError, outside) as stage:
            return _problems_of(stage, path)
    except MissingFileError:
        raise
    except CurveError as error:
        return [str(error)]


def _problems_of(stage: Usd.Stage, path) -> list[str]:
    """Return the problems of a whole stage."""
    problems = _from_validators(stage)
    shapes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.BasisCurves) or prim.IsA(UsdGeom.Mesh)]
    bodies = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    if not (shapes or bodies):
        problems.append(f"{path}: there are neither BasisCurves nor meshes nor rigid bodies")
    points = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Points)]
    located = [(prim, problem) for prim in shapes for problem in _problems(prim)]
    located += [(prim, problem) for prim in points for problem in _problems_of_points(UsdGeom.Points(prim))]
    located += [(prim, problem) for prim in bodies for problem in _problems_of_body(UsdGeom.Xformable(prim))]
    return problems + [f"{prim.GetPath()}: {problem}" for prim, problem in located]


def _from_validators(stage: Usd.Stage) -> list[str]:
    try:
        from pxr import UsdValidation
    except ImportError:
        return []
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetErrorAsString() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


def _problems(prim: Usd.Prim) -> list[str]:
    shape = UsdGeom.PointBased(prim)
    times = shape.GetPointsAttr().GetTimeSamples() or [Usd.TimeCode.Default()]
    if prim.IsA(UsdGeom.Mesh):
        count, problems = _check_faces(UsdGeom.Mesh(prim))
        widths = np.zeros(1)
    else:
        curves = UsdGeom.BasisCurves(prim)
        count = int(np.sum(curves.GetCurveVertexCountsAttr().Get(times[0]) or [0]))
        widths = np.array(curves.GetWidthsAttr().Get(times[0]) or [np.nan])
        good = (widths >= 0.0).all() and widths.any()
        problems = [] if good else ["the widths are missing or not positive"]
        if len(widths) not in {1, len(curves.GetCurveVertexCountsAttr().Get(times[0]) or []), count}:
            problems.append(f"there are {len(widths)} widths for {count} points")
    for time in times:
        problems += [f"at time {time}, {each}" for each in _check_frame(shape, time, count, 0.5 * widths.max())]
    return problems


def _problems_of_points(prim: UsdGeom.Points) -> list[str]:
    """Return the problems of Points, whose number may differ between time samples."""
    problems = []
    for time in prim.GetPointsAttr().GetTimeSamples() or [Usd.TimeCode.Default()]:
        widths = np.array(prim.GetWidthsAttr().Get(time) or [])
        problems += [f"at time {time}, {each}" for each in _check_frame(prim, time, len(widths), 0.5 * widths)]
        if not (widths > 0.0).all():
            problems.append(f"at time {time}, the widths are not positive")
    return problems


def _problems_of_body(prim: UsdGeom.Xformable) -> list[str]:
    """Return the problems of the transforms of a rigid body."""
    problems = []
    for time in prim.GetTimeSamples() or [Usd.TimeCode.Default()]:
        matrix = np.array(prim.GetLocalTransformation(time))
        rotation = matrix[:3, :3]
        if not np.isfinite(matrix).all():
            problems.append(f"at time {time}, the transform is not finite")
        elif np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID_SLACK or np.linalg.det(rotation) < 0.0:
            problems.append(f"at time {time}, the transform is not rigid")
    return problems


def _check_faces(mesh: UsdGeom.Mesh) -> tuple[int, list[str]]:
    """Return (number of points that faces use, problems)."""
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [0])
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [-1])
    problems = [] if indices.min() >= 0 else [f"corner {np.argmin(indices)} has the index {indices.min()}"]
    if counts.sum() != len(indices):
        problems.append(f"faces have {counts.sum()} corners, but {len(indices)} are listed")
    return indices.max() + 1, problems


def _check_frame(shape: UsdGeom.PointBased, time, count: int, margin: float | np.ndarray) -> list[str]:
    """Return problems of points, velocities and extent at one time; `margin` is half the largest width, or half of each width."""
    points = np.array(shape.GetPointsAttr().Get(time) or [], dtype=np.float64).reshape(-1, 3)
    if len(points) != count:
        return [f"there are {len(points)} points, but the topology takes {count}"]
    if not np.isfinite(points).all():
        return [f"point {np.flatnonzero(~np.isfinite(points).all(axis=1))[0]} is not finite"]
    problems = []
    velocities = shape.GetVelocitiesAttr().Get(time)
    if velocities is not None and (len(velocities) != count or not np.isfinite(np.array(velocities)).all()):
        problems.append("the velocities do not match the points or are not finite")
    normals = shape.GetNormalsAttr().Get(time)
    if normals is not None and shape.GetNormalsInterpolation() == UsdGeom.Tokens.vertex:
        lengths = np.linalg.norm(np.array(normals, dtype=np.float64).reshape(-1, 3), axis=1)
        if len(lengths) != count or not (np.isclose(lengths, 1.0, atol=1e-4) | (lengths == 0.0)).all():
            problems.append("the normals do not match the points or are not of length 1")
    extent = np.array(shape.GetExtentAttr().Get(time) or [], dtype=np.float64)
    if extent.shape != (2, 3):
        return [*problems, "there is no extent"]
    if not count:
        return problems
    slack = EXTENT_SLACK * max(np.ptp(extent), np.abs(extent).max())
    margin = np.reshape(margin, (-1, 1))
    if (points - margin < extent[0] - slack).any() or (points + margin > extent[1] + slack).any():
        problems.append("the extent does not contain the curves")
    return problems
