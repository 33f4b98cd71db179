"""Scene: description of a simulation with rods, supports and loads, in NumPy and independent of a device."""

import warnings
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SceneWarning
from ddg_warp.scene import drag, validate
from ddg_warp.scene.descriptions import Dynamics, Load, PathAnalysis, RodBatch, Statics, Support
from ddg_warp.scene.field import Fields
from ddg_warp.scene.frame_motion import FrameMotion
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.handle import LOAD, ROD, SHELL, SUPPORT, Handle, Handles, need
from ddg_warp.scene.law import Law, laws_of
from ddg_warp.scene.material import Material, Section, Stiffness, stiffness_of
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.scene.rigid_bodies import RigidBodies
from ddg_warp.scene.shells_and_joints import Structures
from ddg_warp.scene.user_force import UserForces
from ddg_warp.typing import Amplitude, Device, End, Floats, Integers, Numbers, Precision, Selection, Vector

if TYPE_CHECKING:
    from ddg_warp.model.model import Model
    from ddg_warp.model.state import State


@argument_checks.called
@dataclass(kw_only=True, repr=False, eq=False)
class Scene(Structures, RigidBodies, Fields, UserForces):
    """Description of rods and shells with supports and loads, from which `build` compiles a model.

    A model is independent of later changes of the scene.

    Args:
        gravity: acceleration (3,) [m/s^2].
        dimension: 3, or 2 for a scene in a plane y = const: forces, couples, motions and gravity out of the plane are refused.
        analysis: `Dynamics`, `Statics` or `PathAnalysis` of `ddg-warp run`.
        mass_damping: mass-proportional damping alpha [1/s].
        flow: velocity of the fluid of `drag` [m/s]: uniform (3,), or a function of time that returns it. Or a field of position and
            time, such as `FlowGrid` or `Turbulence`: a function `flow(points, t)` of points (n, 3), or (worlds, n, 3), that returns
            velocities of that shape. It is evaluated at the nodes of the start of a step.
        initial: function of the model that returns the first state of a run; the rest state by default.
        callbacks: functions of the state, called between steps.

    Raises:
        SceneError: an invalid argument; the message names it.
    """

    gravity: Vector = (0.0, 0.0, -9.81)
    dimension: int = 3
    analysis: Dynamics | Statics | PathAnalysis = field(default_factory=Dynamics)
    mass_damping: float = 0.0
    flow: Vector | Callable[[float], Vector] | Callable[[Floats, float], Floats] = (0.0, 0.0, 0.0)
    initial: "Callable[[Model], State] | None" = None
    callbacks: "list[Callable[[State], object]]" = field(default_factory=list)
    batches: list[RodBatch] = field(default_factory=list, init=False)
    supports: list[Support] = field(default_factory=list, init=False)
    loads: list[Load] = field(default_factory=list, init=False)
    masses: list[tuple[Integers, int, float]] = field(default_factory=list, init=False)
    drags: list[drag.RodDrag] = field(default_factory=list, init=False)
    shell_drags: list[drag.ShellDrag] = field(default_factory=list, init=False)

    def __post_init__(self):
        validate.check_settings(self)

    def __setattr__(self, name: str, value) -> None:
        self._need_attribute(name)
        super().__setattr__(name, value)

    def _need_attribute(self, name: str) -> None:
        if name not in self.__dataclass_fields__:
            raise SceneError(f"Scene has no attribute {name!r}{argument_checks.meant(name, self.__dataclass_fields__)}")

    def __repr__(self) -> str:
        joined = f", {len(self.joints)} joints, {len(self.attachments)} attachments" if self.joints else ""
        support_count = len(self.supports) + len(self.shell_supports) + len(self.ring_supports)
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
            f"{len(self.axisymmetric_shells)} shells of revolution{joined}{obstacles}, {support_count} supports, {loads} loads>"
        )

    @property
    def rod_count(self) -> int:
        """Number of rods added so far."""
        return self.batches[-1].first + self.batches[-1].rods if self.batches else 0

    def add_rod(
        self,
        points: Numbers | Sequence[Numbers],
        *,
        section: Section,
        material: Material | None = None,
        closed: bool = False,
        natural: Literal["shape", "straight"] | Numbers = "shape",
        director: Numbers | None = None,
        twist: bool = True,
        bend: bool = True,
        name: str = "rod",
        laws: Mapping[str, Law] | None = None,
        curvature: Literal["tangent", "angle"] = "tangent",
    ) -> Handle:
        """Add one rod with points (n, 3) and return its handle; arguments as in `add_rods`, a director (3,) or (edges, 3)."""
        if director is not None:
            director = argument_checks.array(f"rods '{name}': director", director, "give (3,) or (edges, 3)")
            director = director[None] if director.ndim == 2 and len(director) > 1 else director
        options = {"closed": closed, "natural": natural, "twist": twist, "bend": bend, "name": name}
        options |= {"laws": laws, "curvature": curvature}
        return self.add_rods([points], section=section, material=material, director=director, **options)[0]

    def add_rods(
        self,
        points: Numbers | Sequence[Numbers],
        *,
        section: Section,
        material: Material | None = None,
        closed: bool = False,
        natural: Literal["shape", "straight"] | Numbers = "shape",
        director: Numbers | None = None,
        twist: bool = True,
        bend: bool = True,
        name: str = "rod",
        laws: Mapping[str, Law] | None = None,
        curvature: Literal["tangent", "angle"] = "tangent",
    ) -> Handles:
        """Add rods.

        Args:
            points: nodes at rest (R, n, 3) [m], or a list of arrays (n, 3) of any n; distances are the rest lengths. Rods of one
                n after each other are stored together, so that sorted rods compile fastest.
            section: `Circle`, `Ellipse`, `Rectangle`, `Ribbon` (with a material) or `Stiffness`.
            material: `Material`; not needed with `Stiffness`.
            closed: whether the last node is joined to the first.
            natural: natural curvature and twist. "shape" takes both from the points and directors, "straight" sets them to zero.
                Or three arrays (curvature 1, curvature 2, twist) [1/m] that broadcast to (R, vertices), of vertices between
                edges. With tangent t and first director d1, curvature 1 > 0 bends the rod towards d1, and curvature 2 > 0
                towards the second director t x d1. Twist > 0 rotates both right-handed about t from the first node to the last
                (tools/results/natural_curvature.png). In dimension 2 one array, positive from x towards z.
            director: first director of the first edge (3,) or (R, 3), parallel-transported along the rod, or of all edges
                (R, edges, 3); made perpendicular to the tangents. By default any perpendicular direction.
            twist: False omits twist: 3 dofs a node, for isotropic rods that are straight at rest.
            bend: False omits bending and twist: a row of springs, as rods of two nodes always are (`SceneWarning`).
            name: shown in reports and output.
            laws: a `Law` for terms by name, such as "rod_bend_twist", instead of the quadratic law of the section.
            curvature: discrete curvature at the turning angle phi and mean edge length l: "tangent", 2 tan(phi/2) / l, or "angle",
                phi / l, which is exact for circles. The energy of a fold by "angle" is bounded by EI pi^2 / 2 l, and does not
                prevent folding over. See `ddg_warp.kernels.measures.turning_angle`.

        Returns:
            Handles of the rods.

        Raises:
            SceneError: no valid rod; the message names rod and node.
        """
        argument_checks.text("add_rods: name", name)
        if runs := _runs(points):
            options = {"material": material, "closed": closed, "twist": twist, "bend": bend, "name": name}
            options |= {"laws": laws, "curvature": curvature}
            return self._add_unequal(points, runs, section, natural, director, options)
        points = argument_checks.array(f"rods '{name}': points", points, "give (rods, nodes, 3)").copy()
        if director is not None:
            director = argument_checks.array(
                f"rods '{name}': director", director, "give (3,), (rods, 3) or (rods, edges, 3)"
            )
            director = director.copy()
        if points.ndim == 2:
            points = points[None]
        if points.ndim != 3 or points.shape[2] != 3:
            raise SceneError(f"rods '{name}': points have shape {points.shape}; give (rods, nodes, 3)")
        argument_checks.sized(f"rods '{name}': points", points, "rod", "node")
        flags = {"closed": closed, "twist": twist, "bend": bend}
        closed, twist, bend = (argument_checks.flag(f"rods '{name}': {flag}", value) for flag, value in flags.items())
        stiffness = stiffness_of(f"rods '{name}'", section, material)
        if argument_checks.choice(f"rods '{name}': curvature", curvature, ("tangent", "angle")) == "angle" and not bend:
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
            laws_of(f"rods '{name}'", laws, section, material),
            curvature,
            not (isinstance(section, Stiffness) or laws),
        )
        self.batches.append(batch)
        return Handles(range(batch.first, batch.first + batch.rods), name)

    def _add_unequal(self, points, runs: list[slice], section, natural, director, options: dict) -> Handles:
        """Add rods in runs of equal node count, all or none."""
        first, batches, count = self.rod_count, len(self.batches), len(points)
        stiffness_of(f"rods '{options['name']}'", section, options["material"])
        several = isinstance(natural, list | tuple)
        try:
            for rods in runs:
                values = {each.name: _of_rods(getattr(section, each.name), rods, count) for each in fields(section)}
                self.add_rods(
                    np.stack([argument_checks.array("add_rods: points", each) for each in points[rods]]),
                    section=replace(section, **values),
                    natural=[_of_rods(value, rods, count) for value in natural] if several else natural,
                    director=_of_rods(director, rods, count),
                    **options,
                )
        except SceneError:
            del self.batches[batches:]
            raise
        return Handles(range(first, self.rod_count), options["name"])

    def clamp(
        self,
        rods: Selection,
        edges: Selection = (0,),
        motion: Motion | Grip | FrameMotion | None = None,
        name: str = "",
    ) -> Handle:
        """Clamp edges: fix both nodes and the twist angle. The continuum clamp then lies at the middle of the edge.

        Negative indices count from the last edge; a mask of bools or a slice is accepted, too. `motion` prescribes the edges, all
        alike or as a `FrameMotion` rod by rod; by default they stay at rest. `name` is the support's in `Model.reactions`.
        """
        rods, edges = self._on_rods("clamp", rods, "edge", edges)
        nodes = tuple(dict.fromkeys(n for e in edges for n in ((e, e + 1) if e >= 0 else (e - 1, e))))
        return self._support("clamp", rods, nodes=nodes, edges=edges, motion=motion, name=name)

    def clamp_end(
        self,
        rods: Selection,
        end: End = "first",
        motion: Motion | Grip | FrameMotion | None = None,
        components: str = "xyz",
        tangent: Numbers | None = None,
        director: Numbers | None = None,
        name: str = "",
    ) -> Handle:
        """Fix position and frame exactly at an end node, with the tangent prescribed at the node and an end cell of half size.

        Args:
            rods: one rod or several.
            end: "first" or "last".
            motion: translates and rotates the end; by default the end stays at rest.
            components: fixed components of the position; a clamped end can slide along the free axes.
            tangent: of the rod at the end at rest, (3,) or (rods, 3), pointing from the first node to the last. A rod with natural
                shape from its points is stress-free with it. By default extrapolated from the two edges at the end.
            director: first material director at the end at rest, (3,) or (rods, 3), made perpendicular to the tangent; by default
                extrapolated with the rotation of the directors along the rod.
            name: of the support in `Model.reactions`.

        Raises:
            SceneError: an invalid end, tangent or director; the message names it.
        """
        argument_checks.choice("clamp_end: end", end, ("first", "last"))
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
        options = {"components": components, "end": end, "tangent": tangent, "director": director}
        return self._support("clamp_end", rods, motion=motion, name=name, **options)

    def fix(
        self,
        rods: Selection,
        nodes: Selection,
        components: str = "xyz",
        motion: Motion | Grip | FrameMotion | None = None,
        name: str = "",
    ) -> Handle:
        """Fix components of nodes (a hinge). A motion may give a displacement for every node."""
        rods, nodes = self._on_rods("fix", rods, "node", nodes)
        return self._support("fix", rods, nodes=nodes, components=components, motion=motion, name=name)

    def fix_twist(
        self, rods: Selection, edges: Selection, motion: Motion | Grip | FrameMotion | None = None, name: str = ""
    ) -> Handle:
        """Fix the twist angle of edges."""
        rods, edges = self._on_rods("fix_twist", rods, "edge", edges)
        self._need_twist("fix_twist", rods)
        return self._support("fix_twist", rods, edges=edges, motion=motion, name=name)

    def add_force(self, rods: Selection, node: int, force: Vector, amplitude: Amplitude | None = None) -> Handle:
        """Add a dead force [N] on a node, times amplitude(t). In statics it grows with the load parameter if amplitude is None."""
        force = argument_checks.vector(f"add_force: force on node {node}", force)
        self._in_plane("add_force: force", force, (1,))
        return self._load("add_force", rods, "node", node, amplitude, force=force)

    def add_twisting_moment(
        self, rods: Selection, edge: int, moment: float, amplitude: Amplitude | None = None
    ) -> Handle:
        """Add a moment [N m] about the tangent of an edge, conjugate to the twist angle."""
        self._need_twist("add_twisting_moment", self._rods(rods))
        moment = argument_checks.number(f"add_twisting_moment: moment on edge {edge}", moment)
        return self._load("add_twisting_moment", rods, "edge", edge, amplitude, moment=moment)

    def add_couple(self, rods: Selection, edge: int, couple: Vector, amplitude: Amplitude | None = None) -> Handle:
        """Add a couple (3,) [N m] on an edge with axis fixed in space: a pair of forces across the edge and a moment about it.

        Out of plane it has no potential (Ziegler, Principles of Structural Stability, 1968). Statics treats it exactly; in
        dynamics its forces are time-lagged, evaluated on the predicted edge.
        """
        couple = argument_checks.vector(f"add_couple: couple on edge {edge}", couple)
        self._in_plane("add_couple: couple", couple, (0, 2))
        return self._load("add_couple", rods, "edge", edge, amplitude, couple=couple)

    def add_mass(self, rods: Selection, node: int, mass: float) -> None:
        """Add a point mass [kg] on a node."""
        rods = argument_checks.once("add_mass: rods", self._rods(rods))
        rods, (node,) = self._on_rods("add_mass", rods, "node", argument_checks.index("add_mass: node", node))
        mass = argument_checks.positive(f"add_mass: mass at node {node}", mass, "kg")
        self.masses.append((rods, node, mass))

    def drag(
        self,
        rods: Selection | None = None,
        law: drag.Viscous | drag.QuadraticDrag | drag.Granular | None = None,
        *,
        shells: Selection | None = None,
        tangential: Numbers | None = None,
        normal: Numbers | None = None,
        rotational: Numbers = 0.0,
        nodes: Numbers | None = None,
    ) -> None:
        """Add anisotropic drag of a fluid or granular medium against `flow` on rods (resistive force theory) or shells.

        Drag does not act in statics, continuation and spectra. In a time step it is implicit, which allows long steps of
        overdamped rods, with time-lagged tangents and normals of the start of the step (midpoint rule: of the predicted midpoint).
        Rods with linear drag in all directions need no mass. Velocities of massless rods are means over the last step. `Model.drag`
        returns forces and power.

        Args:
            rods: rods with drag. By default all added so far, in scenes with shells only for a `QuadraticDrag`.
            law: `Viscous(viscosity)` or `Granular(...)` of rods, `QuadraticDrag(density)` of rods and shells; or the following
                coefficients instead. Each is a number, or an array (edges,) or (rods, edges) along the rod, or (nodes,) or
                (rods, nodes) of open rods with linear interpolation. Of a shell it is a number or an array (triangles,).
            shells: shells with drag, which acts on both sides. By default, without `rods`, all added so far.
            tangential, normal: force along and across over velocity, per length of rods [N s/m^2] or per area of shells [N s/m^3].
            rotational: moment per length over the angular velocity about the tangent [N s].
            nodes: force over velocity of bodies at nodes [N s/m], such as 6 pi mu R of a ball, added to the drag of the rod. A number,
                (nodes,) or (rods, nodes).

        Raises:
            SceneError: an invalid coefficient or law, a shell of revolution, which has no drag, or coefficients for rods and shells
                at once. At `build`, a rod or shell with two laws, or laws of two kinds in a scene.
        """
        if rods is None and shells is None:
            if self.axisymmetric_shells:
                name = self.axisymmetric_shells[0].name
                raise SceneError(
                    f"drag: shell of revolution 0 ('{name}') can feel none; name the rods or shells that do"
                )
            shells = range(len(self.shells)) if self.shells else None
            rods = range(self.rod_count) if self.rod_count or not self.shells else None
        if rods is not None and shells is not None and not isinstance(law, drag.QuadraticDrag):
            raise SceneError(
                "drag: coefficients are per length of rods and per area of shells; name the rods or the shells"
            )
        if rods is not None:
            rods = argument_checks.once("drag: rods", self._rods(rods))
            self.drags.append(drag.rod_drag(self.batches, rods, law, tangential, normal, rotational, nodes))
        if shells is not None:
            need(SHELL, shells)
            shells = argument_checks.once(
                "drag: shells", argument_checks.indices("drag: shells", shells, len(self.shells))
            )
            for shell in shells:
                self._check_shell(shell)
            self.shell_drags += drag.shell_drag(self.shells, shells, law, tangential, normal, rotational, nodes)

    def build(
        self, device: Device = None, precision: Precision | None = None, worlds: int = 1, allow_rounding: bool = False
    ) -> "Model":
        """Compile the current scene into a `Model` on a device.

        Args:
            device: Warp device, such as "cpu" or "cuda:0"; by default CUDA if there is one.
            precision: "float64", "mixed" or "float32"; by default as the analysis, else "mixed" on CUDA and "float64" on the CPU.
            worlds: number of independent copies with common time; parameters, states, `Controls` and outcomes differ by world.
            allow_rounding: step and solve in "float32" also where rounding dominates the result; counted as `lost_in_rounding`.

        Raises:
            SceneError: see `ddg_warp.scene.validate`.
        """
        from ddg_warp.model.model import Model
        from ddg_warp.model.validate import refuse_underflow

        validate.check_scene(self)
        worlds = argument_checks.count("worlds", worlds)
        allow_rounding = argument_checks.flag("build: allow_rounding", allow_rounding)
        options = {"device": device, "precision": precision, "worlds": worlds, "allow_rounding": allow_rounding}
        model = Model(self.copy(), **options)
        refuse_underflow(model)
        return model

    def copy(self, **changes: object) -> "Scene":
        """Return a copy of the scene with changed attributes; lists and entries are copied, arrays are not."""
        for name in changes:
            self._need_attribute(name)
        result, attributes = copy(self), vars(self).items()
        result.__dict__.update({name: list(map(copy, value)) for name, value in attributes if isinstance(value, list)})
        result.__dict__.update(changes)
        if changes:
            validate.check_settings(result)
        return result

    def _rods(self, rods) -> np.ndarray:
        need(ROD, rods)
        index = argument_checks.indices("rods", rods, self.rod_count)
        missing = index[(index < 0) | (index >= self.rod_count)]
        if missing.size:
            raise SceneError(f"rod {missing[0]} does not exist; the scene has {self.rod_count} rods so far")
        return index

    def _on_rods(self, call: str, rods, kind: str, chosen) -> tuple[np.ndarray, tuple[int, ...]]:
        """Return rods and the chosen nodes or edges (`kind`) of each rod."""
        rods = self._rods(rods)
        batches = self._batches(rods)
        sizes = np.array([getattr(batch, kind + "s") for batch in batches])
        chosen = argument_checks.indices(
            f"{call}: {kind}s", chosen, int(sizes[0]) if (sizes == sizes[0]).all() else None
        )
        starts = [batch.first for batch in batches]
        size = sizes[np.searchsorted(starts, rods, side="right") - 1]
        for item in chosen[(chosen >= sizes.min()) | (chosen < -sizes.min())][:1].tolist():
            validate.check_index(kind, item, size, rods)
        return rods, tuple(chosen.tolist())

    def _support(self, call: str, rods: np.ndarray, *, motion, components: str = "xyz", name: str, **dofs) -> Handle:
        name = name and argument_checks.text(f"{call}: name", name)
        argument_checks.components(call, components)
        validate.check_motion(call, motion, planar=self.dimension == 2)
        if motion is not None and motion.by_rod and motion.count != len(rods):
            raise SceneError(
                f"{call}: the motion has frames of {motion.count} rods, and there are {len(rods)}; give one for each"
            )
        if motion is not None and motion.count is not None and not motion.by_rod:
            if call != "fix":
                raise SceneError(f"{call}: the motion has a displacement for each node, which rotates no edge; use fix")
            if motion.count != (count := len(rods) * len(dofs["nodes"])):
                raise SceneError(
                    f"fix: the motion has {motion.count} displacements of {count} nodes; give one for each"
                )
        self.supports.append(Support(rods, components=components, motion=motion, call=call, name=name, **dofs))
        return Handle(len(self.supports) - 1, SUPPORT, name)

    def _load(self, call: str, rods, kind: str, item, amplitude, **load) -> Handle:
        rods = argument_checks.once(f"{call}: rods", self._rods(rods))
        rods, (item,) = self._on_rods(call, rods, kind, argument_checks.index(f"{call}: {kind}", item))
        self.loads.append(Load(rods, amplitude=argument_checks.amplitude(call, amplitude), **{kind: item}, **load))
        return Handle(len(self.loads) - 1, LOAD)

    def _need_twist(self, call: str, rods: np.ndarray) -> None:
        for batch in self._batches(rods):
            if not batch.twist:
                raise SceneError(
                    f"{call}: rod {batch.first} ('{batch.name}') has no twist; add it with twist=True, in dimension 3"
                )

    def _in_plane(self, label: str, value: tuple, out: tuple[int, ...]) -> None:
        """Refuse components out of the plane of a planar scene."""
        if self.dimension == 2 and any(value[d] != 0.0 for d in out):
            zero = " and ".join("xyz"[d] for d in out)
            raise SceneError(
                f"{label} is {value}; a scene of dimension 2 stays in the plane of x and z, give 0 along {zero}"
            )

    def _batches(self, rods: np.ndarray) -> list[RodBatch]:
        """Return the batches of some rods, in order."""
        first, last = (bisect_right(self.batches, r, key=lambda batch: batch.first) for r in (rods.min(), rods.max()))
        near = self.batches[first - 1 : last]
        starts = [batch.first for batch in near]
        return [near[i] for i in np.unique(np.searchsorted(starts, rods, side="right") - 1)]


def _runs(points) -> list[slice]:
    """Return runs of rods of equal node count; none if all have one count."""
    if not isinstance(points, list | tuple) or not all(getattr(each, "ndim", 0) == 2 for each in points):
        return []
    ends = np.flatnonzero(np.diff([len(each) for each in points])) + 1
    edges = [0, *ends.tolist(), len(points)]
    return list(map(slice, edges[:-1], edges[1:])) if ends.size else []


def _of_rods(value, rods: slice, count: int):
    """Return the values of some rods, of values with an axis of `count` rods before others; others are for all."""
    if isinstance(value, list | tuple) and len(value) == count and all(np.ndim(each) for each in value):
        return np.stack(value[rods])
    return value[rods] if np.ndim(value) > 1 and len(value) == count else value
