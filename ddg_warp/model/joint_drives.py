"""Angles and torques of hinges, of the scene and of `Controls`, in the parameters of their elements."""

from collections.abc import Mapping

import numpy as np

from ddg_warp import argument_checks

REST, TORQUE = "rest_6", "torque"  # driven parameters of the term "hinge": angle and torque
PARAMETERS = {"angles": REST, "torques": TORQUE}  # by the name of the control


class JointDrives:
    """Hinges of a model, and the values that drive them.

    Attributes:
        joints: the hinges, `BodyJoint`, in the order of `Controls.angles`.
        driven: mask of hinges with a driven angle, or with a spring (hinges,).
        sets: element sets with hinges, and the indices of the hinges in one of their parameters (worlds, hinges).
        kept: True while the values in memory stay, whatever `to` is given.
    """

    def __init__(self, model):
        self.joints = [joint for joint in model.scene.body_joints if joint.call == "hinge"]
        self.driven = np.array([joint.angle is not None or joint.spring is not None for joint in self.joints], bool)
        self.sets, self.kept = [], False
        numbers = [i for i, joint in enumerate(model.scene.body_joints) if joint.call == "hinge"]
        for part in model.coupled.sets if numbers else ():
            if part.term.name == "hinge":
                element = {number: k for k, number in enumerate(part.host.owner[0].tolist())}
                index = np.array([element[number] for number in numbers])
                for name in (REST, TORQUE):
                    part.parameters.prescribe(name, (model.worlds, part.elements))
                self.sets.append((part, index + part.elements * np.arange(model.worlds)[:, None]))

    def to(self, t: float, factor: float = 1.0, controls: Mapping | None = None) -> None:
        """Write the values at a time, or at a load parameter `factor` of statics, which scales constant torques.

        Args:
            controls: "angles" and "torques" (1 or worlds, hinges) of `Controls`.

        Raises:
            SolverError: a function failed, or its value does not fit; the message names the hinge.
        """
        if not self.joints or self.kept:
            return
        controls = controls or {}
        angles, torques = (
            np.array([_value(k, joint, label, t, factor) for k, joint in enumerate(self.joints)])
            for label in ("angle", "torque")
        )
        angles = controls.get("angles", angles)
        torques = torques + factor * controls.get("torques", 0.0)
        for part, index in self.sets:
            part.parameters.write(REST, [(index, np.broadcast_to(np.where(self.driven, angles, 0.0), index.shape))])
            part.parameters.write(TORQUE, [(index, np.broadcast_to(torques, index.shape))])


def _value(number: int, joint, label: str, t: float, factor: float) -> float:
    """Return the angle or the torque of a hinge, zero without."""
    drive = getattr(joint, label)
    if drive is None:
        return 0.0
    if not callable(drive):
        return drive if label == "angle" else factor * drive
    return float(argument_checks.value_at(f"hinge {joint.name or number}: {label}", drive, t))
