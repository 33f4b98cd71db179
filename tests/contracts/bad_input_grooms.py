"""Bad inputs to grooms: reader, scene, simulation and layer."""

# fmt: off
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from bad_inputs import INF, NAN, each, refuse

import ddg_warp as ddg
from ddg_warp.scenes import _groomed_head as shot


@cache
def folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory()


@cache
def stage() -> Path:
    """Return a stage with two strands and a head of two frames."""
    path = Path(folder().name) / "shot.usda"
    shot.write(path, 2, 2, 1)
    return path


@cache
def groom() -> ddg.usd.Groom:
    return ddg.usd.open_groom(stage())


@cache
def skin() -> ddg.AnimatedMesh:
    return ddg.usd.read_animated_mesh(stage())


def opened(**options):
    return ddg.usd.open_groom(stage(), **options)


def described(**options):
    return ddg.groom_scene(groom(), skin(), **options)


def run(**options):
    with tempfile.TemporaryDirectory() as directory:
        named = {"out": Path(directory) / "hair.usda", "progress": False, "device": "cpu", "frames": 0} | options
        return ddg.simulate_groom(named.pop("path", stage()), **named)


def layer(path="hair.usda", points=None, velocities=None):
    with tempfile.TemporaryDirectory() as directory, ddg.usd.GroomLayer(groom(), Path(directory) / path) as made:
        made.write(0.0, groom().points if points is None else points, velocities)


each("grooms", "samples", ["all", 0, -1, 1.5, None], lambda v: opened(samples=v), "open_groom: samples")
each("grooms", "prim", ["hair", 3, "/no/prim"], lambda v: opened(prim=v), "prim")
each("grooms", "young", [0.0, -1.0, NAN, [1.0, 2.0]], lambda v: described(young=v), "young")
each("grooms", "young by", ["no_such"], lambda v: described(young=v), "no primvar 'no_such'", "clump_id, st")
each("grooms", "radius", [0.0, -1.0, NAN, INF], lambda v: described(radius=v), "radius")
each("grooms", "range", [0.0, -1.0, NAN, "far"], lambda v: described(range=v), "groom: range", "positive")
each("grooms", "root length", [0.0, -1.0, NAN], lambda v: described(root_length=v), "root_length", "positive")
each("grooms", "sag_free", [1.5, "yes", None], lambda v: described(sag_free=v), "sag_free", "True or False")
each("grooms", "contact", [1.5, "yes"], lambda v: described(contact=v), "contact", "True or False")
each("grooms", "groom", [None, "shot.usda", 3], ddg.groom_scene, "groom_scene: groom", "open_groom")
each("grooms", "skin", ["/char/head", 3], lambda v: ddg.groom_scene(groom(), v), "groom_scene: skin", "read_animated_mesh")
each("grooms", "substeps", [0, -1, 1.5, "two"], lambda v: run(substeps=v), "substeps", "whole number")
each("grooms", "frames", [-1, 1.5, "all"], lambda v: run(frames=v), "frames", "whole number")
refuse("grooms", {
    "no value for a group": (lambda: described(group="clump_id", young={99: 1e9}), "young has no value for group", "'99'"),
    "group by no primvar": (lambda: described(group="side"), "no primvar 'side'", "clump_id, st"),
    "sag-free curls": (lambda: described(curl=1.0, sag_free=True), "sag_free finds natural curvature", "leave out"),
    "nearly young": (lambda: run(yong=1e9), "simulate_groom takes no 'yong'", "did you mean 'young'"),
    "a skin that is no mesh": (lambda: run(skin="/char/hair"), "0 meshes to read"),
    "a layer over itself": (lambda: ddg.usd.GroomLayer(groom(), stage()), "is the groom itself", "another file"),
    "a layer of another suffix": (lambda: layer("hair.abc"), "hair.abc", ".usda"),
    "points of another groom": (lambda: layer(points=np.zeros((3, 3))), "points have shape (3, 3)", "all nodes"),
    "points that are no number": (lambda: layer(points=NAN * groom().points), "points of strand 0 are not finite"),
    "velocities of another shape": (lambda: layer(velocities=np.zeros(3)), "velocities have shape (3,)"),
})
