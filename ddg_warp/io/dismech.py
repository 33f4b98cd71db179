"""Readers of rods and shells in text files of the DisMech family (MATLAB, Python: sections; C++: bare coordinates).

    *Nodes               one `x, y, z` a line, metres (also `*rodNodes`)
    0.0, 0.0, 0.0
    ...
    *Edges               one `i, j` a line (also `*rodEdges`), counted from 1
    1, 2
    *Triangles           one `i, j, k` a line (also `*shellTriangles`), counted from 1
    1, 2, 3

The MATLAB and Python programs count nodes from 1. A file in which an edge or a triangle names node 0 is taken to count from 0.
The C++ program has no sections: its files hold one node a line, separated by blanks, in order along a single rod.
Sections that the programs derive from edges (`*elStretchRod`, ...) are skipped. Separators are commas or blanks.
Text after `#` or `%` is a comment, in any encoding.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ddg_warp.io.curves import CurveSet, checked_curves
from ddg_warp.io.file_mesh import FileMesh, mesh_of_polygons
from ddg_warp.io.paths import CurveError, MeshError, existing, shown

COLUMNS = {"nodes": (3, float), "edges": (2, int), "triangles": (3, int)}
ALIASES = {"rodnodes": "nodes", "rodedges": "edges", "shelltriangles": "triangles"}
BEYOND = 2**31  # a node that no file has
DERIVED_PREFIX = "el"


def read_rods(path) -> CurveSet:
    """Return the rods of a DisMech text file, in which edges form separate paths and cycles.

    Nodes are returned in the order in which the edges run through them. The format stores no radius. Triangles, and nodes that
    only triangles use, are listed as unread; `read_mesh` reads them.
    """
    path = existing(path)
    sections = _sections(path)
    nodes = np.array(sections["nodes"], dtype=np.float64).reshape(-1, 3)
    if not len(nodes):
        raise CurveError(f"{path}: there are no nodes; write one `x, y, z` a line below `*Nodes`")
    triangles = np.array(sections["triangles"], int).reshape(-1, 3)
    if len(triangles) and not sections["edges"]:
        raise CurveError(f"{path}: the file holds a shell (`*Triangles`) and no rods (`*Edges`); read it by read_mesh")
    edges, base = _edges(sections, len(nodes), path)
    neighbours = _neighbours(edges, len(nodes))
    of_shell = np.isin(np.arange(len(nodes)) + base, triangles)
    for node, adjacent in enumerate(neighbours):
        if adjacent or not of_shell[node]:
            _refuse_joint(f"{path}: node {node + base}", adjacent)
    paths = [each for each in _polylines(neighbours) if len(each[0]) > 1]
    order = np.concatenate([nodes_in_order for nodes_in_order, _ in paths])
    counts, closed = [len(nodes_in_order) for nodes_in_order, _ in paths], [closed for _, closed in paths]
    curves = checked_curves(nodes[order], counts, closed, None, "Nodes", str(path))
    if not len(triangles):
        return curves
    shared = np.count_nonzero(of_shell[order])
    text = f"{len(triangles)} triangles of a shell, to which {shared} nodes of rods belong; read_mesh reads them"
    return replace(curves, unread=(text,))


def read_shell(path) -> FileMesh:
    """Return the triangles of a DisMech text file as a mesh, in metres; edges of rods are listed as unread.

    Raises:
        MeshError: The file has no triangles, or cannot be read; names the line.
    """
    try:
        sections = _sections(path)
    except CurveError as error:
        raise MeshError(str(error)) from error
    if not sections["triangles"]:
        raise MeshError(f"{path}: there is not a single face; write one `i, j, k` a line below `*Triangles`")
    nodes = np.array(sections["nodes"], dtype=np.float64).reshape(-1, 3)
    triangles = np.array(sections["triangles"], dtype=int)
    lost = [f"{len(sections['edges'])} edges of rods"] * bool(sections["edges"])
    counts = np.full(len(triangles), 3)
    return mesh_of_polygons(nodes, counts, triangles.ravel() - _first(sections), str(path), path.stem, lost=lost)


def _first(sections: dict[str, list[tuple]]) -> int:
    """Return the number of the first node, 0 or 1."""
    return 0 if any(0 in row for name in ("edges", "triangles") for row in sections[name]) else 1


def _sections(path) -> dict[str, list[tuple]]:
    """Return rows of numbers by section name; lines before the first header are nodes."""
    sections: dict[str, list[tuple]] = {name: [] for name in COLUMNS}
    sections["headers"] = []
    current = "nodes"
    for number, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1):
        text = line.partition("#")[0].partition("%")[0].strip()
        if text.startswith("*"):
            current = _section(text, f"{path}:{number}")
            sections["headers"].append(current)
        elif text and current in COLUMNS:
            sections[current].append(_row(text, current, f"{path}:{number}"))
    return sections


def _section(header: str, where: str) -> str:
    name = header[1:].strip().lower()
    name = ALIASES.get(name, name)
    if name not in COLUMNS and not name.startswith(DERIVED_PREFIX):
        raise CurveError(
            f"{where}: unknown section `{shown([header])}`; known are *Nodes, *Edges, *Triangles, *rodNodes, *rodEdges, *shellTriangles"
        )
    return name


def _row(text: str, section: str, where: str) -> tuple:
    width, number = COLUMNS[section]
    try:
        row = tuple(number(word) for word in text.replace(",", " ").split())
    except ValueError:
        row = ()
    if len(row) != width:
        raise CurveError(
            f"{where}: `{shown([text])}` is not a line of *{section}: {width} {number.__name__} values are expected"
        )
    if number is int and max(map(abs, row)) > BEYOND:
        raise CurveError(f"{where}: `{shown([text])}` names a node that no file has; correct the line")
    return row


def _edges(sections: dict[str, list[tuple]], node_count: int, path) -> tuple[np.ndarray, int]:
    """Return (node pairs counted from 0 (E, 2), first node of the file, 0 or 1); one rod without sections."""
    if not sections["headers"]:
        first = np.arange(node_count - 1)
        return np.column_stack([first, first + 1]), 0
    if not sections["edges"]:
        raise CurveError(f"{path}: there are no edges; write one `i, j` a line below `*Edges`")
    edges = np.array(sections["edges"], dtype=int)
    base = _first(sections)
    out_of_range = np.flatnonzero(((edges < base) | (edges >= node_count + base)).any(axis=1))
    if len(out_of_range):
        i, j = edges[out_of_range[0]]
        raise CurveError(
            f"{path}: edge {i}, {j} names a node that does not exist; nodes run from {base} to {node_count - 1 + base}"
        )
    if (edges[:, 0] == edges[:, 1]).any():
        i = edges[edges[:, 0] == edges[:, 1]][0, 0]
        raise CurveError(f"{path}: an edge joins node {i} to itself; remove it")
    return edges - base, base


def _neighbours(edges: np.ndarray, node_count: int) -> list[list[int]]:
    neighbours: list[list[int]] = [[] for _ in range(node_count)]
    for i, j in edges.tolist():
        neighbours[i].append(j)
        neighbours[j].append(i)
    return neighbours


def _refuse_joint(node: str, adjacent: list[int]) -> None:
    """Refuse a node without one or two different neighbours."""
    if not adjacent:
        raise CurveError(f"{node} belongs to no edge; remove it or join it")
    if len(adjacent) > 2:
        raise CurveError(f"{node} joins {len(adjacent)} edges; networks are not supported yet, split the rods there")
    if len(set(adjacent)) < len(adjacent):
        raise CurveError(f"{node}: an edge is listed twice; remove one")


def _polylines(neighbours: list[list[int]]) -> list[tuple[list[int], bool]]:
    """Return paths and cycles as (nodes in order, closed), ordered by first node in the file."""
    ends = [node for node, adjacent in enumerate(neighbours) if len(adjacent) == 1]
    visited: set[int] = set()
    paths = []
    for start in ends + list(range(len(neighbours))):
        if start not in visited:
            nodes = _walk(start, neighbours)
            visited.update(nodes)
            paths.append((nodes, len(neighbours[start]) == 2))
    return sorted(paths, key=lambda nodes: min(nodes[0]))


def _walk(start: int, neighbours: list[list[int]]) -> list[int]:
    """Return the nodes along the edges from `start` to an end or around a cycle."""
    nodes, previous, node = [start], None, start
    while True:
        following = [neighbour for neighbour in neighbours[node] if neighbour != previous]
        if not following or following[0] == start:
            return nodes
        previous, node = node, following[0]
        nodes.append(node)
