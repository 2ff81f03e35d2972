"""Pictures and films of a run, in a notebook or as files."""

from __future__ import annotations

import importlib.util
import io
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.io.run import Run
from jaxcrumple.model.walls import AbstractShape
from jaxcrumple.options.units import LENGTH
from jaxcrumple.plot.camera import UP, VIEW, Camera
from jaxcrumple.plot.fields import Values, field_kind
from jaxcrumple.plot.figure import DPI, INCH, PRINT_DPI, encoded, fit_to_print, save_figure
from jaxcrumple.plot.plot import about
from jaxcrumple.plot.sheet import PAPER, PIXELS, Walls, camera_of, sheet_figure
from jaxcrumple.plot.surroundings import wall_shapes

# Frames per second of a film, longer side of its sheet in pixels, and its dots per inch.
RATE, FILM_PIXELS, FILM_DPI = 10.0, 700, 100
# Width and height in inches of a picture beside axes.
PAIR = (5.6, 3.1)
# Pixels per inch of a picture in print.
PRINT_PIXELS = 300
# Extensions of films.
FILMS = (".gif", ".mp4")


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture that a notebook shows: a Matplotlib `figure`, and the dots per inch `dpi` of its file."""

    figure: Figure
    dpi: int = DPI

    def _repr_png_(self) -> bytes:
        return encoded(self.figure, "png")

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


class _Look(NamedTuple):
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
    view: Sequence[float] = VIEW,
    up: Sequence[float] = UP,
    pixels: int | None = None,
    width: float | str | None = None,
) -> Picture:
    """Draw a frame of a run in space.

    **Arguments:** `frame`: index of the frame, -1 for the last; `field`: "curvature", "damage", "strain",
    "contact", or "paper" for the shape alone; `walls`: whether to show the walls of a named scene; `view`
    (3,): direction from the sheet to the camera, with `up` (3,) vertical; `pixels`: of the longer side of the
    sheet, by default 820, or 300 an inch in print; `width`: for print, in m or with a unit, such as "86 mm":
    no caption, letters of at most 8 points.

    **Raises:** ValueError for an unknown field, a frame that the run does not have, a `view` along `up`, or a
    width that is not a positive length.
    """
    number, wide = frame_number(run, frame), None if width is None else _width(width)
    if pixels is None:
        pixels = PIXELS if wide is None else round(PRINT_PIXELS * wide / INCH)
    look = _look(run, [number], field, walls, view, up, pixels)
    if wide is None:
        return Picture(_drawn(run, number, look, about(run, t=run.t[number])))
    figure = _drawn(run, number, look, "")
    fit_to_print(figure, wide)
    return Picture(figure, PRINT_DPI)


def film(
    run: Run,
    path: str | Path,
    *,
    frames: Sequence[int] | None = None,
    field: str = "curvature",
    walls: bool = True,
    view: Sequence[float] = VIEW,
    up: Sequence[float] = UP,
    pixels: int = FILM_PIXELS,
    rate: float = RATE,
) -> Path:
    """Write a film of a run as .gif or .mp4, with one camera and one colour scale, and return `path`.

    An MP4 needs the extra `film` (PyAV).

    **Arguments:** `frames`: indices, by default all; `rate`: frames per second; `field`, `walls`, `view`,
    `up`, `pixels` as of `picture`.

    **Raises:** as `picture`; ValueError for another extension, ImportError without the extra.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in FILMS:
        raise ValueError(f"{path.name!r} is no film: end its name in .gif or .mp4.")
    if kind == ".mp4" and importlib.util.find_spec("av") is None:
        raise ImportError("an MP4 needs PyAV (pip install av); or write a .gif.")
    chosen = [frame_number(run, frame) for frame in (range(len(run.t)) if frames is None else frames)]
    look = _look(run, chosen, field, walls, view, up, pixels)
    images = (_pixels_of(_drawn(run, frame, look, about(run, t=run.t[frame]))) for frame in chosen)
    write_bytes(path, _gif(images, rate) if kind == ".gif" else _mp4(images, rate))
    return path


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


def _look(
    run: Run,
    frames: Sequence[int],
    field: str,
    walls: bool,
    view: Sequence[float],
    up: Sequence[float],
    pixels: int,
) -> _Look:
    """Return the look of pictures of all `frames`: the camera sees all of them, and colours span them all."""
    kind = field_kind(field)
    shapes = wall_shapes(run) if walls else ()
    camera = camera_of(run.x[frames].reshape(-1, 3), Walls(shapes, float(run.t[frames[0]])), view, up)
    if kind is None:
        return _Look("", {}, shapes, pixels, camera, None)
    values = {frame: kind.values(run, frame) for frame in frames}
    scale = kind.scale(*(values[frame] for frame in frames))
    return _Look(kind.label, values, shapes, pixels, camera, scale)


def _drawn(run: Run, frame: int, look: _Look, caption: str) -> Figure:
    """Return the figure of a frame."""
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
    )


def _pixels_of(figure: Figure) -> np.ndarray:
    """Return the image (rows, columns, 3) of a figure, with even numbers of pixels, as most codecs ask."""
    figure.set_dpi(FILM_DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., :3]
    return np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])


def _gif(images: Iterator[np.ndarray], rate: float) -> bytes:
    """Encode images (rows, columns, 3) as GIF."""
    from PIL import Image

    first, *rest = (Image.fromarray(image).quantize(dither=Image.Dither.NONE) for image in images)
    buffer = io.BytesIO()
    duration = round(1000.0 / rate)
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=duration, loop=0)
    return buffer.getvalue()


def _mp4(images: Iterator[np.ndarray], rate: float) -> bytes:
    """Encode images (rows, columns, 3) as MP4 (H.264)."""
    import av

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
        # Players expect this format; a lower `crf` is a better picture.
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "18"}
        first = next(images)
        stream.height, stream.width = first.shape[:2]
        for image in itertools.chain([first], images):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return buffer.getvalue()
