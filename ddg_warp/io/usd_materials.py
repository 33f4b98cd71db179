"""Materials of USD prims: a preview surface that shows the prim's color in programs that shade.

The surface reads the primvar displayColor of prims that have one for every vertex or face, such as prims colored by a scalar.
Source: UsdPreviewSurface specification, openusd.org.
"""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

ROUGHNESS = 0.6
SCOPE = "/World/Materials"


def bind_preview_surface(stage: Usd.Stage, prim: Usd.Prim, color: np.ndarray) -> None:
    """Bind a new preview surface to a prim.

    Args:
        stage: The stage of the prim.
        prim: Curves or a mesh.
        color: RGB without a displayColor, (3,), or the mean of (n, 3).
    """
    if not stage.GetPrimAtPath(SCOPE):
        UsdGeom.Scope.Define(stage, SCOPE)
    material = UsdShade.Material.Define(stage, f"{SCOPE}/{prim.GetName()}")
    surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(ROUGHNESS)
    reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("displayColor"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    rgb = Gf.Vec3f(*map(float, np.mean(np.atleast_2d(color), axis=0)))
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(rgb)
    diffuse = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    diffuse.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
