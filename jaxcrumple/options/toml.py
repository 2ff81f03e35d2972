"""Read TOML files, and find the line of a value."""

import re
import tomllib
from pathlib import Path
from typing import Any

from jaxcrumple.options.validation import ConfigError, Place

# Largest size in bytes and depth of nested tables and lists; any larger file is a mistake.
LARGEST, DEEPEST = 10_000_000, 50
_NAME = r"(?:[\w-]+|\"[^\"]*\"|'[^']*')"
_NAMES = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEADER = re.compile(rf"\s*(\[\[?)\s*({_NAMES})\s*\]")
_KEY = re.compile(rf"\s*({_NAMES})\s*=")


def read_toml(path: str | Path) -> tuple[dict[str, Any], str]:
    """Return the values of a file, and its text.

    **Raises:** `ConfigError` for a file that cannot be read, with the line if it is known.
    """
    data = _bytes(Path(path))
    try:
        # Some editors write a byte-order mark or other line endings.
        text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
        values = tomllib.loads(text)
    except RecursionError as error:
        raise ConfigError(f"{path} cannot be read as TOML: it is nested too deeply") from error
    except ValueError as error:
        raise ConfigError(f"{path} cannot be read as TOML: {error}") from error
    if _depth(values) > DEEPEST:
        raise ConfigError(f"{path} is nested more than {DEEPEST} levels deep; give a file with fewer")
    return values, text


def _bytes(path: Path) -> bytes:
    """Read a file or a shell pipe such as `<(...)`; reading any other device could block.

    **Raises:** ConfigError for a folder, another device, an unreadable file, or a file above `LARGEST`.
    """
    try:
        if not (path.is_file() or path.is_relative_to("/dev/fd") or not path.exists()):
            raise ConfigError(f"{path} is a folder or a device; give a TOML file")
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
    except FileNotFoundError as error:
        raise ConfigError(f"{path} does not exist; give a TOML file") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}; give another file") from error
    if len(data) > LARGEST:
        raise ConfigError(f"{path} has more than {LARGEST / 1e6:.0f} MB; give a TOML file")
    return data


def _depth(values: Any) -> int:
    """Count the levels of nested tables and lists."""
    depth, level = 0, [values]
    while level := [part for part in level if isinstance(part, dict | list)]:
        depth += 1
        level = [part for one in level for part in (one.values() if isinstance(one, dict) else one)]
    return depth


def line_of(text: str, place: Place) -> int | None:
    """Return the line number, from 1, of a value, or of the table that contains it.

    The search compares the names at the beginning of lines. A value inside a list or an inline table gets
    the line where that begins. Text in a multi-line string may be mistaken for a name.
    """
    found, depth = None, 0
    table: Place = ()
    counts: dict[Place, int] = {}
    for number, line in enumerate(text.split("\n"), start=1):
        if header := _HEADER.match(line):
            names = _parts(header[2])
            if header[1] == "[[":
                counts[names] = counts.get(names, -1) + 1
            here = table = _numbered(names, counts)
        elif key := _KEY.match(line):
            here = (*table, *_parts(key[1]))
        else:
            continue
        if len(here) > depth and here == place[: len(here)]:
            found, depth = number, len(here)
    return found


def _parts(names: str) -> Place:
    return tuple(part.strip("\"'") for part in re.findall(_NAME, names))


def _numbered(names: Place, counts: dict[Place, int]) -> Place:
    """Return the names of a table, with its index after the name of each array of tables."""
    place: Place = ()
    for end in range(1, len(names) + 1):
        place = (*place, names[end - 1])
        if names[:end] in counts:
            place = (*place, counts[names[:end]])
    return place
