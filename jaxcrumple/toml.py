"""TOML files as they are read: their values, and the lines that these stand on."""

import re
import tomllib
from pathlib import Path
from typing import Any

from jaxcrumple.validation import ConfigError, Place

_NAME = r"(?:[\w-]+|\"[^\"]*\"|'[^']*')"
_NAMES = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEADER = re.compile(rf"\s*(\[\[?)\s*({_NAMES})\s*\]")
_KEY = re.compile(rf"\s*({_NAMES})\s*=")


def read_toml(path: str | Path) -> tuple[dict[str, Any], str]:
    """Values of a file, and its text.

    **Raises:** `ConfigError` for a file that cannot be read, with the line where that is known.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        return tomllib.loads(text), text
    except FileNotFoundError as error:
        raise ConfigError(f"{path} does not exist; give a TOML file") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read as TOML: {error}") from error


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
