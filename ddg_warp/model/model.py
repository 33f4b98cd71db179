"""Model: constant device data compiled from a scene: arrays, terms, dof map; and queries of a state."""

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ddg_warp import argument_checks, device_arrays
from ddg_warp.capture_lock import launches, one_at_a_time
from ddg_warp.compile import memory
from ddg_warp.compile.boundary_conditions import scene_motions
from ddg_warp.compile.precision import choose, warn_of_rounding
from ddg_warp.compile.rod_groups import compile_rod_groups
from ddg_warp.errors import SceneError
from ddg_warp.io.bodies import Bodies
from ddg_warp.io.contact_records import ContactScales
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.shapes import Curves, Surfaces
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.rod_layout import rod_storage
from ddg_warp.kernels.stepping import rod_step
from ddg_warp.model import rod_shell_coupling
from ddg_warp.model.fields import Fields
from ddg_warp.model.joint_drives import JointDrives
from ddg_warp.model.parameters import valid_numbers
from ddg_warp.model.rebuild import ModelBuilder
from ddg_warp.model.rod_group import RodGroup
from ddg_warp.model.state import GripState, RodGroupState, Snapshot, State, check_state, query
from ddg_warp.model.user_numbering import UserNumbering
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.handle import OBSTACLE, ROD, SHELL, Handle
from ddg_warp.scene.scene import Scene
from ddg_warp.typing import Bools, Device, Floats, Numbers, Precision, Vector

if TYPE_CHECKING:
    from ddg_warp.io.contact_records import Contacts
    from ddg_warp.postprocess.joint_wrenches import JointWrenches
    from ddg_warp.postprocess.quantities import Drag
    from ddg_warp.postprocess.resultants import Stresses
    from ddg_warp.solve.collision.contact_model import ContactModel
    from ddg_warp.solve.stepping.wrenches import Reactions, Wrenches


