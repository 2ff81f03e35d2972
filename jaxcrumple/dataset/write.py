"""Write the samples of a split into its group, run by run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcrumple.dataset.arrays import SampleArray
from jaxcrumple.dataset.maps import CHANNELS, SheetMaps
from jaxcrumple.dataset.source import Source, mesh_arrays
from jaxcrumple.dataset.statistics import Statistics
from jaxcrumple.measure.raster import Raster

if TYPE_CHECKING:
    import zarr

# Columns and types of the arrays of a mesh.
_MESH = {"vertices": (3, "f8"), "faces": (3, "i4"), "edges": (2, "i4"), "hinges": (4, "i4")}
_INDEX = {"t": "f8", "run": "i4", "frame": "i4"}


def write_samples(
    group: zarr.Group,
    sources: Sequence[Source],
    sizes: Mapping[str, int],
    raster: Raster,
    statistics: Statistics | None,
) -> None:
    """Write maps, meshes and states of the runs; count the maps into `statistics`.

    `sizes`: rows of the arrays of the largest mesh.
    """
    count = sum(len(source.frames) for source in sources)
    shapes = {"maps": (len(CHANNELS), *raster.shape), "x": (sizes["vertices"], 3), "p": (sizes["hinges"],)}
    samples = {
        name: SampleArray(group, name, count, shape, np.dtype("f4" if name == "maps" else "f8"))
        for name, shape in shapes.items()
    }
    meshes = {
        name: SampleArray(group, name, len(sources), (sizes[name], width), np.dtype(kind))
        for name, (width, kind) in _MESH.items()
    }
    index: list[tuple[float, int, int]] = []
    for row, source in enumerate(sources):
        mesh, frames = source.read()
        maps = SheetMaps(mesh, raster)
        for name, array in mesh_arrays(mesh).items():
            meshes[name].append(array)
        for number, frame in zip(source.frames, frames, strict=True):
            p = mesh.rest_curvature if frame.p is None else frame.p
            image = maps.of(frame.x, p)
            for name, array in {"maps": image, "x": frame.x, "p": p}.items():
                samples[name].append(array)
            index.append((frame.t, row, number))
            if statistics is not None:
                statistics.add(image)
    for written in (*samples.values(), *meshes.values()):
        written.flush()
    for column, (name, kind) in enumerate(_INDEX.items()):
        write_table(group, name, [row[column] for row in index], (count,), kind)
    write_table(group, "rows", [list(source.rows.values()) for source in sources], (len(sources), 4), "i4")
    write_table(group, "seed", [source.seed for source in sources], (len(sources),), "i8")
    group.attrs["runs"] = [source.name for source in sources]


def write_table(
    group: zarr.Group, name: str, values: Sequence[Any], shape: tuple[int, ...], kind: str = "f8"
) -> None:
    """Write a small array in one piece."""
    table = np.array(values, kind).reshape(shape)
    chunks = tuple(max(1, size) for size in shape)
    group.create_array(name, shape=shape, dtype=table.dtype, chunks=chunks)[...] = table
