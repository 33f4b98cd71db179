"""Elements of one term on any nodes: what a net gathers by index."""

from dataclasses import dataclass, field

import numpy as np

from ddg_warp.kernels.terms import Term


@dataclass(frozen=True)
class ElementSet:
    """Elements of one term, on the host.

    Attributes:
        term: measure and density.
        nodes: node of each place in the stencil (E, n) int.
        angles: angle of each place (E, a) int, counted by whoever makes the elements; of a surface, its edges.
        data: constant data as the measure's s (E, d) float.
        parameters: by name, as `Term.bind` gives them, each broadcastable to (E,).
        normals: (element, first of three columns of its data, mesh edge) of every normal among the data that a support of that
            edge gives (n, 3) int.
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
