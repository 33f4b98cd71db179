"""MuJoCo models: compilation of MJCF and URDF, and names."""

from copy import copy
from pathlib import Path

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import MissingPackageError, SceneError

WORLD = 0  # MuJoCo's index of the world body


def mujoco_module():
    """Import mujoco.

    Raises:
        MissingPackageError: the package is missing; the message has the command that installs it.
    """
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise MissingPackageError("coupling needs", error, "mujoco") from error
    return mujoco


def compiled(call: str, source):
    """Return an `MjModel` from itself, from the path of an MJCF or URDF file, or from XML text.

    Raises:
        SceneError: there is no such file, or MuJoCo refuses it.
    """
    mujoco = mujoco_module()
    if isinstance(source, mujoco.MjModel):
        return source
    if not isinstance(source, str | Path):
        raise SceneError(
            f"{call}: the MuJoCo model is {argument_checks.shown(source)}; give an MjModel, or path or text of an MJCF or URDF file"
        )
    text = str(source)
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjModel.from_xml_string(text)
        return mujoco.MjModel.from_xml_path(text)
    except ValueError as error:
        raise SceneError(f"{call}: MuJoCo refuses the model: {error}") from error


def start_data(call: str, mj_model, data=None):
    """Return a copy of MuJoCo's data, by default of the initial configuration, with all poses computed."""
    mujoco = mujoco_module()
    if data is not None:
        if not isinstance(data, mujoco.MjData):
            raise SceneError(f"{call}: data are {argument_checks.shown(data)}; give an MjData of the MuJoCo model")
        if data.qpos.size != mj_model.nq:
            raise SceneError(
                f"{call}: data have {data.qpos.size} coordinates and the model {mj_model.nq}; give data of this MuJoCo model"
            )
    result = mujoco.MjData(mj_model) if data is None else copy(data)
    mujoco.mj_forward(mj_model, result)
    return result


def name_of(mj_model, kind: str, index: int) -> str:
    """Return the name of a body, joint, geom, ... of MuJoCo, or its kind and index without."""
    return getattr(mj_model, kind)(index).name or f"{kind} {index}"


def body_of(call: str, mj_model, name: str) -> int:
    """Return the index of the body of a name, or of the site or geom of a name.

    Raises:
        SceneError: nothing has the name, or objects of several bodies.
    """
    mujoco, bodies, names = mujoco_module(), set(), []
    owners = {"body": np.arange(mj_model.nbody), "site": mj_model.site_bodyid, "geom": mj_model.geom_bodyid}
    for kind, owner in owners.items():
        index = mujoco.mj_name2id(mj_model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), str(name))
        if index >= 0:
            bodies.add(int(owner[index]))
        names += [text for i in range(len(owner)) if (text := getattr(mj_model, kind)(i).name)]
    if not bodies:
        raise SceneError(
            f"{call}: no body, site or geom of MuJoCo is named {name!r}{argument_checks.meant(str(name), names)}"
        )
    if len(bodies) > 1:
        raise SceneError(
            f"{call}: the name {name!r} is of objects on {len(bodies)} bodies of MuJoCo; rename one of them"
        )
    return bodies.pop()
