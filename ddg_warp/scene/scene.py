"""The description of a simulation: rods, supports, loads. NumPy only; nothing here knows a device."""

import warnings
from bisect import bisect_right
from collections.abc import Callable, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError, SceneWarning
from ddg_warp.scene import drag, validate
from ddg_warp.scene.descriptions import Dynamics, Law, Load, RodBatch, Statics, Support, Trace, laws_of
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.material import Material, Stiffness, stiffness_of
from ddg_warp.scene.motion import Motion
from ddg_warp.scene.structures import Structures


@arguments.called
@dataclass(kw_only=True, repr=False, eq=False)
class Scene(Structures):
    """Rods and shells with supports and loads, ready to be built for a device.

    A model is made of the scene as it is when `build` is called: what is added or changed later does not reach it.

    Args:
        gravity: acceleration (3,) [m/s^2].
        dimension: 3, or 2 for a scene that stays in a plane y = const: forces, couples, motions and gravity out of it are refused.
        analysis: `Dynamics`, `Statics` or `Trace`: what `ddg-warp run` does with the scene.
        mass_damping: mass-proportional damping alpha [1/s].
        flow: velocity (3,) [m/s] of the fluid that `drag` is against, everywhere alike; or a function of the time that returns it.
        initial: makes the first state of a run from the model; the rest state by default.
        callbacks: functions of the state, called between steps.

    Raises:
        SceneError: an argument that is none of these; the message names it.
    """

    gravity: tuple = (0.0, 0.0, -9.81)
    dimension: int = 3
    analysis: Dynamics | Statics | Trace = field(default_factory=Dynamics)
    mass_damping: float = 0.0
    flow: tuple | Callable[[float], tuple] = (0.0, 0.0, 0.0)
    initial: Callable | None = None
    callbacks: list[Callable] = field(default_factory=list)
    batches: list[RodBatch] = field(default_factory=list, init=False)
    supports: list[Support] = field(default_factory=list, init=False)
    loads: list[Load] = field(default_factory=list, init=False)
    masses: list[tuple[np.ndarray, int, float]] = field(default_factory=list, init=False)
    drags: list[tuple[np.ndarray, object]] = field(default_factory=list, init=False)

    def __post_init__(self):
        validate.check_settings(self)

    def __setattr__(self, name: str, value) -> None:
        self._need_attribute(name)
        super().__setattr__(name, value)

    def _need_attribute(self, name: str) -> None:
        if name not in self.__dataclass_fields__:
            raise SceneError(f"Scene has no attribute {name!r}{arguments.meant(name, self.__dataclass_fields__)}")

    def __repr__(self) -> str:
        joined = f", {len(self.joints)} joints, {len(self.attachments)} attachments" if self.joints else ""
        held = len(self.supports) + len(self.shell_supports) + len(self.ring_supports)
        obstacles = f", {len(self.obstacles)} obstacles" if self.obstacles else ""
        loads = sum(
            map(
                len,
                (self.loads, self.shell_loads, self.pressures, self.edge_couples, self.ring_loads, self.ring_pressures),
            )
        )
        nodes = sum(batch.rods * batch.nodes for batch in self.batches)
        triangles = sum(len(shell.triangles) for shell in self.shells)
        return (
            f"<Scene of dimension {self.dimension}, gravity {tuple(self.gravity)} m/s^2, {type(self.analysis).__name__}: "
            f"{self.rod_count} rods of {nodes} nodes, {len(self.shells)} shells of {triangles} triangles, "
            f"{len(self.axisymmetric_shells)} shells of revolution{joined}{obstacles}, {held} supports, {loads} loads>"
        )

    @property
    def rod_count(self) -> int:
        """Number of rods added so far."""
        return self.batches[-1].first + self.batches[-1].rods if self.batches else 0

    def add_rod(
        self,
        points,
        *,
        section,
        material: Material | None = None,
        closed: bool = False,
        natural="shape",
        director=None,
        twist: bool = True,
        bend: bool = True,
        name: str = "rod",
        laws: Mapping[str, Law] | None = None,
        curvature: str = "tangent",
    ) -> int:
        """Add one rod with points (n, 3); arguments as in `add_rods`, without R: a director (3,) or (edges, 3). Returns its index."""
        if director is not None:
            director = arguments.array(f"rods '{name}': director", director, "give (3,) or (edges, 3)")
            director = director[None] if director.ndim == 2 and len(director) > 1 else director
        options = {"closed": closed, "natural": natural, "twist": twist, "bend": bend, "name": name}
        options |= {"laws": laws, "curvature": curvature}
        return self.add_rods([points], section=section, material=material, director=director, **options)[0]

    def add_rods(
        self,
        points,
        *,
        section,
        material: Material | None = None,
        closed: bool = False,
        natural="shape",
        director=None,
        twist: bool = True,
        bend: bool = True,
        name: str = "rod",
        laws: Mapping[str, Law] | None = None,
        curvature: str = "tangent",
    ) -> range:
        """Add rods of equal node count.

        Args:
            points: nodes at rest (R, n, 3) [m]; their distances are the rest lengths.
            section: `Circle`, `Ellipse`, `Rectangle`, `Ribbon` (with a material) or `Stiffness`.
            material: `Material`; not needed with `Stiffness`.
            closed: whether the last node is joined to the first.
            natural: "shape" takes curvature and twist at rest from the points and directors; "straight" sets both to zero; or
                three arrays (curvature 1, curvature 2, twist) [1/m] that broadcast to (R, vertices), of vertices between edges.
                With tangent t and first director d1: curvature 1 > 0 bends the rod towards d1, curvature 2 > 0 towards the
                second director t x d1, twist > 0 turns both right-handed about t on the way from the first node to the last
                (tools/results/natural_curvature.png). In dimension 2 one array, positive from x towards z.
            director: first director of the first edge (3,) or (R, 3), carried along without twist, or of all edges
                (R, edges, 3); made perpendicular to the tangents. By default one is chosen.
            twist: False leaves twist out: 3 dofs a node, for isotropic rods that are straight at rest.
            bend: False leaves bending and twist out: a chain of springs, as rods of two nodes are in any case (`SceneWarning`).
            name: shown in reports and output.
            laws: a `Law` for terms by name, such as "rod_bend_twist", instead of the quadratic one with the section's stiffness.
            curvature: what it is where edges meet at the angle phi, l the mean of their lengths: "tangent", 2 tan(phi/2) / l, or
                "angle", phi / l, by which circles are exact; but a fold costs no more than EI pi^2 / 2 l, and lets the rod through. See
                `ddg_warp.kernels.measures.turning_angle`.

        Returns:
            Indices of the rods.

        Raises:
            SceneError: what is given cannot be a rod; the message names rod and node.
        """
        arguments.text("add_rods: name", name)
        points = arguments.array(f"rods '{name}': points", points, "give (rods, nodes, 3)").copy()
        if director is not None:
            director = arguments.array(f"rods '{name}': director", director, "give (3,), (rods, 3) or (rods, edges, 3)")
            director = director.copy()
        if points.ndim == 2:
            points = points[None]
        if points.ndim != 3 or points.shape[2] != 3:
            raise SceneError(f"rods '{name}': points have shape {points.shape}; give (rods, nodes, 3)")
        arguments.sized(f"rods '{name}': points", points, "rod", "node")
        flags = {"closed": closed, "twist": twist, "bend": bend}
        closed, twist, bend = (arguments.flag(f"rods '{name}': {what}", value) for what, value in flags.items())
        stiffness = stiffness_of(f"rods '{name}'", section, material)
        if arguments.choice(f"rods '{name}': curvature", curvature, ("tangent", "angle")) == "angle" and not bend:
            raise SceneError(f"rods '{name}': curvature is 'angle' and bend is False; without bending leave it out")
        if bend and not closed and points.shape[1] == 2:
            warnings.warn(
                f"rods '{name}' have 2 nodes each, and no vertex at which they could bend or twist: they are springs, as with "
                "bend=False; give 3 nodes at least where they are to bend",
                SceneWarning,
                stacklevel=3,
            )
            bend = False
        planar = self.dimension == 2
        points.setflags(write=False)
        batch = RodBatch(
            points,
            stiffness,
            closed,
            deepcopy(natural),
            director,
            twist and bend and not planar,
            bend,
            name,
            self.rod_count,
            laws_of(f"rods '{name}'", section, material, laws),
            curvature,
            not (isinstance(section, Stiffness) or laws),
        )
        self.batches.append(batch)
        return range(batch.first, batch.first + batch.rods)

    def clamp(self, rods, edges=(0,), motion: Motion | Grip | None = None) -> None:
        """Hold edges: both nodes and the angle. The continuum clamp then lies at the middle of the edge.

        Negative indices count from the last edge; a mask of bools, or a slice, chooses among the edges, too. `motion` moves them;
        without it they stay where they are at rest.
        """
        rods, edges = self._on_rods("clamp", rods, "edge", edges)
        nodes = tuple(dict.fromkeys(n for e in edges for n in ((e, e + 1) if e >= 0 else (e - 1, e))))
        self._support("clamp", rods, nodes=nodes, edges=edges, motion=motion)

    def clamp_end(
        self,
        rods,
        end: str = "first",
        motion: Motion | Grip | None = None,
        components: str = "xyz",
        tangent=None,
        director=None,
    ) -> None:
        """Hold position and frame exactly at an end node: the tangent is prescribed there and the end cell is half a cell.

        Args:
            rods: one rod or several.
            end: "first" or "last".
            motion: moves and turns the end; it stays as it is at rest without.
            components: of the position that are held; the others are free, so that a clamped end can slide along an axis of space.
            tangent: of the rod at the end at rest, (3,) or (rods, 3), pointing from the first node to the last; a rod whose natural
                shape is that of its points is free of stress with it. By default extrapolated from the two edges at the end.
            director: first material director at the end at rest, (3,) or (rods, 3), made perpendicular to the tangent; by default
                extrapolated likewise, so that a rod whose directors turn along it goes on turning up to its end.

        Raises:
            SceneError: the end, the tangent or the director is none; the message says which.
        """
        arguments.choice("clamp_end: end", end, ("first", "last"))
        rods = self._rods(rods)
        tangent = None if tangent is None else validate.directions("clamp_end: tangent", tangent, rods)
        director = None if director is None else validate.directions("clamp_end: director", director, rods)
        if tangent is not None and self.dimension == 2 and tangent[:, 1].any():
            raise SceneError(
                f"clamp_end: tangent {tangent[0]} leaves the plane of x and z that a scene of dimension 2 stays in"
            )
        for batch in self._batches(rods):
            if batch.closed:
                raise SceneError(
                    f"clamp_end: rod {batch.first} ('{batch.name}') is closed: it has no end to clamp; use clamp"
                )
            if director is not None and not batch.twist:
                raise SceneError(
                    f"clamp_end: rod {batch.first} ('{batch.name}') has no twist, and so no director; leave director out"
                )
        held = {"components": components, "end": end, "tangent": tangent, "director": director}
        self._support("clamp_end", rods, motion=motion, **held)

    def fix(self, rods, nodes, components: str = "xyz", motion: Motion | Grip | None = None) -> None:
        """Hold components of nodes (a hinge). A motion may give every node a displacement of its own."""
        rods, nodes = self._on_rods("fix", rods, "node", nodes)
        self._support("fix", rods, nodes=nodes, components=components, motion=motion)

    def fix_twist(self, rods, edges, motion: Motion | Grip | None = None) -> None:
        """Hold the angle of edges."""
        rods, edges = self._on_rods("fix_twist", rods, "edge", edges)
        self._need_twist("fix_twist", rods)
        self._support("fix_twist", rods, edges=edges, motion=motion)

    def add_force(self, rods, node: int, force, amplitude: Callable[[float], float] | None = None) -> None:
        """Dead force [N] on a node, times amplitude(t). In statics it grows with the load parameter if amplitude is None."""
        force = arguments.vector(f"add_force: force on node {node}", force)
        self._in_plane("add_force: force", force, (1,))
        self._load("add_force", rods, "node", node, amplitude, force=force)

    def add_twisting_moment(self, rods, edge: int, moment: float, amplitude=None) -> None:
        """Moment [N m] about the tangent of an edge, conjugate to its angle."""
        self._need_twist("add_twisting_moment", self._rods(rods))
        moment = arguments.number(f"add_twisting_moment: moment on edge {edge}", moment)
        self._load("add_twisting_moment", rods, "edge", edge, amplitude, moment=moment)

    def add_couple(self, rods, edge: int, couple, amplitude=None) -> None:
        """Couple (3,) [N m] on an edge, its axis fixed in space: a pair of forces across the edge and a moment about it.

        Outside the plane it has no potential (Ziegler, Principles of Structural Stability, 1968). Statics takes it as it is; in
        dynamics its forces are those on the predicted edge and stay as they are within a step.
        """
        couple = arguments.vector(f"add_couple: couple on edge {edge}", couple)
        self._in_plane("add_couple: couple", couple, (0, 2))
        self._load("add_couple", rods, "edge", edge, amplitude, couple=couple)

    def add_mass(self, rods, node: int, mass: float) -> None:
        """Point mass [kg] on a node."""
        rods = arguments.once("add_mass: rods", self._rods(rods))
        rods, (node,) = self._on_rods("add_mass", rods, "node", arguments.index("add_mass: node", node))
        mass = arguments.positive(f"add_mass: mass at node {node}", mass, "kg")
        self.masses.append((rods, node, mass))

    def drag(self, rods=None, law=None, *, tangential=None, normal=None, rotational=0.0, nodes=None) -> None:
        """Let a fluid, or sand, resist the motion of rods by resistive force theory: anisotropic drag against `flow`.

        Drag needs motion: it does nothing in statics, continuation and spectra. In a time step it is implicit, with the tangents of the
        step's start (of the predicted midpoint by the midpoint rule), so that overdamped rods take long steps; rods that drag holds
        back need no mass; the velocities of these are means over the last step. `Model.drag` tells forces and power.

        Args:
            rods: those in the fluid, all added so far by default.
            law: `Viscous(viscosity)` or `Granular(...)`; or coefficients instead, each a number or an array along the rod, one an edge
                (edges,), or one a node of open rods (nodes,), linear between; (rods, edges) or (rods, nodes) where rods differ:
            tangential, normal: force per length over velocity along and across the rod [N s/m^2].
            rotational: moment per length over the spin about the tangent [N s].
            nodes: force over velocity of bodies at nodes [N s/m], such as 6 pi mu R of a ball: a number, (nodes,) or (rods, nodes);
                beside the rod's own drag, or alone.

        Raises:
            SceneError: a coefficient is none, or does not fit the rods, or, without `rods`, there are shells, which feel none; at
                `build`, a rod has two laws.
        """
        if rods is None:
            for kind, shells in (("shell", self.shells), ("shell of revolution", self.axisymmetric_shells)):
                if shells:
                    raise SceneError(f"drag: {kind} 0 ('{shells[0].name}') can feel none; name the rods that do")
            rods = range(self.rod_count)
        rods = arguments.once("drag: rods", self._rods(rods))
        self.drags.append(drag.rod_drag(self.batches, rods, law, tangential, normal, rotational, nodes))

    def build(self, device=None, precision: str | None = None, worlds: int = 1, allow_rounding: bool = False):
        """Freeze the scene, as it is now, into a `Model` on a device.

        Args:
            device: Warp device, such as "cpu" or "cuda:0"; by default CUDA if there is one.
            precision: "float64", "mixed" or "float32"; by default that of the analysis, else "mixed" on CUDA and "float64" on the CPU.
            worlds: independent copies that share their time; parameters, states, `Controls` and outcomes are each world's own.
            allow_rounding: step and solve in "float32" also where its rounding decides what comes out; counted as `lost_in_rounding`.

        Raises:
            SceneError: see `ddg_warp.scene.validate`.
        """
        from ddg_warp.model.model import Model
        from ddg_warp.model.validate import refuse_underflow

        validate.check_scene(self)
        worlds = arguments.count("worlds", worlds)
        allow_rounding = arguments.flag("build: allow_rounding", allow_rounding)
        options = {"device": device, "precision": precision, "worlds": worlds, "allow_rounding": allow_rounding}
        model = Model(self.copy(), **options)
        refuse_underflow(model)
        return model

    def copy(self, **changes) -> "Scene":
        """The scene as it is now, with attributes changed; lists and entries are its own, their arrays are shared."""
        for name in changes:
            self._need_attribute(name)
        other, own = copy(self), vars(self).items()
        other.__dict__.update({name: list(map(copy, value)) for name, value in own if isinstance(value, list)})
        other.__dict__.update(changes)
        if changes:
            validate.check_settings(other)
        return other

    def _rods(self, rods) -> np.ndarray:
        index = arguments.indices("rods", rods, self.rod_count)
        bad = index[(index < 0) | (index >= self.rod_count)]
        if bad.size:
            raise SceneError(f"rod {bad[0]} does not exist; the scene has {self.rod_count} rods so far")
        return index

    def _on_rods(self, call: str, rods, what: str, chosen) -> tuple[np.ndarray, tuple[int, ...]]:
        """Rods, and the nodes or edges (`what`) chosen of each of them."""
        rods = self._rods(rods)
        batches = self._batches(rods)
        sizes = np.array([getattr(batch, what + "s") for batch in batches])
        chosen = arguments.indices(f"{call}: {what}s", chosen, int(sizes[0]) if (sizes == sizes[0]).all() else None)
        starts = [batch.first for batch in batches]
        size = sizes[np.searchsorted(starts, rods, side="right") - 1]
        for place in chosen[(chosen >= sizes.min()) | (chosen < -sizes.min())][:1].tolist():
            validate.check_index(what, place, size, rods)
        return rods, tuple(chosen.tolist())

    def _support(self, call: str, rods: np.ndarray, *, motion, components: str = "xyz", **held) -> None:
        arguments.components(call, components)
        validate.check_motion(call, motion, planar=self.dimension == 2)
        if motion is not None and motion.count is not None:
            if call != "fix":
                raise SceneError(f"{call}: the motion has a displacement for each node, which turns no edge; use fix")
            if motion.count != (there := len(rods) * len(held["nodes"])):
                raise SceneError(
                    f"fix: the motion has {motion.count} displacements of {there} nodes; give one for each"
                )
        self.supports.append(Support(rods, components=components, motion=motion, call=call, **held))

    def _load(self, call: str, rods, what: str, place, amplitude, **load) -> None:
        rods = arguments.once(f"{call}: rods", self._rods(rods))
        rods, (place,) = self._on_rods(call, rods, what, arguments.index(f"{call}: {what}", place))
        self.loads.append(Load(rods, amplitude=arguments.amplitude(call, amplitude), **{what: place}, **load))

    def _need_twist(self, call: str, rods: np.ndarray) -> None:
        for batch in self._batches(rods):
            if not batch.twist:
                raise SceneError(
                    f"{call}: rod {batch.first} ('{batch.name}') has no twist; add it with twist=True, in dimension 3"
                )

    def _in_plane(self, what: str, value: tuple, out: tuple[int, ...]) -> None:
        """Refuse components that a planar scene cannot feel."""
        if self.dimension == 2 and any(value[d] != 0.0 for d in out):
            zero = " and ".join("xyz"[d] for d in out)
            raise SceneError(
                f"{what} is {value}; a scene of dimension 2 stays in the plane of x and z, give 0 along {zero}"
            )

    def _batches(self, rods: np.ndarray) -> list[RodBatch]:
        """The batches that some rods belong to, in order."""
        first, last = (bisect_right(self.batches, r, key=lambda batch: batch.first) for r in (rods.min(), rods.max()))
        near = self.batches[first - 1 : last]
        starts = [batch.first for batch in near]
        return [near[i] for i in np.unique(np.searchsorted(starts, rods, side="right") - 1)]
