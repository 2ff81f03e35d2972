"""The audit of a frame: how often the sheet passes through itself."""

from numpy.typing import ArrayLike

from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh import Mesh
from jaxcrumple.model.intersections import intersections


def count_intersections(mesh: Mesh, x: ArrayLike) -> int:
    """Number of pairs of an edge and a triangle that it pierces, at positions `x` (n, 3) in m; 0 for a sheet
    that is free of intersections. See `jaxcrumple.model.intersections`."""
    return len(intersections(positions(mesh, x), mesh.faces, mesh.edges))
