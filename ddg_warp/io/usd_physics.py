"""Deformable bodies in USD: rods and shells with their materials, by the proposal of AOUSD for UsdPhysics.

The names are from the revision of 2026 that Newton 1.8 reads. Its schemas are PhysicsDeformableBodyAPI,
PhysicsCurvesDeformableSimAPI, PhysicsSurfaceDeformableSimAPI and their materials. The geometry has `physics:thicknesses`, the material
stiffnesses of the section. The schemas are not in USD yet, which therefore does not check them. The reader also accepts the
namespace `omniphysics:` of NVIDIA Omniverse 107 and later, with thicknesses at the material.
Written are mean values of a prim. Supports, joints, contact parameters and anisotropic sections have no counterpart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from ddg_warp.io.paths import CurveError, existing
from ddg_warp.io.usd_materials import SCOPE
from ddg_warp.scene.material import Material, Stiffness

NAMESPACES = ("physics", "omniphysics")
KINDS = {"curves": "CurvesDeformable", "surface": "SurfaceDeformable"}
# attribute of `Deformable`: suffix of its name in USD; unit as powers of (mass, length, time)
MATERIAL = {
    "density": ("density", (1, -3)),
    "young": ("youngsModulus", (1, -1)),
    "poisson": ("poissonsRatio", (0, 0)),
}
STIFFNESS = {
    "curves": {
        "stretch": ("curvesStretchStiffness", (1, 1)),
        "shear": ("curvesShearStiffness", (1, 1)),
        "bend": ("curvesBendStiffness", (1, 3)),
        "twist": ("curvesTwistStiffness", (1, 3)),
    },
    "surface": {
        "stretch": ("surfaceStretchStiffness", (1, 0)),
        "shear": ("surfaceShearStiffness", (1, 0)),
        "bend": ("surfaceBendStiffness", (1, 2)),
    },
}
THICKNESS = {"curves": "curvesThickness", "surface": "surfaceThickness"}  # at the material, in earlier revisions
MOST_POISSON = 0.499  # the proposal excludes 0.5
DEFAULTS = {"thickness": 1e-3, "density": 1000.0, "young": 1e6, "poisson": 0.3}  # of the proposal, SI


@dataclass(frozen=True)
class Deformable:
    """Deformable curves or a deformable surface, in SI units; None for values that the file does not state.

    Attributes:
        path: Path of the geometry.
        kind: "curves" or "surface".
        thickness: Diameter of curves, or thickness of a surface [m], the mean.
        density: Mass density [kg/m^3].
        young, poisson: Young's modulus [Pa] and Poisson's ratio.
        `stretch`, `shear`, `bend`, `twist`: Stiffness of the section, of curves in [N] and [N m^2], of a surface in [N/m] and [N m].
        rest: Rest positions [m], shape (P, 3), in the frame of the prim.
        unread: Attributes of the proposal at geometry and material that are not read.
    """

    path: str
    kind: str
    thickness: float | None = None
    density: float | None = None
    young: float | None = None
    poisson: float | None = None
    stretch: float | None = None
    shear: float | None = None
    bend: float | None = None
    twist: float | None = None
    rest: np.ndarray | None = None
    unread: tuple[str, ...] = field(default=())

    def section(self) -> Stiffness:
        """Return the section of curves for `add_rod`; stiffness that is not stated is that of a circle of the material."""
        diameter, density, young, poisson = self._filled()
        area = 0.25 * np.pi * diameter**2
        inertia = area * diameter**2 / 16.0
        shear = young / (2.0 * (1.0 + poisson))
        return Stiffness(
            EA=young * area if self.stretch is None else self.stretch,
            EI1=young * inertia if self.bend is None else self.bend,
            GJ=shear * 2.0 * inertia if self.twist is None else self.twist,
            mass_per_length=density * area,
            rotary_inertia=2.0 * density * inertia,
            radius=0.5 * diameter,
            area=area,
        )

    def material(self) -> Material:
        """Return the material of a surface for `add_shell`; a stretch stiffness takes precedence over Young's modulus.

        The bending stiffness of a shell follows from its thickness. One that differs needs a thickness or a `Law` of its own.
        """
        thickness, density, young, poisson = self._filled()
        if self.stretch is not None:
            young = self.stretch * (1.0 - poisson**2) / thickness
        return Material(young=young, poisson=poisson, density=density)

    def _filled(self) -> tuple[float, float, float, float]:
        """Return thickness, density, Young's modulus and Poisson's ratio, by default of the proposal."""
        values = {name: getattr(self, name) for name in DEFAULTS}
        return tuple(DEFAULTS[name] if value is None else value for name, value in values.items())


@dataclass(frozen=True)
class Physics:
    """Materials of all rods and shells of a scene, for the writer.

    Attributes:
        gravity: Acceleration [m/s^2], shape (3,).
        rods: Values of each rod of one world by name, shape (R,): thickness, density, stretch, bend, twist; NaN for none.
        rest: Kind of the rest shape of each rod, shape (R,), str: "shape" of its points, "straight", or "" for others.
        points: Points of all rods [m], shape (P, 3).
        shells: Values of each shell by name: `points` (V, 3), whether it is `flat` at rest, and numbers.
    """

    gravity: np.ndarray
    rods: dict[str, np.ndarray]
    rest: np.ndarray
    points: np.ndarray
    shells: list[dict]

    @classmethod
    def of(cls, scene, count: int) -> Physics:
        """Describe the rods and shells of a scene with `count` curves; the first of them are rods."""
        names = ("thickness", "density", "stretch", "bend", "twist")
        rods = {name: np.full(count, np.nan) for name in names}
        kinds, points = np.full(count, "", object), [np.zeros((0, 3))]
        for batch in scene.batches:
            mine, section = slice(batch.first, batch.first + batch.rods), batch.section
            for name, value in _of_section(section).items():
                rods[name][mine] = _of_rods(value, batch.rods)
            natural = batch.natural if isinstance(batch.natural, str) else ""
            kinds[mine] = "" if batch.closed and natural == "straight" else natural
            points.append(batch.points.reshape(-1, 3))
        shells = [_of_shell(shell) for shell in scene.shells]
        return cls(np.array(scene.gravity, float), rods, kinds, np.concatenate(points), shells)


def _of_section(section) -> dict[str, np.ndarray]:
    radius = np.nan if section.radius is None else np.asarray(section.radius, float)
    area = np.where(np.asarray(section.area) > 0.0, section.area, np.pi * radius**2)
    return {
        "thickness": 2.0 * radius,
        "density": section.mass_per_length / area,
        "stretch": section.EA,
        "bend": 0.5 * (np.asarray(section.EI1) + section.EI2),
        "twist": section.GJ,
    }


def _of_rods(value, rods: int) -> np.ndarray:
    """Return the mean of each rod, shape (rods,), of a number or of values (rods or 1, edges or 1)."""
    values = np.asarray(value, float)
    return np.broadcast_to(values.mean(-1) if values.ndim == 2 else values.mean(), (rods,))


def _of_shell(shell) -> dict:
    material = {name: float(np.mean(getattr(shell.material, name))) for name in ("young", "poisson", "density")}
    thickness, plane = float(np.mean(shell.thickness)), material["young"] / (1.0 - material["poisson"] ** 2)
    return material | {
        "points": shell.points,
        "thickness": thickness,
        "stretch": plane * thickness,
        "shear": material["young"] / (2.0 * (1.0 + material["poisson"])) * thickness,
        "bend": plane * thickness**3 / 12.0,
        "flat": isinstance(shell.rest, str) and shell.rest == "flat",
    }


def write_scene(stage: Usd.Stage, gravity: np.ndarray) -> None:
    """Define the physics scene with gravity, and kilograms as unit of mass."""
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    scene = UsdPhysics.Scene.Define(stage, "/World/PhysicsScene")
    size = float(np.linalg.norm(gravity))
    scene.CreateGravityMagnitudeAttr(size)
    scene.CreateGravityDirectionAttr(Gf.Vec3f(*map(float, gravity / size if size else (0.0, 0.0, -1.0))))


def write_curves(prim: Usd.Prim, physics: Physics, counts: np.ndarray, rods: np.ndarray, worlds: int) -> None:
    """Make curves deformable.

    Args:
        prim: The curves.
        physics: Materials of the scene.
        counts: Points of every rod of one world, shape (R,).
        rods: Rods of the prim in one world.
        worlds: Copies of the rods in the prim.
    """
    values = {name: float(np.mean(each[rods])) for name, each in physics.rods.items()}
    if not np.isfinite([values["stretch"], values["thickness"]]).all():
        return
    area = 0.25 * np.pi * values["thickness"] ** 2
    values["young"] = values["stretch"] / area
    ratio = (
        values["bend"] / values["twist"] - 1.0 if values["twist"] > 0.0 else 0.0
    )  # of a circular section, 2 G I = GJ
    values["poisson"] = float(np.clip(ratio, 0.0, MOST_POISSON))
    kinds, rest = set(physics.rest[rods]), None
    if len(kinds) == 1 and kinds <= {"shape", "straight"}:
        rest = physics.points[np.isin(np.repeat(np.arange(len(counts)), counts), rods)]
        rest = np.tile(rest if kinds == {"shape"} else _straightened(rest, counts[rods]), (worlds, 1))
    _write(prim, "curves", values, rest)


def write_surface(prim: Usd.Prim, values: dict) -> None:
    """Make a mesh deformable, with the values of a shell."""
    _write(prim, "surface", values, values["points"])
    default = prim.CreateAttribute(
        "physics:restBendAnglesDefault", Sdf.ValueTypeNames.Token, False, Sdf.VariabilityUniform
    )
    default.Set("flat" if values["flat"] else "restShape")


def _write(prim: Usd.Prim, kind: str, values: dict, rest: np.ndarray | None) -> None:
    stage, name = prim.GetStage(), KINDS[kind]
    for schema in ("PhysicsDeformableBodyAPI", f"Physics{name}SimAPI"):
        prim.AddAppliedSchema(schema)
    UsdPhysics.CollisionAPI.Apply(prim)
    floats = Sdf.ValueTypeNames.FloatArray
    prim.CreateAttribute("physics:thicknesses", floats, False).Set(Vt.FloatArray([values["thickness"]]))
    kinds = prim.CreateAttribute(
        "physics:thicknesses:elementType", Sdf.ValueTypeNames.Token, False, Sdf.VariabilityUniform
    )
    kinds.Set("constant")
    if rest is not None:
        points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rest, np.float32))
        prim.CreateAttribute("physics:restShapePoints", Sdf.ValueTypeNames.Point3fArray, False).Set(points)
    material = UsdShade.Material.Define(stage, f"{SCOPE}/{prim.GetName()}_physics").GetPrim()
    UsdPhysics.MaterialAPI.Apply(material)
    material.AddAppliedSchema(f"Physics{name}MaterialAPI")
    for key, (suffix, _) in (MATERIAL | STIFFNESS[kind]).items():
        if np.isfinite(values.get(key, np.nan)):
            attribute = material.CreateAttribute(f"physics:{suffix}", Sdf.ValueTypeNames.Float, False)
            attribute.Set(float(values[key]))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(UsdShade.Material(material), materialPurpose="physics")


def _straightened(points: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return polylines (P, 3) along x from their first points, with edges of unchanged length."""
    straight = []
    for rod in np.split(points, np.cumsum(counts)[:-1]):
        lengths = np.linalg.norm(np.diff(rod, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(lengths)])
        straight.append(rod[0] + along[:, None] * [1.0, 0.0, 0.0])
    return np.concatenate(straight)