@argument_checks.sealed
@launches
class Model:
    """A built scene; see `Scene.build`.

    Attributes:
        scene: the scene it was built from.
        curves: rods in the user's order.
        groups: rod groups: uncoupled rods, each group of one kind and similar length.
        coupled: coupled system: shells, and rods that are joined, attached or in contact; None without.
        motions: distinct motions of supports.
        grips: motions that are control inputs, in the order of `Controls.poses`: as supports were added, of rods, then of shells,
            then of shells of revolution.
        precision: scalar types.
        worlds: number of independent copies.
        allow_rounding: whether steps and solves run although float32 rounding exceeds its limit.
        order: points and edges in the user's order.
        drives: hinges of rigid bodies, with driven angles and torques.
        fields: rest strains of rods that the scene prescribes, see `Scene.prescribe`.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        device: Device = None,
        precision: Precision | None = None,
        worlds: int = 1,
        allow_rounding: bool = False,
    ):
        self.scene: Scene = scene
        self.wp_device = device_arrays.device_named(device)
        asked = getattr(scene.analysis, "precision", None) if precision is None else precision
        self.types = choose(asked, self.wp_device)
        self.worlds, self.allow_rounding = worlds, allow_rounding
        self.version = self.layout = 0  # see `note_change`
        memory.require(scene, needs_coupling(scene), worlds, self.precision, self.wp_device)
        with memory.named("build", self.wp_device):
            self._compile(scene)
        warn_of_rounding(self, scene.analysis)

    def _compile(self, scene) -> None:
        self.rod_group_data = compile_rod_groups(scene)
        self.motions = scene_motions(scene)
        self.grips = [motion for motion in self.motions if isinstance(motion, Grip)]
        self.groups = [
            RodGroup(data, scene, self.worlds, self.wp_device, self.types.real) for data in self.rod_group_data
        ]
        self.coupled = self._build_coupled() if needs_coupling(scene) else None
        self.order = UserNumbering(self)
        self.fields, self.drives = Fields(self), JointDrives(self)

    def _build_coupled(self):
        from ddg_warp.compile.coupled.builder import compile_coupled
        from ddg_warp.model.coupled_model import CoupledModel

        supports = [*self.scene.shell_supports, *self.scene.ring_supports]
        turning = [s.motion is not None and s.motion.turns for s in supports]
        place = {id(motion): i for i, motion in enumerate(self.motions)}
        motions = [place[id(s.motion)] if turns else -1 for s, turns in zip(supports, turning, strict=True)]
        coupled = compile_coupled(self.scene, along=self.wp_device.is_cpu)
        motions, user_forces = np.array(motions, int), self.scene.user_forces
        return CoupledModel(coupled, self.worlds, self.wp_device, self.types.real, motions, user_forces)

    def __repr__(self) -> str:
        scene, number = self.scene, argument_checks.number_of
        parts = {"rod": scene.rod_count, "shell": len(scene.shells), "meridian": len(scene.axisymmetric_shells)}
        counts = ", ".join(number(count, name) for name, count in parts.items() if count)
        size = f"{number(self.worlds, 'world')} of {number(self.points_count, 'point')}"
        return f"<Model of {counts}: {size} on {self.device} in {self.precision}>"

    def __reduce__(self):
        """Have pickle, torch.save and copy.deepcopy rebuild the scene with the current parameters and rest shapes."""
        return ModelBuilder.build, (ModelBuilder(self, self.worlds),)

    @property
    def device(self) -> str:
        """Name of the Warp device."""
        return str(self.wp_device)

    def to(self, device: Device) -> "Model":
        """Return the model on a device: itself, or one built there with its current parameters and rest shapes.

        Raises:
            SceneError: there is no such device.
        """
        target = device_arrays.device_named(str(device))
        return self if target == self.wp_device else ModelBuilder(self, self.worlds, str(target)).build()

    @property
    def precision(self) -> str:
        """Name of the precision."""
        return self.types.name

    @property
    def curves(self) -> Curves:
        """Rods, then meridians of axisymmetric shells with the radius of half the thickness."""
        return self.order.curves

    @property
    def surfaces(self) -> Surfaces | None:
        """Shells as triangles among the rows of `State.points`; None without."""
        return self.order.surfaces

    @property
    def obstacles(self) -> Obstacles | None:
        """Obstacles as surfaces, for display; None without."""
        return self.order.obstacles

    @property
    def bodies(self) -> list[str]:
        """Names of the rigid bodies, in their order."""
        return [body.name for body in self.scene.bodies]

    @property
    def rigid_bodies(self) -> Bodies | None:
        """Rigid bodies, for recordings; None without."""
        return self.order.rigid_bodies

    @property
    def contact_scales(self) -> ContactScales | None:
        """Contact metadata of recordings: labels, sizes, force scale; None without contact."""
        host = self.coupled.host.contact_parameters if self.coupled is not None else None
        if host is None:
            return None
        forces = (host.stiffness * host.range)[host.meeting]
        return ContactScales(
            [body.label for body in host.bodies], host.size, float(np.median(forces)) if forces.size else 1.0
        )

    @cached_property
    def touch(self) -> "ContactModel | None":
        """Contact queries at given states (`ContactModel`); None without contact."""
        from ddg_warp.solve.collision.contact_model import ContactModel

        if self.coupled is None or self.coupled.host.contact_parameters is None:
            return None
        return ContactModel(self.coupled, self.types.real, self.coupled.rest().q)

    @cached_property
    def static_wrenches(self) -> "Wrenches":
        """`Wrenches` for sums of reactions over supports at states."""
        from ddg_warp.solve.stepping.wrenches import Wrenches

        return Wrenches(self)

    @property
    def magnetic(self) -> bool:
        """True if rods are in a magnetic field."""
        return self.coupled is not None and any(part.term.measure.field for part in self.coupled.sets)

    @property
    def points_count(self) -> int:
        """Rows of `State.points` in one world."""
        return self.order.points_count

    def rod(self, item: int | str) -> Handle:
        """Return the handle of a rod from a name or index.

        Raises:
            SceneError: there is no such rod, or several have the name; see `rods`.
        """
        return self.order.handle(ROD, item)

    def rods(self, name: str | None = None) -> list[Handle]:
        """Return the handles of all rods, or of the rods with a name."""
        names = self.curves.names[: self.scene.rod_count]
        rows = np.arange(len(names)) if name is None else np.flatnonzero(names == name)
        if name is not None and not len(rows):
            self.order.handle(ROD, name)  # refused
        return [Handle(row, ROD, names[row]) for row in rows.tolist()]

    def shell(self, item: int | str) -> Handle:
        """Return the handle of a shell from a name or index."""
        return self.order.handle(SHELL, item)

    def obstacle(self, item: int | str) -> Handle:
        """Return the handle of an obstacle from a name or index."""
        return self.order.handle(OBSTACLE, item)

    def report(self, absent: bool = False) -> str:
        """Return a text: content and cost of the model; with `absent` also the terms that it has not."""
        from ddg_warp.postprocess.model_report import report

        return report(self, argument_checks.flag("report: absent", absent))

    @one_at_a_time
    def energies(self, state: State) -> dict[str, float | Floats]:
        """Return energies by term at a state [J]; see `ddg_warp.postprocess.quantities`."""
        from ddg_warp.postprocess.quantities import energies

        check_state("energies", self, state)
        return energies(self, state)

    @one_at_a_time
    def joint_wrenches(self, state: State, factor: float = 1.0) -> "JointWrenches":
        """Return the equilibrium wrench of every joint of rigid bodies on the second body, about the point of the joint.

        A joint with the world acts on the body. `Integrator.joint_wrenches` is for a step, with inertia.

        Args:
            factor: the load parameter.

        Raises:
            SceneError: the scene has no joint of rigid bodies.
        """
        from ddg_warp.postprocess.joint_wrenches import of_equilibrium, require_joints

        require_joints("joint_wrenches", self)
        query("joint_wrenches", self, state)
        return of_equilibrium(self, state, factor)

    def reactions(self, state: State, point: Vector | None = None, factor: float = 1.0) -> "Reactions":
        """Return forces and moments of the supports; see `ddg_warp.postprocess.quantities.reactions`."""
        from ddg_warp.postprocess.quantities import reactions

        check_state("reactions", self, state)
        return reactions(self, state, point, factor)

    @one_at_a_time
    def drag(self, state: State) -> "Drag":
        """Return forces and power of the drag on rods; see `ddg_warp.postprocess.quantities.drag`."""
        from ddg_warp.postprocess.quantities import drag

        check_state("drag", self, state)
        return drag(self, state)

    @one_at_a_time
    def resolve_overlaps(self, state: State, gap: float | None = None) -> tuple[State, float]:
        """Return a state without overlaps and the largest node displacement [m]; see `postprocess.overlap_resolution`."""
        from ddg_warp.postprocess.overlap_resolution import resolve_overlaps

        check_state("resolve_overlaps", self, state)
        return resolve_overlaps(self, state, gap)

    @one_at_a_time
    def contacts(self, state: State) -> "Contacts":
        """Return the contact pairs of a state, an `io.contact_records.Contacts`; see `postprocess.contact_pairs`."""
        from ddg_warp.postprocess.contact_pairs import contacts

        check_state("contacts", self, state)
        return contacts(self, state)

    @one_at_a_time
    def stresses(self, state: State) -> "Stresses":
        """Return stresses of rods and shells; see `ddg_warp.postprocess.quantities.stresses`."""
        from ddg_warp.postprocess.quantities import stresses

        check_state("stresses", self, state)
        return stresses(self, state)

    def set_parameter(self, term: str, parameter: str, values: Numbers) -> None:
        """Set a parameter of a term in all rods and shells, for all worlds or per world.

        Args:
            term, parameter: names as `parameters` gives them, such as "rod_bend_twist", "stiffness_1".
            values: one number, one a world (worlds,), one an element (elements,), or (worlds, elements). Elements are of the longest
                rod of a group, clamped ends included.

        Raises:
            ValueError: nothing has the term, the term has no such parameter, a field prescribes it, or the shape or a value is wrong;
                nothing is changed.
        """
        if (force := self._user_force(term)) is not None:
            force.set(parameter, values)
            self.note_change(False)
            return
        parts = self.coupled.sets if self.coupled is not None else ()
        values, remade = self.valid_values(term, parameter, values), False
        self.fields.refuse("set_parameter", f"{term}.{parameter}")
        if values.shape == (1,) and self.worlds == 1:
            values = values.reshape(())  # one a world, of one world, is one number
        name = f"{term}.{parameter}"
        for group in self.groups:
            if name in group.parameters.values:
                remade |= group.set_parameter(name, values)
        for part in parts:
            if part.term.name == term and parameter in part.parameters.values:
                remade |= part.set_parameter(parameter, values)
        self.note_change(remade)

    def _user_force(self, name: str):
        """Return the user-defined force of a name; None without."""
        forces = self.coupled.user_forces if self.coupled is not None else ()
        return next((force for force in forces if force.name == name), None)

    def note_change(self, remade: bool) -> None:
        """Count a change of parameters or rest shapes in `version`, and a reallocation in `layout`.

        Host data derived from parameters is valid for one version, captured launches for one layout.
        """
        self.version += 1
        self.layout += remade
        self.fields.forget()

    def valid_values(self, term: str, parameter: str, values: Numbers) -> Floats:
        """Return values of a parameter as a checked array of numbers.

        Raises:
            ValueError: there is no such parameter, or a value is no number, not finite or not allowed.
        """
        rule = self.parameter_rule(term, parameter)
        return valid_numbers(f"{term}.{parameter}", values, *rule)

    def parameter_rule(self, term: str, parameter: str) -> tuple[str, Callable[[Floats], Bools]]:
        """Return the rule for values of a parameter: a text, and a predicate of arrays.

        Raises:
            ValueError: nothing has the term, or the term has no such parameter.
        """
        terms = self._terms()
        if not isinstance(term, str) or term not in terms:
            raise ValueError(
                f"set_parameter: no rod or shell has the term {term!r}{argument_checks.nearest(term, terms) or ';'} this model has "
                f"{', '.join(sorted(terms))}"
            )
        rules = terms[term]
        if not isinstance(parameter, str) or parameter not in rules:
            near = argument_checks.nearest(parameter, rules)
            raise ValueError(
                f"set_parameter: {term} has no parameter {parameter!r}{near or ';'} it has {', '.join(rules)}"
            )
        return rules[parameter].valid

    def _terms(self) -> dict[str, dict]:
        """Return the parameters of all terms: term -> name -> `Parameter`."""
        parts = self.coupled.sets if self.coupled is not None else ()
        terms: dict[str, dict] = {}
        for term in (*(t for group in self.groups for t in group.kind.terms), *(part.term for part in parts)):
            terms.setdefault(term.name, {}).update({parameter.name: parameter for parameter in term.parameters})
        return terms

    def set_rest(
        self,
        shell: int,
        *,
        points: Numbers | None = None,
        metric: Numbers | None = None,
        curvature: Numbers | None = None,
        angle: Numbers | None = None,
    ) -> None:
        """Set the rest shape of a shell in every world: growth, swelling, bilayers, creases, pre-stress.

        Forms left out stay, as do masses and the direction of clamped normals. See `rest_shapes` for forms from principal stretches
        and curvatures.

        Args:
            shell: index of the shell.
            points: (P, 3) [m], a shape that gives metric, curvature and angles at rest.
            metric: first fundamental form (T, 3) [m^2], (11, 12, 22) in the basis of the first two edges of a triangle.
            curvature: second fundamental form (T, 3) [m] in the same basis; bending "midedge_dof" and "midedge".
            angle: dihedral angle of mesh edges (E,) [rad], positive where convex on the side of the normals; bending "hinge".

        Raises:
            ValueError: no such shell, a shape that does not fit, a metric without area, or a form that this bending model lacks.
        """
        from ddg_warp.model.rest_shapes import set_rest

        set_rest(self, shell, points=points, metric=metric, curvature=curvature, angle=angle)

    def parameters(self) -> dict[str, Floats]:
        """Return parameters of all terms by name, `group/term/parameter`, broadcastable to (node, column of the group).

        Parameters of the coupled system are `net/term/parameter`. Further element sets of a term, with other laws, are numbered:
        `net/term 1/...`.
        """
        result = {}
        for i, group in enumerate(self.groups):
            for name, values in group.parameters.values.items():
                result[f"{i}/{name.replace('.', '/')}"] = values
            result |= {f"{i}/mass": group.host.mass, f"{i}/rotary_inertia": group.host.rotary}
        laws: dict[str, list] = {}
        for part in self.coupled.sets if self.coupled is not None else ():
            laws.setdefault(part.term.name, []).append(part)
        for term, parts in laws.items():
            for number, part in enumerate(parts):  # one element set for each law
                place = f"net/{term}" + (f" {number}" if number else "")
                result |= {f"{place}/{name}": values for name, values in part.parameters.values.items()}
        for force in self.coupled.user_forces if self.coupled is not None else ():
            result |= {f"net/{force.name}/{name}": values for name, values in force.values.items()}
        return result

    def state(
        self,
        points: Numbers | None = None,
        velocities: Numbers | None = None,
        spins: Numbers | None = None,
        angles: Numbers | None = None,
    ) -> State:
        """Return an initial state: the rest state without motion, or given positions and velocities.

        Args:
            points: positions (P, 3) or (worlds, P, 3) [m] in the order of `curves`. Reference frames are transported from rest to
                these positions, and edges glued to a shell follow it. Ghost nodes of clamped ends stay. Rigid bodies start as the
                scene has them, and nodes that they carry stay with them, with their velocities.
            velocities: (P, 3) or (worlds, P, 3) [m/s].
            spins: rate of twist angles (edges,) or (worlds, edges) [rad/s]; by default zero, and as the shell rotates where edges
                are glued. Given spins switch on gyroscopic moments in the following steps, see `Integrator`, gyroscopic.
            angles: twist angles (edges,) or (worlds, edges) [rad]; by default zero.

        Raises:
            ValueError: a shape does not fit, or a value is not finite.
        """
        state = self.empty_state()
        state.spun = spins is not None and bool(argument_checks.floats(spins).any())
        for group, data in zip(self.groups, state.groups, strict=True):
            x = group.host.x
            if self.worlds > 1 or points is not None:
                x = np.concatenate([x] * self.worlds, axis=1)
            if points is not None:
                self.order.put_nodes(group, points, x, "points")
            device_arrays.assign(data.x, x)
            if velocities is not None:
                v = np.zeros_like(x)
                self.order.put_nodes(group, velocities, v, "velocities")
                device_arrays.assign(data.v, v)
            if group.kind.twist:
                frame = group.host.frame
                device_arrays.assign(data.frame, np.tile(frame, self.worlds) if self.worlds > 1 else frame)
                if spins is not None:
                    omega = np.zeros((group.nodes, group.columns))
                    self.order.put_edges(group, spins, omega)
                    device_arrays.assign(data.omega, omega)
                if angles is not None:
                    theta = np.zeros((group.nodes, group.columns))
                    self.order.put_edges(group, angles, theta, "angles")
                    device_arrays.assign(data.theta, theta)
        if self.coupled is not None:
            state.coupled = self.coupled.rest()
            for values, array, label in (
                (points, state.coupled.q, "points"),
                (velocities, state.coupled.v, "velocities"),
            ):
                if values is not None:
                    array.assign(self.order.put_blocks(values, array.numpy(), label))
            if angles is not None and self.scene.attachments:
                raise ValueError("angles: edges attached to a shell rotate with it; leave angles out")
            for edge_values, array, label in ((spins, state.coupled.v, "spins"), (angles, state.coupled.q, "angles")):
                if edge_values is not None:
                    values, start = self.order.of_edges(edge_values, label)
                    blocks = array.numpy().reshape(self.worlds, -1, 3)
                    for rod in self.coupled.host.rods:
                        blocks[:, rod.edges, 0] = values[..., start[rod.rod] + np.arange(len(rod.edges))]
                    array.assign(blocks.reshape(-1, 3))
            if self.coupled.bodies:
                self.coupled.bodies.carry(state.coupled)
        if points is not None:
            self.carry_frames(state)
        if self.coupled is not None:
            rod_shell_coupling.follow(
                self.coupled, state.coupled, angles=points is not None, rates=velocities is not None and spins is None
            )
        self.update_strains(state)
        return state

    def empty_state(self) -> State:
        """Allocate a state."""
        coupled, grips = self.coupled.empty() if self.coupled is not None else None, None
        if self.grips:
            shape = (6, self.worlds * len(self.grips))
            grips = GripState(wp.zeros(shape, dtype=self.types.real, device=self.wp_device))
        return State(self, [self.group_state(group) for group in self.groups], coupled, grips=grips)

    def restore(self, snapshot: Snapshot) -> State:
        """Return the state of a `State.snapshot`, bit by bit.

        Raises:
            ValueError: the snapshot is of another model.
        """
        if not isinstance(snapshot, dict):
            raise ValueError(f"restore: {type(snapshot).__name__} is no snapshot; give what state.snapshot() returns")
        state = self.empty_state()
        names = {"time", *({"spun"} & set(snapshot))} | {
            f"{part}/{name}" for part, data in state.parts().items() for name in data.arrays()
        }
        if names ^ set(snapshot):
            raise ValueError(f"snapshot is of another model: it differs by {', '.join(sorted(names ^ set(snapshot)))}")
        for part, data in state.parts().items():
            for name, array in data.arrays().items():
                values = np.asarray(snapshot[f"{part}/{name}"])
                if values.shape[: array.ndim] != array.shape:
                    raise ValueError(
                        f"snapshot is of another model: {name} has shape {values.shape}, not {array.shape}"
                    )
                device_arrays.assign(array, values)
        state.time, state.spun = float(snapshot["time"]), "spun" in snapshot
        return state

    def group_state(self, group: RodGroup) -> RodGroupState:
        """Allocate the state of a rod group."""
        kind, real = group.kind, self.types.real
        vector = wp.types.vector(kind.dim, real)
        nodes = (group.nodes, group.columns)

        def make(shape, dtype, needed=True):
            return device_arrays.allocate(shape if needed else (1,) * len(shape), dtype, self.wp_device)

        return RodGroupState(
            x=make(nodes, vector),
            v=make(nodes, vector),
            theta=make(nodes, real, kind.twist),
            omega=make(nodes, real, kind.twist),
            frame=make((7, *nodes), real, kind.twist),
            last=make((kind.strain_rows, *nodes), real, kind.viscous),
            a=make(nodes, vector),
            alpha=make(nodes, real, kind.twist),
        )

    def carry_frames(self, state: State) -> None:
        """Transport reference frames of a state to the current tangents."""
        for group, data in zip(self.groups, state.groups, strict=True):
            if group.kind.twist:
                new = device_arrays.allocate(data.frame.shape, self.types.real, self.wp_device)
                every = wp.full(group.columns, 1, dtype=int, device=self.wp_device)
                wp.launch(
                    rod_step.finish_frames_kernel(group.kind, self.types.real),
                    group.element_threads,
                    [data.x, data.frame, data.frame, group.count, every],
                    [new],
                    device=self.wp_device,
                )
                wp.copy(data.frame, new)
        if self.coupled is not None:
            self.coupled.carry(state.coupled, state.coupled)

    def update_strains(self, state: State) -> None:
        """Store the strains of a state for strain-rate damping."""
        for group, data in zip(self.groups, state.groups, strict=True):
            if group.kind.viscous:
                self.strains(group, data, data.last)
        if self.coupled is not None:
            self.coupled.update_strains(state.coupled)

    def strains(self, group: RodGroup, data: RodGroupState, out: wp.array, stress: wp.array | None = None) -> None:
        """Launch the strain kernel of a group; write elastic stresses to `stress` if given. Can be captured."""
        wp.launch(
            element_path.strain_kernel(rod_storage(group.kind, self.types.real), self.types.real),
            (group.elements, group.columns),
            [group.element_inputs(data, data.last), int(stress is not None)],
            [device_arrays.columns(out), device_arrays.columns(out if stress is None else stress)],
            device=self.wp_device,
        )


def needs_coupling(scene) -> bool:
    """Return True if a scene has more than uncoupled rods."""
    parts = (
        scene.shells,
        scene.joints,
        scene.attachments,
        scene.bodies,
        scene.magnets,
        scene.axisymmetric_shells,
        scene.contact_settings,
        scene.user_forces,
    )
    return any(map(bool, parts))


def check_model(call: str, model) -> None:
    """Raise SceneError if an argument is no model."""
    if not isinstance(model, Model):
        raise SceneError(f"{call}: the model is {type(model).__name__}; give what scene.build() returns")
