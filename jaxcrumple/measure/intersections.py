"""The audit of a frame: how often the sheet passes through itself."""

from numpy.typing import ArrayLike

from jaxcrumple.geometry.intersections import intersections
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import Mesh


def count_intersections(mesh: Mesh, x: ArrayLike) -> int:
    """Number of pairs of an edge and a triangle that it pierces, at positions `x` (n, 3) in m; 0 for a sheet
    that is free of intersections. See `jaxcrumple.geometry.intersections`."""
    return len(intersections(positions(mesh, x), mesh.faces, mesh.edges))
