"""Create figures without a display, with the Agg canvas, and write them atomically."""

from __future__ import annotations

import io
import re
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from jaxcrumple.io.atomic import write_bytes

# Dots per inch of pictures of pixels, on a screen and in print; largest letters in print in points.
DPI, PRINT_DPI = 160, 600
LETTERS = 8.0
INCH = 0.0254


def new_figure(size: tuple[float, float], caption: str) -> Figure:
    """Create an empty figure of `size` in inches; write the `caption` above unless it is empty."""
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    if caption:
        figure.suptitle(caption, fontsize=10)
    return figure


def fit_to_print(figure: Figure, width: float) -> None:
    """Change the figure to a `width` in m: letters of at most `LETTERS` points, long labels in lines."""
    wide, high = figure.get_size_inches()
    figure.set_size_inches(width / INCH, width / INCH * high / wide)
    for axes in figure.axes:
        axes.tick_params(labelsize=LETTERS)
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_fontsize(min(text.get_fontsize(), LETTERS))
    # A colour bar is about half as high as its figure, and a letter half as wide as high.
    fitting = int(0.5 * figure.get_size_inches()[1] * 72 / (0.5 * LETTERS))
    for axes in figure.axes:
        axes.set_ylabel("\n".join(_lines(axes.get_ylabel(), fitting)))


def _lines(label: str, fitting: int) -> list[str]:
    """Return the lines of a label, of at most `fitting` letters if words allow it; formulas stay whole."""
    words = re.findall(r"(?:\$[^$]*\$|\S)+", label)
    lines = [""]
    for word in words:
        joined = f"{lines[-1]} {word}".strip()
        lines = [*lines[:-1], joined] if len(joined) <= fitting or not lines[-1] else [*lines, word]
    return lines


def save_figure(figure: Figure, path: str | Path, dpi: int = DPI) -> Path:
    """Write the picture atomically, in the format of the extension of `path`.

    **Raises:** ValueError for an unknown extension, `RunDirectoryError` if `path` cannot be written.
    """
    path = Path(path)
    write_bytes(path, encoded(figure, path.suffix[1:].lower() or "png", dpi))
    return path


def encoded(figure: Figure, kind: str, dpi: int = DPI) -> bytes:
    """Return the picture as a file of a `kind`, such as "png".

    **Raises:** ValueError for an unknown kind.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi)
    return buffer.getvalue()
