"""Elements of magnetised rod edges in the applied field, and dipole pairs."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.compile.coupled.system import CoupledRod, CoupledSet, CoupledSystem
from ddg_warp.errors import SceneError
from ddg_warp.kernels.terms import MAGNETS
from ddg_warp.scene.descriptions import Dynamics


@dataclass(frozen=True)
class _Magnets:
    """Magnetised edges of a rod.

    Attributes:
        k: edges of the rod (E,).
        ends: dof blocks of both nodes (2, E).
        volume: (E,) [m^3].
        direction, size: unit vector (3, E) in the material frame and size (E,) [A/m] of the magnetisation.
    """

    rod: CoupledRod
    k: np.ndarray
    ends: np.ndarray
    volume: np.ndarray
    direction: np.ndarray
    size: np.ndarray

    @property
    def along(self) -> bool:
        """True if all edges are magnetised along the tangent, so that frames do not matter."""
        return not self.direction[:2].any()

    @property
    def angles(self) -> np.ndarray:
        return self.rod.edges[self.k]

    @property
    def owner(self) -> np.ndarray:
        return np.array([np.full(len(self.k), self.rod.rod), self.k + self.rod.first])


def magnet_sets(scene, coupled: CoupledSystem) -> list[CoupledSet]:
    """Return the elements of magnetised edges in the applied field, and of dipole pairs."""
    magnets = [edges for rod in coupled.rods if len((edges := _magnets(scene, coupled, rod)).k)]
    sets = _pairs(scene, coupled, magnets) if scene.dipoles else []
    if scene.applied_field is None:
        return sets
    # an initial state is at the start of the run, where loads of statics are zero
    field = scene.applied_field.at(0.0, float(isinstance(scene.analysis, Dynamics)), SceneError)
    for magnet in magnets:
        term = MAGNETS["magnetic_tangent" if magnet.along else "magnetic"]
        blocks = magnet.ends if magnet.along else np.concatenate([magnet.ends, magnet.angles[None]])
        data = np.concatenate([magnet.direction, np.repeat(field[:, None], len(magnet.k), axis=1)])
        values = term.bind(measure=magnet.volume, magnetisation=magnet.size)
        sets.append(CoupledSet(term, blocks, np.zeros((0, len(magnet.k))), data, values, magnet.owner))
    return sets


def _magnets(scene, coupled: CoupledSystem, rod: CoupledRod) -> _Magnets:
    batch = rod.piece.batch
    total = np.zeros((batch.edges, 3))
    for magnet in scene.magnets:
        if rod.rod in magnet.rods:
            total[magnet.edges] += magnet.magnetisation
    size = np.linalg.norm(total, axis=1)
    k = np.flatnonzero(size)
    ends = np.stack([rod.nodes[k], np.roll(rod.nodes, -1)[k]])
    area = np.broadcast_to(np.asarray(batch.section.area, float), (batch.rods, batch.edges))[rod.rod - batch.first, k]
    length = np.linalg.norm(coupled.rest[ends[1]] - coupled.rest[ends[0]], axis=1)
    return _Magnets(rod, k, ends, area * length, (total[k] / size[k, None]).T, size[k])


def _pairs(scene, coupled: CoupledSystem, magnets: list[_Magnets]) -> list[CoupledSet]:
    """Return the elements of all listed pairs of magnetised edges."""
    from scipy.spatial import cKDTree

    def joined(attribute):
        return np.concatenate([getattr(magnet, attribute) for magnet in magnets], axis=-1)

    ends, owner, volume, direction, size = map(joined, ("ends", "owner", "volume", "direction", "size"))
    counts = [len(magnet.k) for magnet in magnets]
    along = np.repeat([m.along for m in magnets], counts)
    framed = np.repeat([m.rod.edges.size > 0 for m in magnets], counts)
    angle = np.concatenate([m.angles if m.rod.edges.size else np.zeros(len(m.k), int) for m in magnets])
    middle, pairs = coupled.rest[ends].mean(0), []
    for listed in scene.dipoles:
        chosen = np.arange(len(angle)) if listed.rods is None else np.flatnonzero(np.isin(owner[0], listed.rods))
        cutoff = min(listed.cutoff, 2.0 * np.ptp(middle, axis=0).max())
        pairs.append(chosen[cKDTree(middle[chosen]).query_pairs(cutoff, output_type="ndarray")])
    a, b = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0).T
    disjoint = (ends[:, None, a] != ends[None, :, b]).all((0, 1))
    a, b = a[disjoint], b[disjoint]
    if not a.size:
        raise SceneError("add_dipoles: no two magnetised edges are within the cutoff of each other; take a larger one")
    for i in np.flatnonzero(np.linalg.norm(middle[a] - middle[b], axis=1) <= 1e-9 * np.abs(middle).max())[:1]:
        names = " and ".join("edge {1} of rod {0}".format(*owner[:, magnet_index]) for magnet_index in (a[i], b[i]))
        raise SceneError(f"add_dipoles: {names} have their middles at one point, where dipoles attract without bound")
    along, framed = along[a] & along[b], framed[a] & framed[b]
    for i in np.flatnonzero(~along & ~framed)[:1]:
        raise SceneError(
            f"add_dipoles: of rods {owner[0, a[i]]} and {owner[0, b[i]]} one is magnetised across its tangent and one has no twist; "
            "give both twist=True"
        )
    sets = []
    for name, chosen in (("dipoles_tangent", along), ("dipoles", ~along)):
        i, j, term = a[chosen], b[chosen], MAGNETS[name]
        blocks = np.concatenate(
            [ends[:, i], ends[:, j], *([] if name == "dipoles_tangent" else [angle[None, i], angle[None, j]])]
        )
        values = term.bind(measure=volume[i] * volume[j], magnetisation=[size[i], size[j]])
        data = np.concatenate([direction[:, i], direction[:, j]])
        sets.append(CoupledSet(term, blocks, np.zeros((0, len(i))), data, values, owner[:, i]))
    return sets
