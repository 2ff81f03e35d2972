"""Triangulated sheets: connectivity and rest metric, computed once on the host with NumPy.

A `Mesh` stores what stays constant while the sheet moves: nodes, triangles, springs (edges) and hinges (pairs
of triangles with a shared edge), with the lengths, areas and weights of the rest shape. Equation numbers
refer to Andrejevic & Rycroft, J. Comput. Phys. (2022) 111607.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Int, Real, Shaped

from jaxcrumple.mesh.files import MeshError
from jaxcrumple.mesh.files.sheet import read_sheet
from jaxcrumple.mesh.files.write import FILE_FORMATS, write_triangles
from jaxcrumple.mesh.graph import components
from jaxcrumple.mesh.hilbert import hilbert_order

__all__ = ["FILE_FORMATS", "Mesh", "MeshError"]

# Positions as a user gives them, in two or three columns.
Points = Real[ArrayLike, "points _"] | Sequence[Sequence[float]]

_MIN_HEIGHT = 1e-6  # smallest height of a triangle, in units of its longest edge


@dataclass(frozen=True, eq=False)
class Mesh:
    """A connected, oriented, manifold triangulation and its rest metric. Read-only arrays, lengths in metres.

    Build one with `Mesh.from_arrays`, `Mesh.from_file`, `disc`, `rectangle` or `hexagonal`.

    - `vertices` (n, 3): rest positions in m, not necessarily flat.
    - `faces` (f, 3): nodes of each triangle, consistently oriented.
    - `edges` (e, 2): nodes of each spring, the smaller number first, in lexicographic order.
    - `hinges` (h, 4): nodes x0, x1, x2, x3 of each pair of triangles with a shared edge.
    - `hinge_edges` (h,), `hinge_faces` (h, 2): rows of the shared edge in `edges`, and of both triangles in
      `faces`.
    - `source_nodes` (n,): row of each node in the input.
    - `edge_length` (e,) in m: rest lengths of eq. 11; `face_area` (f,) in m2.
    - `hinge_length` (h,) in m: length of the shared edge; `hinge_area` (h,) in m2: area of both triangles
      (eq. 16); `hinge_height` (h,) in m: their mean height over the shared edge, area / length.
    - `hinge_weight` (h,): sqrt(3) length^2 / (2 area) of eq. 20, 1 for equilateral triangles.
    - `rest_curvature` (h,): signed curvature 2 sin(theta/2) at rest (eq. 33), 0 for a flat sheet.
    - `node_area` (n,) in m2: a third of the area of the triangles at a node.

    The columns of a hinge are as in Fig. 3a and (A.12)-(A.16): e0 = x1 - x0 is the shared edge, e1 = x2 - x0,
    e2 = x3 - x0, and n1 = e0 x e1, n2 = -e0 x e2 are the normals of its two faces (x0, x1, x2) and (x1, x0,
    x3), on the same side of the sheet. Its angle theta is positive where the sheet is convex seen from that
    side. The edge (x0, x1) points as in `edges`.
    """

    vertices: Float[np.ndarray, "nodes 3"]
    faces: Int[np.ndarray, "faces 3"]
    edges: Int[np.ndarray, "edges 2"]
    hinges: Int[np.ndarray, "hinges 4"]
    hinge_edges: Int[np.ndarray, " hinges"]
    hinge_faces: Int[np.ndarray, "hinges 2"]
    source_nodes: Int[np.ndarray, " nodes"]
    edge_length: Float[np.ndarray, " edges"]
    face_area: Float[np.ndarray, " faces"]
    hinge_length: Float[np.ndarray, " hinges"]
    hinge_area: Float[np.ndarray, " hinges"]
    hinge_weight: Float[np.ndarray, " hinges"]
    hinge_height: Float[np.ndarray, " hinges"]
    rest_curvature: Float[np.ndarray, " hinges"]
    node_area: Float[np.ndarray, " nodes"]

    @classmethod
    def from_arrays(
        cls,
        vertices: Points,
        faces: Int[ArrayLike, "faces 3"] | Sequence[Sequence[int]],
        *,
        reorder: bool = False,
    ) -> Mesh:
        """Check and orient a triangulated surface. The nodes keep their numbers if faces use all of them.

        **Arguments:**

        - `vertices`: (m, 2) or (m, 3) rest positions in m; two columns mean z = 0. Vertices that no face uses
          are dropped.
        - `faces`: (f, 3) integers. If the orientations of faces disagree, the minority is flipped.
        - `reorder`: number the nodes along a Hilbert curve and sort the faces to match. Neighbours on the
          sheet are then neighbours in memory, which is faster if the input has no such order. Arrays in the
          order of the input then do not fit the mesh; `array[source_nodes]` has the order of the mesh.

        **Raises:** `MeshError` naming the offending nodes or faces of the input: wrong shape or type,
        non-finite position, index out of range, repeated vertex, duplicate face, zero area, edge with more
        than two faces, several components, two fans touching at one node, one-sided surface.

        >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
        >>> square.area, square.edges.tolist()
        (1.0, [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]])
        >>> jc.Mesh.from_arrays([[0, 0], [1, 0], [2, 0]], [[0, 1, 2]])
        Traceback (most recent call last):
        jaxcrumple.mesh.files.surface.MeshError: face 0 with nodes (0, 1, 2) near (1, 0, 0) has no area; ...
        """
        x = _checked_vertices(vertices)
        f = _checked_faces(faces, len(x))
        _check_areas(x, f)
        f = _oriented(_checked_topology(f))
        order = np.unique(f)
        if reorder:
            order = order[hilbert_order(x[order])]
        number = np.zeros(len(x), np.int64)
        number[order] = np.arange(len(order))
        f = number[f]
        if reorder:
            f = f[np.lexsort(np.sort(f, axis=1).T[::-1])]
        topology = _connectivity(f.astype(np.int32))
        return cls(source_nodes=order.astype(np.int32), **topology, **_metric(x[order], topology))

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        *,
        reorder: bool = True,
        merge: float | str | None = None,
        unit: str | None = None,
    ) -> Mesh:
        """Read a surface of triangles, quadrilaterals or polygons from any file that trimesh or meshio reads.

        It skips points that no face uses, line segments, colours, normals and texture coordinates. It cuts
        quadrilaterals along the shorter diagonal. `source_nodes` counts the points of the file from 0.

        **Arguments:**

        - `reorder`: as in `from_arrays`, but on by default; False keeps the order of the file.
        - `merge`: merge points up to this distance apart, in m or a string such as "1 um". By default only
          STL files, which have no shared points, are merged, within 1e-6 of the size of the sheet.
        - `unit`: unit of all lengths in the file, such as "mm"; metres by default.

        **Raises:** `FileNotFoundError`; `MeshError` if the file cannot be read, holds no surface or volume
        cells, or fails the checks of `from_arrays`, whose numbers then refer to the file, from 0.

        **Warns:** `MeshWarning` for a size that suggests another unit.
        """
        points, faces = read_sheet(path, merge, unit)
        try:
            return cls.from_arrays(points, faces, reorder=reorder)
        except MeshError as error:
            raise MeshError(f"{str(path)!r}, its points counted from 0: {error}") from None

    def __post_init__(self) -> None:
        for name, array in vars(self).items():
            object.__setattr__(self, name, _read_only(array))

    def __reduce__(self) -> tuple[Any, ...]:
        # Pickling and copying make arrays writeable; the constructor makes them read-only again.
        return type(self), tuple(getattr(self, name.name) for name in fields(self))

    def save(self, path: str | Path) -> None:
        """Write nodes and triangles to a file.

        The ending of `path` selects the format: .vtu, .vtk, .ply, .obj, .off or .msh.
        `Mesh.from_file(path, reorder=False)` reads the same mesh back.

        **Raises:** `MeshError` for an unknown ending, `OSError` if the file cannot be written.
        """
        write_triangles(path, self.vertices, self.faces)

    def with_rest_shape(self, vertices: Points) -> Mesh:
        """Return the same connectivity with the rest metric of other positions.

        **Arguments:** `vertices`: (n, 3) or (n, 2) in m, in the order of the mesh.

        **Raises:** `MeshError` for a wrong shape, a non-finite position or a triangle without area.
        """
        x = _checked_vertices(vertices)
        if len(x) != self.n_nodes:
            raise MeshError(
                f"rest shape of {len(x)} nodes for a mesh of {self.n_nodes}; give one row per node"
            )
        _check_areas(x, self.faces)
        topology = {"faces": self.faces, "edges": self.edges, "hinges": self.hinges}
        return replace(self, **_metric(x, topology))

    @property
    def n_nodes(self) -> int:
        """Number of nodes n."""
        return len(self.vertices)

    @property
    def area(self) -> float:
        """Rest area A in m2."""
        return float(self.face_area.sum())

    @property
    def boundary_edges(self) -> Int[np.ndarray, " boundary"]:
        """Rows of `edges` that belong to one face only, ascending; empty for a closed surface."""
        return np.setdiff1d(np.arange(len(self.edges), dtype=np.int32), self.hinge_edges)

    @property
    def boundary_nodes(self) -> Int[np.ndarray, " boundary"]:
        """Nodes on the boundary, ascending; empty for a closed surface."""
        return np.unique(self.edges[self.boundary_edges])

    @property
    def linear_density(self) -> float:
        """lambda = sqrt(n / A) [1/m] of Fig. 3b."""
        return float(np.sqrt(self.n_nodes / self.area))


# Rest metric


def _metric(
    x: Float[np.ndarray, "nodes 3"], topology: dict[str, Int[np.ndarray, " ..."]]
) -> dict[str, Float[np.ndarray, " ..."]]:
    faces, edges, hinges = topology["faces"], topology["edges"], topology["hinges"]
    face_area = _doubled_areas(x, faces) / 2
    e0, e1, e2 = (x[hinges[:, k]] - x[hinges[:, 0]] for k in (1, 2, 3))
    n1, n2 = np.cross(e0, e1), -np.cross(e0, e2)
    length = np.linalg.norm(e0, axis=1)
    area = (np.linalg.norm(n1, axis=1) + np.linalg.norm(n2, axis=1)) / 2
    theta = np.arctan2((np.cross(n1, n2) * e0).sum(axis=1) / length, (n1 * n2).sum(axis=1))
    return {
        "vertices": x,
        "edge_length": np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1),
        "face_area": face_area,
        "hinge_length": length,
        "hinge_area": area,
        "hinge_weight": np.sqrt(3) * length**2 / (2 * area),
        "hinge_height": area / length,
        "rest_curvature": 2 * np.sin(theta / 2),
        "node_area": np.bincount(faces.ravel(), weights=np.repeat(face_area / 3, 3), minlength=len(x)),
    }


def _doubled_areas(
    x: Float[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " faces"]:
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _read_only(array: Shaped[np.ndarray, " *axes"]) -> Shaped[np.ndarray, " *axes"]:
    """Return the array itself if nothing can write to it, else a read-only copy."""
    base: Any = array
    safe = array.flags.c_contiguous
    while isinstance(base, np.ndarray):
        safe = safe and not base.flags.writeable
        base = base.base
    if not safe:
        array = np.array(array, order="C")
        array.flags.writeable = False
    return array


# Checks that need no connectivity


def _checked_vertices(vertices: Points) -> Float[np.ndarray, "points 3"]:
    raw = np.asarray(vertices)
    if raw.ndim != 2 or raw.shape[1] not in (2, 3):
        raise MeshError(f"vertices have shape {raw.shape}; give an array of shape (n, 2) or (n, 3)")
    if raw.dtype.kind not in "fiu":
        raise MeshError(f"vertices have type {raw.dtype}; give real numbers in metres")
    x = np.zeros((len(raw), 3))
    x[:, : raw.shape[1]] = raw
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(bad):
        raise MeshError(f"vertex {bad[0]} is at {_point(x[bad[0]])}{_more(bad)}; make every position finite")
    return x


def _checked_faces(
    faces: Int[ArrayLike, "faces 3"] | Sequence[Sequence[int]], n: int
) -> Int[np.ndarray, "faces 3"]:
    raw = np.asarray(faces)
    if raw.ndim != 2 or raw.shape[1] != 3 or len(raw) == 0:
        raise MeshError(f"faces have shape {raw.shape}; give an array of shape (f, 3) with f >= 1")
    if raw.dtype.kind not in "iu":
        raise MeshError(f"faces have type {raw.dtype}; give integer node numbers, counted from 0")
    f = raw.astype(np.int64)
    bad = np.flatnonzero(((f < 0) | (f >= n)).any(axis=1))
    if len(bad):
        where = f"face {bad[0]} is {_ids(f[bad[0]])}{_more(bad)}"
        raise MeshError(f"{where}, outside 0..{n - 1}; count nodes from 0 and give all {n} of them")
    bad = np.flatnonzero((f == np.roll(f, 1, axis=1)).any(axis=1))
    if len(bad):
        raise MeshError(f"face {bad[0]} repeats a vertex: {_ids(f[bad[0]])}{_more(bad)}; remove it")
    return f


def _check_areas(x: Float[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
    longest = np.max([np.linalg.norm(x[faces[:, k]] - x[faces[:, k - 1]], axis=1) for k in range(3)], axis=0)
    bad = np.flatnonzero(_doubled_areas(x, faces) <= _MIN_HEIGHT * longest**2)
    if len(bad):
        where = f"face {bad[0]} with nodes {_ids(faces[bad[0]])} near {_point(x[faces[bad[0]]].mean(axis=0))}"
        raise MeshError(f"{where} has no area{_more(bad)}; move its nodes apart or remesh there")


def _more(bad: Int[np.ndarray, " bad"]) -> str:
    return f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""


def _ids(row: Iterable[int]) -> str:
    return "(" + ", ".join(str(int(i)) for i in row) + ")"


def _point(x: Float[np.ndarray, " 3"]) -> str:
    return "(" + ", ".join(f"{c:.6g}" for c in x) + ")"


# Topology. Half-edge 3 f + k runs from vertex k to vertex k + 1 of face f; it also numbers the corner at k.


def _half_edges(
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[Int[np.ndarray, " half_edges"], Int[np.ndarray, " half_edges"], Int[np.ndarray, " half_edges"]]:
    """Tail, head and opposite node of each half-edge."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()


