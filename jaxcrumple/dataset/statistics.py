"""Range, mean and deviation of each map over the samples, in one pass."""

import numpy as np
from jaxtyping import Float

from jaxcrumple.dataset.maps import CHANNELS


class Statistics:
    """Statistics of each channel over the pixels on the sheet."""

    def __init__(self) -> None:
        self.count = 0
        self.sums, self.squares = np.zeros((2, len(CHANNELS)))
        self.least, self.most = np.full(len(CHANNELS), np.inf), np.full(len(CHANNELS), -np.inf)

    def add(self, maps: Float[np.ndarray, "channels rows columns"]) -> None:
        """Count a sample in."""
        values = maps[:, maps[-1] > 0].astype(float)
        self.count += values.shape[1]
        self.sums += values.sum(axis=1)
        self.squares += (values**2).sum(axis=1)
        self.least = np.minimum(self.least, values.min(axis=1, initial=np.inf))
        self.most = np.maximum(self.most, values.max(axis=1, initial=-np.inf))

    def of_channels(self) -> dict[str, dict[str, float]]:
        """Return "min", "max", "mean" and "std" of each channel, in its unit."""
        mean = self.sums / self.count
        std = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0.0))
        rows = np.column_stack([self.least, self.most, mean, std]).tolist()
        return {
            name: dict(zip(("min", "max", "mean", "std"), row, strict=True))
            for name, row in zip(CHANNELS, rows, strict=True)
        }
