"""An orthographic camera, so that lengths in a picture can be measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Direction from the sheet to the camera, and the direction that appears vertical.
VIEW, UP = (-0.45, -0.8, 0.55), (0.0, 0.0, 1.0)
# Share of the picture around the sheet that stays free, and smallest ratio of its sides.
FREE, SMALLEST = 0.04, 0.4


@dataclass(frozen=True)
class Camera:
    """An orthographic camera.

    `center` (3,) in m: middle of the picture; `axes` (3, 3): unit vectors to the right, up and towards the
    camera; `width`, `height` in m: extent of the picture; `depth` in m: distance of the camera from `center`.
    """

    center: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    width: float
    height: float
    depth: float

    def shape(self, pixels: int) -> tuple[int, int]:
        """Return the number of rows and columns of a picture whose longer side has `pixels` pixels."""
        longer = max(self.width, self.height)
        return max(round(pixels * self.height / longer), 1), max(round(pixels * self.width / longer), 1)

    def origins(
        self, shape: tuple[int, int], shift: Float[np.ndarray, "rows columns 2"]
    ) -> Float[np.ndarray, "rays 3"]:
        """Return origins (rows * columns, 3) in m of the rays through the pixels, relative to `center`.

        `shift` (rows, columns, 2): place of each ray in its pixel, right and down, from 0 to 1.
        """
        rows, columns = shape
        right = ((np.arange(columns)[None, :] + shift[..., 0]) / columns - 0.5) * self.width
        up = (0.5 - (np.arange(rows)[:, None] + shift[..., 1]) / rows) * self.height
        plane = right[..., None] * self.axes[0] + up[..., None] * self.axes[1] + self.depth * self.axes[2]
        return plane.reshape(-1, 3)


def camera_for(
    points: Float[np.ndarray, "points 3"],
    view: Sequence[float] = VIEW,
    up: Sequence[float] = UP,
) -> Camera:
    """Return the camera that sees all `points` (n, 3) in m from the direction `view`, with `up` vertical.

    **Raises:** ValueError if `view` is zero, or parallel to `up`.
    """
    back = np.asarray(view, dtype=np.float64)
    right = np.cross(np.asarray(up, dtype=np.float64), back)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(back) * np.linalg.norm(up):
        raise ValueError(f"view = {view} must not be zero or parallel to up = {up}; choose another `up`.")
    back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    seen = points @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    size = np.maximum(high - low, 1e-12)
    width, height, _ = np.maximum(size, SMALLEST * size[:2].max()) + 2.0 * FREE * size[:2].max()
    return Camera(0.5 * (low + high) @ axes, axes, width, height, 2.0 * float(np.linalg.norm(size)))
