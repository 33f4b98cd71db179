"""Angles and torques of hinges that are functions of time, in the parameters of their elements."""

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.model.rigid_bodies import REST, TORQUE


class JointDrives:
    """Driven hinges of a coupled model.

    Args:
        midpoint: True for values at the middle of a step.
    """

    def __init__(self, model, midpoint: bool):
        self.model, self.midpoint, self._drives = model, midpoint, []
        worlds = np.arange(model.worlds)[:, None]
        for part in model.coupled.sets:
            if part.term.name != "hinge":
                continue
            joints = [model.scene.body_joints[number] for number in part.host.owner[0]]
            for name, label in ((REST, "angle"), (TORQUE, "torque")):
                driven = [(i, j, getattr(j, label)) for i, j in enumerate(joints) if getattr(j, label) is not None]
                if driven:
                    index = np.array([i for i, _, _ in driven]) + part.elements * worlds
                    self._drives.append((part.parameters, name, label, index, driven))

    def upload(self, t0: float, t1: float) -> None:
        """Write the values of a step from t0 to t1."""
        t = 0.5 * (t0 + t1) if self.midpoint else t1
        for table, name, label, index, driven in self._drives:
            values = [
                argument_checks.value_at(f"hinge {joint.name or number}: {label}", function, t)
                for number, joint, function in driven
            ]
            table.write(name, [(index, np.broadcast_to(np.array(values, float), index.shape))])
