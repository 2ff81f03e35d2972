"""Films of a run, as GIF or MP4."""

from __future__ import annotations

import importlib.util
import io
import itertools
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.io.run import Run
from jaxcrumple.plot.camera import UP, VIEW
from jaxcrumple.plot.picture import drawn, frame_number, look_of
from jaxcrumple.plot.plot import about

# Frames per second of a film, longer side of its sheet in pixels, and its dots per inch.
RATE, PIXELS, DPI = 10.0, 700, 100
# Extensions of films.
FILMS = (".gif", ".mp4")


def film(
    run: Run,
    path: str | Path,
    *,
    frames: Sequence[int] | None = None,
    field: str = "curvature",
    walls: bool = True,
    view: Sequence[float] = VIEW,
    up: Sequence[float] = UP,
    pixels: int = PIXELS,
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
    look = look_of(run, chosen, field, walls, view, up, pixels)
    images = (_pixels_of(drawn(run, frame, look, about(run, t=run.t[frame]))) for frame in chosen)
    write_bytes(path, _gif(images, rate) if kind == ".gif" else _mp4(images, rate))
    return path


def _pixels_of(figure: Figure) -> np.ndarray:
    """Return the image (rows, columns, 3) of a figure, with even numbers of pixels, as most codecs ask."""
    figure.set_dpi(DPI)
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
