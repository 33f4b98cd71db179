"""Shells of a scene with supports and loads, joints of rods, and attachments of rods to shells."""

import warnings
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SceneWarning
from ddg_warp.geometry.fundamental_forms import MEMBRANES, MODELS, TURNING
from ddg_warp.geometry.surface import Surface
from ddg_warp.scene import validate
from ddg_warp.scene.axisymmetric_shells import Meridians
from ddg_warp.scene.contact import Contacts
from ddg_warp.scene.descriptions import Attachment, EdgeCouple, Joint, Pressure, Shell, ShellLoad, ShellSupport
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.handle import BODY, SHELL, SHELL_SUPPORT, Handle, need
from ddg_warp.scene.law import Law, laws_of
from ddg_warp.scene.magnets import Magnets
from ddg_warp.scene.material import Material
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.typing import Amplitude, Axis, Numbers, Selection, Vector

COINCIDE = 1e-6  # largest distance of coincident or coplanar points, over the largest coordinate


@argument_checks.called
@dataclass(kw_only=True, repr=False, eq=False)
class Structures(Meridians, Magnets, Contacts):
    """Shells, joints and attachments of a scene: everything but uncoupled rods."""

    shells: list[Shell] = field(default_factory=list, init=False)
    shell_supports: list[ShellSupport] = field(default_factory=list, init=False)
    shell_loads: list[ShellLoad] = field(default_factory=list, init=False)
    pressures: list[Pressure] = field(default_factory=list, init=False)
    edge_couples: list[EdgeCouple] = field(default_factory=list, init=False)
    joints: list[Joint] = field(default_factory=list, init=False)
    attachments: list[Attachment] = field(default_factory=list, init=False)

    def add_shell(
        self,
        points: Numbers,
        triangles: Numbers,
        *,
        thickness: Numbers,
        material: Material,
        bending: Literal["midedge_dof", "midedge_boundary", "midedge", "hinge", "isometric"] = "midedge_dof",
        membrane: Literal["flat", "curved"] = "flat",
        rest: Literal["shape", "flat"] | tuple[Numbers, Numbers] = "shape",
        name: str = "shell",
        laws: Mapping[str, Law] | None = None,
        uv: Numbers | None = None,
    ) -> Handle:
        """Add a triangle mesh as a thin shell.

        Args:
            points: vertices at rest (P, 3) [m].
            triangles: corners (T, 3), neighbours oriented alike; normals follow the right hand.
            thickness: one number or one a triangle [m].
            material: `Material`; its density gives the mass, its viscosity the strain-rate damping.
            bending: "midedge_dof", "midedge_boundary", "midedge", "hinge" or "isometric"; see `ddg_warp.compile.shells`.
            membrane: "flat" (constant strain triangles) or "curved" (sides as long as arcs by the normals of bending "midedge_dof").
                "curved" avoids membrane locking of thin shells at large bending, for statics only. It about doubles the time of an
                iteration.
            rest: "shape" takes metric and curvature at rest from the points, "flat" the metric alone. Or two arrays (abar (T, 3)
                [m^2], bbar (T, 3) [m]), first and second fundamental form in the basis of the first two edges.
            name: shown in reports and output.
            laws: a `Law` for terms by name, such as "shell_stretch" or "shell_bend_dof", instead of the material's.
            uv: texture coordinates for recordings, at the corners of triangles (T, 3, 2), such as `read_mesh(path).uv`, or at vertices
                (P, 2).

        Returns:
            Handle of the shell.

        Raises:
            SceneError: no valid surface; the message names shell and triangle.
        """
        surface = Surface(points, triangles, argument_checks.text("add_shell: name", name))
        if not isinstance(material, Material):
            raise SceneError(
                f"shell '{name}': material is {argument_checks.shown(material)}; give material=Material(...)"
            )
        if np.any(np.abs(material.poisson) >= 1.0):
            raise SceneError(f"shell '{name}': Poisson's ratio {material.poisson}; that of a shell is between -1 and 1")
        argument_checks.choice(f"shell '{name}': bending", bending, MODELS)
        argument_checks.choice(f"shell '{name}': membrane", membrane, MEMBRANES)
        if isinstance(rest, str):
            argument_checks.choice(f"shell '{name}': rest", rest, ("shape", "flat"))
        else:
            rest = _forms(f"shell '{name}': rest", rest, len(surface.triangles))
        label = f"shell '{name}': thickness"
        thickness = argument_checks.array(label, thickness, "give one number, or one a triangle [m]").copy()
        argument_checks.sized(label, thickness)
        laws = laws_of(f"shell '{name}'", laws)
        uv = None if uv is None else _texture(f"shell '{name}': uv", uv, surface)
        _warn_of_pieces(surface)
        self.shells.append(Shell(surface, thickness, deepcopy(material), bending, membrane, rest, name, laws, uv))
        return Handle(len(self.shells) - 1, SHELL, name)

    def hold(
        self,
        shell: int,
        vertices: Selection,
        components: str = "xyz",
        motion: Motion | Grip | None = None,
        name: str = "",
    ) -> Handle:
        """Fix or prescribe components of vertices of a shell, free to rotate (simply supported).

        `motion` may give a displacement for every vertex. `name` is the support's in `Model.reactions`.
        """
        return self._hold("hold", shell, vertices, components, motion=motion, name=name)

    def clamp_boundary(
        self,
        shell: int,
        vertices: Selection,
        components: str = "xyz",
        motion: Motion | Grip | None = None,
        name: str = "",
    ) -> Handle:
        """Clamp a shell: fix components of vertices, and the normal at mesh edges between them, interior edges too.

        `motion` moves the components and rotates the normals as one body, also by more than one revolution. Other components stay
        free, so that with "yz" a rotating clamp can slide along x.
        """
        vertices = self._vertices(shell, vertices)
        surface = self.shells[shell].surface
        self._need_edges("clamp_boundary", shell, vertices, np.arange(len(surface.edges)), "mesh edge", "hold")
        return self._hold("clamp_boundary", shell, vertices, components, edges="clamp", motion=motion, name=name)

    def symmetry(
        self, shell: int, vertices: Selection, axis: Axis | Vector, motion: Motion | Grip | None = None, name: str = ""
    ) -> Handle:
        """Add a symmetry plane through boundary vertices, orthogonal to the surface.

        Args:
            shell: index.
            vertices: at the boundary, in one plane.
            axis: coordinate axis normal to the plane, "x", "y" or "z"; or the normal (3,), of any length (skew support).
            motion: translation of the plane along a coordinate axis.
            name: of the support in `Model.reactions`.

        Raises:
            SceneError: vertices in no common plane or not at the boundary, or an unsupported motion of the plane.
        """
        if isinstance(axis, str):
            normal = np.eye(3)["xyz".index(argument_checks.choice("symmetry: axis", axis, ("x", "y", "z")))]
        else:
            normal = argument_checks.direction("symmetry: axis, 'x', 'y' or 'z' or the plane's normal,", axis)
            # a coordinate axis to rounding is made exact
            axis = "xyz"[np.argmax(np.abs(normal))] if np.sort(np.abs(normal))[1] < 1e-15 else ""
            normal = np.round(normal) if axis else normal
        vertices = self._vertices(shell, vertices)
        surface = self.shells[shell].surface
        height = surface.points[vertices] @ normal
        off = np.abs(height - np.median(height))
        if off.max() > COINCIDE * np.ptp(surface.points, axis=0).max():
            raise SceneError(
                f"symmetry: vertex {vertices[np.argmax(off)]} of shell {shell} is {off.max():.3g} m off the plane "
                f"{axis or 'with this normal at'} = {np.median(height):g} m of the others; choose the vertices of one plane"
            )
        self._need_edges("symmetry", shell, vertices, surface.boundary_edges, "boundary edge", "hold")
        if motion is not None and (not axis or getattr(motion, "turns", False)):
            raise SceneError(
                "symmetry: a moving plane is normal to a coordinate axis and does not rotate; give 'x', 'y' or 'z' and "
                "Motion(translation=...)"
            )
        options = {"edges": "symmetry", "normal": tuple(normal.tolist()), "motion": motion, "name": name}
        return self._hold("symmetry", shell, vertices, axis, **options)

    def add_vertex_force(
        self, shell: int, vertices: Selection, force: Numbers, amplitude: Amplitude | None = None
    ) -> Handle:
        """Add a dead force [N] on each of some vertices, (3,) or (V, 3). In statics it grows with the load parameter."""
        vertices = argument_checks.once("add_vertex_force: vertices", self._vertices(shell, vertices))
        force = argument_checks.broadcast("add_vertex_force: force", force, (len(vertices), 3), own=1)
        amplitude = argument_checks.amplitude("add_vertex_force", amplitude)
        self.shell_loads.append(ShellLoad(shell, vertices, force, amplitude))
        return Handle(len(self.shell_loads) - 1, "shell load")

    def add_edge_force(self, shell: int, path: Selection, force: Vector, amplitude: Amplitude | None = None) -> Handle:
        """Add a dead force per length (3,) [N/m] along mesh edges, half of each edge's force to either end.

        Args:
            shell: index.
            path: boundary vertices in any order, which load all boundary edges between them; or any mesh edges as pairs of vertices
                (E, 2).
            force: per length [N/m].
            amplitude: function of time, or None.
        """
        surface, edges = self._mesh_edges("add_edge_force", shell, path)
        force = np.array(argument_checks.vector("add_edge_force: force", force))
        half = 0.5 * np.linalg.norm(np.diff(surface.points[surface.edges[edges]], axis=1)[:, 0], axis=1)
        length = np.bincount(surface.edges[edges].ravel(), np.repeat(half, 2), len(surface.points))
        vertices = np.flatnonzero(length)
        amplitude = argument_checks.amplitude("add_edge_force", amplitude)
        self.shell_loads.append(ShellLoad(shell, vertices, length[vertices, None] * force, amplitude))
        return Handle(len(self.shell_loads) - 1, "shell load")

    def add_edge_couple(
        self, shell: int, path: Selection, couple: Numbers, amplitude: Amplitude | None = None
    ) -> Handle:
        """Add a couple per length at rest [N] about boundary edges: a follower edge moment.

        Positive by the right hand about the edge with the surface to its left: a positive couple makes the surface convex on the side
        of its normals. It is conjugate to the angle of the mid-edge normal, which needs bending "midedge_dof" or "midedge_boundary".
        It has no potential if the edge changes its direction.

        Args:
            shell: index.
            path: as for `add_edge_force`, boundary edges only.
            couple: one number, or one an edge for edges as pairs [N].
            amplitude: function of time, or None.

        Raises:
            SceneError: an edge inside the surface, or one without an angle.
        """
        surface, edges = self._mesh_edges("add_edge_couple", shell, path)
        bending = self.shells[shell].bending
        if bending not in TURNING:
            raise SceneError(
                f"add_edge_couple: the edges of shell {shell} have no angle with bending {bending!r}; take {' or '.join(TURNING)}"
            )
        for edge in edges[~surface.boundary[edges]][:1]:
            raise SceneError(
                "add_edge_couple: the edge between the vertices {} and {} is inside the surface; give edges of its boundary".format(
                    *surface.edges[edge]
                )
            )
        couple = argument_checks.broadcast("add_edge_couple: couple", couple, edges.shape)
        self.edge_couples.append(
            EdgeCouple(shell, edges, couple, argument_checks.amplitude("add_edge_couple", amplitude))
        )
        return Handle(len(self.edge_couples) - 1, "edge couple")

    def add_pressure(
        self,
        shell: int,
        pressure: Numbers,
        triangles: Selection | None = None,
        *,
        dead: bool = False,
        amplitude: Amplitude | None = None,
    ) -> Handle:
        """Add pressure [Pa] along the normals of triangles (all by default).

        Pressure is a follower load, without potential if the boundary moves. Statics uses its exact, unsymmetric load stiffness; in
        dynamics its forces are time-lagged, evaluated on the predicted surface. With `dead` it keeps normals and areas of the rest
        shape.
        """
        self._check_shell(shell)
        count = len(self.shells[shell].triangles)
        index = slice(None) if triangles is None else triangles
        index = argument_checks.once(
            "add_pressure: triangles", argument_checks.indices("add_pressure: triangles", index, count)
        )
        missing = index[(index < 0) | (index >= count)]
        if missing.size:
            raise SceneError(f"add_pressure: triangle {missing[0]} does not exist; shell {shell} has {count}")
        pressure = argument_checks.broadcast("add_pressure: pressure", pressure, index.shape)
        dead, amplitude = (
            argument_checks.flag("add_pressure: dead", dead),
            argument_checks.amplitude("add_pressure", amplitude),
        )
        self.pressures.append(Pressure(shell, index, pressure, dead, amplitude))
        return Handle(len(self.pressures) - 1, "pressure")

    def join(
        self, members: Iterable[tuple[int, int]], rigid: bool = True, laws: Mapping[str, Law] | None = None
    ) -> None:
        """Join rods at nodes, (rod, node) each, which coincide at rest.

        A rigid joint has rotation dofs, and bends every adjacent edge against this rotation over half a cell, so that two collinear
        rods joined rigidly are one rod. A hinged joint has only a common position.

        Args:
            members: (rod, node) each.
            rigid: whether the joint has rotation dofs.
            laws: of a rigid joint, a `Law` for its term "rigid_joint", instead of the quadratic law with the sections' stiffness.

        Raises:
            SceneError: invalid members; at `build`, points that do not coincide, or a law that does not fit.
        """
        pairs = []
        for member in members if np.iterable(members) else [members]:
            pair = tuple(member) if np.iterable(member) else ()
            if len(pair) != 2:
                raise SceneError(f"join: {member!r} is no member; give (rod, node) each")
            rods, (node,) = self._on_rods("join", *pair[:1], "node", argument_checks.index("join: node", pair[1]))
            pairs.append((int(rods[0]), node))
        if len(set(pairs)) < 2:
            raise SceneError(f"join: {pairs}; a joint has two different members at least, (rod, node) each")
        rigid, laws = argument_checks.flag("join: rigid", rigid), laws_of("join", laws)
        if laws and not rigid:
            raise SceneError(
                "join: a hinged joint has no energy to give a law; leave laws out, or join it with rigid=True"
            )
        self.joints.append(Joint(tuple(pairs), rigid, laws))

    def join_coincident(
        self, rods: Selection | None = None, rigid: bool = True, laws: Mapping[str, Law] | None = None
    ) -> None:
        """Join rods wherever nodes coincide at rest: gridshells, lattices. Nodes of earlier joints stay as they are.

        Args:
            rods: rods to join, by default all rods added so far.
            rigid, laws: of every joint, see `join`.

        Raises:
            SceneError: no nodes coincide.
        """
        from scipy.spatial import cKDTree

        rods = argument_checks.once(
            "join_coincident: rods", self._rods(range(self.rod_count) if rods is None else rods)
        )
        points, members = [], []
        for batch in self._batches(rods):
            for rod in rods[(rods >= batch.first) & (rods < batch.first + batch.rods)].tolist():
                points.append(batch.points[rod - batch.first])
                members += [(rod, node) for node in range(batch.nodes)]
        points, earlier = np.concatenate(points), {member for joint in self.joints for member in joint.members}
        groups: dict[int, list[int]] = {}
        for first, second in sorted(cKDTree(points).query_pairs(COINCIDE * np.abs(points).max())):
            if earlier.isdisjoint((members[first], members[second])):
                groups.setdefault(first, [first]).append(second)
        joined: set[int] = set()
        for first, group in groups.items():
            if first not in joined:  # later nodes of a group list the rest of it again
                joined.update(group)
                self.join([members[index] for index in group], rigid, laws)
        if not joined:
            raise SceneError("join_coincident: no nodes coincide at rest; give rods that cross or meet at nodes")

    def attach(
        self,
        rod: int,
        nodes: Selection,
        shell: int,
        vertices: Selection | None = None,
        spin: Literal["glued", "free"] | None = None,
        frame: bool | None = None,
    ) -> None:
        """Merge nodes of a rod with vertices of a shell, coincident at rest; or let a rigid body carry nodes or vertices.

        Args:
            rod: index; with a body also the handle of a shell.
            nodes: of the rod, or vertices of the shell that a body carries.
            shell: index; or the handle of a body, which carries the nodes from where they are at rest.
            vertices: as many as nodes; none for a body.
            frame: for a body: True (default) clamps the rod by its frame at the nodes, as a rigid joint does; False leaves a ball
                joint. A shell has a ball joint at each vertex, so that two vertices leave a hinge.
            spin: for a shell: "glued" (default) couples the twist of rod edges on mesh edges to the shell (rod-shell coupling). The
                directors of such an edge rotate about it with the surface, at the same angle as at rest. Two triangles act by their
                mean, which leaves the stiffness of a fold along the rod unchanged. "free" leaves the twist uncoupled.

        The coupling constrains only rotation about the edge. A rod off the mesh edges (a post, a line from a vertex) has a ball joint
        and may spin; a rod without twist has no spin. With bending "midedge_dof" the mid-edge normal rotates the rod, on any mesh.
        Otherwise the triangle normals do, which is accurate for a uniform mesh along the rod. Edges on a symmetry plane do not
        rotate.

        Raises:
            SceneError: an index out of range, not as many vertices as nodes, or another `spin`. At `build`: points that do not
                coincide, or a node that two bodies, or a body and a support, hold.
        """
        if isinstance(shell, Handle) and shell.kind == BODY:
            if vertices is not None or spin is not None:
                raise SceneError(
                    "attach: vertices and spin are for a shell; a body carries nodes as they are, with frame"
                )
            self._attach_to_body(rod, nodes, shell, True if frame is None else frame)
            return
        if vertices is None or frame is not None:
            raise SceneError("attach: a shell takes vertices, and no frame, which is for the handle of a body")
        spin = "glued" if spin is None else spin
        (rod,), nodes = self._on_rods("attach", argument_checks.index("attach: rod", rod), "node", nodes)
        vertices = self._vertices(shell, vertices)
        if len(nodes) != len(vertices):
            raise SceneError(f"attach: {len(nodes)} nodes of rod {rod} and {len(vertices)} vertices; give as many")
        glued = argument_checks.choice("attach: spin", spin, ("glued", "free")) == "glued"
        self.attachments.append(Attachment(int(rod), np.array(nodes), shell, vertices, glued))

    def _hold(self, call: str, shell, vertices, components, *, name: str, **options) -> Handle:
        name = name and argument_checks.text(f"{call}: name", name)
        if options.get("edges") != "symmetry":  # a skew support has no components
            argument_checks.components(call, components)
        motion, vertices = options.get("motion"), self._vertices(shell, vertices)
        validate.check_motion(call, motion, planar=False)
        if motion is not None and motion.count not in (None, len(vertices)):
            raise SceneError(
                f"{call}: the motion has {motion.count} displacements of {len(vertices)} vertices; give one for each"
            )
        self.shell_supports.append(ShellSupport(shell, vertices, components, call=call, name=name, **options))
        return Handle(len(self.shell_supports) - 1, SHELL_SUPPORT, name)

    def _check_shell(self, shell) -> None:
        need(SHELL, shell)
        if not 0 <= argument_checks.index("shell", shell) < len(self.shells):
            raise SceneError(f"shell {shell} does not exist; the scene has {len(self.shells)} shells so far")

    def _vertices(self, shell, vertices) -> np.ndarray:
        self._check_shell(shell)
        count = len(self.shells[shell].points)
        index = argument_checks.indices("vertices", vertices, count)
        missing = index[(index < 0) | (index >= count)]
        if missing.size:
            raise SceneError(f"vertex {missing[0]} does not exist: shell {shell} has {count} vertices")
        return index

    def _mesh_edges(self, call: str, shell: int, path) -> tuple[Surface, np.ndarray]:
        """Return the surface of a shell and edges between boundary vertices or pairs of vertices."""
        self._check_shell(shell)
        surface = self.shells[shell].surface
        if np.ndim(path) == 2 and np.shape(path)[1] == 2 and np.asarray(path).dtype.kind in "iu":
            edges = surface.edge_between(*np.asarray(path).T)
            return surface, argument_checks.once(f"{call}: edges", edges)
        vertices = self._vertices(shell, path)
        return surface, self._need_edges(
            call, shell, vertices, surface.boundary_edges, "boundary edge", "pairs of vertices"
        )

    def _need_edges(self, call: str, shell: int, vertices, among: np.ndarray, kind: str, instead: str) -> np.ndarray:
        """Return the edges between vertices; refuse a vertex without such an edge."""
        surface = self.shells[shell].surface
        edges = np.intersect1d(surface.edges_on(vertices), among)
        alone = np.setdiff1d(vertices, surface.edges[edges])
        if alone.size:
            raise SceneError(
                f"{call}: no {kind} leads from vertex {alone[0]} of shell {shell} to another of the {len(vertices)} vertices given; "
                f"choose the ends of edges, or use {instead}"
            )
        return edges


