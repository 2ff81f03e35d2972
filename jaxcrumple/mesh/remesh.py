"""Remesh a flat sheet with random nodes inside its outline."""

from __future__ import annotations

from typing import SupportsIndex

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxcrumple.mesh.generate import centroids, guard_points, lattice_spacing, whole_number
from jaxcrumple.mesh.isotropy import flattened
from jaxcrumple.mesh.mesh import Mesh, MeshError

_CORNER = np.radians(20)  # smallest turn of an outline that counts as a corner, which gets a node
_INSET = np.sqrt(3) / 4  # smallest start distance of random nodes from the boundary, as in `generate`
_TRIES = 1000


def remeshed(
    mesh: Mesh, nodes: SupportsIndex, *, seed: SupportsIndex = 0, sweeps: SupportsIndex = 100
) -> Mesh:
    """Make a random mesh of `nodes` nodes inside the outline of a flat sheet, by Lloyd's algorithm.

    Boundary nodes lie on the outline and on the edges of holes, evenly spaced between corners. Every turn of
    more than 20 degrees is a corner and gets a node. `source_nodes` counts the new nodes; the mesh keeps none
    of the old ones.

    **Arguments:** `mesh`: a flat sheet; `nodes`: number of nodes of the new mesh; `seed`, `sweeps` as in
    `rectangle`.

    **Raises:** `MeshError` for a curved sheet, or too few nodes for the outline.
    """
    nodes, seed, sweeps = (
        whole_number(name, value, least)
        for name, value, least in (("nodes", nodes, 5), ("seed", seed, 0), ("sweeps", sweeps, 0))
    )
    plane = flattened(mesh)
    if plane is None:
        raise MeshError("a curved sheet cannot be remeshed; remesh it in the program that made it")
    outline = _Outline([plane[loop] for loop in boundary_loops(mesh)])
    spacing = lattice_spacing(outline.area, outline.perimeter, nodes + outline.holes)
    fixed = _Outline([_resampled(loop, spacing) for loop in outline.loops])
    if len(fixed.points) >= nodes:
        raise MeshError(f"nodes = {nodes} all lie on the outline of this slender sheet; give more")
    free = fixed.sample(np.random.default_rng(seed), nodes - len(fixed.points), spacing)
    guard = guard_points(fixed.points)
    for _ in range(sweeps):
        images = fixed.mirror(free, spacing)
        moved = centroids(free, np.vstack([fixed.points, images, guard]))
        free = np.where(fixed.contains(moved)[:, None], moved, free)
    points = np.vstack([fixed.points, free])
    triangles = scipy.spatial.Delaunay(np.vstack([points, guard])).simplices
    triangles = triangles[(triangles < nodes).all(axis=1)]
    triangles = triangles[fixed.contains(points[triangles].mean(axis=1))]
    new = _placed(mesh, plane, points, triangles)
    if new.n_nodes != nodes or abs(new.area / fixed.area - 1) > 1e-9:
        raise MeshError(f"nodes = {nodes} are too few for the details of the outline; give more")
    return new


def boundary_loops(mesh: Mesh) -> list[Int[np.ndarray, " _"]]:
    """Nodes along each closed curve of the boundary."""
    neighbours: dict[int, list[int]] = {}
    for a, b in mesh.edges[mesh.boundary_edges].tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    loops = []
    while neighbours:
        loop = [next(iter(neighbours))]
        while loop[-1] in neighbours:
            ahead = [node for node in neighbours.pop(loop[-1]) if node in neighbours]
            loop += ahead[:1]
        loops.append(np.array(loop))
    return loops


