"""User-defined forces of a scene, on nodes and between all pairs of nodes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.typing import Floats, Integers, Numbers, Selection

WarpFunction: TypeAlias = Callable[[type], object]  # scalar type -> function decorated by `wp.func`
SIGNATURES = {False: ("x", "v", "t", "p"), True: ("d", "p", "q")}


@dataclass(frozen=True, eq=False)
class UserForce:
    """User-defined force on nodes of rods and vertices of shells.

    Attributes:
        name: name in parameters and reports.
        function, potential: real -> Warp function of the force and of its potential; see `UserForces`.
        pairs: True for a force between all pairs of its nodes.
        rods, shells: (index, nodes) of each object on which it acts.
        parameters: values by name, () or (nodes,) of numbers, (3,) or (nodes, 3) of vectors.
    """

    name: str
    function: WarpFunction
    potential: WarpFunction | None
    pairs: bool
    rods: list[tuple[int, Integers]]
    shells: list[tuple[int, Integers]]
    parameters: dict[str, Floats]

    @property
    def count(self) -> int:
        """Number of nodes."""
        return sum(len(nodes) for _, nodes in (*self.rods, *self.shells))

    @property
    def layout(self) -> tuple[tuple[str, int], ...]:
        """Name and number of components, 1 or 3, of each parameter."""
        vectors = {name: values.ndim > 0 and values.shape[-1] == 3 for name, values in self.parameters.items()}
        return tuple((name, 3 if vector else 1) for name, vector in vectors.items())


@dataclass(kw_only=True, repr=False, eq=False)
class UserForces:
    """User-defined forces of a `Scene`."""

    user_forces: list[UserForce] = field(default_factory=list, init=False)

    def add_nodal_force(
        self,
        name: str,
        function: WarpFunction,
        *,
        parameters: Mapping[str, Numbers] | None = None,
        potential: WarpFunction | None = None,
        rods: Selection | None = None,
        nodes: Selection | None = None,
        shells: Selection | None = None,
        vertices: Selection | None = None,
    ) -> None:
        """Add a user-defined force on nodes, evaluated with its derivatives in every iteration of steps and equilibria.

        The force of a node is `function(real)(x, v, t, p)`, a Warp function in the scalar type `real`. Here x is the position [m],
        v the velocity in the step [m/s], zero in equilibria, and t the time or the load parameter. Parameters are attributes of p.
        Derivatives come from automatic differentiation. Rods on which it acts belong to the coupled system.

        Args:
            name: name in parameters and reports; parameters are `name.parameter`.
            function: real -> Warp function with annotated arguments, vectors `wp.types.vector(3, real)`, and `p: typing.Any`.
            parameters: values by name: a number, (nodes,), a vector (3,) or (nodes, 3).
            potential: real -> Warp function of the same arguments, for `Model.energies` [J]. The force is its negative gradient.
            rods, shells: where it acts, by default on all rods and shells added so far. A joint counts once.
            nodes, vertices: nodes of each rod and vertices of each shell, by default all.

        Raises:
            SceneError: a wrong argument, or a function of other arguments; the message names it.
        """
        where = rods, nodes, shells, vertices
        self._add_user_force("add_nodal_force", name, function, False, parameters, potential, *where)

    def add_pair_force(
        self,
        name: str,
        function: WarpFunction,
        *,
        parameters: Mapping[str, Numbers] | None = None,
        potential: WarpFunction | None = None,
        rods: Selection | None = None,
        nodes: Selection | None = None,
        shells: Selection | None = None,
        vertices: Selection | None = None,
    ) -> None:
        """Add a user-defined force between all pairs of nodes, such as gravity or electrostatics.

        The force on a node from another is `function(real)(d, p, q)`, a Warp function in the scalar type `real`. Here d is the vector
        to the other node [m]; parameters of both nodes are attributes of p and q. The force on the other node must be opposite, and
        the derivative by d symmetric, as for forces with a potential of the distance. The cost of an evaluation grows with the square
        of the number of nodes. `potential` is the energy of a pair. Other arguments as in `add_nodal_force`.
        """
        where = rods, nodes, shells, vertices
        self._add_user_force("add_pair_force", name, function, True, parameters, potential, *where)

    def _add_user_force(
        self,
        call,
        name,
        function,
        pairs,
        parameters,
        potential,
        rods,
        nodes,
        shells,
        vertices,
    ) -> None:
        argument_checks.text(f"{call}: name", name)
        if not name.isidentifier() or any(name == force.name for force in self.user_forces):
            raise SceneError(f"{call}: name {name!r} is no new name of letters, digits and _, give one")
        for label, factory in (("function", function), ("potential", potential)):
            if factory is not None or label == "function":
                _check_function(f"{call} {name!r}: {label}", factory, SIGNATURES[pairs])
        if not isinstance(parameters or {}, Mapping) or not all(str(key).isidentifier() for key in parameters or {}):
            raise SceneError(f"{call} {name!r}: parameters = {parameters!r}; give a dictionary from names to values")
        everything = rods is None and shells is None
        rods = np.arange(self.rod_count) if everything else [] if rods is None else self._rods(rods)
        shells = (
            range(len(self.shells))
            if everything
            else []
            if shells is None
            else argument_checks.indices("shells", shells)
        )
        places = []
        for rod in argument_checks.once(f"{call}: rods", np.asarray(rods, int)).tolist():
            chosen = self._on_rods(call, rod, "node", nodes if nodes is not None else slice(None))[1]
            count = self._batches(np.array([rod]))[0].nodes
            places.append((rod, np.arange(count)[list(chosen)]))
        sheets = [
            (int(shell), self._vertices(shell, vertices if vertices is not None else slice(None))) for shell in shells
        ]
        force = UserForce(name, function, potential, pairs, places, sheets, {})
        if force.count < 1 + pairs:
            raise SceneError(f"{call} {name!r}: it acts on {force.count} nodes; give rods or shells of more")
        for key, values in (parameters or {}).items():
            force.parameters[key] = parameter(f"{call} {name!r}: {key}", values, force.count)
        if not force.parameters:
            raise SceneError(
                f"{call} {name!r}: it has no parameters; give one at least, such as parameters={{'stiffness': 1.0}}"
            )
        self.user_forces.append(force)


def parameter(label: str, values, count: int) -> np.ndarray:
    """Return the values of a parameter of `count` nodes: (), (nodes,), (3,) or (nodes, 3).

    Raises:
        SceneError: other shapes, or values that are not finite.
    """
    values = argument_checks.array(label, values).copy()
    if values.shape == (count, 1):
        values = values[:, 0]
    if values.shape not in ((), (count,), (3,), (count, 3)):
        raise SceneError(f"{label} has shape {values.shape}; give a number, ({count},), a vector (3,) or ({count}, 3)")
    if not np.isfinite(values).all():
        raise SceneError(f"{label} is not finite")
    return values


def _check_function(label: str, factory, arguments: tuple[str, ...]) -> None:
    """Refuse a factory without a Warp function of the arguments."""
    import warp as wp

    if isinstance(factory, wp.Function) or not callable(factory):
        raise SceneError(
            f"{label} is {factory!r}; give a function of the scalar type `real` that returns a Warp function"
        )
    for real in (wp.float32, wp.float64):
        function = factory(real)
        if not isinstance(function, wp.Function):
            raise SceneError(
                f"{label} returns {function!r} for {real.__name__}; return a function decorated by wp.func"
            )
        if len(function.input_types) != len(arguments):
            raise SceneError(
                f"{label} has the arguments ({', '.join(function.input_types)}); they are ({', '.join(arguments)})"
            )
