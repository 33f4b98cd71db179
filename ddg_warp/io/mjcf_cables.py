"""Reader of cables in MJCF files: `composite` of type cable, and bodies with the plugin mujoco.elasticity.cable.

Poses of bodies, frames and replicates are computed by MuJoCo from a copy of the file without anything else. Files of MuJoCo 3
can therefore be read with MuJoCo 4, which has neither composites nor the plugin.
Source: MuJoCo documentation, XML reference (composite) and plugin/elasticity/README.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from ddg_warp.errors import MissingPackageError
from ddg_warp.io.curves import CurveSet, checked_curves
from ddg_warp.io.paths import CurveError, shown

PLUGIN = "mujoco.elasticity.cable"
POSE = ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler")
ROUND = ("capsule", "cylinder")
MOST = 100_000  # points of a cable
DENSITY = 1000.0  # of a geom without one, in MuJoCo [kg/m^3]
VALUES = {"bend": "young", "twist": "shear"}  # of the plugin, in Pa
UNREAD = (
    "geom",
    "joint",
    "freejoint",
    "site",
    "flexcomp",
    "flex",
    "include",
    "attach",
    "tendon",
    "actuator",
    "sensor",
    "skin",
)


@dataclass
class Cable:
    """Cable of the file: name, elements, and names of the sites at its points."""

    name: str
    geom: Element | None
    plugin: Element | None
    sites: list[str] = field(default_factory=list)


def read_cables(path: Path) -> list[CurveSet]:
    """Return the cables of an MJCF file in metres with z up, one set each; a replicate gives several rods.

    `attributes` has `young` (bend) and `shear` (twist) of the plugin [Pa], and `density` [kg/m^3]. Capsules and cylinders have a
    radius, boxes none. Everything else in the file is listed as unread.

    Raises:
        CurveError: There are no cables, or the file cannot be read.
    """
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except ElementTree.ParseError as error:
        raise CurveError(f"{path}: this is no XML, or it is cut short ({error}); export it again") from error
    copy, cables = Element("mujoco"), []
    for compiler in root.findall("compiler"):
        SubElement(copy, "compiler", {key: compiler.get(key) for key in ("angle", "eulerseq") if compiler.get(key)})
    for worldbody in root.findall("worldbody"):
        _copy_poses(worldbody, SubElement(copy, "worldbody"), cables, None, path)
    if not cables:
        raise CurveError(
            f'{path}: there are no cables; <composite type="cable"> and bodies with the plugin {PLUGIN} are read'
        )
    located = _located(copy, path)
    instances = {
        each.get("name"): each for plugin in root.findall("extension/plugin") for each in plugin.findall("instance")
    }
    unread = _unread(root)
    return [_curves(cable, located, instances, unread, path) for cable in cables]


def _copy_poses(source: Element, target: Element, cables: list[Cable], current: Cable | None, path: Path) -> None:
    """Copy bodies, frames and replicates below an element, with a site at each point of a cable."""
    for child in source:
        pose = {key: child.get(key) for key in POSE if child.get(key)}
        if child.tag == "composite" and child.get("type") == "cable":
            name = child.get("prefix", "").rstrip("_") or f"cable {len(cables)}"
            cables.append(Cable(name, child.find("geom"), child.find("plugin")))
            if child.get("offset"):
                pose["pos"] = child.get("offset")
            body = SubElement(target, "body", pose)
            for point in _points_of_composite(child, f"{path}: composite {name!r}"):
                _add_site(body, cables, cables[-1], " ".join(map(repr, point.tolist())))
        elif child.tag == "body":
            body, plugin = SubElement(target, "body", pose), _cable_plugin(child)
            if plugin is None:
                _copy_poses(child, body, cables, None, path)
                continue
            cable = current
            if cable is None:
                cable = Cable(child.get("name") or f"cable {len(cables)}", child.find("geom"), plugin)
                cables.append(cable)
            current = None  # a second body of the same parent begins a cable of its own
            _add_site(body, cables, cable, "0 0 0")
            following = [each for each in child.findall("body") if _cable_plugin(each) is not None]
            if not following:
                _add_site(body, cables, cable, _end_of(child.find("geom"), f"{path}: body {child.get('name')!r}"))
            _copy_poses(child, body, cables, cable, path)
        elif child.tag in ("frame", "replicate"):
            if child.tag == "replicate":
                pose = {key: child.get(key) for key in ("count", "offset", "euler") if child.get(key)}
            _copy_poses(child, SubElement(target, child.tag, pose), cables, None, path)


def _cable_plugin(body: Element) -> Element | None:
    """Return the element of the cable plugin of a body, or None."""
    plugins = body.findall("plugin")
    return next((each for each in plugins if each.get("plugin", PLUGIN) == PLUGIN), None)


def _add_site(body: Element, cables: list[Cable], cable: Cable, position: str) -> None:
    name = f"cable_{cables.index(cable)}_{len(cable.sites)}_"
    cable.sites.append(name)
    SubElement(body, "site", {"name": name, "pos": position})


def _points_of_composite(composite: Element, where: str) -> np.ndarray:
    """Return the vertices of a cable in the frame of the composite, by `vertex`, or by `curve`, `count` and `size`."""
    if composite.get("vertex"):
        values = _numbers(composite.get("vertex"), f"{where}: vertex")
        if len(values) % 3:
            raise CurveError(f"{where}: vertex has {len(values)} numbers; give three for each point")
        return values.reshape(-1, 3)
    count = _first(composite.get("count", "0"), f"{where}: count")
    if not 2 <= count <= MOST:
        raise CurveError(f"{where}: count = {count:g}; a cable has 2 to {MOST} points")
    size = np.pad(_numbers(composite.get("size", "1 0 0"), f"{where}: size"), (0, 3))
    s = np.linspace(0.0, 1.0, int(count))
    functions = {"s": size[0] * s, "0": 0.0 * s, "zero": 0.0 * s}
    functions |= {"cos(s)": size[1] * np.cos(np.pi * size[2] * s), "sin(s)": size[1] * np.sin(np.pi * size[2] * s)}
    kinds = composite.get("curve", "").split()
    if not kinds or len(kinds) > 3 or not set(kinds) <= set(functions):
        raise CurveError(f"{where}: curve = {composite.get('curve')!r} cannot be read; use s, cos(s), sin(s) and 0")
    return np.stack([functions[kind] for kind in [*kinds, "0", "0"][:3]], 1)


def _end_of(geom: Element | None, where: str) -> str:
    """Return the position of the last point of a cable in the frame of the last body."""
    if geom is not None and geom.get("fromto"):
        return " ".join(geom.get("fromto").split()[3:])
    if geom is None or not geom.get("pos"):
        raise CurveError(
            f"{where}: the last body of the cable has no geom with pos or fromto, so its length is unknown; give one"
        )
    return " ".join(str(2.0 * value) for value in _numbers(geom.get("pos"), where))


def _numbers(text: str | None, where: str) -> np.ndarray:
    words = (text or "").split()
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        raise CurveError(f"{where} = {shown(words)!r} has no numbers; correct it") from None


def _first(text: str | None, where: str) -> float:
    """Return the first number of a text."""
    values = _numbers(text, where)
    if not len(values):
        raise CurveError(f"{where} is empty; give a number")
    return float(values[0])


def _located(copy: Element, path: Path) -> dict[str, np.ndarray]:
    """Return the world positions of all sites of the copy by name."""
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise MissingPackageError(f"{path}: MJCF files need", error, "mujoco") from error
    try:
        model = mujoco.MjModel.from_xml_string(ElementTree.tostring(copy, encoding="unicode"))
    except ValueError as error:
        raise CurveError(f"{path}: MuJoCo refuses the poses of the model: {' '.join(str(error).split())}") from error
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return {model.site(k).name: data.site_xpos[k].copy() for k in range(model.nsite)}


def _curves(cable: Cable, located: dict, instances: dict, unread: list[str], path: Path) -> CurveSet:
    """Return the rods of a cable, one for each copy of a replicate."""
    first = cable.sites[0]
    suffixes = [name.removeprefix(first) for name in located if name.startswith(first)]
    points = np.array([[located[name + suffix] for name in cable.sites] for suffix in suffixes])
    radius, attributes, unread = None, {"density": DENSITY}, list(unread)
    if (geom := cable.geom) is not None:
        attributes["density"] = _first(geom.get("density", str(DENSITY)), f"{path}: density")
        if geom.get("type", "capsule") not in ROUND:
            unread.append(f"section of geom type {geom.get('type')!r}, size {geom.get('size')}")
        elif geom.get("size"):
            radius = _first(geom.get("size"), f"{path}: size")
    if (plugin := cable.plugin) is not None:
        source = instances.get(plugin.get("instance"), plugin)
        config = {each.get("key"): each.get("value") for each in source.findall("config")}
        for key, name in VALUES.items():
            if key in config:
                attributes[name] = _first(config[key], f"{path}: {key}")
        unread += [f"{key} = {value} of the plugin" for key, value in config.items() if key not in VALUES]
    rods = len(suffixes)
    curves = checked_curves(
        points.reshape(-1, 3), np.full(rods, len(cable.sites)), False, radius, cable.name, str(path)
    )
    values = {name: np.full(rods, value) for name, value in attributes.items()}
    return replace(curves, attributes=values, unread=tuple(unread))


def _unread(root: Element) -> list[str]:
    """Return a text for each kind of element of the file that belongs to no cable."""
    inside = {each for composite in root.iter("composite") for each in composite.iter()}
    inside |= {body.find("geom") for body in root.iter("body") if _cable_plugin(body) is not None}
    counts = Counter(each.tag for each in root.iter() if each not in inside)
    unread = [f"{counts[tag]} {tag}" for tag in UNREAD if counts[tag]]
    kinds = [each.get("type") for each in root.iter("composite") if each.get("type") != "cable"]
    equalities = sum(len(each) for each in root.findall("equality"))
    unread += [f"composite of type {kind!r}" for kind in kinds] + [f"{equalities} equality constraints"] * (
        equalities > 0
    )
    damped = any(each.get("damping") for each in root.iter("joint"))
    return unread + ["damping of joints"] * damped
