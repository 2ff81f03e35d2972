"""What a sweep saves of its cases in a folder, so that a killed sweep goes on from there."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
import xarray as xr

from jaxcrumple.io.atomic import RunDirectoryError, discard, refusal, replacing, to_json, write_bytes
from jaxcrumple.io.checkpoint import load_checkpoint, read_metadata, save_checkpoint
from jaxcrumple.io.lock import LOCK, writing
from jaxcrumple.io.manifest import sealed, unsealed
from jaxcrumple.io.sketch import first_difference
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.state import State
from jaxcrumple.sweeps.outcome import Outcome, joined

FORMAT, VERSION = "jaxcrumple-sweep", 1
# What all cases share.
SHARED = "sweep.json"
# Characters of names that remain in the names of files, and the longest name of a file in bytes, less that of
# its temporary file.
PLAIN, LONGEST = " =,+-", 245
# Dimension of the saved values.
FRAME = "frame"
# Most characters of two values that a message tells.
MOST = 400
# Results of cases that the next call tries again or goes on with.
UNFINISHED = ("error", "budget")

Sketches = Mapping[str, Sequence[float]]


class Saved(NamedTuple):
    """What an interrupted case goes on from: the `state`, and the measured values of the `frames` so far."""

    state: State
    frames: list[xr.Dataset]


class CaseFiles:
    """Files of one case: NAME.nc holds its measured frames and, at its end, its outcome; until then NAME.npz
    holds the state from which it goes on."""

    def __init__(self, folder: Path, name: str):
        plain = quote(name, safe=PLAIN)
        if len(plain) > LONGEST:
            raise ConfigError(
                f"case {name[:40]!r}... has a name of {len(plain)} bytes; a file's name may have {LONGEST}; "
                "give shorter words, or leave folder out."
            )
        self.name, self.values, self.state = name, folder / f"{plain}.nc", folder / f"{plain}.npz"

    def outcome(self) -> Outcome | None:
        """Return the outcome of a case that has ended, None for others.

        **Raises:** `RunDirectoryError` for a damaged file.
        """
        if not self.values.exists():
            return None
        frames, told = self._read()
        return Outcome(told["result"], frames, told["spent"]) if told.get("result") else None

    def check_built(self, built: Sketches) -> None:
        """Refuse a case that is now built otherwise than its saved part.

        **Raises:** `RunDirectoryError` that names the part of the scene.
        """
        if self.values.exists():
            saved = self._read()[1]["built"]
        elif self.state.exists():
            saved = read_metadata(self.state)["built"]
        else:
            return
        if other := first_difference(saved, built):
            raise RunDirectoryError(
                f"{self.name}: {str(self.values.parent)!r} holds this case with another {other}: the scene's "
                "function, a file or this program has changed. Restore what was changed, or choose another "
                "folder."
            )

    def saved(self, start: State) -> Saved:
        """Return what the case goes on from; its `start` if nothing was saved."""
        if not self.state.exists():
            return Saved(start, [])
        state, told = load_checkpoint(self.state, start)
        # A kill may have left one frame more than the state has reached.
        return Saved(state, self._read()[0][: told["frames"]] if told["frames"] else [])

    def save_frames(self, frames: Sequence[xr.Dataset], built: Sketches) -> None:
        """Save the measured values so far."""
        self._write(frames, {"built": built})

    def save_state(self, state: State, frames: int, built: Sketches) -> None:
        """Save a state after a number of frames whose values are saved."""
        save_checkpoint(self.state, state, {"frames": frames, "built": built})

    def finish(self, outcome: Outcome, built: Sketches) -> None:
        """Save the outcome of a case that has ended."""
        self._write(outcome.frames, {"built": built, "result": outcome.result, "spent": outcome.spent or {}})
        discard(self.state)

    def _write(self, frames: Sequence[xr.Dataset], told: Mapping[str, Any]) -> None:
        numbers = pd.RangeIndex(len(frames), name=FRAME)
        values = joined(frames, numbers) if frames else xr.Dataset(coords={FRAME: numbers})
        with replacing(self.values) as path:
            values.assign_attrs(told=to_json(told)).to_netcdf(path, engine="h5netcdf")

    def _read(self) -> tuple[list[xr.Dataset], dict[str, Any]]:
        try:
            with xr.open_dataset(self.values, engine="h5netcdf") as file:
                values = file.load()
            told = json.loads(values.attrs.pop("told"))
            return [values.isel({FRAME: k}, drop=True) for k in range(values.sizes[FRAME])], told
        except (OSError, KeyError, ValueError) as error:
            raise RunDirectoryError(
                f"{str(self.values)!r} cannot be read ({error}); remove it and {self.state.name!r} to begin "
                "this case anew."
            ) from error


@contextmanager
def kept_in(folder: Path, shared: Mapping[str, Any]) -> Iterator[None]:
    """Begin or continue a sweep in a folder, and hold its lock inside.

    `shared`: what all cases have in common, by name, as JSON types.

    **Raises:** `RunDirectoryError` for a folder that cannot be written, that another process writes, or that
    holds another sweep or other files.
    """
    _check_free(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refusal(folder, error) from error
    now = json.loads(to_json(shared))
    with writing(folder):
        if (folder / SHARED).exists():
            _check_same(folder, now)
        else:
            write_bytes(folder / SHARED, sealed(now, FORMAT, VERSION))
        yield


def _check_free(folder: Path) -> None:
    """Refuse a folder that holds other things than a sweep."""
    try:
        others = {path.name for path in folder.iterdir()} - {LOCK} if folder.exists() else set()
    except OSError as error:
        raise refusal(folder, error) from error
    if others and SHARED not in others:
        raise RunDirectoryError(
            f"folder {str(folder)!r} is not empty and holds no sweep; choose a new folder."
        )


def _check_same(folder: Path, now: Mapping[str, Any]) -> None:
    """Refuse a folder that holds a sweep of which something differs that all cases share."""
    try:
        saved = unsealed((folder / SHARED).read_bytes(), FORMAT, VERSION)
    except (OSError, ValueError) as error:
        raise RunDirectoryError(
            f"{str(folder / SHARED)!r} cannot be read: {error}; choose a new folder."
        ) from error
    for key in {**saved, **now}:
        was, asked = (str(found.get(key)) for found in (saved, now))
        if was != asked:
            short = len(was + asked) < MOST
            what = f"{key} = {was}, and this one has {asked}" if short else f"another {key}"
            raise ConfigError(f"{str(folder)!r} holds a sweep with {what}; choose another folder.")
