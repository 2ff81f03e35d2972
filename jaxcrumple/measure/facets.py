"""Facets of a crumpled sheet: automatic segmentation into the regions between creases.

The paper segments its crease patterns by hand (Fig. 9d). In a simulation a crease is a zig-zag of hinges, up
to a few rows wide, with gaps. Damaged hinges alone therefore do not separate the regions. The algorithm
draws the flat sheet as an image and splits it at the necks between creases: it applies the watershed
transform to the distance from the nearest crease, seeded at the h-maxima of that distance (Soille,
Morphological Image Analysis, 2003, ch. 6 and 9). It then merges over-segmented regions, beginning with the
border of which a crease follows the smallest fraction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import skimage as ski  # skimage imports its submodules lazily
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, label

from jaxcrumple._jax.arrays import HingeValuesLike
from jaxcrumple.measure.creases import DAMAGE, damaged, plastic_curvature
from jaxcrumple.measure.raster import Raster, require_flat
from jaxcrumple.mesh.graph import components
from jaxcrumple.mesh.mesh import Mesh

#: Least plastic fold angle of a crease in rad, summed over the damage within its width.
FOLD = 0.2
#: Two regions are separate facets if a crease follows at least this fraction of their common border.
CLOSED = 0.5
#: Width of a crease, in units of $\\sqrt{A/n}$, which is within 7 % of the node distance.
ROWS = 1.5

_PIXELS = 12  # pixels per width of a crease


class Facets(NamedTuple):
    """Facets, numbered in the order of their first triangle.

    `label` (f,): facet of each triangle, from 0; each facet is connected. `area` (k,) in m2: rest area of
    each facet; the sum is the area of the sheet.
    """

    label: Int[np.ndarray, " faces"]
    area: Float[np.ndarray, " facets"]


def segment_facets(
    mesh: Mesh,
    p: HingeValuesLike,
    *,
    threshold: float = DAMAGE,
    fold: float = FOLD,
    width: float | None = None,
    closed: float = CLOSED,
) -> Facets:
    """Segment the sheet into facets, from the rest curvature `p` (h,) of its hinges.

    It applies the watershed transform to the distance from the nearest crease (Soille, Morphological Image
    Analysis, 2003, ch. 6 and 9), then merges regions whose border is not creased. The paper segments its
    crease patterns by hand (Fig. 9d).

    **Arguments:**

    - `mesh`: its rest shape lies in the x-y plane, except for a small imperfection.
    - `threshold`: least change of the dimensionless rest curvature of a damaged hinge, as in `crease_length`.
    - `fold`: least plastic fold angle of a crease, in rad. The plastic fold angle of a hinge is 2
      arcsin(abs(p)/2) (eq. 33), its plastic curvature in 1/m times its height. That of a crease is the sum
      over the hinges across it, so that it does not depend on the mesh size.
    - `width`: width of a crease, in m, by default 1.5 sqrt(A/n). All damage within this width counts as one
      crease. A region that contains no circle of this diameter is not a facet: the algorithm adds it to a
      neighbour.
    - `closed`: least creased fraction of the border between two facets, from 0 to 1.

    For known patterns with 15 % of the crease length missing, the adjusted Rand index is 0.98 at 500
    triangles per facet, 0.95 at 200, 0.88 at 70 and 0.5 at 20, where half of the facets are lost. The result
    is uncertain for borders that lack almost half of their crease, or are hardly longer than the width of a
    crease.

    **Raises:** ValueError if the sheet is not flat, `p` has another shape, or a parameter is out of range.

    >>> mesh = jc.hexagonal(30, 20, 1e-3)
    >>> across = mesh.vertices[mesh.hinges[:, :2], 0].mean(axis=1)  # x of the shared edges
    >>> facets = measure.segment_facets(mesh, np.where(abs(across) < 0.6e-3, 1.0, 0.0))  # a crease at x = 0
    >>> (1e4 * facets.area).round(2)  # cm2
    array([2.51, 2.51])
    """
    width = ROWS / mesh.linear_density if width is None else width
    _check(mesh, fold, width, closed)
    raster = Raster.over(mesh, width / _PIXELS)
    angle = np.where(damaged(mesh, p, threshold), _hinge_fold(mesh, p), 0.0)
    creased = _fold_across(mesh, angle, raster, 0.5 * width) >= fold
    regions = _regions(mesh, raster, np.where(creased, angle, 0.0), width)
    regions = _connected(mesh, regions, angle)
    return _facets(mesh, _merged(mesh, regions, creased, closed))


def _hinge_fold(mesh: Mesh, p: HingeValuesLike) -> Float[np.ndarray, " hinges"]:
    """Return the plastic fold angle (h,) $2 \\arcsin(|p|/2)$ in rad of each hinge (eq. 33)."""
    return 2 * np.arcsin(np.minimum(np.abs(plastic_curvature(mesh, p)) / 2, 1.0))


def _fold_across(
    mesh: Mesh, angle: Float[np.ndarray, " hinges"], raster: Raster, sigma: float
) -> Float[np.ndarray, " hinges"]:
    """Return the fold angle (h,) in rad across the crease at the middle of each hinge.

    A Gaussian of standard deviation `sigma` in m spreads the hinge `angle` (h,) times hinge length. A
    straight crease of fold angle $\\phi$ gives the density $\\phi/(\\sqrt{2\\pi}\\,\\sigma)$, independent of
    the mesh and of the number of rows in the crease. A zig-zag of edges gives up to 1.3 times that.
    """
    ends = mesh.vertices[mesh.hinges[:, :2], :2]
    density = raster.density(ends, angle * mesh.hinge_length, sigma)
    return np.sqrt(2 * np.pi) * sigma * density[raster.pixels(ends.mean(axis=1))]


def _regions(
    mesh: Mesh, raster: Raster, angle: Float[np.ndarray, " hinges"], width: float
) -> Int[np.ndarray, " faces"]:
    """Return the region (f,) of each triangle, from 1, bounded by necks and by folded hinges.

    The watershed floods each region from its middle to its necks, then crosses creases in the order of
    increasing `angle` (h,).
    """
    crease = np.flatnonzero(angle)
    rows, columns, line = raster.lines(mesh.vertices[mesh.hinges[crease, :2], :2])
    ridge = np.zeros(raster.shape)
    np.maximum.at(ridge, (rows, columns), angle[crease][line])
    inside = raster.inside(mesh)
    distance = distance_transform_edt(inside & (ridge == 0)) * raster.pixel
    tops, _ = label(ski.morphology.h_maxima(distance, 0.5 * width))
    image = ski.segmentation.watershed(np.where(ridge > 0, ridge, -distance), tops, mask=inside)
    image = ski.segmentation.expand_labels(image, distance=2)  # covers pixels cut by the boundary
    from scipy.stats import mode  # a second, and only facets need it

    return mode(raster.on_faces(mesh, image), axis=1).mode


def _connected(
    mesh: Mesh, regions: Int[np.ndarray, " faces"], angle: Float[np.ndarray, " hinges"]
) -> Int[np.ndarray, " faces"]:
    """Return the regions (f,) reduced to their largest connected piece; reassign all other triangles.

    Such triangles are few: the majority of their pixels belongs to a region that is not adjacent. Each takes
    the region of its neighbour across the hinge with the smallest `angle` (h,).
    """
    regions, stray = regions.copy(), _strays(mesh, regions)
    while stray.any():
        rim = np.flatnonzero(stray[mesh.hinge_faces[:, 0]] != stray[mesh.hinge_faces[:, 1]])
        sides = mesh.hinge_faces[rim[np.argsort(-angle[rim])]]
        sides = np.where(stray[sides[:, :1]], sides, sides[:, ::-1])
        regions[sides[:, 0]] = regions[sides[:, 1]]  # the last (smallest) angle wins
        stray[sides[:, 0]] = False
    return regions


def _strays(mesh: Mesh, regions: Int[np.ndarray, " faces"]) -> Bool[np.ndarray, " faces"]:
    """Return a mask (f,) of the triangles outside the largest connected piece of their region."""
    sides = mesh.hinge_faces[np.equal(*regions[mesh.hinge_faces].T)]
    _, piece = components(len(regions), *sides.T)
    order = np.argsort(np.bincount(piece)[piece], kind="stable")
    largest = np.zeros(regions.max() + 1, dtype=piece.dtype)
    largest[regions[order]] = piece[order]  # the last (largest) piece wins
    return piece != largest[regions]


def _merged(
    mesh: Mesh, regions: Int[np.ndarray, " faces"], creased: Bool[np.ndarray, " hinges"], closed: float
) -> Int[np.ndarray, " faces"]:
    """Merge regions (f,) until all borders are `creased` (h,) over the fraction `closed` of their length."""
    graph = ski.graph.RAG()
    graph.add_nodes_from((int(r), {"labels": [int(r)]}) for r in np.unique(regions))
    sides = np.sort(regions[mesh.hinge_faces], axis=1)
    for h in np.flatnonzero(sides[:, 0] != sides[:, 1]):
        a, b = map(int, sides[h])
        hinge = {"length": mesh.hinge_length[h], "creased": mesh.hinge_length[h] * creased[h]}
        graph.add_edge(a, b, **_border([graph[a][b], hinge] if graph.has_edge(a, b) else [hinge]))
    options = {"rag_copy": False, "in_place_merge": True, "merge_func": _nothing, "weight_func": _joined}
    return ski.graph.merge_hierarchical(regions, graph, closed, **options)


def _nothing(graph: ski.graph.RAG, a: int, b: int) -> None:
    """Do nothing: regions have no properties to update in a merge."""


def _joined(graph: ski.graph.RAG, a: int, b: int, other: int) -> dict[str, float]:
    """Return the border between `other` and the union of the regions `a` and `b`."""
    return _border([graph[k][other] for k in (a, b) if graph.has_edge(k, other)])


def _border(parts: list[dict[str, float]]) -> dict[str, float]:
    length, creased = (sum(part[name] for part in parts) for name in ("length", "creased"))
    return {"length": length, "creased": creased, "weight": creased / length}


def _facets(mesh: Mesh, regions: Int[np.ndarray, " faces"]) -> Facets:
    _, first, number = np.unique(regions, return_index=True, return_inverse=True)
    number = np.argsort(np.argsort(first))[number]
    return Facets(number, np.bincount(number, weights=mesh.face_area).astype(float))


def _check(mesh: Mesh, fold: float, width: float, closed: float) -> None:
    require_flat(mesh, "facets")
    if not 0 < fold < np.inf:
        raise ValueError(f"fold = {fold} rad; give a positive angle")
    if not 0.5 <= width * mesh.linear_density < np.inf:
        least = 0.5 / mesh.linear_density
        raise ValueError(f"width = {width} m; give at least half the node distance, {least:.3g} m")
    if not 0 <= closed <= 1:
        raise ValueError(f"closed = {closed}; give a fraction of the border between 0 and 1")
