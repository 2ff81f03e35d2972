"""Arrays of a data set in Zarr, version 3: a chunk for each sample, many chunks in a file (shard)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Shaped

if TYPE_CHECKING:
    import zarr

#: Bytes of a shard before compression, which are held in memory until it is full.
SHARD = 2**25


class SampleArray:
    """An array (count, ...) that is written sample by sample.

    A sample that is smaller than `shape` is padded with zeros.
    """

    def __init__(
        self, group: zarr.Group, name: str, count: int, shape: tuple[int, ...], dtype: np.dtype
    ) -> None:
        from zarr.codecs import BloscCodec

        fitting = SHARD // max(1, math.prod(shape) * dtype.itemsize)
        per_shard = max(1, min(count, fitting))
        self.array = group.create_array(
            name,
            shape=(count, *shape),
            dtype=dtype,
            chunks=(1, *shape),
            shards=(per_shard, *shape),
            # Sorted by bytes, floats are smaller and read faster than by the default.
            compressors=BloscCodec(cname="zstd", clevel=3, shuffle="shuffle"),
        )
        self.held = np.zeros((per_shard, *shape), dtype)
        self.written = self.count = 0

    def append(self, value: Shaped[np.ndarray, " ..."]) -> None:
        """Add a sample; write the shard that it completes."""
        self.held[self.count][tuple(slice(size) for size in value.shape)] = value
        self.count += 1
        if self.count == len(self.held):
            self.flush()

    def flush(self) -> None:
        """Write the samples that are held."""
        self.array[self.written : self.written + self.count] = self.held[: self.count]
        self.written += self.count
        self.held[:] = 0
        self.count = 0
