"""Count self-intersections of the sheet."""

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple.geometry.intersections import intersections
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import Mesh


def count_intersections(mesh: Mesh, x: NodeVectorsLike) -> int:
    """Return the number of edge-triangle pairs where the edge pierces the triangle; `x` (n, 3) in m.

    It is 0 for a sheet without self-intersections. Pairs that share a node do not count.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    return len(intersections(positions(mesh, x), mesh.faces, mesh.edges))
