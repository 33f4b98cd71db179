"""Materials of USD scenes: a preview surface for each prim's color, bound to it, so that programs that shade show the colors, too.

The surface reads the primvar displayColor where the prim has one for every vertex or face, as when it is colored by a scalar.
Source: UsdPreviewSurface specification, openusd.org.
"""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

ROUGHNESS = 0.6
SCOPE = "/World/Materials"


def bind_preview_surface(stage: Usd.Stage, prim: Usd.Prim, color: np.ndarray) -> None:
    """Gives a prim a material of its own.

    Args:
        stage: The stage of the prim.
        prim: Curves or a mesh.
        color: Its RGB, (3,), shown where it has no displayColor, or (n, 3), whose mean is.
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
