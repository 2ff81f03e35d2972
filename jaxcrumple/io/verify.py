"""Find damaged files in a run folder, and return to its last undamaged checkpoint."""

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
from jaxcrumple.io.parts import checked, cure
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
    frame_name,
    is_run,
)
from jaxcrumple.io.table import TableFile

#: Files that a resumed run rebuilds from the others.
DERIVED = (SUMMARY, FILM)


def damages(folder: Path) -> dict[str, str]:
    """Return the cause of damage of each damaged file of a run, by file name.

    Files that the manifest does not list, such as pictures, are not checked.
    """
    try:
        manifest = read_manifest(folder)
    except RunDirectoryError as error:
        return {MANIFEST: str(error)}
    return dict(_damages(folder, manifest))


def verify_runs(folder: str | Path) -> dict[Path, dict[str, str]]:
    """Return the damage in one run folder, or in each run of a folder of runs, by run folder and file name.

    **Raises:** `RunDirectoryError` if the folder contains no run.
    """
    path = Path(folder)
    runs = [path] if path.is_dir() and is_run(path) else sorted(p for p in path.glob("*/") if is_run(p))
    if not runs:
        RunDirectory.open(path)
    return {run: damages(run) for run in runs}


def check_sound(folder: Path) -> bool:
    """Refuse a damaged folder; return whether a file in `DERIVED`, which the run rebuilds, is damaged.

    **Raises:** `RunDirectoryError` that names one damaged file, the cause, the number of others and the cure.
    """
    every = damages(folder)
    found = {name: cause for name, cause in every.items() if name not in DERIVED}
    if found:
        first, more = next(iter(found.values())), len(found) - 1
        also = f" (and {more} more, see: jaxcrumple verify {folder})" if more else ""
        raise RunDirectoryError(f"{first}{also}; {cure(folder)}")
    return bool(every)


def go_back(folder: Path) -> float | None:
    """Make the last undamaged checkpoint current; return its time in s, or None if there is none.

    Later data no longer belongs to the run; a resumed run removes it. The caller must hold the lock.

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
    """A checkpoint: `name`, `entry`, time `t` in s, and the `manifest` and `run.json` it stores."""

    name: str
    entry: Entry
    t: float
    manifest: Manifest
    contents: dict[str, Any]

    @property
    def place(self) -> tuple[float, int]:
        """Sort key: time, then number of frames; two checkpoints share the time of a frame."""
        return self.t, self.manifest.tables["frames.csv"].rows


def _damages(folder: Path, manifest: Manifest) -> Iterator[tuple[str, str]]:
    """Yield name and cause of each deviation from a manifest."""
    for name, entry in manifest.files.items():
        yield from _damage(folder, name, entry)
    for name, prefix in manifest.tables.items():
        table = TableFile(folder / name, FRAME_COLUMNS, prefix)
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
    """Yield the checkpoints that pass their own checksums; the manifest may itself be damaged."""
    for path in folder.glob(f"{CHECKPOINTS}/*.npz"):
        try:
            entry, metadata = entry_of(path.read_bytes()), read_metadata(path)
            manifest = Manifest.of(metadata["manifest"])
            name = path.relative_to(folder).as_posix()
            yield _Moment(name, entry, float(metadata["t"]), manifest, metadata["run"])
        except (CheckpointError, OSError, KeyError, TypeError, ValueError):
            continue
