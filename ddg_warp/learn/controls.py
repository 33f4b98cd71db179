"""Loads and poses that a step is given, and derivatives by them."""

import numpy as np
import torch
import warp as wp

from ddg_warp.learn.layout import view
from ddg_warp.solve.controls import LOADS
from ddg_warp.solve.motion import counts_turns, turns_between


class StepControls:
    """Of an engine: what its steps are given."""

    def __init__(self, engine):
        self.engine, self.model, self.layout = engine, engine.model, engine.layout
        real = wp.dtype_to_torch(self.model.types.real)
        self._usual = torch.tensor(np.array(self.model.scene.gravity, float), dtype=real, device=engine.device)
        self._pulled_by = False  # gravity that was given

    def give(self, controls: dict) -> None:
        """Hand the integrator loads and poses; masses that parameters give are loads, too, which residuals are compared with."""
        engine, integrator, model = self.engine, self.engine.integrator, self.model
        loaded = engine.tables.weighs or any(name in controls for name in LOADS)
        if integrator.given is None and loaded:
            integrator._control({"gravity": np.array(model.scene.gravity, float)[None]}, 0)
        if integrator.given is not None:
            given = integrator.given
            given.any = loaded
            for name in LOADS:
                place = view(getattr(given, name))
                if name in controls:
                    value = controls[name]
                    place.copy_(value - self._usual if name == "gravity" else value)
                else:
                    place.zero_()
        self.give_field(controls)
        if model.grips:
            place = view(engine.after.grips.pose)
            if "poses" in controls:
                self._refuse_far_turns(controls["poses"])
                place.copy_(controls["poses"].reshape(-1, 6).T)
            else:
                place.copy_(view(engine.before.grips.pose))

    def _refuse_far_turns(self, poses: torch.Tensor) -> None:
        """Refuse rotation vectors that count more than half a turn; where reading them would wait, steps end as not finite by them.

        Raises:
            SolverError: as `turns_between`.
        """
        if self.model.wp_device.is_cuda and self.model.touch is None:
            return
        ends = poses.detach().cpu().numpy()
        if counts_turns(ends):
            begin = view(self.engine.before.grips.pose).T.reshape(ends.shape).detach().cpu().numpy()
            turns_between(begin, np.where(np.isfinite(ends), ends, begin))

    def give_field(self, controls: dict) -> None:
        """Hand the integrator the magnetic field of a step."""
        if not self.model.magnetic:
            return
        place = view(self.engine.integrator.field)
        if "field" in controls:
            place.copy_(controls["field"].T)
        else:
            place.zero_()

    def give_gravity(self, controls: dict, adjoint) -> None:
        """Hand the reverse the gravity of a step; it has the scene's at first."""
        given = "gravity" in controls
        if given or self._pulled_by:
            own = controls.get("gravity", self._usual)
            for i, part in enumerate(adjoint.parts):
                view(part.gravity).copy_(own.index_select(-1, self._axes(i, part.axes)))
        self._pulled_by = given

    def _axes(self, part: int, axes) -> torch.Tensor:
        """Components of space that a part of the model has."""
        return self.layout.places(("axes", part), lambda: [list(axes)])[0]

    def pull(self, name: str, value: torch.Tensor, inputs: list, flags) -> torch.Tensor:
        """Derivatives by what a step, or an equilibrium at full load, is given (worlds, ...)."""
        if name == "poses":
            return self.engine.by_poses * self.layout.by_world(flags)[:, None, None]
        result = torch.zeros_like(value)
        model, worlds = self.model, self.model.worlds
        if name == "field":
            for part, data in zip(model.net.sets, inputs[-1].data, strict=True):
                measure = part.term.measure
                if measure.field:
                    first = measure.data_size - measure.field
                    result += view(data)[first : first + 3].reshape(3, worlds, -1).sum(2).T
            return result * flags[-1][:, None]
        for i, group in enumerate(model.groups):
            found = inputs[i]
            if name == "gravity":
                own = view(found.gravity) * flags[i][:, None]
                own = own.reshape(group.nodes, worlds, group.rods, -1).sum((0, 2))
                result.index_add_(1, self._axes(i, group.host.axes), own)
                continue
            w = (view(found.load) * flags[i]).reshape(-1, group.nodes, worlds, group.rods)
            if name == "forces":
                k, column, rows = self.layout.places(("points", i), lambda group=group: model.order.places(group))
                result[:, rows[:, None], self._axes(i, group.host.axes)] = w[: group.kind.dim, k, :, column].permute(
                    2, 0, 1
                )
            elif group.kind.twist:
                k, column, rows = self.layout.places(("edges", i), lambda group=group: model.order.edge_places(group))
                result[:, rows] = w[group.kind.dim, k, :, column].T
        if model.net is not None:
            found = inputs[-1]
            if name == "gravity":
                own = view(found.gravity).reshape(worlds, -1, 3).sum(1)
                return result + own * flags[-1][:, None]
            w = view(found.load).reshape(worlds, -1, 3) * flags[-1][:, None, None]
            if name == "forces":
                rows, blocks = self.layout.places(("points", "net"), lambda: model.order.net_rows)
                result[:, rows] = w[:, blocks]
            else:
                rows, blocks = self.layout.net_edges()
                result[:, rows] = w[:, blocks, 0]
        return result
