"""TOML files as they are read: their values, and the lines that these stand on."""

import re
import tomllib
from pathlib import Path
from typing import Any

from jaxcrumple.options.validation import ConfigError, Place

# Bytes of the largest file, and levels of tables and lists, that anybody can mean.
LARGEST, DEEPEST = 10_000_000, 50
_NAME = r"(?:[\w-]+|\"[^\"]*\"|'[^']*')"
_NAMES = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEADER = re.compile(rf"\s*(\[\[?)\s*({_NAMES})\s*\]")
_KEY = re.compile(rf"\s*({_NAMES})\s*=")


def read_toml(path: str | Path) -> tuple[dict[str, Any], str]:
    """Values of a file, and its text.

    **Raises:** `ConfigError` for a file that cannot be read, with the line where that is known.
    """
    data = _bytes(Path(path))
    try:
        # Some editors begin a file with a byte-order mark, and end lines in other ways.
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
    """What a file holds, or a pipe of the shell's, as by `<(...)`; any other would be waited for.

    **Raises:** ConfigError for what is neither, cannot be read, or is too large to be meant.
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
    """How many levels of tables and lists values have."""
    depth, level = 0, [values]
    while level := [part for part in level if isinstance(part, dict | list)]:
        depth += 1
        level = [part for one in level for part in (one.values() if isinstance(one, dict) else one)]
    return depth


def line_of(text: str, place: Place) -> int | None:
    """Number of the line, counted from 1, where a value stands, or else the table that it belongs to.

    Found by the names at the beginning of lines: what stands inside a list or an inline table has the line
    where that begins, and text in a string of several lines may be taken for a name.
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
    """Names of a table with the number of each list of tables that it is in."""
    place: Place = ()
    for end in range(1, len(names) + 1):
        place = (*place, names[end - 1])
        if names[:end] in counts:
            place = (*place, counts[names[:end]])
    return place
