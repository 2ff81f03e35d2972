"""A picture of a frame of a run, in a notebook or as a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from jaxcrumple.io.run import Run
from jaxcrumple.model.walls import AbstractShape
from jaxcrumple.options.units import LENGTH
from jaxcrumple.plot.camera import UP, VIEW, Camera
from jaxcrumple.plot.draw import Picture
from jaxcrumple.plot.fields import Values, field_kind
from jaxcrumple.plot.figure import INCH, PRINT_DPI, fit_to_print
from jaxcrumple.plot.plot import about
from jaxcrumple.plot.sheet import PAPER, PIXELS, Walls, camera_of, sheet_figure
from jaxcrumple.plot.surroundings import wall_shapes

# Pixels per inch of a picture in print.
PRINT_PIXELS = 300


class Look(NamedTuple):
    """Hold what all pictures of a run share: the colour `scale` of a field, its `label` and its `values` by
    frame, the `shapes` of the walls, and the `camera`. Without a field there are neither scale nor values."""

    label: str
    values: Mapping[int, Values]
    shapes: Sequence[AbstractShape]
    pixels: int
    camera: Camera
    scale: ScalarMappable | None


def picture(
    run: Run,
    frame: int = -1,
    *,
    field: str = "curvature",
    walls: bool = True,
    axes: Axes | None = None,
    scale: ScalarMappable | None = None,
    view: Sequence[float] = VIEW,
    up: Sequence[float] = UP,
    pixels: int | None = None,
    width: float | str | None = None,
) -> Picture:
    """Draw a frame of a run in space. `draw_sheet` draws any mesh with any values.

    **Arguments:** `frame`: index of the frame, -1 for the last; `field`: "curvature", "damage", "strain",
    "contact", or "paper" for the shape alone; `walls`: whether to show the walls; `axes`:
    of Matplotlib to draw into, by default those of a new figure with caption and colour bar; `scale`: of the
    colours, a `ScalarMappable` of Matplotlib that pictures can share, by default one that spans the values;
    `view` (3,): direction from the sheet to the camera, with `up` (3,) vertical; `pixels`: of the longer side
    of the sheet, by default 820, or 300 an inch in print; `width`: for print, in m or with a unit, such as
    "86 mm": no caption, letters of at most 8 points.

    **Raises:** ValueError for an unknown field, a frame that the run does not have, a `view` along `up`, a
    width that is not a positive length, or both `axes` and a width.
    """
    if axes is not None and width is not None:
        raise ValueError("width is that of a new figure; with axes, set the size of theirs.")
    number, wide = frame_number(run, frame), None if width is None else _width(width)
    if pixels is None:
        pixels = PIXELS if wide is None else round(PRINT_PIXELS * wide / INCH)
    look = look_of(run, [number], field, walls, view, up, pixels)
    if scale is not None and look.scale is not None:
        look = look._replace(scale=scale)
    if wide is None:
        return Picture(drawn(run, number, look, about(run, t=run.t[number]), axes))
    figure = drawn(run, number, look, "")
    fit_to_print(figure, wide)
    return Picture(figure, PRINT_DPI)


def _width(width: float | str) -> float:
    """Return the width of a picture in m."""
    try:
        wide = float(LENGTH.si(width))
    except (TypeError, ValueError):
        wide = np.nan
    if not (np.isfinite(wide) and wide > 0):
        raise ValueError(f"width = {width!r} must be a positive length in m, or with a unit such as '86 mm'.")
    return wide


def frame_number(run: Run, frame: int) -> int:
    """Return the index of a frame from 0 on."""
    if not -len(run.t) <= frame < len(run.t):
        raise ValueError(f"frame {frame} does not exist: the run has {len(run.t)} frames.")
    return frame % len(run.t)


def look_of(
    run: Run,
    frames: Sequence[int],
    field: str,
    walls: bool,
    view: Sequence[float],
    up: Sequence[float],
    pixels: int,
) -> Look:
    """Return the look of pictures of all `frames`: the camera sees all of them, and colours span them all."""
    kind = field_kind(field)
    shapes = wall_shapes(run) if walls else ()
    camera = camera_of(run.x[frames].reshape(-1, 3), Walls(shapes, float(run.t[frames[0]])), view, up)
    if kind is None:
        return Look("", {}, shapes, pixels, camera, None)
    values = {frame: kind.values(run, frame) for frame in frames}
    scale = kind.scale(*(values[frame] for frame in frames))
    return Look(kind.label, values, shapes, pixels, camera, scale)


def drawn(run: Run, frame: int, look: Look, caption: str, axes: Axes | None = None) -> Figure:
    """Return the figure of a frame, drawn into `axes` or new ones."""
    return sheet_figure(
        run.mesh,
        run.x[frame],
        PAPER if look.scale is None else look.scale,
        look.values.get(frame),
        label=look.label,
        camera=look.camera,
        walls=Walls(look.shapes, float(run.t[frame])),
        pixels=look.pixels,
        caption=caption,
        axes=axes,
    )
