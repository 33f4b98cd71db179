"""State: what a step writes."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp import arguments, arrays
from ddg_warp.geometry import polyline
from ddg_warp.threads import launches

EQUILIBRIUM = ("stable", "outcome", "unbalanced", "sliding")  # what solvers tell of equilibria
VELOCITIES = ("v", "omega", "a", "alpha")


@dataclass
class GroupState:
    """Device arrays of one group of rods; n nodes, R rods.

    Attributes:
        x, v: position [m] and velocity [m/s] of nodes, vectors (n, R).
        theta, omega: angle [rad] and its rate [rad/s] of edges (n, R); empty without twist.
        frame: lagged reference frames (7, n, R): first director, tangent, reference twist; empty without twist.
        last: strains at this state (strains, n, R); empty without strain-rate damping.
        a, alpha: what the last solve added to its predictor, over the square of its step (n, R), [m/s^2] and [rad/s^2]; the next one
            starts from where they lead. Zero where there was none; alpha is empty without twist. By the midpoint rule accelerations of
            what has drag and no mass, by its mean velocities in the last two steps.
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
        """All arrays by name."""
        return dict(self.__dict__)


@dataclass
class GripState:
    """Where the grips of a model are.

    Attributes:
        pose: translation (3) [m] and rotation vector (3) [rad] of each, relative to rest (6, worlds grips).
    """

    pose: wp.array

    def arrays(self) -> dict[str, wp.array]:
        """All arrays by name."""
        return dict(self.__dict__)


@dataclass(frozen=True)
class Sliding:
    """The way to an equilibrium with friction from the one before.

    Attributes:
        velocity: of the blocks of the net (W N,) on that way, by load parameter.
        increment: of the load parameter, positive.
    """

    velocity: wp.array
    increment: float

    def begun(self, q: wp.array) -> wp.array:
        """Blocks (W N,) of the equilibrium before, from which slips count, of an equilibrium with blocks q."""
        return wp.array(q.numpy() - self.increment * self.velocity.numpy(), dtype=q.dtype, device=q.device)


