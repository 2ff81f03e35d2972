"""Flat meshes: the exact triangular lattice, and random Delaunay meshes regularised by Lloyd's algorithm.

The construction follows the paper (section 3.1), with SciPy's Qhull in place of Voro++. Boundary nodes are
evenly spaced exactly on the boundary of the domain and stay fixed; a rectangle has nodes at its corners. The
other nodes start at random positions, and Lloyd sweeps move them. The sweeps bring the relaxed moduli close
to those of the lattice: the bending rigidity is 5.3 / 2.9 / 1.6 % too high after 10 / 30 / 100 sweeps.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Protocol, SupportsIndex

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxcrumple._jax.memory import require
from jaxcrumple._jax.shared import shared
from jaxcrumple.mesh.mesh import Mesh

_ROW = math.sqrt(3) / 2  # height of a lattice row in units of the spacing
_BYTES = 1000.0  # bytes per node during generation, with its triangles, edges and hinges (1040 at 1e5)
_INSET = _ROW / 2  # smallest start distance of random nodes from the boundary, whose nodes fill half a row


def hexagonal(nx: int, ny: int, spacing: float, *, reorder: bool = True) -> Mesh:
    """Make a strip of `ny` rows of equilateral triangles, centred on the origin of the plane z = 0.

    It has `ny + 1` rows of `nx` nodes along x, `sqrt(3)/2 * spacing` apart, odd rows shifted by half a
    spacing. There are `2 (nx - 1) ny` faces. With `reorder=False` node i of row j has the number nx j + i.

    **Arguments:** `nx`: nodes per row, at least 2; `ny`: rows of triangles, at least 1; `spacing` > 0 in m;
    `reorder` as in `Mesh.from_arrays`.

    **Raises:** ValueError if a count is too small or not an integer, or the spacing is not positive.

    >>> mesh = jc.hexagonal(4, 2, 1e-3)
    >>> mesh.n_nodes, len(mesh.faces), len(mesh.hinges)
    (12, 12, 13)
    >>> print(mesh.edge_length.round(9).min(), mesh.edge_length.round(9).max())  # m
    0.001 0.001
    """
    nx, ny = whole_number("nx", nx, 2), whole_number("ny", ny, 1)
    spacing = _length("spacing", spacing)
    _check_size(nx * (ny + 1), "nx or ny")
    i, j = np.meshgrid(np.arange(nx), np.arange(ny + 1))
    x = (i + 0.5 * (j % 2) - (nx - 0.5) / 2) * spacing
    y = (j - ny / 2) * (_ROW * spacing)
    a = (i + nx * j)[:-1, :-1].ravel()
    b, c, d = a + 1, a + nx, a + nx + 1
    odd = (j[:-1, :-1] % 2 == 1).ravel()
    lower = np.column_stack([a, b, np.where(odd, d, c)])
    upper = np.column_stack([np.where(odd, a, b), d, c])
    return Mesh.from_arrays(
        np.column_stack([x.ravel(), y.ravel()]), np.vstack([lower, upper]), reorder=reorder
    )


def rectangle(width: float, height: float, nodes: int, *, seed: int = 0, sweeps: int = 100) -> Mesh:
    """Make a random mesh of exactly `nodes` nodes on a rectangle in the plane z = 0, centred on the origin.

    Delaunay triangulation and Lloyd's algorithm, as in section 3.1 of the paper. Equal arguments give equal
    meshes.

    **Arguments:** `width` along x and `height` along y > 0 in m; `nodes` >= 5, more if the rectangle is
    slender; `seed` >= 0 of the random positions; `sweeps` >= 0 of Lloyd's algorithm.

    **Raises:** ValueError for a size that is not positive, or a count or seed too small or not an integer.

    >>> mesh = jc.rectangle(0.1, 0.05, 60)
    >>> mesh.n_nodes, round(mesh.area, 9)
    (60, 0.005)
    """
    return _random_mesh(_Rectangle(_length("width", width), _length("height", height)), nodes, seed, sweeps)


def disc(radius: float, nodes: int, *, seed: int = 0, sweeps: int = 100) -> Mesh:
    """Make a random mesh of exactly `nodes` nodes on a disc in the plane z = 0, centred on the origin.

    The boundary is a regular polygon inscribed in the circle; its area is slightly smaller than the circle's.

    **Arguments:** `radius` > 0 in m; `nodes` >= 5; `seed`, `sweeps` as in `rectangle`.

    **Raises:** ValueError for a size that is not positive, or a count or seed too small or not an integer.

    >>> mesh = jc.disc(0.05, 100)
    >>> mesh.n_nodes, round(mesh.area / (np.pi * 0.05**2), 3)
    (100, 0.993)
    """
    return _random_mesh(_Disc(_length("radius", radius)), nodes, seed, sweeps)


class _Domain(Protocol):
    """A convex region around the origin."""

    @property
    def area(self) -> float: ...
    @property
    def perimeter(self) -> float: ...

    def boundary(self, spacing: float) -> Float[np.ndarray, "boundary 2"]:
        """Evenly spaced nodes (b, 2) on the boundary, about `spacing` apart."""

    def sample(self, rng: np.random.Generator, count: int, inset: float) -> Float[np.ndarray, "nodes 2"]:
        """Uniform random positions (count, 2), no nearer to the boundary than `inset`."""

    def mirror(self, points: Float[np.ndarray, "nodes 2"], depth: float) -> Float[np.ndarray, "images 2"]:
        """Images behind the boundary of the points within `depth` of it."""


@dataclass(frozen=True)
class _Rectangle:
    width: float
    height: float

    @property
    def area(self) -> float:
        return self.width * self.height

    @property
    def perimeter(self) -> float:
        return 2 * (self.width + self.height)

    def boundary(self, spacing: float) -> Float[np.ndarray, "boundary 2"]:
        x, y = (
            np.linspace(-side / 2, side / 2, max(1, round(side / spacing)) + 1)
            for side in (self.width, self.height)
        )
        sides = [(x[:-1], y[0]), (x[-1], y[:-1]), (x[1:], y[-1]), (x[0], y[1:])]
        return np.vstack([np.column_stack(np.broadcast_arrays(*side)) for side in sides])

    def sample(self, rng: np.random.Generator, count: int, inset: float) -> Float[np.ndarray, "nodes 2"]:
        half = np.array([self.width, self.height]) / 2
        return rng.uniform(-1, 1, size=(count, 2)) * np.maximum(half - inset, half / 4)

    def mirror(self, points: Float[np.ndarray, "nodes 2"], depth: float) -> Float[np.ndarray, "images 2"]:
        half = np.array([self.width, self.height]) / 2
        images = []
        for axis in (0, 1):
            image = points.copy()
            image[:, axis] = np.copysign(2 * half[axis], points[:, axis]) - points[:, axis]
            images.append(image[half[axis] - np.abs(points[:, axis]) < depth])
        return np.vstack(images)


@dataclass(frozen=True)
class _Disc:
    radius: float

    @property
    def area(self) -> float:
        return math.pi * self.radius**2

    @property
    def perimeter(self) -> float:
        return 2 * math.pi * self.radius

    def boundary(self, spacing: float) -> Float[np.ndarray, "boundary 2"]:
        count = max(3, round(self.perimeter / spacing))
        angle = 2 * math.pi * np.arange(count) / count
        return self.radius * np.column_stack([np.cos(angle), np.sin(angle)])

    def sample(self, rng: np.random.Generator, count: int, inset: float) -> Float[np.ndarray, "nodes 2"]:
        r = max(self.radius - inset, self.radius / 4) * np.sqrt(rng.uniform(size=count))
        angle = rng.uniform(0, 2 * math.pi, size=count)
        return np.column_stack([r * np.cos(angle), r * np.sin(angle)])

    def mirror(self, points: Float[np.ndarray, "nodes 2"], depth: float) -> Float[np.ndarray, "images 2"]:
        r = np.linalg.norm(points, axis=1, keepdims=True)
        near = (self.radius - r < depth).ravel()
        return (points * (2 * self.radius / np.maximum(r, 1e-300) - 1))[near]


def _random_mesh(domain: _Domain, nodes: SupportsIndex, seed: SupportsIndex, sweeps: SupportsIndex) -> Mesh:
    nodes, seed, sweeps = (
        whole_number("nodes", nodes, 5),
        whole_number("seed", seed, 0),
        whole_number("sweeps", sweeps, 0),
    )
    _check_size(nodes, "nodes")
    return _lloyd_mesh(domain, nodes, seed, sweeps)


@shared
def _lloyd_mesh(domain: _Domain, nodes: int, seed: int, sweeps: int) -> Mesh:
    spacing = lattice_spacing(domain.area, domain.perimeter, nodes)
    fixed = domain.boundary(spacing)
    if len(fixed) >= nodes:
        raise ValueError(f"nodes = {nodes} all lie on the boundary of this slender domain; give more")
    guard = guard_points(fixed)
    free = domain.sample(np.random.default_rng(seed), nodes - len(fixed), _INSET * spacing)
    for _ in range(sweeps):
        # Images clip the cells at the boundary. Nodes farther from it than half a spacing need no image: a
        # boundary node is nearer to every point of the boundary.
        free = centroids(free, np.vstack([fixed, domain.mirror(free, spacing), guard]))
    points = np.vstack([fixed, free])
    triangles = scipy.spatial.Delaunay(np.vstack([points, guard])).simplices
    mesh = Mesh.from_arrays(points, triangles[(triangles < nodes).all(axis=1)], reorder=True)
    if mesh.n_nodes != nodes:
        raise ValueError(f"two of the random nodes of seed = {seed} coincide; choose another seed")
    return mesh


def lattice_spacing(area: float, perimeter: float, nodes: int) -> float:
    """Side of the equilateral triangles that cover a domain; count each hole as one more node.

    With b = perimeter / a nodes on the rim, Euler's formula gives 2 n - 2 - b faces of area sqrt(3)/4 a^2.
    """
    half = perimeter / 2
    return (half + math.sqrt(half**2 + 8 / math.sqrt(3) * area * (nodes - 1))) / (2 * (nodes - 1))


def guard_points(fixed: Float[np.ndarray, "boundary 2"]) -> Float[np.ndarray, "8 2"]:
    """Far points around the domain, so that no side of the domain lies on the convex hull.

    Qhull may cover collinear points of the hull with triangles of zero area, or omit them.
    """
    angle = 2 * math.pi * (np.arange(8) + 0.5) / 8
    return 20 * np.abs(fixed).max() * np.column_stack([np.cos(angle), np.sin(angle)])


def centroids(
    free: Float[np.ndarray, "free 2"], others: Float[np.ndarray, "others 2"]
) -> Float[np.ndarray, "free 2"]:
    """Centroids of the Voronoi cells of `free` in the diagram of all points: one sweep of Lloyd's algorithm.

    The cell of a point is the fan of triangles (point, c, c') over its Voronoi edges, whose ends c, c' are
    the circumcentres of the two Delaunay triangles beside the edge dual to it.
    """
    points = np.vstack([free, others])
    mesh = scipy.spatial.Delaunay(points)
    centre = _circumcentres(points, mesh.simplices)
    # Side k of a triangle runs from vertex k + 1 to k + 2, and neighbour k lies across it.
    site, across = np.roll(mesh.simplices, -1, axis=1), mesh.neighbors
    triangle, side = np.nonzero((site < len(free)) & (across >= 0))
    site, across = site[triangle, side], across[triangle, side]
    p = points[site]
    one, two = centre[across] - p, centre[triangle] - p
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    total = np.bincount(site, weights=area, minlength=len(free))
    moment = [np.bincount(site, weights=area * m, minlength=len(free)) for m in ((one + two) / 3).T]
    return free + np.column_stack(moment) / total[:, None]


def _circumcentres(
    points: Float[np.ndarray, "points 2"], triangles: Int[np.ndarray, "triangles 3"]
) -> Float[np.ndarray, "triangles 2"]:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    uu, vv = (u * u).sum(axis=1), (v * v).sum(axis=1)
    det = 2 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    shift = np.column_stack([v[:, 1] * uu - u[:, 1] * vv, u[:, 0] * vv - v[:, 0] * uu])
    return a + shift / np.where(det == 0, 1, det)[:, None]


def whole_number(name: str, value: SupportsIndex, least: int) -> int:
    try:
        count = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} = {value!r} is not an integer; give a whole number") from None
    if count < least:
        raise ValueError(f"{name} = {count} is too small; give at least {least}")
    return count


def _check_size(nodes: int, name: str) -> None:
    require(_BYTES * nodes, f"a mesh of {nodes} nodes", f"give a smaller {name}")


def _length(name: str, value: float) -> float:
    try:
        length = float(value)
    except (TypeError, ValueError):
        length = math.nan
    if not (0 < length < math.inf):
        raise ValueError(f"{name} = {value!r} is not a length; give a positive number of metres")
    return length
