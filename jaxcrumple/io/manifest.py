"""The manifest of a run folder: which files belong to the run, and their checksums.

The manifest is replaced as a whole, after everything it names is on the disk. So the folder holds what the
last manifest names; rows and files beyond it come from writes that were cut off.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from jaxcrumple.io.atomic import RunDirectoryError, json_bytes, to_json, write_bytes

MANIFEST = "manifest.json"
FORMAT, VERSION = "jaxcrumple-manifest", 1
# Names of the tables of a run.
TABLES = ("history.csv", "events.csv", "frames.csv")


class Entry(NamedTuple):
    """A whole file: its `size` in bytes and its checksum."""

    size: int
    sha256: str


class Prefix(NamedTuple):
    """The part of a table that belongs to the run: `size` in bytes, `rows` below the header, checksum."""

    size: int
    rows: int
    sha256: str


#: A table before its header is written.
EMPTY = Prefix(0, 0, hashlib.sha256().hexdigest())


@dataclass(frozen=True)
class Manifest:
    """What belongs to a run: whole `files` and `tables` by name, and the name of the current `checkpoint`.

    The tables include the list of frames, whose rows hold the checksums of the frames' files.
    """

    files: Mapping[str, Entry] = field(default_factory=dict)
    tables: Mapping[str, Prefix] = field(default_factory=lambda: dict.fromkeys(TABLES, EMPTY))
    checkpoint: str | None = None

    def plain(self) -> dict[str, Any]:
        """The manifest as JSON types; `Manifest.of` takes it back."""
        return {
            "files": {name: list(entry) for name, entry in self.files.items()},
            "tables": {name: list(prefix) for name, prefix in self.tables.items()},
            "checkpoint": self.checkpoint,
        }

    @classmethod
    def of(cls, plain: Any) -> Manifest:
        """The manifest of JSON types. **Raises:** ValueError for what `plain` never returns."""
        try:
            files = {str(name): Entry(int(size), str(sha)) for name, (size, sha) in plain["files"].items()}
            tables = {name: Prefix(*plain["tables"][name]) for name in TABLES}
            return cls(files, tables, plain["checkpoint"])
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"its contents are incomplete ({error!r})") from error

    def with_files(self, files: Mapping[str, Entry]) -> Manifest:
        """The manifest with further files, or others of the same names."""
        return replace(self, files={**self.files, **files})

    def without(self, *names: str) -> Manifest:
        """The manifest without files of these names."""
        return replace(self, files={name: entry for name, entry in self.files.items() if name not in names})


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a run folder. **Raises:** `RunDirectoryError` if it is missing or damaged."""
    path = folder / MANIFEST
    try:
        return Manifest.of(unsealed(path.read_bytes(), FORMAT, VERSION))
    except FileNotFoundError as error:
        raise RunDirectoryError(f"{str(path)!r} does not exist") from error
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"{str(path)!r} is damaged: {error}") from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Commit: from here on the folder holds what the manifest names. **Raises:** `RunDirectoryError`."""
    write_bytes(folder / MANIFEST, sealed(manifest.plain(), FORMAT, VERSION))


def entry_of(data: bytes | memoryview) -> Entry:
    """Size and checksum of a file's contents."""
    return Entry(len(data), hashlib.sha256(data).hexdigest())


def sealed(contents: Mapping[str, Any], form: str, version: int) -> bytes:
    """JSON text of `contents` with the name and version of its format, and with its own checksum."""
    plain = json.loads(to_json(contents))
    sha256 = _checksum(plain, form, version)
    return json_bytes({"format": form, "version": version, "sha256": sha256, "contents": plain})


def unsealed(data: bytes, form: str, version: int) -> dict[str, Any]:
    """Contents of a text that `sealed` made. **Raises:** ValueError for another or a damaged one."""
    try:
        whole = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is no JSON ({error})") from error
    if not isinstance(whole, dict) or whole.get("format") != form:
        raise ValueError(f"it is not of the format {form!r}")
    contents, found = whole.get("contents"), whole.get("version")
    if whole.get("sha256") != _checksum(contents, form, found) or not isinstance(contents, dict):
        raise ValueError("its checksum does not fit its contents")
    if found != version:
        raise VersionError(
            f"its format version is {found}, this program reads {version}; use the version of jaxcrumple "
            "that wrote it"
        )
    return contents


class VersionError(ValueError):
    """A sound file of another version of its format."""


def _checksum(contents: Any, form: str, version: Any) -> str:
    text = json.dumps([form, version, contents], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
