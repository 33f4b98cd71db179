"""Boundary conditions, masses and loads of rods."""

import numpy as np

from ddg_warp.compile.dof_map import FREE, DofStorage, Held
from ddg_warp.compile.loads import Couple
from ddg_warp.errors import SceneError
from ddg_warp.scene.descriptions import supports_of
from ddg_warp.scene.grip import Grip

STILL = FREE - 1  # pose index of a dof fixed at rest

_NONE = np.zeros(0, int)


def scene_motions(scene) -> list:
    """Return the distinct prescribed motions of a scene, in order of appearance."""
    supports = supports_of(scene)
    return list({id(s.motion): s.motion for s in supports if s.motion is not None}.values())


def pose_starts(motions: list) -> np.ndarray:
    """Return the index of the first pose of every motion. A motion has one pose, or one for each node."""
    return np.cumsum([0, *(motion.count or 1 for motion in motions)])


def add_masses(scene, storage: DofStorage) -> None:
    """Add the point masses of rods."""
    for rods, node, mass in scene.masses:
        _, rows = storage.places.among(rods)
        storage.add_mass(storage.places.node(rows, node), mass)


def load_rods(scene, storage: DofStorage) -> None:
    """Add the loads of rods."""
    places = storage.places
    for load in scene.loads:
        _, rows = places.among(load.rods)
        if load.edge is None:
            storage.add_load(places.node(rows, load.node), load.force, load.amplitude)
        elif load.moment:
            storage.add_load(places.edge(rows, load.edge)[0][0][:, 2], (load.moment, 0.0, 0.0), load.amplitude)
        elif any(load.couple):
            edges = ((edge, length) for edge, length in places.edge(rows, load.edge) if len(edge))
            storage.followers += [Couple(*edge, np.array(load.couple), load.amplitude) for edge in edges]


def fix_rods(scene, storage: DofStorage, claims: "ConstraintRegistry") -> None:
    """Fix the dofs that supports of rods name."""
    places = storage.places
    for support in scene.supports:
        positions, rows = places.among(support.rods)
        nodes = [places.node(rows, node) for node in support.nodes]
        angles = [places.edge(rows, edge)[0][0][:, 2] for edge in support.edges]
        if support.end:
            last, twisted = support.end == "last", rows[places.twist[rows]]
            nodes += [places.nodes(rows, k) for k in ((places.own[rows] - 1, places.own[rows]) if last else (0, -1))]
            angles.append(places.angles(twisted, places.own[twisted] - 1 if last else -1))
        twisted_owners = np.tile(positions[places.twist[rows]], len(angles))
        owners = np.tile(positions, len(nodes))
        nth = owners * len(support.nodes) + np.repeat(np.arange(len(nodes)), len(positions))
        angles = np.concatenate([_NONE, *angles])
        claims.take(support, np.concatenate([_NONE, *nodes]), nth, owners, angles, twisted_owners)


class ConstraintRegistry:
    """Assignment of poses to fixed dofs; conflicting poses of a dof are refused.

    A component named by a support that its motion never changes counts as fixed at rest. So a motion about y does not conflict with a
    symmetry plane "y". A motion that changes none of the named components claims all of them.
    """

    def __init__(self, scene, storage: DofStorage):
        self.storage, self.motions = storage, scene_motions(scene)
        self._duration = getattr(scene.analysis, "duration", None) or 1.0
        starts = pose_starts(self.motions)
        self._start = {id(motion): int(start) for motion, start in zip(self.motions, starts, strict=False)}
        self._moved = {}  # (motion, components named) by number of the support
        self._claims = []  # (indices, components, poses, number, owners) of each support

    def take(
        self,
        support,
        nodes: np.ndarray,
        nth: np.ndarray,
        owners: np.ndarray,
        angles: np.ndarray = _NONE,
        angle_owners: np.ndarray = _NONE,
    ) -> None:
        """Fix nodes along the components of a support, and twist angles; `nth` numbers the nodes of the support.

        `owners` are the rods, counted in the support, for which nodes are named: joined rods may each displace a common node, and the
        last counts. `angle_owners` are the rods of angles.
        """
        storage, motion = self.storage, support.motion
        along = [d for d in range(3) if "xyz"[d] in support.components]
        places = np.concatenate([np.tile(nodes, len(along)), angles])
        components = np.concatenate([np.repeat(np.array(along, int), len(nodes)), 0 * angles])
        storage.fix(nodes, along, angles)
        storage.held.append(Held(places, components) if along else Held(nodes, 0 * nodes, support.normal))
        if self.motions:
            poses = np.full(len(places), STILL if motion is None else self._start[id(motion)])
            if motion is not None and motion.by_rod:
                poses += np.concatenate([np.tile(owners, len(along)), angle_owners])
            elif motion is not None and motion.count is not None:
                poses += np.tile(nth, len(along))  # such a motion rotates no edge
            self._moved[len(storage.held)] = motion, along
            stored = np.isin(components, storage.axes)
            owners = np.concatenate([np.tile(owners, len(along)), angles])
            claims = places, components, poses, np.full(len(places), len(storage.held)), owners
            self._claims.append([values[stored] for values in claims])

    def finish(self) -> None:
        """Write the moving nodes and angles to the storage.

        Raises:
            SceneError: two supports prescribe different motions of a dof; names the dof.
        """
        if not self._claims:
            return
        claims = [np.concatenate(values) for values in zip(*self._claims, strict=True)]
        order = np.argsort(3 * claims[0] + claims[1], kind="stable")  # claims of one dof stay in order
        places, components, poses, supports, owners = (values[order] for values in claims)
        dofs, original_poses = 3 * places + components, poses.copy()
        again = np.diff(dofs) == 0
        differ = np.isin(dofs, dofs[1:][again & (np.diff(poses) != 0)]) & (places < self.storage.nodes) & (poses > FREE)
        for support in np.unique(supports[differ]):
            conflicting = differ & (supports == support)
            poses[conflicting] = np.where(self._kept(support)[components[conflicting]], STILL, poses[conflicting])
        shared = (np.diff(supports) == 0) & (np.diff(owners) != 0)
        clash = np.flatnonzero(again & (np.diff(poses) != 0) & ~shared)
        if clash.size:
            first = clash[np.argmin(order[clash + 1])]
            self._refuse(
                places[first], components[first], min(original_poses[first], original_poses[first + 1]) == STILL
            )
        moves = np.append(~again, True) & (poses > FREE)
        places, components, poses = (values[moves] for values in (places, components, poses))
        node = places < self.storage.nodes
        nodes, row = np.unique(places[node], return_inverse=True)
        moving = np.full((len(nodes), 4), FREE)
        moving[:, 0], moving[row, 1 + components[node]] = nodes, poses[node]
        self.storage.moving, self.storage.turning = moving, np.column_stack([places[~node], poses[~node]])

    def _kept(self, support: int) -> np.ndarray:
        """Return the mask of components (3,) that the motion of a support never changes."""
        motion, along = self._moved[support]
        if isinstance(motion, Grip) or motion.count is not None:
            return np.zeros(3, bool)
        moves = motion.moves(self._duration)
        return ~moves & moves[along].any()

    def _refuse(self, index: int, component: int, still: bool) -> None:
        where, axis = self.storage.name(index), f" along {'xyz'[component]}" if index < self.storage.nodes else ""
        if still:
            raise SceneError(
                f"{where} is fixed by one support and moved by another{axis}; leave one of them out, give the moving one "
                "other components, or give both the same motion"
            )
        raise SceneError(f"{where} has two motions{axis}; give it one that does both")
