"""Runs of a campaign that a data set takes, and those that it leaves out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxcrumple.io import Frame, RunDirectory
from jaxcrumple.io.lock import LOCK
from jaxcrumple.io.rundir import is_run
from jaxcrumple.measure.raster import require_flat
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.run.run import flat, stored_config

#: Frames of each run: all that were saved, or the last one.
Frames = Literal["all", "last"]
CHOSEN: dict[str, slice] = {"all": slice(None), "last": slice(-1, None)}
SUCCESS = "success"


class Source(NamedTuple):
    """A run in a folder that ended with success: its `options` by name, the packages that made it, the
    indices of its frames in the data set, and its mesh: number of rows of each array, and its bounds in m."""

    place: Path
    options: dict[str, Any]
    versions: dict[str, str]
    frames: range
    rows: dict[str, int]
    bounds: Float[np.ndarray, "2 2"]

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.place.name

    @property
    def seed(self) -> int:
        """Seed of mesh and imperfection."""
        return self.options["seed"]

    def read(self) -> tuple[Mesh, Iterator[Frame]]:
        """Return the mesh, and the frames one by one."""
        folder = RunDirectory.open(self.place)
        return folder.load_mesh(), folder.load_frames(slice(self.frames.start, self.frames.stop))


def survey(folder: Path, frames: Frames) -> tuple[list[Source], dict[str, str]]:
    """Return the successful runs of a campaign, sorted by name, and the reasons why others are left out.

    **Raises:** ConfigError for a folder without a successful run; `RunDirectoryError` for a damaged run;
    ValueError for a sheet whose rest shape is not flat.
    """
    if is_run(folder):
        raise ConfigError(f"{folder} is a single run; give the folder of a campaign, which holds runs.")
    places = sorted(path for path in folder.glob("*/") if is_run(path) or (path / LOCK).exists())
    if not places:
        raise ConfigError(f"{folder} holds no runs; give the folder of a campaign.")
    left_out = {place.name: reason for place in places if (reason := _fault(place))}
    taken = [_source(place, frames) for place in places if place.name not in left_out]
    if not taken:
        name, reason = next(iter(left_out.items()))
        raise ConfigError(
            f"no run in {folder} ended with success ({name}: {reason}); complete the campaign first."
        )
    return taken, left_out


def _fault(place: Path) -> str:
    """Return why a run is left out; empty for a successful one."""
    summary = RunDirectory.open(place).read_summary() if is_run(place) else {}
    if not summary:
        return "unfinished"
    return "" if summary["result"] == SUCCESS else f"{summary['result']}: {summary['message']}"


def _source(place: Path, frames: Frames) -> Source:
    folder = RunDirectory.open(place)
    mesh = folder.load_mesh()
    try:
        require_flat(mesh, "the maps of a data set")
    except ValueError as error:
        raise ValueError(f"{place}: {error}.") from error
    corners = mesh.vertices[:, :2]
    return Source(
        place=place,
        options=flat(stored_config(folder)),
        versions=folder.read_summary()["versions"],
        frames=folder.frames()[CHOSEN[frames]],
        rows={name: len(array) for name, array in mesh_arrays(mesh).items()},
        bounds=np.stack([corners.min(axis=0), corners.max(axis=0)]),
    )


def mesh_arrays(mesh: Mesh) -> dict[str, np.ndarray]:
    """Return the arrays of a mesh that a data set holds, by name."""
    return {name: getattr(mesh, name) for name in ("vertices", "faces", "edges", "hinges")}
