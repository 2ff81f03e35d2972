"""The folder of one run.

    run.json        settings of the run, and a sketch (numeric fingerprint) of the scene built from them
    manifest.json   files and rows that belong to the run, with their checksums
    mesh.npz        mesh and stiffness of the sheet
    frames/         one npz per saved state, listed in frames.csv
    history.csv     one line per logged step
    events.csv      one line per change of stage
    checkpoints/    restart states: the last one, and a few earlier ones
    summary.json    final result; absent during the run and after a kill
    run.vtkhdf      film for ParaView

The program writes each file atomically and appends rows to the tables. It replaces the manifest last. Files
and rows that the manifest does not list come from an interrupted write; a resumed run removes them. Every
reader verifies the checksum of a file first.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import ArrayLike, Shaped

from jaxcrumple._jax.arrays import HingeValuesLike, NodeVectorsLike
from jaxcrumple.io.atomic import (
    RunDirectoryError,
    discard,
    json_bytes,
    refusal,
    temporary,
    to_json,
)
from jaxcrumple.io.checkpoint import pack_checkpoint
from jaxcrumple.io.frames import Frame, Stiffness, pack_frame, pack_mesh, unpack_frame, unpack_mesh
from jaxcrumple.io.lock import LOCK
from jaxcrumple.io.manifest import (
    MANIFEST,
    Entry,
    Manifest,
    entry_of,
    read_manifest,
    sealed,
    unsealed,
    write_manifest,
)
from jaxcrumple.io.parts import checked, cure, write_part
from jaxcrumple.io.table import TableFile
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.solvers.log import COLUMNS, ENERGIES, EVENT_COLUMNS
from jaxcrumple.state import STAGES, Work

FORMAT, VERSION = "jaxcrumple-run", 3
RUN, MESH, SUMMARY, FILM = "run.json", "mesh.npz", "summary.json", "run.vtkhdf"
# The film of an unfinished run; it does not belong to the run.
PARTIAL = "partial.vtkhdf"
FRAMES, CHECKPOINTS = "frames", "checkpoints"
# Two alternating names, so that the last checkpoint stays intact while the next one is written.
LATEST = (f"{CHECKPOINTS}/latest-0.npz", f"{CHECKPOINTS}/latest-1.npz")
FRAME_COLUMNS = ("index", "t", "size", "sha256")
_NUMBERS = {"t", "h", "acceleration", "acceleration_mean", "error", *ENERGIES}
_WORK = {f"work_{name}" for name in Work._fields}
#: Integer columns of the history, written without a decimal point.
INTEGERS = frozenset(COLUMNS) - _NUMBERS - _WORK - {"stage"}


class Counts(NamedTuple):
    """Numbers of rows and frames that a run has written."""

    history_rows: int
    event_rows: int
    frames: int


class RunDirectory:
    """The output folder of one run. Use `create` or `open`; a writer must hold the lock (`lock.writing`)."""

    def __init__(self, path: Path, contents: Mapping[str, Any], manifest: Manifest) -> None:
        self.path, self.contents, self.manifest = path, contents, manifest
        columns = {
            "history.csv": COLUMNS,
            "events.csv": EVENT_COLUMNS,
            "frames.csv": FRAME_COLUMNS,
        }
        self._tables = [
            TableFile(path / name, columns[name], prefix) for name, prefix in manifest.tables.items()
        ]
        self.history, self.events, self._frames = self._tables

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: Mapping[str, Any],
        mesh: Mesh,
        stiffness: Stiffness,
        built: Mapping[str, Any] | None = None,
    ) -> RunDirectory:
        """Start a run in a free folder (see `check_free`); create the folder if it is missing.

        **Arguments:** `config`, `built`: JSON types or NumPy, stored in `run.json`; `stiffness`: of the edges
        (e,) in N/m and of the hinges (h,) in J.

        **Raises:** `RunDirectoryError` if the folder is occupied or cannot be written.
        """
        path = make_folder(path)
        return cls.begin(path, config, mesh, stiffness, built)

    @classmethod
    def begin(
        cls,
        path: Path,
        config: Mapping[str, Any],
        mesh: Mesh,
        stiffness: Stiffness,
        built: Mapping[str, Any] | None,
    ) -> RunDirectory:
        """Start a run as `create` does, in a folder without run files; other files are allowed."""
        contents = json.loads(to_json({"config": config, "built": built or {}}))
        begun = {RUN: sealed(contents, FORMAT, VERSION), MESH: pack_mesh(mesh, stiffness)}
        entries = {name: write_part(path / name, data) for name, data in begun.items()}
        folder = cls(path, contents, Manifest(entries))
        write_manifest(path, folder.manifest)
        folder.cut()
        return folder

    @staticmethod
    def check_free(path: str | Path) -> None:
        """Check that `path` is free and writable. Change nothing.

        **Raises:** `RunDirectoryError` if the path is a file or a non-empty folder, or if it is not writable.
        """
        path = Path(path)
        try:
            if path.exists() and not path.is_dir():
                raise RunDirectoryError(f"{str(path)!r} is a file; choose a new folder for the output")
            # A kill before the first manifest leaves some of these files; the new run replaces them.
            begun = {LOCK, RUN, MESH, *(temporary(Path(name)).name for name in (RUN, MESH, MANIFEST))}
            occupied = path.is_dir() and any(entry.name not in begun for entry in path.iterdir())
        except OSError as error:
            raise refusal(path, error) from error
        if occupied:
            what = "holds a run already; resume it, or" if is_run(path) else "is not empty;"
            raise RunDirectoryError(f"folder {str(path)!r} {what} choose a new folder for the output")
        nearest = next((folder for folder in (path, *path.absolute().parents) if folder.exists()), path)
        if not os.access(nearest, os.W_OK):
            raise RunDirectoryError(f"cannot write into folder {str(nearest)!r}; choose another place")

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """Open the folder of an existing run, to read or resume it. Change nothing.

        **Raises:** `RunDirectoryError` if the folder does not exist, is not a run or has another format
        version, or if its manifest or `run.json` is damaged.
        """
        path = Path(path)
        if not path.is_dir():
            what = "is a file" if path.exists() else "does not exist"
            raise RunDirectoryError(f"{str(path)!r} {what}; give the output folder of a run")
        if not is_run(path):
            inner = sorted(entry.parent.name for entry in path.glob(f"*/{MANIFEST}"))
            what = (
                f"it holds runs; give one of them, such as {inner[0]!r}" if inner else "give a run's folder"
            )
            raise RunDirectoryError(f"folder {str(path)!r} is not a run: it has no {MANIFEST}; {what}")
        try:
            manifest = read_manifest(path)
            return cls(path, read_contents(path, checked(path, RUN, manifest.files.get(RUN))), manifest)
        except RunDirectoryError as error:
            raise RunDirectoryError(f"{error}; {cure(path)}") from error

    @property
    def config(self) -> dict[str, Any]:
        """Settings of the run."""
        return self.contents["config"]

    @property
    def built(self) -> dict[str, Any]:
        """Sketch (numeric fingerprint) of the scene built from `config`."""
        return self.contents["built"]

    @property
    def counts(self) -> Counts:
        """Rows and frames that belong to the run."""
        return Counts(self.history.count, self.events.count, self._frames.count)

    def frames(self) -> range:
        """Numbers of the saved frames."""
        return range(self._frames.count)

    @property
    def finished(self) -> bool:
        """Whether the run has ended."""
        return SUMMARY in self.manifest.files

    # Reading. A damaged file raises an error that names the cure.

    def load_mesh(self) -> Mesh:
        """Return the mesh, bit for bit as saved."""
        return self.load_sheet()[0]

    def load_sheet(self) -> tuple[Mesh, Stiffness]:
        """Return the mesh, and the stiffness of its edges (e,) in N/m and of its hinges (h,) in J."""
        return unpack_mesh(self.path / MESH, self.read(MESH))

    def load_frames(self, chosen: slice = slice(None)) -> Iterator[Frame]:
        """Yield all frames in order, or only the `chosen` ones."""
        table = self._read_table(self._frames)[chosen]
        for index, size, sha in zip(table["index"], table["size"], table["sha256"], strict=True):
            name = frame_name(index)
            yield unpack_frame(self.path / name, self.read(name, Entry(size, str(sha))))

    def read_history(self) -> pd.DataFrame:
        """Return the history as a table."""
        return self._read_table(self.history)

    def read_events(self) -> pd.DataFrame:
        """Return the events as a table."""
        return self._read_table(self.events)

    def read_summary(self) -> dict[str, Any]:
        """Return the final result of the run; empty if the run is in progress or was killed."""
        return json.loads(self.read(SUMMARY)) if self.finished else {}

    def read(self, name: str, entry: Entry | None = None) -> bytes:
        """Return the verified contents of a file of the run. **Raises:** `RunDirectoryError`."""
        try:
            return checked(self.path, name, entry or self.manifest.files.get(name))
        except RunDirectoryError as error:
            raise RunDirectoryError(f"{error}; {cure(self.path)}") from error

    def is_sound(self, name: str) -> bool:
        """Return whether the manifest lists a file and the file is undamaged."""
        try:
            checked(self.path, name, self.manifest.files.get(name))
        except RunDirectoryError:
            return False
        return True

    def _read_table(self, table: TableFile) -> pd.DataFrame:
        try:
            return table.read()
        except RunDirectoryError as error:
            raise RunDirectoryError(f"{error}; {cure(self.path)}") from error

    # Writing. New data belongs to the run only after `commit` or `finish`.

    def save_frame(self, t: float, x: NodeVectorsLike, v: NodeVectorsLike, p: HingeValuesLike | None) -> None:
        """Write the next frame.

        `t` in s; `x`, `v` (n, 3) in m and m/s; `p` (h,), or None if elastic.
        """
        index = self._frames.count
        rest = None if p is None else np.asarray(p)
        data = pack_frame(Frame(float(t), np.asarray(x), np.asarray(v), rest))
        entry = write_part(self.path / frame_name(index), data)
        self._frames.append([[index, float(t), *entry]])

    def append_history(self, rows: Shaped[ArrayLike, "rows columns"] | Sequence[Sequence[Any]]) -> None:
        """Append rows (r, columns) to the history. Stages may be numbers or names; the file stores names."""
        names = self.history.columns
        values = np.asarray(rows, dtype=object).reshape(-1, len(names))
        self.history.append([[_entry(c, v) for c, v in zip(names, row, strict=True)] for row in values])

    def append_events(self, events: Sequence[Mapping[str, Any]]) -> None:
        """Append changes of stage."""
        self.events.append([[event.get(c) for c in EVENT_COLUMNS] for event in events])

    def commit(self, state: Any, metadata: Mapping[str, Any], *, keep: bool = False) -> None:
        """Write a checkpoint; make it and all rows and frames so far part of the run.

        `keep`: keep this checkpoint after later ones, so that `jaxcrumple repair` can return to it.
        """
        last = self.manifest.checkpoint
        name = f"{CHECKPOINTS}/frame-{self._frames.count:05d}.npz" if keep else LATEST[last == LATEST[0]]
        tables = {table.path.name: table.prefix for table in self._tables}
        manifest = replace(self.manifest, tables=tables)
        outside = replace(
            manifest.without(*(other for other in manifest.files if other.startswith(CHECKPOINTS))),
            checkpoint=None,
        )
        held = {**metadata, "manifest": outside.plain(), "run": self.contents}
        entry = write_part(self.path / name, pack_checkpoint(state, held))
        passed = [other for other in LATEST if other != name]
        self._set(replace(manifest.without(*passed), checkpoint=name).with_files({name: entry}))
        for other in passed:
            discard(self.path / other)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the summary; make it and the film, if one exists, part of the run."""
        entry = write_part(self.path / SUMMARY, json_bytes(summary))
        self._set(self.manifest.with_files({SUMMARY: entry, **self._film()}))
        discard(self.path / PARTIAL)

    def add_film(self) -> None:
        """Make a rewritten film part of the run."""
        self._set(self.manifest.with_files(self._film()))

    def _film(self) -> dict[str, Entry]:
        film = self.path / FILM
        return {FILM: entry_of(film.read_bytes())} if film.exists() else {}

    def cut(self) -> None:
        """Remove interrupted writes, and the summary and film of a run that resumes.

        **Raises:** `RunDirectoryError` if a table is damaged or a file cannot be removed.
        """
        self._drop_ending()
        for table in self._tables:
            table.cut()
        named = {frame_name(index) for index in self.frames()} | set(self.manifest.files)
        try:
            for path in (*self.path.glob(f"{FRAMES}/*"), *self.path.glob(f"{CHECKPOINTS}/*")):
                if path.relative_to(self.path).as_posix() not in named:
                    path.unlink()
            for leftover in self.path.glob(".*.tmp"):
                leftover.unlink()
        except OSError as error:
            raise refusal(self.path, error) from error

    def clear(self) -> None:
        """Remove all files of the run except `run.json`."""
        files = [MANIFEST, MESH, SUMMARY, FILM, PARTIAL, *(table.path.name for table in self._tables)]
        try:
            for path in (*(self.path / name for name in files), *self.path.glob(f"{FRAMES}/*")):
                path.unlink(missing_ok=True)
            for path in self.path.glob(f"{CHECKPOINTS}/*"):
                path.unlink()
        except OSError as error:
            raise refusal(self.path, error) from error

    def _drop_ending(self) -> None:
        """Remove the summary and the film, which are invalid once the run resumes."""
        if self.finished or FILM in self.manifest.files:
            self._set(self.manifest.without(SUMMARY, FILM))
        try:
            for name in (SUMMARY, FILM):
                (self.path / name).unlink(missing_ok=True)
        except OSError as error:
            raise refusal(self.path, error) from error

    def _set(self, manifest: Manifest) -> None:
        write_manifest(self.path, manifest)
        self.manifest = manifest


def is_run(path: Path) -> bool:
    """Return whether a folder holds a run or its remains."""
    return (path / MANIFEST).exists() or (path / CHECKPOINTS).is_dir()


def make_folder(path: str | Path) -> Path:
    """Create the folder of a new run, with its parents. **Raises:** `RunDirectoryError`."""
    path = Path(path)
    RunDirectory.check_free(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refusal(path, error) from error
    return path


def frame_name(index: int) -> str:
    """Return the name of a frame file, relative to the run folder."""
    return f"{FRAMES}/{index:05d}.npz"


def read_contents(path: Path, data: bytes) -> dict[str, Any]:
    """Decode the contents of `run.json`. **Raises:** `RunDirectoryError`."""
    try:
        return unsealed(data, FORMAT, VERSION)
    except ValueError as error:
        raise RunDirectoryError(f"{str(path / RUN)!r} cannot be read: {error}") from error


def _entry(column: str, value: Any) -> float | int | str:
    if column == "stage":
        return value if isinstance(value, str) else STAGES[int(value)]
    return int(value) if column in INTEGERS and np.isfinite(value) else float(value)
