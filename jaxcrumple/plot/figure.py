"""Figures that need no display: made with the Agg canvas, written whole or not at all."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxcrumple.io.atomic import write_bytes


def new_figure(size: tuple[float, float], caption: str) -> Figure:
    """An empty figure of `size` in inches, with the `caption` above if it is not empty."""
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    if caption:
        figure.suptitle(caption, fontsize=10)
    return figure


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write the picture, all or nothing, in the format that the ending of `path` names.

    **Raises:** ValueError for an unknown ending, `RunDirectoryError` if it cannot be written.
    """
    path = Path(path)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix[1:].lower() or "png", dpi=160)
    write_bytes(path, buffer.getvalue())
    return path
