"""Raster image of a flat sheet, the input of image analysis and of learning."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.ndimage import gaussian_filter

from jaxcrumple._jax.memory import require
from jaxcrumple.mesh.mesh import Mesh

_BYTES = 60.0  # per pixel or point of a line, with copies
_SUBDIVISION = 4  # samples of a triangle: the centres of its 4 x 4 parts
_FLAT = 0.9  # least ratio of projected to true area of a triangle; below 1 to allow for imperfections
_MARGIN = 1e-9  # margin of a square, so that rounding puts no point of the sheet outside


class Raster(NamedTuple):
    """Square pixels in the x-y plane; the pixel in row i and column j is at `origin + pixel * (j, i)`."""

    origin: Float[np.ndarray, " 2"]  # (2,) x, y of the first pixel [m]
    pixel: float  # side of a pixel [m]
    shape: tuple[int, int]  # rows, columns

    @classmethod
    def over(cls, mesh: Mesh, pixel: float) -> Raster:
        """Cover the sheet with pixels of side `pixel` in m and a margin of at least one pixel."""
        low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
        columns, rows = np.ceil((high - low) / pixel) + 3.0
        what = f"an image of {columns:.4g} x {rows:.4g} pixels"
        require(_BYTES * columns * rows, what, "choose a larger width")
        return cls(low - pixel, pixel, (int(rows), int(columns)))

    @classmethod
    def square(
        cls, low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"], count: int, what: str
    ) -> Raster:
        """Cover the rectangle from `low` to `high` (2,) in m by a square of `count` x `count` pixels.

        Both have the same centre. `what`: name of the image in the refusal of one that memory cannot hold.
        """
        require(_BYTES * float(count) ** 2, what, "choose fewer pixels")
        pixel = (1.0 + _MARGIN) * float((high - low).max()) / count
        return cls(0.5 * (low + high) - 0.5 * (count - 1) * pixel, pixel, (count, count))

    def pixels(
        self, points: Float[np.ndarray, "*points 2"]
    ) -> tuple[Int[np.ndarray, " *points"], Int[np.ndarray, " *points"]]:
        """Return rows and columns (...) of the pixels nearest to `points` (..., 2) in m."""
        columns, rows = np.moveaxis(np.rint((points - self.origin) / self.pixel).astype(int), -1, 0)
        return rows, columns

    def centres(self) -> Float[np.ndarray, "rows columns 2"]:
        """Return x and y (rows, columns, 2) in m of the centres of the pixels."""
        rows, columns = np.indices(self.shape)
        return self.origin + self.pixel * np.stack([columns, rows], axis=-1)

    def faces(self, mesh: Mesh) -> Int[np.ndarray, "rows columns"]:
        """Return the triangle (rows, columns) at the centre of each pixel, or -1 outside the sheet."""
        from matplotlib.tri import Triangulation  # imported here, since matplotlib is slow to import

        x, y = mesh.vertices[:, :2].T
        return np.asarray(
            Triangulation(x, y, mesh.faces).get_trifinder()(*np.moveaxis(self.centres(), -1, 0))
        )

    def inside(self, mesh: Mesh) -> Bool[np.ndarray, "rows columns"]:
        """Return a mask (rows, columns) of the pixels whose centre is on the sheet."""
        return self.faces(mesh) >= 0

    def lines(
        self, ends: Float[np.ndarray, "lines 2 2"]
    ) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, " points"], Int[np.ndarray, " points"]]:
        """Sample straight lines between `ends` (m, 2, 2) at points less than a pixel apart.

        **Returns:** row, column and line number of each point.
        """
        longest = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max(initial=0.0)
        points = np.ceil(2 * longest / self.pixel) + 1.0
        what = f"an image of {len(ends)} lines of up to {points:.4g} points each"
        require(_BYTES * points * len(ends), what, "choose a larger width")
        count = int(points)
        s = (np.arange(count) + 0.5)[:, None] / count
        rows, columns = self.pixels(ends[:, None, 0] * (1 - s) + ends[:, None, 1] * s)
        return rows.ravel(), columns.ravel(), np.repeat(np.arange(len(ends)), count)

    def density(
        self, ends: Float[np.ndarray, "lines 2 2"], amount: Float[np.ndarray, " lines"], sigma: float
    ) -> Float[np.ndarray, "rows columns"]:
        """Spread `amount` (m,) along the lines `ends` (m, 2, 2), then by a Gaussian of width `sigma` in m.

        **Returns:** amount per area (rows, columns), in the unit of `amount` per m2.
        """
        rows, columns, line = self.lines(ends)
        points = np.bincount(line, minlength=len(ends))
        image = np.zeros(self.shape)
        np.add.at(image, (rows, columns), (amount / points)[line])
        return gaussian_filter(image, sigma / self.pixel, mode="constant") / self.pixel**2

    def on_faces(
        self, mesh: Mesh, image: Shaped[np.ndarray, "rows columns"]
    ) -> Shaped[np.ndarray, "faces samples"]:
        """Sample `image` at m points spread evenly over each triangle: values (f, m)."""
        corners = mesh.vertices[mesh.faces][..., :2]
        return image[self.pixels(np.einsum("mc,fcd->fmd", _barycentres(_SUBDIVISION), corners))]


def require_flat(mesh: Mesh, who: str) -> None:
    """Refuse a rest shape that an image in the x-y plane does not show; `who` needs a flat one.

    **Raises:** ValueError.
    """
    e1, e2 = (mesh.vertices[mesh.faces[:, k], :2] - mesh.vertices[mesh.faces[:, 0], :2] for k in (1, 2))
    shadow = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2
    if np.any(shadow < _FLAT * mesh.face_area):
        raise ValueError(f"the rest shape is not flat; {who} need a sheet that lies in the x-y plane")


def _barycentres(n: int) -> Float[np.ndarray, "parts 3"]:
    """Return barycentric coordinates (n^2, 3) of the centres of n^2 equal parts of a triangle."""
    i, j = np.indices((n, n)).reshape(2, -1)
    up, down = i + j < n, i + j < n - 1
    first = np.stack([i[up] + 1 / 3, j[up] + 1 / 3], axis=1)
    second = np.stack([i[down] + 2 / 3, j[down] + 2 / 3], axis=1)
    uv = np.concatenate([first, second]) / n
    return np.column_stack([uv, 1 - uv.sum(axis=1)])
