"""Elements of one term on arbitrary nodes, for assembly in the coupled system."""

from dataclasses import dataclass, field

import numpy as np

from ddg_warp.kernels.terms import Term


@dataclass(frozen=True)
class ElementSet:
    """Element set of one term, on the host.

    Attributes:
        term: measure and density.
        nodes: node of each local node index (E, n) int.
        angles: angle of each local angle index (E, a) int, in a numbering of the caller; of a surface, its edges.
        data: constant data, the argument s of the measure (E, d) float.
        parameters: parameters by name, as from `Term.bind`, each broadcastable to (E,).
        normals: (element, first of three columns of data, mesh edge) of every normal in the data that a support of that edge
            prescribes (n, 3) int.
    """

    term: Term
    nodes: np.ndarray
    angles: np.ndarray
    data: np.ndarray
    parameters: dict[str, np.ndarray]
    normals: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), int))

    def __post_init__(self):
        measure = self.term.measure
        count = len(self.nodes)
        expected = {"nodes": measure.nodes, "angles": measure.angles, "data": measure.data_size}
        for name, size in expected.items():
            if getattr(self, name).shape != (count, size):
                raise ValueError(f"{self.term.name}: {name} {getattr(self, name).shape}; it takes {(count, size)}")
        if tuple(self.parameters) != self.term.parameter_names:
            raise ValueError(
                f"{self.term.name}: parameters {list(self.parameters)}; it takes {self.term.parameter_names}"
            )
        for name, values in self.parameters.items():
            if np.shape(values) not in ((), (1,), (count,)):
                raise ValueError(f"{self.term.name}: {name} has shape {np.shape(values)}; one number or {count}")

    def __len__(self) -> int:
        return len(self.nodes)
