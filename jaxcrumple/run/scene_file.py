"""Scene files: one run of a named scene as TOML, read, and written with all values."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.options.toml import line_of, read_toml
from jaxcrumple.run.config import ConfigError, RunConfig, complete, pairs, with_settings


def read_scene_file(
    path: str | Path, settings: Sequence[str] | Mapping[str, Any] = (), **top: Any
) -> RunConfig:
    """Read a file of `scene`, `nodes`, `seed`, `t_end`, `frames`, and tables `options`, `material`, `solver`.

    All but `scene` have defaults. Numbers are in SI units, strings may carry a unit, e.g. "0.25 mm"; the word
    none stands for None. Paths in the file are taken from its folder.

    **Arguments:** `settings`: as in `configure`, `top`: `nodes`, `seed` or `t_end`; both replace what the
    file has.

    **Raises:** `ConfigError` for a file that cannot be read, or with unknown or impossible entries: it names
    file, place and, where it is known, line.
    """
    path = Path(path)
    values, text = read_toml(path)
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
    """Write a configuration, or that of a loaded run (`Run.config`), complete, as a scene file, which
    `read_scene_file` reads back as an equal one.

    **Raises:** `RunDirectoryError` where it cannot be written.
    """
    config = config if isinstance(config, RunConfig) else RunConfig(**config)
    write_bytes(Path(path), tomlkit.dumps(plain(config.model_dump())).encode())


def plain(value: Any) -> Any:
    """Values as TOML has them: the word none for None, and no empty lists, which are defaults."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items() if part != []}
    if isinstance(value, list):
        return [plain(part) for part in value]
    return "none" if value is None else value


def _with_none(value: Any) -> Any:
    """Values with None for the word none."""
    if isinstance(value, Mapping):
        return {key: _with_none(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_with_none(part) for part in value]
    return None if isinstance(value, str) and value.lower() == "none" else value