@arguments.sealed
@launches
class State:
    """Positions, velocities, frames and time of a model's rods and shells. A step returns another state and does not change this one.

    A state stays as it is for as long as something refers to it, or to a part or an array of it. Memory of states that nothing refers
    to is written again, so that a loop which keeps none needs that of two. A state kept takes a copy of its arrays with it. Who keeps
    bare arrays of a state that it let go (`state.groups[0].x`, or a view of them) keeps their memory, and steps are captured
    anew: rather keep the state.

    Attributes:
        time: [s], which all worlds share.
        grips: poses of the grips of all worlds; None without, see `Grip`.
        stable: of an equilibrium that a static solver found, whether it is stable; None where that was not asked, as in dynamics, or
            rounding hides it. See `Equilibrium.solve`.
        outcome: of an equilibrium, "converged" or "converged_to_rounding"; None of other states.
        unbalanced: of an equilibrium, what of the loads supports and obstacles do not carry, over the loads; None of other states.
            With several worlds these three are arrays (worlds,).
        sliding: of an equilibrium with friction, the `Sliding` by which that acts, though the state is at rest; None where it acts by
            the velocities of the state.
        spun: whether it was given spins, or comes from a state that was; see `Integrator`, gyroscopic.
        lead: half the last step where that was one of the midpoint rule [s], else zero. By so much the state is later than velocities
            of what has no mass, which are means over that step.
    """

    def __init__(self, model, groups: list[GroupState], net=None, time: float = 0.0, grips: GripState | None = None):
        self.stable: bool | np.ndarray | None = None
        self.outcome: str | np.ndarray | None = None
        self.unbalanced: float | np.ndarray | None = None
        self.sliding: Sliding | None = None
        self.model = model
        self.groups = groups
        self.net = net
        self.grips = grips
        self.time = time
        self.spun = False
        self.lead = 0.0

    def __reduce__(self):
        """Have pickle and torch.save keep the arrays, and the model of these, once for all states that are saved together."""
        return State._loaded, (self.model, self.snapshot(), self._told())

    def __copy__(self) -> "State":
        return self.copy()

    def __deepcopy__(self, memo) -> "State":
        """Return a copy, of the same model unless that was copied before."""
        model = memo.get(id(self.model), self.model)
        return self.copy() if model is self.model else State._loaded(model, self.snapshot(), self._told())

    def _told(self) -> dict:
        """What a state says beside its `snapshot`, as a pickle holds it."""
        told = {name: getattr(self, name) for name in (*EQUILIBRIUM, "lead")}
        if self.sliding is not None:
            told["sliding"] = self.sliding.velocity.numpy().copy(), self.sliding.increment
        return told

    @staticmethod
    def _loaded(model, snapshot: dict, told: dict) -> "State":
        state = model.restore(snapshot)
        if told["sliding"] is not None:
            velocity, increment = told["sliding"]
            told = told | {
                "sliding": Sliding(wp.array(velocity, dtype=state.net.v.dtype, device=state.net.v.device), increment)
            }
        vars(state).update(told)
        return state

    def __repr__(self) -> str:
        model = self.model
        return f"<State at t = {self.time:g} s: {model.worlds} worlds of {model.points_count} points on {model.device}>"

    def parts(self) -> dict:
        """State of every group of rods, and of the net and of the grips if there are any, by name."""
        others = {"net": self.net, "grips": self.grips}
        groups = {str(i): group for i, group in enumerate(self.groups)}
        return groups | {name: part for name, part in others.items() if part is not None}

    def arrays(self) -> dict[str, wp.array]:
        """Device arrays "part/name" as they are stored, see `GroupState`; each goes to other libraries without a copy, by DLPack:
        `torch.from_dlpack(state.arrays()["0/x"])`."""
        return {f"{part}/{name}": array for part, own in self.parts().items() for name, array in own.arrays().items()}

    @property
    def rubbing(self) -> wp.array:
        """Velocities of the blocks of the net (W N,) by which friction acts."""
        return self.net.v if self.sliding is None else self.sliding.velocity

    def points(self) -> np.ndarray:
        """Positions (P, 3) [m], or (worlds, P, 3): nodes in the order of `model.curves` (rods, meridians), then vertices."""
        return self.model.order.nodes([arrays.download(group.x) for group in self.groups], self.net and self.net.q)

    def velocities(self) -> np.ndarray:
        """Velocities of nodes, ordered as `points` [m/s]."""
        return self.model.order.nodes([arrays.download(group.v) for group in self.groups], self.net and self.net.v)

    def obstacle_points(self) -> np.ndarray:
        """Positions of the nodes of obstacles that something moves (M, 3) or (worlds, M, 3) [m], see `Model.obstacles`."""
        model = self.model
        if model.obstacles is None:
            return np.zeros((0, 3) if model.worlds == 1 else (model.worlds, 0, 3))
        nodes = np.concatenate(model.net.host.obstacles)[model.obstacles.moving]
        values = self.net.q.numpy().astype(float).reshape(model.worlds, -1, 3)[:, nodes]
        return values[0] if model.worlds == 1 else values

    def angles(self) -> np.ndarray | None:
        """Angles theta of edges [rad] (edges,) or (worlds, edges); None if no rod has twist."""
        model = self.model
        net = None
        if model.net is not None and model.net.edges:
            net = self.net.q.numpy().reshape(model.worlds, -1, 3)[:, model.net.angle_start :, 0]
        return model.order.edges([arrays.download(data.theta) for data in self.groups], net)

    def directors(self) -> np.ndarray | None:
        """First material director of every edge (edges, 3) or (worlds, edges, 3); None if no rod has twist."""
        model = self.model
        values, net = [], None
        if model.net is not None and model.net.edges:
            frame = np.moveaxis(self.net.frame.numpy().reshape(6, model.worlds, -1), 0, -1)
            angle = self.net.q.numpy().reshape(model.worlds, -1, 3)[:, model.net.angle_start :][:, : model.net.edges, 0]
            u, t = frame[..., :3], frame[..., 3:]
            net = polyline.material_directors(u, t, angle)
        for group, data in zip(model.groups, self.groups, strict=True):
            if not group.kind.twist:
                values.append(np.zeros(0))
                continue
            frame, theta = arrays.download(data.frame), arrays.download(data.theta)
            u, t = np.moveaxis(frame[0:3], 0, -1), np.moveaxis(frame[3:6], 0, -1)
            values.append(polyline.material_directors(u, t, theta))
        return model.order.edges(values, net, 3)

    def poses(self) -> np.ndarray | None:
        """Poses of the grips, in the order of `model.grips` (grips, 6) or (worlds, grips, 6): see `Grip`; None without."""
        if self.grips is None:
            return None
        values = self.grips.pose.numpy().T.reshape(self.model.worlds, -1, 6)
        return values[0] if self.model.worlds == 1 else values

    def copy(self) -> "State":
        """An independent copy."""
        other = self.model.empty_state()
        other.assign(self)
        for name in EQUILIBRIUM:
            setattr(other, name, getattr(self, name))
        return other

    def assign(self, other: "State") -> None:
        """Take over everything of another state of the same model."""
        for mine, theirs in zip(self.parts().values(), other.parts().values(), strict=True):
            for array, source in zip(mine.arrays().values(), theirs.arrays().values(), strict=True):
                arrays.copy(array, source)
        self.time, self.lead, self.spun = other.time, other.lead, other.spun
        self.forget_equilibrium()

    def forget_equilibrium(self) -> None:
        """Take this for a state of which no solver has found that it is an equilibrium."""
        for name in EQUILIBRIUM:
            setattr(self, name, None)

    def stop(self) -> None:
        """Set all velocities to zero, and what the next step would go on from."""
        self.lead, self.spun = 0.0, False
        for part in self.parts().values():
            for name, array in part.arrays().items():
                if name in VELOCITIES:
                    array.zero_()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything a bitwise restart needs."""
        spun = {"spun": np.bool_(True)} if self.spun else {}
        own = {name: arrays.download(array) for name, array in self.arrays().items()}
        return {"time": np.float64(self.time)} | spun | own
