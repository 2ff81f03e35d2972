"""Read and write single files of a run, with their entries in the manifest."""

from pathlib import Path

from jaxcrumple.io.atomic import RunDirectoryError, refusal, write_bytes
from jaxcrumple.io.manifest import Entry, entry_of


def checked(folder: Path, name: str, entry: Entry | None) -> bytes:
    """Read a file and verify it. **Raises:** `RunDirectoryError` if it does not match its manifest entry."""
    path = folder / name
    if entry is None:
        raise RunDirectoryError(f"{str(path)!r} is not part of the run: the run has not saved it yet")
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise RunDirectoryError(f"{str(path)!r} does not exist, but the run wrote it") from error
    except OSError as error:
        raise RunDirectoryError(f"{str(path)!r} cannot be read: {error.strerror}") from error
    if entry_of(data) != entry:
        raise RunDirectoryError(f"{str(path)!r} is damaged: its checksum does not match")
    return data


def cure(path: Path) -> str:
    """Return the instruction to repair a damaged folder."""
    return f"restore it from a copy, or return to the last undamaged checkpoint: jaxcrumple repair {path}"


def write_part(path: Path, data: bytes) -> Entry:
    """Write a file, create its folder if missing, and return its manifest entry."""
    try:
        path.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise refusal(path, error) from error
    write_bytes(path, data)
    return entry_of(data)
