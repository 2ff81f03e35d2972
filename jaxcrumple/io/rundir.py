"""The folder of one run.

    run.json        what was asked for
    mesh.npz        the sheet
    frames/         one npz per saved state
    history.csv     one line per logged step
    events.csv      one line per event: switches, retries, ...
    checkpoint.npz  where to go on
    summary.json    how it ended; absent while the run is going and after a kill
    run.vtkhdf      the film for ParaView

Every whole file is written all or nothing. Tables grow by appending, so a killed run may have rows and frames
that its last checkpoint does not know; `RunDirectory.rewind` drops them before the run goes on.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxcrumple.io import frames as _frames
from jaxcrumple.io.atomic import RunDirectoryError, refusal, temporary, write_json
from jaxcrumple.io.frames import Frame
from jaxcrumple.io.table import Table
from jaxcrumple.mesh import Mesh
from jaxcrumple.solvers.log import Row
from jaxcrumple.state import STAGES, Work

FORMAT, VERSION = "jaxcrumple-run", 1
_NUMBERS = {"t", "h", "acceleration", "acceleration_mean", "error"}
_ENERGIES = {"stretch", "bending", "contact", "confinement", "gravity", "extra", "kinetic"}
_WORK = {f"work_{name}" for name in Work._fields}
#: Columns of the history that count something and are written without a decimal point.
INTEGERS = frozenset(Row._fields) - _NUMBERS - _ENERGIES - _WORK - {"stage"}


class Counts(NamedTuple):
    """How much of a run is on disk. A checkpoint stores it and `RunDirectory.rewind` takes it back."""

    history_rows: int
    event_rows: int
    frames: int


class RunDirectory:
    """One run's output folder. Make it with `create` or `open`."""

    def __init__(self, path: Path, config: dict[str, Any]) -> None:
        self.path = path
        self.config = config
        self.history = Table(path / "history.csv")
        self.events = Table(path / "events.csv")

    @classmethod
    def create(cls, path: str | Path, config: Mapping[str, Any]) -> RunDirectory:
        """Make the folder, and its parents, and write `config` (JSON types or NumPy) to `run.json`.

        **Raises:** `RunDirectoryError` if the path is a file, a folder that is not empty, or cannot be
        written.
        """
        path = Path(path)
        cls.check_free(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise refusal(path, error) from error
        write_json(path / "run.json", {"format": FORMAT, "version": VERSION, "config": dict(config)})
        return cls(path, _read_config(path))

    @staticmethod
    def check_free(path: str | Path) -> None:
        """Make sure that nothing is in the way and that the place may be written. Nothing is changed.

        **Raises:** `RunDirectoryError` if the path is a file, a folder that is not empty, or in a folder
        without permission to write.
        """
        path = Path(path)
        try:
            if path.exists() and not path.is_dir():
                raise RunDirectoryError(f"{str(path)!r} is a file; choose a new folder for the output")
            # A kill while run.json was written leaves the beginning of it, which the next one replaces.
            occupied = path.is_dir() and any(
                entry != temporary(path / "run.json") for entry in path.iterdir()
            )
        except OSError as error:
            raise refusal(path, error) from error
        if occupied:
            what = "holds a run already; resume it, or" if (path / "run.json").is_file() else "is not empty;"
            raise RunDirectoryError(f"folder {str(path)!r} {what} choose a new folder for the output")
        nearest = next((folder for folder in (path, *path.absolute().parents) if folder.exists()), path)
        if not os.access(nearest, os.W_OK):
            raise RunDirectoryError(f"folder {str(nearest)!r} may not be written; choose another place")

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """The folder of an earlier run, to read it or go on. Nothing is changed.

        **Raises:** `RunDirectoryError` if it does not exist, is not a run, or is of another version.
        """
        path = Path(path)
        if not path.is_dir():
            what = "is a file" if path.exists() else "does not exist"
            raise RunDirectoryError(f"{str(path)!r} {what}; give the output folder of a run")
        return cls(path, _read_config(path))

    @property
    def checkpoint_path(self) -> Path:
        """Where the checkpoint belongs."""
        return self.path / "checkpoint.npz"

    @property
    def vtkhdf_path(self) -> Path:
        """Where the film belongs."""
        return self.path / "run.vtkhdf"

    @property
    def counts(self) -> Counts:
        """Rows and frames on disk; put it into the metadata of the checkpoint (`counts._asdict()`)."""
        return Counts(self.history.count, self.events.count, len(self.frames()))

    def save_mesh(self, mesh: Mesh) -> None:
        """Write the mesh with its rest shape."""
        _frames.save_mesh(self.path / "mesh.npz", mesh)

    def load_mesh(self) -> Mesh:
        """The mesh as it was saved, bit for bit."""
        return _frames.load_mesh(self.path / "mesh.npz")

    def save_frame(self, index: int, t: float, x: ArrayLike, v: ArrayLike, p: ArrayLike | None) -> None:
        """Write frame `index`, counted from 0 without gaps.

        `t` in s; `x`, `v` (n, 3) in m and m/s; `p` (h,), or None if elastic.
        """
        path = self._frame(index)
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise refusal(path, error) from error
        rest = None if p is None else np.asarray(p)
        _frames.save_frame(path, Frame(float(t), np.asarray(x), np.asarray(v), rest))

    def load_frame(self, index: int) -> Frame:
        """Frame number `index`."""
        return _frames.load_frame(self._frame(index))

    def frames(self) -> list[int]:
        """Numbers of the saved frames, ascending."""
        return sorted(int(path.stem) for path in self.path.glob("frames/[0-9]*.npz"))

    def append_history(self, columns: Sequence[str], rows: ArrayLike) -> None:
        """Add rows (r, columns) to the history. Stages may be numbers or words, and are written as words."""
        values = np.asarray(rows, dtype=object).reshape(-1, len(columns))
        self.history.append(
            columns, [[_entry(c, v) for c, v in zip(columns, row, strict=True)] for row in values]
        )

    def append_events(self, events: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> None:
        """Add events. Keys are columns; new ones are added at the right, missing ones stay empty.

        `columns` that are known beforehand make a header, even where there is no event. By convention
        `t` is the time in s, and a change of stage has the stages `from` and `to` in words.
        """
        known = self.events.columns
        columns = list(dict.fromkeys([*known, *columns, *(key for event in events for key in event)]))
        if columns != known:
            self.events.extend_columns(columns)
        self.events.append(columns, [[event.get(c) for c in columns] for event in events])

    def rewind(self, history_rows: int, event_rows: int, frames: int) -> None:
        """Cut the run back to what its checkpoint knows: `rewind(*counts)` or `rewind(**counts)`.

        The summary, which a run that goes on makes untrue, is removed as well.

        **Raises:** `RunDirectoryError` if something that the checkpoint knows is missing; nothing is cut
        then.
        """
        saved = self.frames()
        if saved[:frames] != list(range(frames)):
            raise RunDirectoryError(
                f"{str(self.path)!r} lacks some of the frames 0..{frames - 1} that the checkpoint knows; "
                "restore them, or start the run again in a new folder"
            )
        for table, count in ((self.history, history_rows), (self.events, event_rows)):
            table.require(count)
        try:
            (self.path / "summary.json").unlink(missing_ok=True)
            for index in saved[frames:]:
                self._frame(index).unlink()
            for leftover in (*self.path.glob(".*.tmp"), *self.path.glob("frames/.*.tmp")):
                leftover.unlink()
        except OSError as error:
            raise refusal(self.path, error) from error
        self.history.truncate(history_rows)
        self.events.truncate(event_rows)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write how the run ended."""
        write_json(self.path / "summary.json", summary)

    def read_summary(self) -> dict[str, Any]:
        """How the run ended; empty if it has not, or was killed."""
        path = self.path / "summary.json"
        return _read_json(path, "remove it, and resume the run to write it again") if path.is_file() else {}

    def _frame(self, index: int) -> Path:
        return self.path / "frames" / f"{index:05d}.npz"


def _entry(column: str, value: Any) -> float | int | str:
    if column == "stage":
        return value if isinstance(value, str) else STAGES[int(value)]
    return int(value) if column in INTEGERS and np.isfinite(value) else float(value)


def _read_config(path: Path) -> dict[str, Any]:
    file = path / "run.json"
    if not file.is_file():
        inner = sorted(entry.parent.name for entry in path.glob("*/run.json"))
        cure = f"it holds runs; give one of them, such as {inner[0]!r}" if inner else "give a run's folder"
        raise RunDirectoryError(f"folder {str(path)!r} is not a run: it has no run.json; {cure}")
    data = _read_json(file)
    if data.get("format") != FORMAT or not isinstance(data.get("config"), dict):
        raise RunDirectoryError(f"{str(file)!r} is not of this program; give the output folder of a run")
    if data.get("version") != VERSION:
        found = data.get("version")
        raise RunDirectoryError(
            f"{str(path)!r} is a run of format version {found}, this program reads {VERSION}; "
            "use the version of jaxcrumple that made it"
        )
    return data["config"]


def _read_json(path: Path, cure: str = "restore it from a copy") -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"cannot read {str(path)!r} ({error}); {cure}") from error
    if not isinstance(data, dict):
        raise RunDirectoryError(f"{str(path)!r} holds no JSON object; {cure}")
    return data
