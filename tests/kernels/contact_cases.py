"""What the tests of contact share: a thousand pairs at random, near-parallel or touching, as samples of the derivative table."""

import numpy as np
import warp as wp

from ddg_warp.kernels.net.frames import lag_kernel
from ddg_warp.kernels.terms import ALL
from ddg_warp.run.element_samples import Elements

COUNT = 1000
RIGHT = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class Pairs(Elements):
    """A thousand elements of a term of contact; each change of a dof is seen by one."""

    COUNT = COUNT
    STEP = 1e-5

    @property
    def nodes(self) -> np.ndarray:
        """Positions (nodes, COUNT, 3)."""
        return self.data["q"].reshape(-1, COUNT, 3)

    def at(self, nodes: np.ndarray) -> "Pairs":
        """These with other positions."""
        return self.like({**self.data, "q": np.ascontiguousarray(nodes).reshape(-1, 3)})

    def with_parameters(self, **values) -> "Pairs":
        """These with other parameters by name: numbers, or one an element."""
        buffer = self.data["buffer"].copy()
        for name, value in values.items():
            buffer[self.term.parameter_names.index(name)] = value
        return self.like({**self.data, "buffer": buffer})

    def touched(self) -> "Pairs":
        """These with the lagged data of where they are."""
        out = wp.zeros((self.measure.lag_size, COUNT), dtype=wp.float64, device=self.device)
        given, moved = self.inputs(wp.float64), wp.full(1, 1, dtype=int, device=self.device)
        kernel = lag_kernel(self.measure, wp.float64, False)
        wp.launch(kernel, COUNT, [given, moved, 1, 0, given.lag], [out], device=self.device)
        return self.like({**self.data, "lag": out.numpy()})


def worst(value: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Largest difference of each element over its largest reference; elements last."""
    axes = tuple(range(value.ndim - 1))
    return np.abs(value - reference).max(axes) / np.abs(reference).max(axes)


def positions(stencil: str, family: str, random: np.random.Generator) -> np.ndarray:
    """Nodes (nodes, COUNT, 3) of pairs about one in size.

    Families: "general", of all regions; "parallel", edges from 3e-3 to 0.03 to each other; "touching", 0.01 to 0.02 apart.
    """
    if stencil == "edge_edge":
        if family != "general":
            angle = (
                10.0 ** random.uniform(-2.5, -1.5, COUNT) if family == "parallel" else random.uniform(0.3, 2.8, COUNT)
            )
            apart = random.uniform(0.01, 0.02, COUNT) if family == "touching" else random.uniform(0.2, 0.4, COUNT)
            e, f = np.zeros((2, COUNT, 3))
            e[:, 0], f[:, 0], f[:, 1] = 1.0, np.cos(angle), np.sin(angle)
            shift = random.uniform(-0.4, 0.4, (COUNT, 1)) * e + random.uniform(-0.4, 0.4, (COUNT, 1)) * f
            shift[:, 2] = apart
            nodes = np.stack([-0.5 * e, 0.5 * e, shift - 0.5 * f, shift + 0.5 * f])
            turn = np.linalg.qr(random.normal(size=(COUNT, 3, 3)))[0]
            return np.einsum("nij,kni->knj", turn, nodes)
        nodes = random.normal(size=(4, COUNT, 3))
        nodes[:2] += [0.5, 0.0, 0.0]
        return nodes
    corners = RIGHT[: 3 if stencil == "point_triangle" else 2, None] + 0.1 * random.normal(size=(1, COUNT, 3))
    if family == "touching":  # above the inside
        share = random.dirichlet(np.full(len(corners), 3.0), COUNT).T
        point = np.einsum("kn,kni->ni", share, corners)
        point[:, 2] += random.uniform(0.01, 0.02, COUNT)
        return np.concatenate([point[None], corners])
    corners += 0.2 * random.normal(size=corners.shape)
    return np.concatenate([random.normal(size=(1, COUNT, 3)) + [0.3, 0.3, 0.3], corners])


def pairs(term: str, family: str, device: str, precision: str = "float64") -> Pairs:
    """A thousand of a term, with parameters such that the gap is a share of the range."""
    random = np.random.default_rng(3)
    sample = Pairs(ALL[term], None, precision, device)
    law, stencil = term.split("_", 1)
    if stencil != "obstacle":
        sample = sample.at(positions(stencil, family, random))
    distance = np.abs(sample.strains()[0][0])
    inside = random.uniform(0.5, 1.2, COUNT) if law == "penalty" else random.uniform(0.2, 0.6, COUNT)
    sample = sample.with_parameters(range=distance * random.uniform(1.0, 2.0, COUNT), thickness=distance * inside)
    if stencil == "edge_edge":
        first, second = (np.diff(ends, axis=0)[0] for ends in np.split(sample.nodes, 2))
        threshold = 1e-3 if family == "parallel" else random.uniform(0.3, 1.5, COUNT)
        sample = sample.with_parameters(threshold=threshold * (first**2).sum(1) * (second**2).sum(1))
    return sample


def closest_by_features(stencil: str, nodes: np.ndarray) -> np.ndarray:
    """Distances (COUNT,): the least of those between all vertices, edges and the inside, where these have a foot."""
    first, second = (nodes[:2], nodes[2:]) if stencil == "edge_edge" else (nodes[:1], nodes[1:])

    def of_lines(points, ends):
        e = ends[1] - ends[0]
        t = ((points - ends[0]) * e).sum(1) / (e**2).sum(1)
        length = np.linalg.norm(points - ends[0] - t[:, None] * e, axis=1)
        return np.where((t > 0.0) & (t < 1.0), length, np.inf)

    found = [np.linalg.norm(a - b, axis=1) for a in first for b in second]
    edges = [second[[i, j]] for i in range(len(second)) for j in range(i)]
    found += [of_lines(point, edge) for point in first for edge in edges]
    if stencil == "edge_edge":
        found += [of_lines(point, first) for point in second]
    if stencil != "point_edge":  # edges that cross, or the inside of a triangle, seen along the normal
        a = first[1] - first[0] if stencil == "edge_edge" else second[2] - second[0]
        b, between = second[1] - second[0], second[0] - first[0]
        normal = np.cross(a, b)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        height = (between * normal).sum(1)
        columns = (a, -b) if stencil == "edge_edge" else (-a, -b)
        shares = np.linalg.solve(np.stack([*columns, normal], -1), between[..., None])[..., :2, 0]
        inside = (shares > 0.0).all(1) & ((shares < 1.0).all(1) if stencil == "edge_edge" else shares.sum(1) < 1.0)
        found.append(np.where(inside, np.abs(height), np.inf))
    return np.min(found, axis=0)
