"""Facets of a crumpled sheet: the regions between its creases, found without hands.

The paper segments its crease patterns by hand (Fig. 9d). Creases of a simulation are zig-zags of hinges, up
to a few rows wide, with gaps, so that the regions between damaged hinges alone leak into each other. The
flat sheet is drawn as an image instead, and split where it is narrow between creases: by the watershed of
the distance to the nearest crease, from the h-maxima of that distance (Soille, Morphological Image Analysis,
2003, ch. 6 and 9). What this splits too much is joined again: of all borders the one that follows a crease
over the smallest part of its length goes first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import skimage as ski  # which loads its parts when they are first used
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import mode

from jaxcrumple.measure.creases import DAMAGE, damaged, plastic_curvature
from jaxcrumple.measure.raster import Raster
from jaxcrumple.mesh.mesh import FloatArray, Mesh

#: A crease is where the damage within its width adds up to a plastic fold angle of at least this, in rad.
FOLD = 0.2
#: Two regions are two facets where a crease follows at least this part of their common border.
CLOSED = 0.5
#: Width of a crease, in units of $\\sqrt{A/n}$, the distance of neighbouring nodes but for 7 %.
ROWS = 1.5

_PIXELS = 12  # to the width of a crease
_FLAT = 0.9  # least area of a triangle seen along z over its own, so that imperfections are let pass


class Facets(NamedTuple):
    """Facets, numbered by their first triangle."""

    label: NDArray[np.intp]  # (f,) facet of each triangle, from 0; a facet is connected
    area: FloatArray  # (k,) rest area of each facet [m^2]; together that of the sheet


def segment_facets(
    mesh: Mesh,
    p: ArrayLike,
    *,
    threshold: float = DAMAGE,
    fold: float = FOLD,
    width: float | None = None,
    closed: float = CLOSED,
) -> Facets:
    """Facets of the sheet whose hinges have the rest curvature `p` (h,).

    **Arguments:**

    - `mesh`: its rest shape lies in the x-y plane, but for an imperfection.
    - `threshold`: hinges are damaged if their dimensionless rest curvature moved by more, as in
      `crease_length`.
    - `fold`: least plastic fold angle of a crease, in rad. A hinge folds by $2 \\arcsin(|p|/2)$ (eq. 33), its
      plastic curvature in 1/m times its height, and a crease by the sum over the hinges across it, so that a
      finer mesh finds the same creases.
    - `width`: of a crease, in m, by default `ROWS` times $\\sqrt{A/n}$. Damage within it adds up to one
      crease, and what holds no circle of this diameter is no facet: it goes to a neighbour.
    - `closed`: part of the border of two facets, from 0 to 1, that is creased.

    On patterns that are known, with 15 % of the length of creases missing, the adjusted Rand index is 0.98 at
    500 triangles for a facet, 0.95 at 200, 0.88 at 70 and 0.5 at 20, where every other facet is lost. Borders
    that lack near half of their crease, or are hardly longer than a crease is wide, may go either way.

    **Raises:** ValueError if the sheet is not flat, `p` has another shape, or a parameter is out of range.
    """
    width = ROWS / mesh.linear_density if width is None else width
    _check(mesh, fold, width, closed)
    raster = Raster.over(mesh, width / _PIXELS)
    angle = np.where(damaged(mesh, p, threshold), _hinge_fold(mesh, p), 0.0)
    creased = _fold_across(mesh, angle, raster, 0.5 * width) >= fold
    regions = _regions(mesh, raster, np.where(creased, angle, 0.0), width)
    regions = _connected(mesh, regions, angle)
    return _facets(mesh, _merged(mesh, regions, creased, closed))


def _hinge_fold(mesh: Mesh, p: ArrayLike) -> FloatArray:
    """Plastic fold angle (h,) $2 \\arcsin(|p|/2)$ in rad of each hinge (eq. 33)."""
    return 2 * np.arcsin(np.minimum(np.abs(plastic_curvature(mesh, p)) / 2, 1.0))


def _fold_across(mesh: Mesh, angle: FloatArray, raster: Raster, sigma: float) -> FloatArray:
    """Fold angle (h,) in rad across the crease at the middle of each hinge, from the `angle` (h,) of hinges.

    Angle times length is spread by a Gaussian of standard deviation `sigma` in m. A straight crease of fold
    angle $\\phi$ gives $\\phi/(\\sqrt{2\\pi}\\,\\sigma)$, whatever the mesh and the number of rows that
    share the fold; a zig-zag of edges up to 1.3 times that.
    """
    ends = mesh.vertices[mesh.hinges[:, :2], :2]
    density = raster.density(ends, angle * mesh.hinge_length, sigma)
    return np.sqrt(2 * np.pi) * sigma * density[raster.pixels(ends.mean(axis=1))]


def _regions(mesh: Mesh, raster: Raster, angle: FloatArray, width: float) -> NDArray[np.intp]:
    """Region (f,) of each triangle, from 1: the parts of the sheet between necks and folded hinges.

    Water rises from the middle of the regions to their necks, then over creases, the strongest `angle` (h,)
    last.
    """
    crease = np.flatnonzero(angle)
    rows, columns, line = raster.lines(mesh.vertices[mesh.hinges[crease, :2], :2])
    ridge = np.zeros(raster.shape)
    np.maximum.at(ridge, (rows, columns), angle[crease][line])
    inside = raster.inside(mesh)
    distance = distance_transform_edt(inside & (ridge == 0)) * raster.pixel
    tops, _ = label(ski.morphology.h_maxima(distance, 0.5 * width))
    image = ski.segmentation.watershed(np.where(ridge > 0, ridge, -distance), tops, mask=inside)
    image = ski.segmentation.expand_labels(image, distance=2)  # over the pixels that the sheet's rim cuts
    return mode(raster.on_faces(mesh, image), axis=1).mode


def _connected(mesh: Mesh, regions: NDArray[np.intp], angle: FloatArray) -> NDArray[np.intp]:
    """Regions (f,), each without the triangles that its largest connected piece leaves out.

    These are few, where the pixels of a triangle vote for a region beyond its neighbours. They go to the
    neighbour over the hinge of least `angle` (h,).
    """
    regions, stray = regions.copy(), _strays(mesh, regions)
    while stray.any():
        rim = np.flatnonzero(stray[mesh.hinge_faces[:, 0]] != stray[mesh.hinge_faces[:, 1]])
        sides = mesh.hinge_faces[rim[np.argsort(-angle[rim])]]
        sides = np.where(stray[sides[:, :1]], sides, sides[:, ::-1])
        regions[sides[:, 0]] = regions[sides[:, 1]]  # where a triangle has several, the last one stays
        stray[sides[:, 0]] = False
    return regions


def _strays(mesh: Mesh, regions: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which triangles (f,) are not in the largest connected piece of their region."""
    sides = mesh.hinge_faces[np.equal(*regions[mesh.hinge_faces].T)]
    links = coo_array((np.ones(len(sides)), sides.T), shape=(len(regions), len(regions)))
    _, piece = connected_components(links, directed=False)
    order = np.argsort(np.bincount(piece)[piece], kind="stable")
    largest = np.zeros(regions.max() + 1, dtype=piece.dtype)
    largest[regions[order]] = piece[order]  # the last one stays
    return piece != largest[regions]


