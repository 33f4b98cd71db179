"""Controls of a step (loads, grip poses, field), and gradients with respect to them."""

from contextlib import contextmanager

import numpy as np
import torch
import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.model.controls import DRIVES
from ddg_warp.model.joint_drives import PARAMETERS
from ddg_warp.solve.forces.control_loads import LOADS
from ddg_warp.solve.forces.prescribed_motion import counts_revolutions, rotations_between
from ddg_warp.torch.state_layout import view

FIELD = "fields/"  # keys of fields among controls: this and the name


class StepControls:
    """Controls of the steps of an engine."""

    def __init__(self, engine):
        self.engine, self.model, self.layout = engine, engine.model, engine.layout
        real = wp.dtype_to_torch(self.model.types.real)
        self._usual = torch.tensor(np.array(self.model.scene.gravity, float), dtype=real, device=engine.device)
        self._pulled_by = False  # True if the last backward pass had gravity as a control
        self._fields, self._has_tensors = {}, False  # storage of fields by name; True if memory has tensors of a step

    def give(self, controls: dict) -> None:
        """Write loads and poses to the integrator; masses given as parameters count as loads, since residuals are scaled by loads."""
        engine, integrator, model = self.engine, self.engine.integrator, self.model
        loaded = engine.tables.weighs or any(name in controls for name in LOADS)
        if integrator.given is None and loaded:
            integrator._control({"gravity": np.array(model.scene.gravity, float)[None]}, 0)
        if integrator.given is not None:
            loads = integrator.given
            loads.any = loaded
            for name in LOADS:
                target = view(getattr(loads, name))
                if name in controls:
                    value = controls[name]
                    target.copy_(value - self._usual if name == "gravity" else value)
                else:
                    target.zero_()
        if model.coupled is not None and model.coupled.bodies:
            struct, wrenches = integrator._coupled.newton.rigid_bodies.bodies, controls.get("wrenches")
            for k, target in enumerate((view(struct.force), view(struct.moment))):
                if wrenches is None:
                    target.zero_()
                else:
                    target.copy_(torch.nan_to_num(wrenches[..., 3 * k : 3 * k + 3].reshape(-1, 3)))
        self.give_field(controls)
        if model.grips:
            target = view(engine.after.grips.pose)
            if "poses" in controls:
                self._refuse_far_turns(controls["poses"])
                target.copy_(controls["poses"].reshape(-1, 6).T)
            else:
                target.copy_(view(engine.before.grips.pose))

    def _refuse_far_turns(self, poses: torch.Tensor) -> None:
        """Refuse rotation vectors that differ by more than 180 degrees from the start of the step.

        On CUDA without contact they are not read, which would synchronise; such steps end with a non-finite outcome.

        Raises:
            SolverError: as `rotations_between`.
        """
        if self.model.wp_device.is_cuda and self.model.touch is None:
            return
        ends = poses.detach().cpu().numpy()
        if counts_revolutions(ends):
            begin = view(self.engine.before.grips.pose).T.reshape(ends.shape).detach().cpu().numpy()
            rotations_between(begin, np.where(np.isfinite(ends), ends, begin))

    def give_field(self, controls: dict) -> None:
        """Write the magnetic field of a step to the integrator."""
        if not self.model.magnetic:
            return
        target = view(self.engine.integrator.field)
        if "field" in controls:
            target.copy_(controls["field"].T)
        else:
            target.zero_()

    def give_drives(self, t: float, controls: dict) -> None:
        """Write angles and torques of hinges at a time to parameter memory: of the scene, then tensors."""
        drives = self.model.drives
        drives.to(t)
        for name, parameter in PARAMETERS.items() if drives.joints else ():
            if name not in controls:
                continue
            for part, index in self._hinges():
                table, value = part.parameters, torch.nan_to_num(controls[name])  # of invalid worlds
                memory = view(table.buffer).narrow(0, table.offsets[parameter], self.model.worlds * part.elements)
                memory[index] = memory[index] + value if name == "torques" else value * self._driven

    @contextmanager
    def driven(self):
        """Keep the values of `give_drives` within the block."""
        self.model.drives.kept = True
        try:
            yield
        finally:
            self.model.drives.kept = False

    def _hinges(self) -> list[tuple]:
        """Return element sets with hinges, and the indices of the hinges (worlds, hinges) as tensors."""
        drives = self.model.drives
        indices = self.layout.places("hinges", lambda: [index for _, index in drives.sets])
        return [(part, index) for (part, _), index in zip(drives.sets, indices, strict=True)]

    @property
    def _driven(self) -> torch.Tensor:
        """Mask of hinges with a driven angle, or with a spring (hinges,)."""
        (driven,) = self.layout.places("driven", lambda: [self.model.drives.driven])
        return driven

    def _by_drive(self, name: str, inputs: list, flags) -> torch.Tensor:
        """Return the gradient with respect to angles or torques of hinges (worlds, hinges)."""
        total = 0.0
        for part, index in self._hinges():
            row = list(part.parameters.values).index(PARAMETERS[name])
            gradient = view(inputs[-1].parameters[self.model.coupled.sets.index(part)])[row]
            total = total + gradient[index]
        return total * flags[-1][:, None] * (self._driven if name == "angles" else 1.0)

    def give_fields(self, t: float, controls: dict) -> None:
        """Write the fields at a time to parameter memory, of the scene, then tensors.

        Worlds whose fields, drives of hinges or wrenches are not finite are invalid.
        """
        fields, tables = self.model.fields, self.engine.tables
        if self._has_tensors:
            fields.forget()
            tables.find_invalid()
        fields.to(t)
        self._has_tensors = False
        for name, value in controls.items():
            if name.startswith(FIELD) or name in (*DRIVES, "wrenches"):
                self._has_tensors = True
                tables.invalid.masked_fill_(~torch.isfinite(value).flatten(1).all(1), outcome.INVALID_INPUT)
            if name.startswith(FIELD):
                for part, row, size, indices, elements in self._storage(name):
                    table = part.parameters
                    memory = view(table.buffer).narrow(0, table.offsets[row], size)
                    memory[indices] = value[:, elements]

    def on_path(self, controls: dict, begin: float, fraction: float) -> dict:
        """Return controls with fields at a fraction of the straight path from the fields of the scene at `begin`."""
        items = self.model.fields.items
        starts = {name: items[name.removeprefix(FIELD)].at(begin) for name in controls if name.startswith(FIELD)}
        return controls | {
            name: start + fraction * (controls[name] - start)
            for name, start in ((name, torch.as_tensor(start).to(controls[name])) for name, start in starts.items())
        }

    def _storage(self, name: str) -> list[tuple]:
        """Return rod groups and element sets of a field, each with its row, size, indices and elements of the field as tensors."""
        if name not in self._fields:
            item = self.model.fields.items[name.removeprefix(FIELD)]
            self._fields[name] = [
                (part, row, int(np.prod(shape)), *(torch.as_tensor(i, device=self.engine.device) for i in indices))
                for part, row, shape, *indices in item.indices(self.model.groups, self.model.coupled)
            ]
        return self._fields[name]

    def _by_field(self, name: str, result: torch.Tensor, inputs: list, flags) -> torch.Tensor:
        """Return the gradient with respect to the values of a field (worlds, size)."""
        for part, row, _, indices, elements in self._storage(name):
            index = list(part.parameters.values).index(row)
            if part in self.model.groups:
                group = self.model.groups.index(part)
                gradient = view(inputs[group].parameters)[index] * flags[group]
            else:
                place = self.model.coupled.sets.index(part)
                gradient = view(inputs[-1].parameters[place])[index].reshape(self.model.worlds, -1) * flags[-1][:, None]
            result[:, elements] = gradient.reshape(-1)[indices]
        return result

    def give_gravity(self, controls: dict, adjoint) -> None:
        """Write the gravity of a step to the adjoint, which starts with that of the scene."""
        is_control = "gravity" in controls
        if is_control or self._pulled_by:
            gravity = controls.get("gravity", self._usual)
            for i, part in enumerate(adjoint.parts):
                view(part.gravity).copy_(gravity.index_select(-1, self._axes(i, part.axes)))
        self._pulled_by = is_control

    def _axes(self, part: int, axes) -> torch.Tensor:
        """Return the space components that a subsystem has."""
        return self.layout.places(("axes", part), lambda: [list(axes)])[0]

    def vjp(self, name: str, value: torch.Tensor, inputs: list, flags) -> torch.Tensor:
        """Return the gradient with respect to a control of a step, or of an equilibrium at full load (worlds, ...)."""
        if name == "poses":
            return self.engine.by_poses * self.layout.by_world(flags)[:, None, None]
        if name in PARAMETERS:
            return self._by_drive(name, inputs, flags)
        if name == "wrenches":
            by_wrench = [
                view(values).reshape(self.model.worlds, -1, 3) for values in (inputs[-1].force, inputs[-1].moment)
            ]
            return torch.cat(by_wrench, -1) * flags[-1][:, None, None]
        result = torch.zeros_like(value)
        model, worlds = self.model, self.model.worlds
        if name.startswith(FIELD):
            return self._by_field(name, result, inputs, flags)
        if name == "field":
            for part, data in zip(model.coupled.sets, inputs[-1].data, strict=True):
                measure = part.term.measure
                if measure.field:
                    first = measure.data_size - measure.field
                    result += view(data)[first : first + 3].reshape(3, worlds, -1).sum(2).T
            return result * flags[-1][:, None]
        for i, group in enumerate(model.groups):
            gradients = inputs[i]
            if name == "gravity":
                by_gravity = view(gradients.gravity) * flags[i][:, None]
                by_gravity = by_gravity.reshape(group.nodes, worlds, group.rods, -1).sum((0, 2))
                result.index_add_(1, self._axes(i, group.host.axes), by_gravity)
                continue
            w = (view(gradients.load) * flags[i]).reshape(-1, group.nodes, worlds, group.rods)
            if name == "forces":
                k, column, rows = self.layout.places(("points", i), lambda group=group: model.order.places(group))
                result[:, rows[:, None], self._axes(i, group.host.axes)] = w[: group.kind.dim, k, :, column].permute(
                    2, 0, 1
                )
            elif group.kind.twist:
                k, column, rows = self.layout.places(("edges", i), lambda group=group: model.order.edge_places(group))
                result[:, rows] = w[group.kind.dim, k, :, column].T
        if model.coupled is not None:
            gradients = inputs[-1]
            if name == "gravity":
                by_gravity = view(gradients.gravity).reshape(worlds, -1, 3).sum(1)
                return result + by_gravity * flags[-1][:, None]
            w = view(gradients.load).reshape(worlds, -1, 3) * flags[-1][:, None, None]
            if name == "forces":
                rows, blocks = self.layout.places(("points", "net"), lambda: model.order.coupled_rows)
                result[:, rows] = w[:, blocks]
            else:
                rows, blocks = self.layout.coupled_edges()
                result[:, rows] = w[:, blocks, 0]
        return result
