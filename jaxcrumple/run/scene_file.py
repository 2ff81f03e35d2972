"""Read and write scene files: one run of a named scene as TOML."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.options.toml import line_of, read_toml
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.run.config import RunConfig, complete, pairs, with_settings


def read_scene_file(
    path: str | Path, settings: Sequence[str] | Mapping[str, Any] = (), **top: Any
) -> RunConfig:
    """Read a file of `scene`, `nodes`, `seed`, `t_end`, `frames`, and tables `options`, `material`, `solver`.

    All entries except `scene` have defaults. Numbers are in SI units; strings may carry a unit, such
    as "0.25 mm". The word none means None. Paths in the file are relative to its folder.

    **Arguments:** `settings`: as in `configure`; `top`: `nodes`, `seed` or `t_end`. Both replace values of
    the file.

    **Raises:** `ConfigError` if the file cannot be read or has unknown or impossible entries; it names the
    file, the entry and, if known, the line.
    """
    path = Path(path)
    values, text = read_toml(path)
    if "over" in values:
        raise ConfigError(
            f"{path}: the table [over] makes this a file of a sweep or a campaign; give it to `jaxcrumple "
            "sweep` or `jaxcrumple campaign`, which check all cases before they run any."
        )
    try:
        given = with_settings({**_with_none(values), **top}, settings)
        return complete(given, {"folder": path.parent})
    except ConfigError as error:
        replaced = {*top, *(key for key, _ in pairs(settings))}
        known = bool(error.place) and error.place[-1] not in replaced
        line = line_of(text, error.place) if known else None
        where = str(path) if line is None else f"{path}, line {line}"
        raise ConfigError(f"{where}: {error}", error.place) from error


def write_scene_file(config: RunConfig | Mapping[str, Any], path: str | Path) -> None:
    """Write a complete configuration `config`, e.g. `Run.config` of a loaded run, as a scene file.

    `read_scene_file` reads it back as an equal configuration.

    **Raises:** `RunDirectoryError` if the file cannot be written.
    """
    config = config if isinstance(config, RunConfig) else RunConfig(**config)
    write_bytes(Path(path), tomlkit.dumps(plain(config.model_dump())).encode())


def plain(value: Any) -> Any:
    """Convert values for TOML: the word none for None; omit empty lists, which are defaults."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items() if part != []}
    if isinstance(value, list):
        return [plain(part) for part in value]
    return "none" if value is None else value


def _with_none(value: Any) -> Any:
    """Replace the word none by None."""
    if isinstance(value, Mapping):
        return {key: _with_none(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_with_none(part) for part in value]
    return None if isinstance(value, str) and value.lower() == "none" else value
