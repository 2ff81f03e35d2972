"""Maps of a frame on a regular grid of the undeformed sheet, where each material point has one value."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from jaxcrumple.measure.creases import (
    crease_pattern,
    curvature_of_angles,
    hinge_angles,
    plastic_curvature,
)
from jaxcrumple.measure.raster import Raster
from jaxcrumple.mesh.mesh import Mesh


class Channel(NamedTuple):
    """A map: its SI `unit` and its `meaning`."""

    unit: str
    meaning: str


#: The maps of a sample, in order.
CHANNELS = {
    "x": Channel("m", "position of the material point"),
    "y": Channel("m", "position of the material point"),
    "z": Channel("m", "position (height) of the material point"),
    "elastic_curvature": Channel("1/m", "mean curvature beyond the rest curvature"),
    "plastic_curvature": Channel("1/m", "mean curvature of the rest shape, which plastic flow changes"),
    "crease": Channel("1", "1 on a mountain, -1 on a valley, 0 without plastic damage"),
    "mask": Channel("1", "1 on the sheet; 0 outside, where all maps are 0"),
}


class SheetMaps:
    """The maps of the frames of one mesh. A pixel of `raster` holds the values at its centre.

    Positions and curvatures are linear within a triangle. A crease passes through each pixel that a damaged
    hinge meets; the most damaged hinge gives the sign.

    Curvatures are sums of the two principal ones, as of `jaxcrumple.measure.mean_curvature`.
    """

    def __init__(self, mesh: Mesh, raster: Raster) -> None:
        self.mesh, self.shape = mesh, raster.shape
        self.inside, self.at_pixels = _interpolation(mesh, raster)
        rows, columns, self.hinge = raster.lines(mesh.vertices[mesh.hinges[:, :2], :2])
        self.pixel = np.ravel_multi_index((rows, columns), raster.shape)

    def of(
        self, x: Float[np.ndarray, "nodes 3"], p: Float[np.ndarray, " hinges"]
    ) -> Float[np.ndarray, "channels rows columns"]:
        """Return the `CHANNELS` (c, rows, columns) in float32, of positions `x` in m and rest curvatures."""
        mesh = self.mesh
        plastic = 2.0 * np.arcsin(np.clip(p / 2.0, -1.0, 1.0))
        elastic = hinge_angles(mesh, x) - plastic
        smooth = np.column_stack([x, curvature_of_angles(mesh, elastic), curvature_of_angles(mesh, plastic)])
        maps = np.zeros((len(CHANNELS), self.inside.size), np.float32)
        maps[:5, self.inside.ravel()] = (self.at_pixels @ smooth).T
        maps[5] = self._creases(p)
        maps[6] = 1.0
        maps[:, ~self.inside.ravel()] = 0.0
        return maps.reshape(-1, *self.shape)

    def _creases(self, p: Float[np.ndarray, " hinges"]) -> Int[np.ndarray, " pixels"]:
        """Return the sign of the most damaged hinge in each pixel."""
        sign, damage = crease_pattern(self.mesh, p), np.abs(plastic_curvature(self.mesh, p))
        points = np.flatnonzero(sign[self.hinge])
        points = points[np.argsort(damage[self.hinge[points]], kind="stable")]
        image = np.zeros(self.inside.size, np.int8)
        image[self.pixel[points]] = sign[self.hinge[points]]  # the last (most damaged) hinge wins
        return image


def _interpolation(mesh: Mesh, raster: Raster) -> tuple[Bool[np.ndarray, "rows columns"], csr_array]:
    """Return the pixels on the sheet, and the matrix that takes values of nodes to these pixels."""
    faces = raster.faces(mesh)
    inside = faces >= 0
    nodes = mesh.faces[faces[inside]]
    a, b, c = np.moveaxis(mesh.vertices[nodes, :2], 1, 0)
    at, ab, ac = raster.centres()[inside] - a, b - a, c - a
    area = _cross(ab, ac)
    second, third = _cross(at, ac) / area, _cross(ab, at) / area
    weights = np.column_stack([1.0 - second - third, second, third])
    ends = np.arange(0, weights.size + 1, 3)
    return inside, csr_array((weights.ravel(), nodes.ravel(), ends), shape=(len(nodes), mesh.n_nodes))


def _cross(
    u: Float[np.ndarray, "points 2"], v: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, " points"]:
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