def _merged(mesh: Mesh, regions: NDArray, creased: NDArray[np.bool_], closed: float) -> NDArray[np.intp]:
    """Regions (f,) joined until all borders are `creased` (h,) over the part `closed` of their length."""
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
    """Regions have no properties of their own that change as two become one."""


def _joined(graph: ski.graph.RAG, a: int, b: int, other: int) -> dict[str, float]:
    """Border to `other` of the union of the regions `a` and `b`."""
    return _border([graph[k][other] for k in (a, b) if graph.has_edge(k, other)])


def _border(parts: list[dict[str, float]]) -> dict[str, float]:
    length, creased = (sum(part[name] for part in parts) for name in ("length", "creased"))
    return {"length": length, "creased": creased, "weight": creased / length}


def _facets(mesh: Mesh, regions: NDArray) -> Facets:
    _, first, number = np.unique(regions, return_index=True, return_inverse=True)
    number = np.argsort(np.argsort(first))[number]
    return Facets(number, np.bincount(number, weights=mesh.face_area).astype(float))


def _check(mesh: Mesh, fold: float, width: float, closed: float) -> None:
    e1, e2 = (mesh.vertices[mesh.faces[:, k], :2] - mesh.vertices[mesh.faces[:, 0], :2] for k in (1, 2))
    shadow = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2
    if np.any(shadow < _FLAT * mesh.face_area):
        raise ValueError("the rest shape is not flat; facets are found on a sheet that lies in the x-y plane")
    if not 0 < fold < np.inf:
        raise ValueError(f"fold = {fold} rad; give a positive angle")
    if not 0.5 <= width * mesh.linear_density < np.inf:
        least = 0.5 / mesh.linear_density
        raise ValueError(f"width = {width} m; give at least half the distance of nodes, {least:.3g} m")
    if not 0 <= closed <= 1:
        raise ValueError(f"closed = {closed}; give a part of the border between 0 and 1")
