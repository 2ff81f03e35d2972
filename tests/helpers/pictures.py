"""What a picture holds, from its pixels."""

from pathlib import Path

import matplotlib.image
import numpy as np


def colors(path: Path) -> int:
    """Number of different colours of a picture of more than 400 pixels each way; an empty one has one."""
    pixels = matplotlib.image.imread(path)
    assert min(pixels.shape[:2]) > 400
    return len(np.unique(np.round(255 * pixels[..., :3]).reshape(-1, 3), axis=0))
