"""State: positions, velocities, frames and history written by a step."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import warp as wp

from ddg_warp import argument_checks
from ddg_warp import device_arrays as arrays
from ddg_warp.capture_lock import launches
from ddg_warp.errors import SceneError
from ddg_warp.geometry import polyline
from ddg_warp.model.rigid_bodies import BodyState, body_rates, body_state, body_states
from ddg_warp.scene.descriptions import Dynamics
from ddg_warp.scene.handle import BODY, OBSTACLE, Handle, named
from ddg_warp.typing import Array, Bools, Device, Floats, Names

if TYPE_CHECKING:
    from ddg_warp.model.coupled_model import CoupledState
    from ddg_warp.model.model import Model

Snapshot: TypeAlias = dict[str, Array]  # name -> array

EQUILIBRIUM = ("stable", "outcome", "unbalanced", "sliding")  # set by static solvers
VELOCITIES = ("v", "omega", "a", "alpha", "momentum")


@dataclass
class RodGroupState:
    """Device arrays of one rod group with n nodes and R rods.

    Attributes:
        x, v: position [m] and velocity [m/s] of nodes, vectors (n, R).
        theta, omega: twist angle [rad] and rate [rad/s] of edges (n, R); empty without twist.
        frame: time-lagged reference frames (7, n, R): first director, tangent, reference twist; empty without twist.
        last: strains at this state (strains, n, R); empty without strain-rate damping.
        a: correction of the last solve to its predictor over the squared step (n, R) [m/s^2], for the warm start. Zero without a
            last solve. With the midpoint rule, massless nodes have accelerations from mean velocities of two steps.
        alpha: correction of twist angles likewise (n, R) [rad/s^2]; empty without twist.
    """

    x: wp.array
    v: wp.array
    theta: wp.array
    omega: wp.array
    frame: wp.array
    last: wp.array
    a: wp.array
    alpha: wp.array

    def arrays(self) -> dict[str, wp.array]:
        """Return all arrays by name."""
        return dict(self.__dict__)


@dataclass
class GripState:
    """Device arrays of the grips (kinematic supports) of a model.

    Attributes:
        pose: translation (3) [m] and rotation vector (3) [rad] relative to rest (6, worlds grips).
    """

    pose: wp.array

    def arrays(self) -> dict[str, wp.array]:
        """Return all arrays by name."""
        return dict(self.__dict__)


@dataclass(frozen=True)
class Sliding:
    """Load step that led to an equilibrium with friction.

    Attributes:
        velocity: displacement of dof blocks (W N,) in this load step, per load parameter.
        increment: increment of the load parameter, positive.
    """

    velocity: wp.array
    increment: float

    def begun(self, q: wp.array) -> wp.array:
        """Return dof blocks (W N,) of the previous equilibrium, the origin of slip, from blocks q."""
        return wp.array(q.numpy() - self.increment * self.velocity.numpy(), dtype=q.dtype, device=q.device)


@argument_checks.sealed
@launches
class State:
    """Positions, velocities, frames and time of a model's rods and shells. A step returns another state and does not change this one.

    A state does not change as long as it, or one of its arrays, is referenced. Memory of unreferenced states is reused: a loop that
    keeps none needs the memory of two. A state that is kept takes a copy of its arrays. Keep states, not bare arrays
    (`state.groups[0].x`, or a view): these pin their memory, and steps are captured again.

    Attributes:
        time: [s], common to all worlds.
        grips: poses of the grips of all worlds; None without, see `Grip`.
        stable: whether an equilibrium of a static solver is stable; None where this was not tested, as in dynamics, or is below
            rounding. See `Equilibrium.solve`.
        outcome: "converged" or "converged_to_rounding" for an equilibrium; None for other states.
        unbalanced: loads of an equilibrium that supports and obstacles do not carry, over the loads; None for other states.
            With several worlds `stable`, `outcome` and `unbalanced` are arrays (worlds,).
        sliding: the `Sliding` that determines friction in an equilibrium; None where friction acts by the velocities of the state.
        spun: whether spins were given to this state or an earlier one; see `Integrator`, gyroscopic.
        lead: half the last step if by the midpoint rule [s], else zero. Velocities of massless dofs are means over that step, and the
            state is later by `lead`.
    """

    def __init__(
        self,
        model: "Model",
        groups: list[RodGroupState],
        coupled: "CoupledState | None" = None,
        time: float = 0.0,
        grips: GripState | None = None,
    ):
        self.stable: bool | Bools | None = None
        self.outcome: str | Names | None = None
        self.unbalanced: float | Floats | None = None
        self.sliding: Sliding | None = None
        self.model = model
        self.groups = groups
        self.coupled = coupled
        self.grips = grips
        self.time = time
        self.spun = False
        self.lead = 0.0

    def __reduce__(self):
        """Have pickle and torch.save keep the arrays, and the model once for all states saved together."""
        return State._loaded, (self.model, self.snapshot(), self._metadata())

    def __copy__(self) -> "State":
        return self.copy()

    def __deepcopy__(self, memo) -> "State":
        """Return a copy of the same model, or of the model's copy in `memo`."""
        model = memo.get(id(self.model), self.model)
        return self.copy() if model is self.model else State._loaded(model, self.snapshot(), self._metadata())

    def _metadata(self) -> dict:
        """Return the attributes that a pickle keeps in addition to `snapshot`."""
        attributes = {name: getattr(self, name) for name in (*EQUILIBRIUM, "lead")}
        if self.sliding is not None:
            attributes["sliding"] = self.sliding.velocity.numpy().copy(), self.sliding.increment
        return attributes

    @staticmethod
    def _loaded(model, snapshot: dict, attributes: dict) -> "State":
        state = model.restore(snapshot)
        if attributes["sliding"] is not None:
            velocity, increment = attributes["sliding"]
            attributes = attributes | {
                "sliding": Sliding(
                    wp.array(velocity, dtype=state.coupled.v.dtype, device=state.coupled.v.device), increment
                )
            }
        vars(state).update(attributes)
        return state

    def __repr__(self) -> str:
        model = self.model
        static = self.outcome is not None or not isinstance(model.scene.analysis, Dynamics)
        reached = f"load parameter {self.time:g}" if static else f"t = {self.time:g} s"
        number = argument_checks.number_of
        size = f"{number(model.worlds, 'world')} of {number(model.points_count, 'point')}"
        return f"<State at {reached}: {size} on {model.device}>"

    def to(self, device: Device) -> "State":
        """Return the state itself, on the device of the model.

        Raises:
            SceneError: another device is given; the message has the calls that copy the state.
        """
        if arrays.device_named(str(device)) != self.model.wp_device:
            raise SceneError(
                f"a state lives with its model, on {self.model.device}; copy both: model = state.model.to({str(device)!r}), "
                "state = model.restore(state.snapshot())"
            )
        return self

    def parts(self) -> "dict[str, RodGroupState | CoupledState | GripState]":
        """Return the states of rod groups, the coupled system and grips, by name."""
        single = {"net": self.coupled, "grips": self.grips}
        groups = {str(i): group for i, group in enumerate(self.groups)}
        return groups | {name: part for name, part in single.items() if part is not None}

    def arrays(self) -> dict[str, wp.array]:
        """Return device arrays by "part/name", in storage order; see `RodGroupState`.

        Other libraries read them without a copy, by DLPack: `torch.from_dlpack(state.arrays()["0/x"])`.
        """
        return {
            f"{part}/{name}": array
            for part, of_part in self.parts().items()
            for name, array in of_part.arrays().items()
        }

    @property
    def slip_velocity(self) -> wp.array:
        """Slip velocities of dof blocks (W N,) for friction, at rotations of rigid bodies their angular velocities."""
        if self.sliding is not None:
            return self.sliding.velocity
        return body_rates(self) if self.model.scene.bodies else self.coupled.v

    def points(self, item: int | str | Sequence[int] | None = None) -> Floats:
        """Return positions (P, 3) or (worlds, P, 3) [m]: nodes in the order of `model.curves`, then vertices.

        Args:
            item: name or handle of a rod, shell or obstacle, or index of a rod. Or several rods of equal node count, which give
                (R, n, 3). By default all rods and shells.
        """
        return self._of_nodes(item, [group.x for group in self.groups], self.coupled and self.coupled.q)

    def velocities(self, item: int | str | Sequence[int] | None = None) -> Floats:
        """Return velocities of nodes [m/s], ordered and chosen as in `points`."""
        return self._of_nodes(item, [group.v for group in self.groups], self.coupled and self.coupled.v)

    def _of_nodes(self, item, groups: list[wp.array], blocks: wp.array | None) -> np.ndarray:
        order = self.model.order
        item = order.find(item) if isinstance(item, str) else item
        if isinstance(item, Handle) and item.kind == OBSTACLE:
            nodes = self.model.coupled.host.obstacles[order.handle(OBSTACLE, item)]
            values = blocks.numpy().astype(float).reshape(self.model.worlds, -1, 3)[:, nodes]
            return values[0] if self.model.worlds == 1 else values
        values = order.nodes([group.numpy() for group in groups], blocks)
        return values if item is None else order.nodes_of(item, values)

    def obstacle_points(self) -> Floats:
        """Return positions of nodes of moving obstacles, then of shapes of rigid bodies, (M, 3) or (worlds, M, 3) [m].

        See `Model.obstacles`.
        """
        model = self.model
        values = [np.zeros((model.worlds, 0, 3))]
        if model.scene.obstacles:
            nodes = np.concatenate(
                [
                    nodes
                    for nodes, obstacle in zip(model.coupled.host.obstacles, model.scene.obstacles, strict=True)
                    if obstacle.motion is not None
                ]
                or [np.zeros(0, int)]
            )
            values.append(self.coupled.q.numpy().astype(float).reshape(model.worlds, -1, 3)[:, nodes])
        if model.bodies:
            poses = self.body_poses().reshape(model.worlds, -1, 3, 4)
            values.append(model.rigid_bodies.nodes(model.obstacles, poses))
        result = np.concatenate(values, axis=1)
        return result[0] if model.worlds == 1 else result

    def tangents(self, item: int | str | Sequence[int] | None = None) -> Floats:
        """Return unit tangents of edges (edges, 3) or (worlds, edges, 3), of all rods, or of rods chosen as in `points`."""
        order, points = self.model.order, self.points()
        edges = []
        for curve, closed in enumerate(order.curves.closed):
            nodes = points[..., order.node_starts[curve] : order.node_starts[curve + 1], :]
            edges.append(np.diff(nodes, axis=-2, append=nodes[..., :1, :] if closed else nodes[..., :0, :]))
        edges = np.concatenate(edges, axis=-2) if edges else points[..., :0, :]
        tangents = edges / np.linalg.norm(edges, axis=-1, keepdims=True)
        return tangents if item is None else order.edges_of(item, tangents, 3)

    def angles(self, item: int | str | Sequence[int] | None = None) -> Floats | None:
        """Return twist angles of edges (edges,) or (worlds, edges) [rad]; None if no rod has twist.

        Args:
            item: rods chosen as in `points`.
        """
        model = self.model
        coupled = None
        if model.coupled is not None and model.coupled.edges:
            coupled = self.coupled.q.numpy().reshape(model.worlds, -1, 3)[:, model.coupled.angle_start :, 0]
        result = model.order.edges([data.theta.numpy() for data in self.groups], coupled)
        return result if item is None or result is None else model.order.edges_of(item, result)

    def directors(self, item: int | str | Sequence[int] | None = None) -> Floats | None:
        """Return the first material director of edges (edges, 3) or (worlds, edges, 3); None without twist.

        Args:
            item: rods chosen as in `points`.
        """
        model = self.model
        values, coupled = [], None
        if model.coupled is not None and model.coupled.edges:
            frame = np.moveaxis(self.coupled.frame.numpy().reshape(6, model.worlds, -1), 0, -1)
            angle = self.coupled.q.numpy().reshape(model.worlds, -1, 3)[:, model.coupled.angle_start :][
                :, : model.coupled.edges, 0
            ]
            u, t = frame[..., :3], frame[..., 3:]
            coupled = polyline.material_directors(u, t, angle)
        for group, data in zip(model.groups, self.groups, strict=True):
            if not group.kind.twist:
                values.append(np.zeros(0))
                continue
            frame, theta = arrays.download(data.frame), arrays.download(data.theta)
            u, t = np.moveaxis(frame[0:3], 0, -1), np.moveaxis(frame[3:6], 0, -1)
            values.append(polyline.material_directors(u, t, theta))
        result = model.order.edges(values, coupled, 3)
        return result if item is None or result is None else model.order.edges_of(item, result, 3)

    def body(self, item: int | str) -> BodyState:
        """Return pose and rates of a rigid body.

        Args:
            item: name, index or handle of the body.
        """
        return body_state(self, named(BODY, item, self.model.bodies))

    def body_poses(self) -> Floats:
        """Return rotation and position of all rigid bodies, [R | x], (bodies, 3, 4) or (worlds, bodies, 3, 4); see `BodyState`."""
        poses = body_states(self)
        values = np.concatenate([poses.rotation, poses.position[..., None]], axis=-1)
        return values[0] if self.model.worlds == 1 else values

    def poses(self) -> Floats | None:
        """Return poses of grips (grips, 6) or (worlds, grips, 6) in the order of `model.grips`; None without."""
        if self.grips is None:
            return None
        values = self.grips.pose.numpy().T.reshape(self.model.worlds, -1, 6)
        return values[0] if self.model.worlds == 1 else values

    def copy(self) -> "State":
        """Return an independent copy."""
        result = self.model.empty_state()
        result.assign(self)
        for name in EQUILIBRIUM:
            setattr(result, name, getattr(self, name))
        return result

    def assign(self, other: "State") -> None:
        """Copy arrays and time of another state of the same model."""
        for mine, theirs in zip(self.parts().values(), other.parts().values(), strict=True):
            for array, source in zip(mine.arrays().values(), theirs.arrays().values(), strict=True):
                arrays.copy(array, source)
        self.time, self.lead, self.spun = other.time, other.lead, other.spun
        self.forget_equilibrium()

    def forget_equilibrium(self) -> None:
        """Reset the attributes that static solvers set."""
        for name in EQUILIBRIUM:
            setattr(self, name, None)

    def stop(self) -> None:
        """Zero all velocities and the data of the warm start."""
        self.lead, self.spun = 0.0, False
        for part in self.parts().values():
            for name, array in part.arrays().items():
                if name in VELOCITIES:
                    array.zero_()

    def snapshot(self) -> Snapshot:
        """Return the data for a bitwise restart, by name."""
        spun = {"spun": np.bool_(True)} if self.spun else {}
        values = {name: arrays.download(array) for name, array in self.arrays().items()}
        return {"time": np.float64(self.time)} | spun | values


def check_state(call: str, model, state) -> None:
    """Raise SceneError if an argument is no state of the model."""
    if not isinstance(state, State):
        raise SceneError(
            f"{call}: the state is {argument_checks.shown(state)}; give one of this model, such as model.state()"
        )
    if state.model is not model:
        raise SceneError(f"{call}: the state is of another model; give one that this model made, such as model.state()")


def query(call: str, model, state) -> None:
    """Refuse an argument that is no state of the model, and set the fields of the model to the time of the state."""
    check_state(call, model, state)
    model.fields.to(state.time)
    model.drives.to(state.time, 1.0 if state.outcome is None else state.time)
