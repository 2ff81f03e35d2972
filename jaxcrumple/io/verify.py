"""What is damaged in a run folder, and the last moment at which all of it is sound."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from jaxcrumple.io.atomic import RunDirectoryError, write_bytes
from jaxcrumple.io.checkpoint import CheckpointError, read_metadata
from jaxcrumple.io.manifest import (
    MANIFEST,
    Entry,
    Manifest,
    entry_of,
    read_manifest,
    sealed,
    write_manifest,
)
from jaxcrumple.io.rundir import (
    CHECKPOINTS,
    FILM,
    FORMAT,
    FRAME_COLUMNS,
    LATEST,
    RUN,
    SUMMARY,
    VERSION,
    RunDirectory,
    checked,
    cure,
    frame_name,
    is_run,
)
from jaxcrumple.io.table import Table

#: Files that a run writes again from the others when it is resumed.
DERIVED = (SUMMARY, FILM)


def damages(folder: Path) -> dict[str, str]:
    """What is wrong with the files of a run, by their names; empty if all of it is sound.

    Files that the manifest does not name, such as pictures, are not looked at.
    """
    try:
        manifest = read_manifest(folder)
    except RunDirectoryError as error:
        return {MANIFEST: str(error)}
    return dict(_damages(folder, manifest))


def verify_runs(folder: str | Path) -> dict[Path, dict[str, str]]:
    """What is wrong with the files of a run, or of each run in a folder of several, by folder and file.

    **Raises:** `RunDirectoryError` if there is no run.
    """
    path = Path(folder)
    runs = [path] if path.is_dir() and is_run(path) else sorted(p for p in path.glob("*/") if is_run(p))
    if not runs:
        RunDirectory.open(path)
    return {run: damages(run) for run in runs}


def check_sound(folder: Path) -> bool:
    """Refuse to go on with a damaged folder; whether only what the run writes again is damaged.

    **Raises:** `RunDirectoryError` that names a file, the cause, how many more there are, and the cure.
    """
    every = damages(folder)
    found = {name: cause for name, cause in every.items() if name not in DERIVED}
    if found:
        first, more = next(iter(found.values())), len(found) - 1
        also = f" (and {more} more, see: jaxcrumple verify {folder})" if more else ""
        raise RunDirectoryError(f"{first}{also}; {cure(folder)}")
    return bool(every)


def go_back(folder: Path) -> float | None:
    """Make the last checkpoint before all damage the current one; its time in s, or None if there is none.

    What came after is no longer part of the run, but stays until the run goes on. Hold the folder's lock.

    **Raises:** `RunDirectoryError` if a file cannot be written.
    """
    moments = sorted(_moments(folder), key=lambda moment: moment.place, reverse=True)
    for index, moment in enumerate(moments):
        run = sealed(moment.contents, FORMAT, VERSION)
        wrong = {name for name, _ in _damages(folder, moment.manifest)} - {RUN}
        if wrong or entry_of(run) != moment.manifest.files.get(RUN):
            continue
        kept = {other.name: other.entry for other in moments[index:] if other.name not in LATEST}
        write_bytes(folder / RUN, run)
        write_manifest(
            folder,
            replace(moment.manifest, checkpoint=moment.name).with_files({**kept, moment.name: moment.entry}),
        )
        return moment.t
    return None


class _Moment(NamedTuple):
    """A checkpoint: its `name` and `entry`, its time in s, the manifest and the `run.json` it came with."""

    name: str
    entry: Entry
    t: float
    manifest: Manifest
    contents: dict[str, Any]

    @property
    def place(self) -> tuple[float, int]:
        """What orders the checkpoints of a run: at a frame's time there are two."""
        return self.t, self.manifest.tables["frames.csv"].rows


def _damages(folder: Path, manifest: Manifest) -> Iterator[tuple[str, str]]:
    """Names and causes of what differs from a manifest."""
    for name, entry in manifest.files.items():
        yield from _damage(folder, name, entry)
    for name, prefix in manifest.tables.items():
        table = Table(folder / name, FRAME_COLUMNS, prefix)
        try:
            rows = table.read()
        except RunDirectoryError as error:
            yield name, str(error)
            continue
        if name == "frames.csv":
            for index, size, sha in zip(rows["index"], rows["size"], rows["sha256"], strict=True):
                yield from _damage(folder, frame_name(index), Entry(size, str(sha)))


def _damage(folder: Path, name: str, entry: Entry) -> Iterator[tuple[str, str]]:
    try:
        checked(folder, name, entry)
    except RunDirectoryError as error:
        yield name, str(error)


def _moments(folder: Path) -> Iterator[_Moment]:
    """The checkpoints all of whose arrays are sound: their own checksums tell, for the manifest may not."""
    for path in folder.glob(f"{CHECKPOINTS}/*.npz"):
        try:
            entry, metadata = entry_of(path.read_bytes()), read_metadata(path)
            manifest = Manifest.of(metadata["manifest"])
            name = path.relative_to(folder).as_posix()
            yield _Moment(name, entry, float(metadata["t"]), manifest, metadata["run"])
        except (CheckpointError, OSError, KeyError, TypeError, ValueError):
            continue
