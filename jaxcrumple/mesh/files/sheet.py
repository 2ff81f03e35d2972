"""Convert the surface in a file to nodes and triangles in metres: unit, polygons, merging."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxcrumple.mesh.files.polygons import triangulated
from jaxcrumple.mesh.files.read import read_surface
from jaxcrumple.mesh.files.surface import MeshError, MeshWarning
from jaxcrumple.mesh.graph import components
from jaxcrumple.options.suggest import nearest
from jaxcrumple.options.units import LENGTH

#: Merging distance for STL files, which list three points for each triangle, relative to the size of the
#: surface: ten times the rounding error of single precision.
STL_MERGE = 1e-6

_LARGEST, _SMALLEST = 5.0, 1e-3  # sizes of a sheet [m] outside which its unit is doubtful
_MOST_NEIGHBOURS = 64  # most neighbours of a point within the merging distance, on average


def read_sheet(
    path: str | Path, merge: float | str | None, unit: str | None
) -> tuple[Float[np.ndarray, "points 3"], Int[np.ndarray, "triangles 3"]]:
    """Read the points (m, 3) of a file in metres, and its triangles (f, 3).

    **Raises:** as `Mesh.from_file`.
    """
    factor = unit_length(unit)
    distance = None if merge is None else merge_distance(merge)
    surface = read_surface(path)
    try:
        faces = triangulated(surface)
    except MeshError as error:
        raise MeshError(f"{str(path)!r}: {error}") from error
    used = surface.points[faces]
    size = float(np.linalg.norm(np.ptp(used.reshape(-1, 3), axis=0)))
    _warn_of_size(path, size, size * factor, unit)
    if distance is None and Path(path).suffix.lower() == ".stl":
        distance = STL_MERGE * size * factor
    points = surface.points * factor
    if distance is not None:
        faces = merged(points, faces, distance)
    return points, faces


def unit_length(unit: str | None) -> float:
    """Return a unit of length in metres.

    **Raises:** `MeshError` for one that is unknown or of another dimension.
    """
    if unit is None:
        return 1.0
    try:
        factor = LENGTH.si(f"1 {unit}")
    except ValueError:
        factor = None
    if not isinstance(factor, float):
        raise MeshError(f"unit = {unit!r} is not a unit of length{nearest(str(unit), LENGTH.usual)}")
    return factor


def merge_distance(merge: float | str) -> float:
    """Convert a merging distance, a number or a string with a unit, to metres.

    **Raises:** `MeshError` if it is not a length or is negative.
    """
    try:
        distance = float(LENGTH.si(merge))
    except (TypeError, ValueError) as error:
        raise MeshError(f"merge = {merge!r} is not a length; give metres or a string like '1 um'") from error
    if not 0 <= distance < np.inf:
        raise MeshError(f"merge = {merge!r} is not a distance; give a length >= 0 m")
    return distance


def merged(
    points: Float[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"], distance: float
) -> Int[np.ndarray, "kept 3"]:
    """Merge points that steps of up to `distance` in m connect, and return the faces over these points.

    The first point of each group represents it. Triangles that collapse to an edge or a point are dropped.

    **Raises:** `MeshError` if merging would remove most of the sheet.
    """
    used = np.unique(faces)
    where, first, inverse = np.unique(points[used], axis=0, return_index=True, return_inverse=True)
    representative = used[first]
    if distance > 0:
        tree = scipy.spatial.cKDTree(where)
        if tree.count_neighbors(tree, distance) > _MOST_NEIGHBOURS * len(where):
            raise MeshError(f"merge = {distance:g} m would merge most of the sheet; give less than its edges")
        pairs = tree.query_pairs(distance, output_type="ndarray")
        count, label = components(len(where), *pairs.T)
        lowest = np.full(count, len(points))
        np.minimum.at(lowest, label, representative)
        representative = lowest[label]
    table = np.arange(len(points))
    table[used] = representative[inverse.ravel()]
    changed = table[faces]
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    collapsed = distinct & (changed == np.roll(changed, 1, axis=1)).any(axis=1)
    if collapsed.all():
        raise MeshError(f"merge = {distance:g} m leaves no triangle; give less than the edges of the sheet")
    return changed[~collapsed]


def _warn_of_size(path: str | Path, raw: float, size: float, unit: str | None) -> None:
    """Warn if the unit of a sheet is doubtful."""
    if unit is None and size > _LARGEST:
        said = f"is {size:.4g} m across, if its lengths are metres; give unit = 'mm' for millimetres, or 'm'"
    elif unit is None and size < _SMALLEST:
        said = f"is {size:.4g} m across, if its lengths are metres; give its unit, or 'm'"
    elif unit is not None and size < _SMALLEST and size < raw < 1:
        said = f"is {size:.4g} m across in the unit {unit!r}; if its lengths are metres, leave it out"
    else:
        return
    warnings.warn(f"the sheet of {str(path)!r} {said}.", MeshWarning, stacklevel=4)