def read_deformables(path, outside: bool = False) -> list[Deformable]:
    """Return the deformable curves and surfaces of a USD file with materials, in SI units.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        outside: Whether layers, references and payloads outside the folder of the file may be opened.

    Raises:
        CurveError: The file cannot be read.
    """
    from ddg_warp.io.usd_read import opened

    with opened(existing(path), CurveError, outside) as stage:
        units = UsdPhysics.GetStageKilogramsPerUnit(stage), UsdGeom.GetStageMetersPerUnit(stage)
        return [_read(prim, kind, units) for prim in stage.Traverse() for kind in KINDS if _applied(prim, kind)]


def _applied(prim: Usd.Prim, kind: str) -> bool:
    """Return True if a prim has the simulation API of a kind, in either spelling."""
    names = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    return any(f"{prefix}{KINDS[kind]}SimAPI" in names for prefix in ("Physics", "OmniPhysics"))


def _read(prim: Usd.Prim, kind: str, units: tuple[float, float]) -> Deformable:
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(materialPurpose="physics")[0].GetPrim()
    values, taken = {}, set()
    for key, (suffix, powers) in (MATERIAL | STIFFNESS[kind]).items():
        value = _value(material, suffix, taken)
        values[key] = None if value is None else float(value) * units[0] ** powers[0] * units[1] ** powers[1]
    thickness = _value(prim, "thicknesses", taken)
    at_material = _value(material, THICKNESS[kind], taken)
    thickness = at_material if thickness is None or not len(thickness) else np.mean(thickness)
    values["thickness"] = None if thickness is None else float(thickness) * units[1]
    rest = _value(prim, "restShapePoints", taken)
    values["rest"] = None if rest is None else np.array(rest, float) * units[1]
    taken.add("physics:thicknesses:elementType")
    unread = [
        each.GetName()
        for owner in (prim, material)
        if owner
        for each in owner.GetAuthoredAttributes()
        if each.GetName().split(":")[0] in NAMESPACES and each.GetName() not in taken
    ]
    return Deformable(str(prim.GetPath()), kind, **values, unread=tuple(unread))


def _value(prim: Usd.Prim, suffix: str, taken: set[str]):
    """Return the value of an attribute of a prim in either namespace, or None."""
    for space in NAMESPACES if prim else ():
        attribute = prim.GetAttribute(f"{space}:{suffix}")
        if attribute and attribute.HasAuthoredValue():
            taken.add(attribute.GetName())
            return attribute.Get()
    return None
