"""Create figures without a display, with the Agg canvas, and write them atomically."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxcrumple.io.atomic import write_bytes

# Dots per inch of pictures of pixels.
DPI = 160


def new_figure(size: tuple[float, float], caption: str) -> Figure:
    """Create an empty figure of `size` in inches; write the `caption` above unless it is empty."""
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    if caption:
        figure.suptitle(caption, fontsize=10)
    return figure


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write the picture atomically, in the format of the extension of `path`.

    **Raises:** ValueError for an unknown extension, `RunDirectoryError` if `path` cannot be written.
    """
    path = Path(path)
    write_bytes(path, encoded(figure, path.suffix[1:].lower() or "png"))
    return path


def encoded(figure: Figure, kind: str) -> bytes:
    """Return the picture as a file of a `kind`, such as "png".

    **Raises:** ValueError for an unknown kind.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=DPI)
    return buffer.getvalue()