def edge_numbers(
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[Int[np.ndarray, "edges 2"], Int[np.ndarray, " half_edges"]]:
    """Edges (e, 2) in lexicographic order, and the edge of each half-edge."""
    tail, head, _ = _half_edges(faces.astype(np.int64))
    n = int(faces.max()) + 1
    keys, number = np.unique(np.minimum(tail, head) * n + np.maximum(tail, head), return_inverse=True)
    return np.stack([keys // n, keys % n], axis=1), number.ravel()


def half_edge_pairs(
    number: Int[np.ndarray, " half_edges"],
) -> tuple[Int[np.ndarray, " hinges"], Int[np.ndarray, " hinges"]]:
    """Return the two half-edges of every edge that has two."""
    order = np.argsort(number, kind="stable")
    first = np.flatnonzero(number[order[1:]] == number[order[:-1]])
    return order[first], order[first + 1]


def _checked_topology(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "faces 3"]:
    """Return `faces` if they form one connected manifold."""
    _, same, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    if count.max() > 1:
        twins = np.flatnonzero(same.ravel() == np.argmax(count))[:2]
        where = f"faces {_ids(twins)} have the same nodes {_ids(faces[twins[0]])}"
        raise MeshError(f"{where}{_more(np.flatnonzero(count > 1))}; keep one")
    edges, number = edge_numbers(faces)
    count = np.bincount(number)
    bad = np.flatnonzero(count > 2)
    if len(bad):
        owners = _ids(np.flatnonzero(number == bad[0]) // 3)
        where = f"edge {_ids(edges[bad[0]])} belongs to {count[bad[0]]} faces {owners}{_more(bad)}"
        raise MeshError(f"{where}; at most two faces may meet at an edge, so split the surface there")
    used, rows = np.unique(edges, return_inverse=True)
    parts, label = components(len(used), *rows.reshape(-1, 2).T)
    if parts > 1:
        sizes = np.sort(np.bincount(label))[::-1]
        listed = ", ".join(map(str, sizes[:8])) + (", ..." if parts > 8 else "")
        raise MeshError(
            f"{parts} separate pieces of {listed} nodes; keep one, or merge coincident nodes (merge = 0)"
        )
    _check_fans(faces, number)
    return faces


def _check_fans(faces: Int[np.ndarray, "faces 3"], number: Int[np.ndarray, " half_edges"]) -> None:
    """Require that shared edges connect all corners at each node."""
    a, b = half_edge_pairs(number)
    node, following = faces.ravel(), np.arange(faces.size).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    same = node[a] == node[b]
    tails = np.where(same, b, following[b]), np.where(same, following[b], b)
    fans, label = components(faces.size, np.concatenate([a, following[a]]), np.concatenate(tails))
    node_of_fan = np.empty(fans, dtype=np.int64)
    node_of_fan[label] = node
    count = np.bincount(node_of_fan)
    bad = np.flatnonzero(count > 1)
    if len(bad):
        where = f"node {bad[0]} joins {count[bad[0]]} fans of faces that share no edge{_more(bad)}"
        raise MeshError(f"{where}; give each fan a node of its own, or fill the gap")


def _oriented(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "faces 3"]:
    """Flip faces until neighbours agree in orientation.

    Each face stands for two nodes of a graph: as given (i) and flipped (i + f). The graph connects
    neighbours that agree. It splits into the two orientations unless the surface has only one side.
    """
    a, b = half_edge_pairs(edge_numbers(faces)[1])
    clash = faces.ravel()[a] == faces.ravel()[b]
    i, j, f = a // 3, b // 3, len(faces)
    pairs = np.concatenate([i, i + f]), np.concatenate([j + f * clash, j + f * ~clash])
    parts, label = components(2 * f, *pairs)
    if parts == 1:
        raise MeshError("the surface has only one side, like a Moebius band, and no orientation; cut it open")
    turned = label[:f] != np.argmax(np.bincount(label[:f], minlength=2))
    return np.where(turned[:, None], faces[:, [0, 2, 1]], faces)


def _connectivity(faces: Int[np.ndarray, "faces 3"]) -> dict[str, Int[np.ndarray, " ..."]]:
    """Edges and hinges of consistently oriented faces."""
    edges, number = edge_numbers(faces)
    tail, head, opposite = _half_edges(faces)
    along, against = np.full(len(edges), -1), np.full(len(edges), -1)
    half_edges = np.arange(faces.size)
    along[number[tail < head]] = half_edges[tail < head]
    against[number[tail > head]] = half_edges[tail > head]
    inner = np.flatnonzero((along >= 0) & (against >= 0))
    one, two = along[inner], against[inner]
    hinges = np.column_stack([edges[inner], opposite[one], opposite[two]])
    pairs = np.stack([one, two], axis=1) // 3
    tables = {"faces": faces, "edges": edges, "hinges": hinges, "hinge_edges": inner, "hinge_faces": pairs}
    return {name: table.astype(np.int32) for name, table in tables.items()}
