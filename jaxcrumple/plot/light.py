"""Light and colours of pictures of a sheet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Direction to the lamp along the axes of the camera: right, up, and towards the camera.
LAMP = (-0.5, 0.65, 0.75)


def srgb(image: Float[np.ndarray, "rows columns 4"]) -> Float[np.ndarray, "rows columns 4"]:
    """Return an image of linear RGB times coverage, and coverage, as sRGB and opacity (IEC 61966-2-1)."""
    color = np.clip(image[..., :3] / np.maximum(image[..., 3:], 1e-9), 0.0, 1.0)
    encoded = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    return np.concatenate([encoded, image[..., 3:]], axis=2)


def linear(color: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Return colours (..., 3) in sRGB as linear RGB (IEC 61966-2-1)."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
