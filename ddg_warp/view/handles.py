"""Handles that a person drags on the page: springs at nodes, and grips."""

from __future__ import annotations

import numpy as np

from ddg_warp.view.stage import Stage

GIZMO = 0.12  # size of a gizmo over the size of the scene
STIFFNESS = 0.25  # of a spring over mass / dt^2


def nearest_to_ray(points: np.ndarray, origin, direction) -> int:
    """Return the row of the point (N, 3) nearest to a ray."""
    offset, along = points - np.asarray(origin), np.asarray(direction) / np.linalg.norm(direction)
    distance = offset @ along
    away = np.linalg.norm(offset - distance[:, None] * along, axis=1)
    return int(np.argmin(np.where(distance > 0.0, away, np.inf)))


class Springs:
    """Springs between nodes and gizmos.

    The force is constant over a step, as of control loads: stiffness times the distance at its start. The stiffness is a fraction of
    mass / dt^2 of the node, with which explicit springs are stable up to 4.

    Args:
        stage: The stage.
        masses: Masses of the points of a world (P,) [kg].
        model: The model.
    """

    def __init__(self, stage: Stage, masses: np.ndarray, model):
        self._stage, self._masses, self._model = stage, masses, model
        self._points = np.zeros((0, 3))
        self._gizmos: dict[int, object] = {}
        self._lines = None
        self._dt = 0.0
        gui = stage.server.gui
        with gui.add_folder("springs"):
            self._pick = gui.add_checkbox("a click attaches a spring to a node", False)
            self._stiffness = gui.add_slider("stiffness over mass / dt^2", 0.01, 1.0, 0.01, STIFFNESS)
            gui.add_button("release springs").on_click(lambda _: self.release())
        stage.server.scene.on_click()(self._clicked)

    def note_step(self, dt: float) -> None:
        """Take the length of the last step [s]."""
        self._dt = dt if dt > 0.0 else self._dt

    def attach(self, row: int):
        """Attach a spring to a node, by its row among the points of all worlds; return the gizmo."""
        if row not in self._gizmos:
            self._gizmos[row] = self._stage.server.scene.add_transform_controls(
                f"/springs/{row}",
                scale=GIZMO * self._stage.drawing.size,
                disable_rotations=True,
                position=self._points[row],
                depth_test=False,
            )
        return self._gizmos[row]

    def release(self) -> None:
        """Remove all springs."""
        for row in list(self._gizmos):
            self._gizmos.pop(row).remove()
        self._draw_lines()

    def forces(self, state) -> np.ndarray | None:
        """Return forces on the points at a state (P, 3) or (worlds, P, 3) [N]; None without springs."""
        gizmos = dict(self._gizmos)
        if not gizmos or state is None or not self._dt:
            return None
        points = state.points()
        forces = np.zeros(points.shape)
        flat, x = forces.reshape(-1, 3), points.reshape(-1, 3)
        for row, gizmo in gizmos.items():
            stiffness = self._stiffness.value * self._masses[row % len(self._masses)] / self._dt**2
            flat[row] = stiffness * (np.asarray(gizmo.position) - x[row])
        if self._model.scene.dimension == 2:
            flat[:, 1] = 0.0
        return forces

    def show(self, points: np.ndarray) -> None:
        """Draw the springs to points (N, 3)."""
        self._points = points
        self._draw_lines()

    def _clicked(self, event) -> None:
        if self._pick.value and len(self._points) and event.ray_origin is not None:
            self.attach(nearest_to_ray(self._points, event.ray_origin, event.ray_direction))

    def _draw_lines(self) -> None:
        gizmos = dict(self._gizmos)
        if not gizmos:
            if self._lines is not None:
                self._lines.visible = False
            return
        ends = np.array([[self._points[row], gizmo.position] for row, gizmo in gizmos.items()], np.float32)
        if self._lines is None:
            width = 3e-3 * self._stage.drawing.size
            self._lines = self._stage.server.scene.add_line_segments(
                "/spring_lines", ends, (30, 30, 30), thickness=width
            )
            return
        self._lines.points, self._lines.visible = ends, True


class Grips:
    """Gizmos of the grips of a model, at the supported nodes or the pivot.

    Args:
        stage: The stage.
        model: The model.
    """

    def __init__(self, stage: Stage, model):
        self._pivots = np.array([grip.pivot for grip in model.grips]).reshape(-1, 3)
        self._centers = np.array([_center(model, grip) for grip in model.grips]).reshape(-1, 3)
        planar = model.scene.dimension == 2
        self._gizmos = [
            stage.server.scene.add_transform_controls(
                f"/grips/{k}",
                scale=GIZMO * stage.drawing.size,
                position=center,
                active_axes=(True, not planar, True),
                disable_rotations=planar,
                depth_test=False,
            )
            for k, center in enumerate(self._centers)
        ]

    def poses(self) -> np.ndarray:
        """Return the pose of every grip (grips, 6): translation [m] and rotation vector [rad]."""
        from scipy.spatial.transform import Rotation

        result = np.zeros((len(self._gizmos), 6))
        for k, gizmo in enumerate(self._gizmos):
            rotation = Rotation.from_quat(np.roll(gizmo.wxyz, -1))
            pivot, arm = self._pivots[k], self._centers[k] - self._pivots[k]
            result[k] = np.concatenate([np.asarray(gizmo.position) - pivot - rotation.apply(arm), rotation.as_rotvec()])
        return result

    def reset(self) -> None:
        """Move the gizmos to the grips at rest."""
        for gizmo, center in zip(self._gizmos, self._centers, strict=True):
            gizmo.position, gizmo.wxyz = center, (1.0, 0.0, 0.0, 0.0)


def _center(model, grip) -> np.ndarray:
    """Return the mean position at rest of the nodes of a grip [m]; the pivot without nodes of rods and shells."""
    curves, points = model.curves, model.state().points().reshape(-1, 3)
    starts = np.cumsum(curves.counts) - curves.counts
    rows: list[np.ndarray] = []
    for support in model.scene.supports:
        if support.motion is grip:
            nodes = np.array(
                [*support.nodes, *support.edges, *({"first": [0], "last": [-1]}.get(support.end, []))], int
            )
            rows += [starts[rod] + nodes % curves.counts[rod] for rod in support.rods]
    return points[np.unique(np.concatenate(rows))].mean(0) if rows else np.array(grip.pivot)
