"""A picture of a sheet from its mesh and positions, alone or within axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import ArrayLike, Float, Real
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple.measure import mean_curvature
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.plot.camera import UP, VIEW
from jaxcrumple.plot.figure import DPI, encoded, save_figure
from jaxcrumple.plot.sheet import CURVATURE_LABEL, PIXELS, Walls, camera_of, color_scale, sheet_figure

# Width and height in inches of a picture beside axes.
PAIR = (5.6, 3.1)


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture that a notebook shows: a Matplotlib `figure`, and the dots per inch `dpi` of its file.

    A notebook shows it at Matplotlib's own `figure.dpi`.
    """

    figure: Figure
    dpi: int = DPI

    def _repr_png_(self) -> bytes:
        return encoded(self.figure, "png", matplotlib.rcParams["figure.dpi"])

    def beside(self, ratio: float = 1.0, **labels: Any) -> Axes:
        """Return new axes to the right of the picture, which loses its caption.

        **Arguments:** `ratio`: width of the axes over that of the picture; `labels`: keywords of Matplotlib's
        `add_subplot`, such as xlabel.
        """
        self.figure.suptitle("")
        self.figure.set_size_inches(*PAIR)
        grid = self.figure.add_gridspec(1, 2, width_ratios=(1.0, ratio))
        self.figure.axes[0].set_subplotspec(grid[0])
        return self.figure.add_subplot(grid[1], **labels)

    def save(self, path: str | Path) -> Path:
        """Write the picture in the format of the extension of `path` (.png, .pdf, .svg, ...).

        **Raises:** ValueError for an unknown extension, `RunDirectoryError` if `path` cannot be written.
        """
        return save_figure(self.figure, path, self.dpi)


def draw_sheet(
    mesh: Mesh,
    x: NodeVectorsLike,
    color: Real[ArrayLike, " values"] | str | None = None,
    *,
    axes: Axes | None = None,
    scale: ScalarMappable | None = None,
    label: str = "",
    walls: Walls | None = None,
    within: Float[ArrayLike, "... 3"] | None = None,
    view: Sequence[float] = VIEW,
    up: Sequence[float] = UP,
    pixels: int = PIXELS,
    caption: str = "",
) -> Picture:
    """Draw a sheet in space from its mesh and positions, in parallel projection, with a length bar.

    **Arguments:** `x` (n, 3): positions in m; `color`: one value per node (n,) or triangle (f,), or one
    colour of Matplotlib, by default the mean curvature in 1/m; `axes`: of Matplotlib to draw into, by default
    those of a new figure with a colour bar; `scale`: of the colours of values, a `ScalarMappable` of
    Matplotlib that pictures can share, by default one that spans the values; `label`: name and unit of
    `color`; `walls`: shapes to show, and the time in s, as `(shapes, t)`; `within` (..., 3): positions in m
    that the picture must hold, such as those of all frames, by default `x`; `view` (3,): direction from the
    sheet to the camera, with `up` (3,) vertical; `pixels`: of the longer side of the sheet; `caption`: text
    above a new figure.

    **Returns:** the `Picture` of the figure.

    **Raises:** ValueError for a wrong shape, or a `view` along `up`.

    >>> mesh = jc.rectangle(0.1, 0.1, 200)
    >>> height = 0.01 * np.cos(40 * mesh.vertices[:, 0])  # m
    >>> x = mesh.vertices + np.outer(height, [0, 0, 1])
    >>> picture = jc.draw_sheet(mesh, x, 1e3 * height, label="height [mm]", pixels=200)
    >>> [axes.get_ylabel() for axes in picture.figure.axes]
    ['', 'height [mm]']
    """
    x, walls = positions(mesh, x), Walls(*(walls or ()))
    values, paint = _painted(mesh, x, color, scale)
    if color is None:
        label = label or CURVATURE_LABEL
    seen = x if within is None else np.concatenate([x, np.asarray(within).reshape(-1, 3)])
    camera = camera_of(seen, walls, view, up)
    figure = sheet_figure(
        mesh,
        x,
        paint,
        values,
        label=label,
        camera=camera,
        walls=walls,
        pixels=pixels,
        caption=caption,
        axes=axes,
    )
    return Picture(figure)


def _painted(
    mesh: Mesh,
    x: Float[np.ndarray, "nodes 3"],
    color: Real[ArrayLike, " values"] | str | None,
    scale: ScalarMappable | None,
) -> tuple[Float[np.ndarray, " values"] | None, ScalarMappable | str]:
    """Return the values to show and their scale, or no values and one colour."""
    if isinstance(color, str):
        return None, color
    values = mean_curvature(mesh, x) if color is None else np.asarray(color, dtype=np.float64)
    return values, color_scale(values, signed=color is None) if scale is None else scale