def _resampled(loop: Float[np.ndarray, "corners 2"], spacing: float) -> Float[np.ndarray, "nodes 2"]:
    """Return nodes (b, 2) about `spacing` apart along a closed polygon, with a node at each corner."""
    after, before = np.roll(loop, -1, axis=0) - loop, loop - np.roll(loop, 1, axis=0)
    turn = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    corners = np.flatnonzero(np.abs(turn) > _CORNER)
    start = corners[0] if len(corners) else 0
    line = np.vstack([np.roll(loop, -start, axis=0), loop[start]])
    ends = [*(corners - start), len(loop)] if len(corners) else [0, len(loop)]
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    least = 3 if len(ends) == 2 else 2 if len(ends) == 3 else 1
    at = []
    for first, last in zip(length[ends[:-1]], length[ends[1:]], strict=True):
        at.append(np.linspace(first, last, max(least, round((last - first) / spacing)), endpoint=False))
    places = np.concatenate(at)
    return np.column_stack([np.interp(places, length, line[:, k]) for k in (0, 1)])


class _Outline:
    """A region between closed polygons: one around it, the others around its holes."""

    def __init__(self, loops: list[Float[np.ndarray, "_ 2"]]):
        self.loops, self.points = loops, np.vstack(loops)
        self.holes = len(loops) - 1
        following = [np.roll(loop, -1, axis=0) for loop in loops]
        self.ends = np.vstack(following)
        self.perimeter = float(np.linalg.norm(self.ends - self.points, axis=1).sum())
        areas = [
            abs((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / 2
            for a, b in zip(loops, following, strict=True)
        ]
        self.area = float(2 * max(areas) - sum(areas))
        # Imported here because the import takes most of a second and only remeshing needs it.
        from matplotlib.path import Path

        self.paths = [Path(loop) for loop in loops]

    def contains(self, points: Float[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        """Which points (k, 2) lie within an odd number of the polygons."""
        return np.logical_xor.reduce([path.contains_points(points) for path in self.paths])

    def sample(self, rng: np.random.Generator, count: int, spacing: float) -> Float[np.ndarray, "nodes 2"]:
        """Uniform random positions (count, 2) inside, away from the boundary."""
        tree, found = scipy.spatial.cKDTree(self.points), np.zeros((0, 2))
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        # A point on a side is up to half a spacing from its ends.
        reach = spacing * np.hypot(_INSET, 0.5)
        for _ in range(_TRIES):
            points = rng.uniform(low, high, size=(2 * count, 2))
            points = points[self.contains(points)]
            found = np.vstack([found, points[tree.query(points)[0] > reach]])
            if len(found) >= count:
                return found[:count]
        raise MeshError("the sheet is too slender for this number of nodes; give more")

    def mirror(self, points: Float[np.ndarray, "points 2"], depth: float) -> Float[np.ndarray, "images 2"]:
        """Return mirror images, outside the region, of points within `depth` of a side and beside it."""
        count = min(3, len(self.points))
        middle = scipy.spatial.cKDTree((self.points + self.ends) / 2)
        near = middle.query(points, count)[1].reshape(len(points), count)
        images = []
        for side in near.T:
            a, along = self.points[side], self.ends[side] - self.points[side]
            share = ((points - a) * along).sum(axis=1) / (along**2).sum(axis=1)
            foot = a + share[:, None] * along
            beside = (share >= 0) & (share <= 1) & (np.linalg.norm(points - foot, axis=1) < depth)
            images.append((2 * foot - points)[beside])
        image = np.unique(np.vstack(images), axis=0)
        return image[~self.contains(image)]


def _placed(
    mesh: Mesh,
    plane: Float[np.ndarray, "nodes 2"],
    points: Float[np.ndarray, "points 2"],
    triangles: Int[np.ndarray, "triangles 3"],
) -> Mesh:
    """Make a mesh of points (k, 2) in the plane of a sheet, with the same orientation as the sheet."""
    to_space = np.linalg.lstsq(np.column_stack([plane, np.ones(len(plane))]), mesh.vertices, rcond=None)[0]
    a, b, c = (plane[mesh.faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    up = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() > 0
    p, q, r = (points[triangles[:, k]] for k in range(3))
    u, v = q - p, r - p
    turned = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0) != up
    triangles = np.where(turned[:, None], triangles[:, [0, 2, 1]], triangles)
    return Mesh.from_arrays(
        np.column_stack([points, np.ones(len(points))]) @ to_space, triangles, reorder=True
    )
