"""Writer of recorded rods and surfaces to USD, exported together with readers, grooms and `validate`.

All rods of a batch (of one name and one material) form one prim below /World, with its own preview surface. The prim is a linear
BasisCurves, or a Mesh of tubes for programs without curves or curve materials (Blender 5.0 drops materials of curves). Every surface
and every obstacle is one Mesh, contact is Points. An obstacle that moves has a transform for each frame.
A rigid body is an Xform at its centre: each frame stores its translation and orientation, while the spheres, capsules and meshes
below it are constant. UsdPhysics gives its mass and inertia; it is kinematic, as its motion is recorded.
The first sample of every attribute is the default, too. z is up, lengths are in metres, times in seconds times timeCodesPerSecond.

USD saves a file over its old table of contents: a process killed meanwhile leaves it unreadable. The stage is therefore
saved to `NAME.partial.usdc`, and a copy of it replaces the final file atomically after each save.
USD does not survive a full disk either. Before each save its largest size is allocated on the disk and released.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdPhysics, Vt

from ddg_warp import argument_checks
from ddg_warp.io.bodies import Bodies
from ddg_warp.io.colors import PALETTE
from ddg_warp.io.contact_records import Contacts, ContactScales
from ddg_warp.io.curves import CurveSet
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.paths import CurveError
from ddg_warp.io.shapes import Curves, Shapes
from ddg_warp.io.usd_animated_mesh import read_animated_mesh
from ddg_warp.io.usd_bodies import BodyPrim
from ddg_warp.io.usd_check import validate
from ddg_warp.io.usd_contact import ContactsPrim, ObstaclePrim
from ddg_warp.io.usd_groom import Groom, open_groom
from ddg_warp.io.usd_groom_layer import GroomLayer
from ddg_warp.io.usd_physics import Physics, write_curves, write_scene, write_surface
from ddg_warp.io.usd_prims import ColorBy, CurvesPrim, Frame, PointsPrim, SurfacePrim, TubesPrim
from ddg_warp.io.usd_read import read_curves
from ddg_warp.typing import Array, FilePath, Floats, Numbers

__all__ = ["CurvesWriter", "Groom", "GroomLayer", "open_groom", "read_animated_mesh", "read_curves", "validate"]

ROOM = 2**16  # bytes of overhead of a save
TABLE = 256  # largest table entry for a frame of a prim [bytes]
TEXT = 4  # largest number of bytes of text for a byte of numbers
GROWTH = 8  # saves are at least an eighth of the recording apart, which bounds the cost of copies


class CurvesWriter:
    """Writer of frames of rods and surfaces to a USD file.

    Args:
        path: The file, .usdc or .usda; an existing one is replaced.
        curves: Rods without points, such as `model.curves`, or a `CurveSet`; or `CollisionMesh` of rods and surfaces.
        fps: Time codes per second.
        colors: RGB of each rod, shape (R, 3), or of each rod point; by default one color a batch.
        color_by: Name of a scalar shown by color instead, and its values at both ends of the scale.
        tube: Whether to write tubes instead of curves.
        attributes: Values of each rod of a world by name, shape (R,): numbers or texts, such as ids and groups of a groom.
        block: Frames between two saves, at least; a killed process leaves the frames saved last.
        obstacles: Obstacles, such as `model.obstacles`; moving obstacles are written once a world.
        contact_scales: Names and typical scales of contact, for frames with contacts.
        bodies: Rigid bodies, such as `model.rigid_bodies`, whose shapes are the last obstacles; without, these are moving obstacles.
        physics: Materials by which curves and surfaces are deformable bodies, see `usd_physics`; not of tubes.
    """

    def __init__(
        self,
        path: FilePath,
        curves: CurveSet | Shapes,
        *,
        fps: float = 24.0,
        colors: Numbers | None = None,
        color_by: tuple[str, float, float] | None = None,
        tube: bool = False,
        block: int = 32,
        attributes: Mapping[str, Array] | None = None,
        obstacles: Obstacles | None = None,
        contact_scales: ContactScales | None = None,
        bodies: Bodies | None = None,
        physics: Physics | None = None,
    ):
        argument_checks.positive("CurvesWriter: fps", fps, "1/s")
        self.path = Path(path)
        self._partial = self.path.with_name(f"{self.path.stem}.partial{self.path.suffix}")
        self._partial.unlink(missing_ok=True)
        self._fps, self._block = fps, block
        self._frames = self._saved = 0
        _take_room(self.path, ROOM)
        self._stage = Usd.Stage.CreateNew(str(self._partial))
        self._describe_stage()
        shapes = curves if isinstance(curves, Shapes) else _drawable(curves)
        self._rows = shapes.worlds * shapes.point_count
        color_by = ColorBy(*color_by) if color_by else None
        self._prims: list[PointsPrim | BodyPrim] = []
        numbers: dict[str, int] = {}
        kept = {name: np.tile(np.asarray(values), shapes.worlds) for name, values in (attributes or {}).items()}
        for name, values in kept.items():
            if values.shape != shapes.curves.counts.shape:
                rods = len(shapes.curves.counts) // shapes.worlds
                raise CurveError(
                    f"attribute {name!r} has {len(values) // shapes.worlds} values for {rods} rods; give one a rod"
                )
        if len(shapes.curves.counts):
            kind = TubesPrim if tube else CurvesPrim
            self._prims += _define_rods(self._stage, shapes, colors, color_by, kind, kept, numbers, physics)
        if shapes.surfaces is not None:
            self._prims += _define_surfaces(self._stage, shapes, color_by, numbers, physics)
        if physics is not None:
            write_scene(self._stage, physics.gravity)
        alone = 0 if obstacles is None else len(obstacles) - (0 if bodies is None else int(bodies.shapes.sum()))
        for k in range(alone):
            for world in range(shapes.worlds if obstacles.moved[k] else 1):
                path = _free_path(self._stage, str(obstacles.names[k]), numbers)
                self._prims.append(ObstaclePrim(self._stage, path, obstacles, k, world))
        if bodies is not None:
            UsdPhysics.SetStageKilogramsPerUnit(self._stage, 1.0)
            for k, world in np.ndindex(len(bodies), shapes.worlds):
                path = _free_path(self._stage, str(bodies.names[k]), numbers)
                self._prims.append(BodyPrim(self._stage, path, bodies, k, obstacles, world))
        if contact_scales is not None:
            self._prims.append(ContactsPrim(self._stage, _free_path(self._stage, "contacts", numbers), contact_scales))
        self._unsaved = _size_of_defaults(self._stage)

    def __enter__(self) -> CurvesWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(
        self,
        time: float,
        points: Numbers,
        *,
        velocities: Numbers | None = None,
        scalars: Mapping[str, Floats] | None = None,
        triangle_scalars: Mapping[str, Floats] | None = None,
        obstacles: Floats | None = None,
        contacts: Contacts | None = None,
        body_poses: Floats | None = None,
    ) -> None:
        """Write a frame.

        Args:
            time: Time [s], later than the frames before.
            points: Positions [m], shape (P, 3).
            velocities: Velocities [m/s], shape (P, 3).
            scalars: Values at the points by name, each of shape (P,), or vectors (P, 3), written unchanged as primvars.
            triangle_scalars: Values of the triangles of all surfaces by name, each of shape (T,), likewise.
            obstacles: Nodes of moving obstacles [m], shape (M, 3) or (worlds, M, 3).
            contacts: Contacts of the frame.
            body_poses: Rotation and position of rigid bodies [R | x], shape (N, 3, 4) or (worlds, N, 3, 4).

        Raises:
            CurveError: The time code is not later than the frame before, or the number of points is wrong.
        """
        time, points = argument_checks.number("CurvesWriter: time", time), np.asarray(points)
        if points.shape != (self._rows, 3):
            raise CurveError(
                f"{self.path}: points have shape {points.shape}, not ({self._rows}, 3); give those of all curves"
            )
        code = Usd.TimeCode(float(f"{time * self._fps:.12g}"))  # rounded, so that frames have whole numbers
        if self._frames and code.GetValue() <= self._stage.GetEndTimeCode():
            raise CurveError(
                f"{self.path}: a frame at {time} s has no later time code than the one before, at {self._fps} a second; write frames "
                "in the order of their times, with a larger fps"
            )
        obstacles = None if obstacles is None else np.reshape(obstacles, (-1, 3))
        body_poses = None if body_poses is None else np.reshape(body_poses, (-1, 3, 4))
        frame = Frame(points, velocities, scalars or {}, triangle_scalars or {}, obstacles, contacts, body_poses)
        for prim in self._prims:
            prim.write(code, frame)
        if self._frames == 0:
            self._stage.SetStartTimeCode(code.GetValue())
        self._stage.SetEndTimeCode(code.GetValue())
        self._frames += 1
        if self._frames - self._saved >= max(self._block, self._frames // GROWTH):
            self.save()

    def save(self) -> None:
        """Write all frames so far to the final file.

        Raises:
            OSError: The disk is full; the final file stays as it was.
        """
        self._save_stage(copies=1)
        copy = self.path.with_name(f"{self.path.stem}.copy{self.path.suffix}")
        copy.unlink(missing_ok=True)
        try:
            shutil.copyfile(self._partial, copy)
            os.replace(copy, self.path)
        except OSError:
            copy.unlink(missing_ok=True)
            raise
        self._saved = self._frames

    def close(self) -> None:
        """Save the remaining frames and close the stage."""
        if self._stage is not None:
            self._save_stage(copies=0)
            self._prims, self._stage = [], None
            try:
                os.replace(self._partial, self.path)
            finally:
                self._partial.unlink(missing_ok=True)

    def abandon(self) -> None:
        """Close the stage without saving; the final file keeps the frames saved last."""
        self._prims, self._stage = [], None
        self._partial.unlink(missing_ok=True)

    def _save_stage(self, copies: int) -> None:
        """Save the stage to the partial file, if the disk has room for it and for copies.

        USD appends new values and rewrites its tables.
        """
        unsaved = self._unsaved + sum(prim.unsaved for prim in self._prims)
        growth = ROOM + unsaved + TABLE * self._frames * len(self._prims)
        if self._partial.suffix == ".usda":
            growth *= TEXT
        _take_room(self.path, (1 + copies) * growth + copies * self._partial.stat().st_size)
        self._stage.GetRootLayer().Save()
        self._unsaved = 0
        for prim in self._prims:
            prim.unsaved = 0

    def _describe_stage(self) -> None:
        UsdGeom.SetStageUpAxis(self._stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(self._stage, 1.0)
        self._stage.SetTimeCodesPerSecond(self._fps)
        self._stage.SetFramesPerSecond(self._fps)
        self._stage.SetDefaultPrim(UsdGeom.Xform.Define(self._stage, "/World").GetPrim())


def _size_of_defaults(stage: Usd.Stage) -> int:
    """Return the size of arrays that do not change with time [bytes]."""
    values = (attribute.Get() for prim in stage.Traverse() for attribute in prim.GetAuthoredAttributes())
    return sum(
        memoryview(value).nbytes for value in values if isinstance(value, Vt.FloatArray | Vt.IntArray | Vt.Vec3fArray)
    )


def _take_room(path: Path, size: int) -> None:
    """Raise an OSError of `path` if the disk has no room for `size` bytes."""
    trial = path.with_name(f"{path.stem}.room{path.suffix}")
    try:
        trial.unlink(missing_ok=True)
        try:
            with open(trial, "xb") as file:
                os.posix_fallocate(file.fileno(), 0, size)
        finally:
            trial.unlink(missing_ok=True)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error


def _drawable(curves) -> Shapes:
    if curves.radius is None:
        raise CurveError("the rods have no radius, so they cannot be drawn: give each point one [m]")
    return Shapes.of(curves)


def _define_rods(
    stage: Usd.Stage,
    shapes: Shapes,
    colors,
    color_by,
    kind,
    attributes: Mapping,
    numbers: dict[str, int],
    physics: Physics | None,
) -> list[PointsPrim]:
    """Define one prim for each batch; two for open and closed rods, because USD wraps all curves of a prim alike."""
    curves = shapes.curves
    if colors is not None and len(colors) == len(curves.counts):
        colors = np.repeat(colors, curves.counts, axis=0)
    prims = []
    for batch in np.unique(curves.batch):
        for closed in (False, True):
            rods = (curves.batch == batch) & (curves.closed == closed)
            if rods.any():
                mine = np.repeat(rods, curves.counts)
                names, radius = curves.names[rods], curves.radius[mine]
                part = Curves(curves.counts[rods], curves.closed[rods], radius, names, curves.batch[rods])
                color = np.array(PALETTE[batch % len(PALETTE)]) if colors is None else np.asarray(colors)[mine]
                path = _free_path(stage, str(names[0]), numbers)
                prims.append(kind(stage, path, part, shapes.rows[mine], color, color_by))
                prims[-1].add_attributes({name: values[rods] for name, values in attributes.items()})
                if physics is not None:
                    of_a_world = shapes.curves_of_a_world.counts
                    members = np.flatnonzero(rods[: len(of_a_world)])
                    write_curves(stage.GetPrimAtPath(path), physics, of_a_world, members, shapes.worlds)
    return prims


def _define_surfaces(
    stage: Usd.Stage, shapes: Shapes, color_by, numbers: dict[str, int], physics: Physics | None
) -> list[PointsPrim]:
    """Define one prim for each surface, with colors after the rods' colors in the palette."""
    surfaces, batches = shapes.surfaces, len(np.unique(shapes.curves.batch))
    of_a_world = len(surfaces.names) // shapes.worlds
    prims = []
    for k, (part, name) in enumerate(zip(surfaces.parts(), surfaces.names, strict=True)):
        color = np.array(PALETTE[(batches + k % of_a_world) % len(PALETTE)])
        path = _free_path(stage, str(name), numbers)
        prims.append(SurfacePrim(stage, path, surfaces, part, color, color_by))
        if physics is not None:
            write_surface(stage.GetPrimAtPath(path), physics.shells[k % of_a_world])
    return prims


def _free_path(stage: Usd.Stage, name: str, numbers: dict[str, int]) -> str:
    """Return a path below /World from a name, with a number if it is taken; `numbers` keeps the last number by path."""
    base = f"/World/{Tf.MakeValidIdentifier(name)}"
    number = numbers.get(base, 1)
    while stage.GetPrimAtPath(path := base if number == 1 else f"{base}_{number}"):
        number += 1
    numbers[base] = number
    return path