def _forms(label: str, rest, triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """Return copies of the rest forms (abar, bbar), checked."""
    if not isinstance(rest, list | tuple) or len(rest) != 2:
        raise SceneError(f"{label} is {argument_checks.shown(rest)}; it is 'shape', 'flat' or two arrays (abar, bbar)")
    forms = tuple(argument_checks.array(label, values).copy() for values in rest)
    for values in forms:
        if values.shape != (triangles, 3) or not np.isfinite(values).all():
            raise SceneError(f"{label} has shape {values.shape}; both arrays are finite and of shape {(triangles, 3)}")
        argument_checks.sized(label, values)
    return forms


def _texture(label: str, uv, surface: Surface) -> np.ndarray:
    """Return texture coordinates at the corners of triangles (T, 3, 2)."""
    values = argument_checks.array(label, uv, "give (T, 3, 2) at corners of triangles, or (P, 2) at vertices")
    if values.shape == (len(surface.points), 2):
        values = values[surface.triangles]
    if values.shape != (*surface.triangles.shape, 2) or not np.isfinite(values).all():
        raise SceneError(
            f"{label} has shape {values.shape}; give finite numbers, {(*surface.triangles.shape, 2)} at corners of triangles or "
            f"{(len(surface.points), 2)} at vertices"
        )
    return values.copy()


def _warn_of_pieces(surface: Surface) -> None:
    """Warn of a mesh in several components with coincident vertices, which likely needs welding."""
    pieces = surface.pieces
    if pieces == 1:
        return
    step = COINCIDE * max(1e-300, np.ptp(surface.points, axis=0).max())
    shared = len(surface.points) - len(np.unique(np.round(surface.points / step), axis=0))
    if shared:
        warnings.warn(
            f"shell '{surface.name}' falls into {pieces} pieces, though {shared} of its vertices lie on others: weld them with "
            "read_mesh(path, weld=1e-6) or meshes.weld(points, triangles, 1e-6)",
            SceneWarning,
            stacklevel=4,
        )
