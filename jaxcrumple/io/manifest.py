"""The manifest of a run folder lists the files that belong to the run, with their checksums.

The program replaces the whole manifest atomically after everything it lists is on disk. The folder therefore
contains all that the last manifest lists; further rows and files come from interrupted writes.
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
    """The valid part of a table: `size` in bytes, number of `rows` below the header, and checksum."""

    size: int
    rows: int
    sha256: str


#: A table before its header is written.
EMPTY = Prefix(0, 0, hashlib.sha256().hexdigest())


@dataclass(frozen=True)
class Manifest:
    """The contents of a run: `files` and `tables` by name, and the name of the current `checkpoint`.

    The table frames.csv lists the frames; each of its rows holds the checksum of a frame file.
    """

    files: Mapping[str, Entry] = field(default_factory=dict)
    tables: Mapping[str, Prefix] = field(default_factory=lambda: dict.fromkeys(TABLES, EMPTY))
    checkpoint: str | None = None

    def plain(self) -> dict[str, Any]:
        """Return the manifest as JSON types, the inverse of `Manifest.of`."""
        return {
            "files": {name: list(entry) for name, entry in self.files.items()},
            "tables": {name: list(prefix) for name, prefix in self.tables.items()},
            "checkpoint": self.checkpoint,
        }

    @classmethod
    def of(cls, plain: Any) -> Manifest:
        """Build the manifest from the output of `plain`. **Raises:** ValueError for incomplete data."""
        try:
            files = {str(name): Entry(int(size), str(sha)) for name, (size, sha) in plain["files"].items()}
            tables = {name: Prefix(*plain["tables"][name]) for name in TABLES}
            return cls(files, tables, plain["checkpoint"])
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"its contents are incomplete ({error!r})") from error

    def with_files(self, files: Mapping[str, Entry]) -> Manifest:
        """Return a copy with `files` added; a file of the same name is replaced."""
        return replace(self, files={**self.files, **files})

    def without(self, *names: str) -> Manifest:
        """Return a copy without the files of these names."""
        return replace(self, files={name: entry for name, entry in self.files.items() if name not in names})


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a run folder. **Raises:** `RunDirectoryError` if it is missing or damaged."""
    path = folder / MANIFEST
    try:
        return Manifest.of(unsealed(path.read_bytes(), FORMAT, VERSION))
    except FileNotFoundError as error:
        raise RunDirectoryError(f"{str(path)!r} does not exist") from error
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"{str(path)!r} is damaged: {error}") from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Commit: make all that `manifest` lists part of the run. **Raises:** `RunDirectoryError`."""
    write_bytes(folder / MANIFEST, sealed(manifest.plain(), FORMAT, VERSION))


def entry_of(data: bytes | memoryview) -> Entry:
    """Return size and checksum of the contents of a file."""
    return Entry(len(data), hashlib.sha256(data).hexdigest())


def sealed(contents: Mapping[str, Any], form: str, version: int) -> bytes:
    """Encode `contents` as JSON with the name and version of the format and a checksum."""
    plain = json.loads(to_json(contents))
    sha256 = _checksum(plain, form, version)
    return json_bytes({"format": form, "version": version, "sha256": sha256, "contents": plain})


def unsealed(data: bytes, form: str, version: int) -> dict[str, Any]:
    """Decode the output of `sealed`. **Raises:** ValueError if `data` is damaged or has another format."""
    try:
        whole = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is not JSON ({error})") from error
    if not isinstance(whole, dict) or whole.get("format") != form:
        raise ValueError(f"it is not of the format {form!r}")
    contents, found = whole.get("contents"), whole.get("version")
    if whole.get("sha256") != _checksum(contents, form, found) or not isinstance(contents, dict):
        raise ValueError("its checksum does not match its contents")
    if found != version:
        raise VersionError(
            f"its format version is {found}, this program reads {version}; use the version of jaxcrumple "
            "that wrote it"
        )
    return contents


class VersionError(ValueError):
    """An undamaged file has another format version."""


def _checksum(contents: Any, form: str, version: Any) -> str:
    text = json.dumps([form, version, contents], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
