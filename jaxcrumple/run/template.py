"""Write a scene file with all defaults, explained in comments."""

import typing
from types import NoneType
from typing import Any

import tomlkit
from pydantic import BaseModel
from tomlkit.items import Table

from jaxcrumple.options.units import unit_of
from jaxcrumple.options.validation import models_in
from jaxcrumple.run.config import RunConfig, configure
from jaxcrumple.run.scene_file import plain
from jaxcrumple.scenes.functions import scene_entry

# Description of numbers without a unit.
_NUMBERS = {float: "a number", int: "a whole number"}


def template(scene: str) -> str:
    """Return the text of a scene file: every option with default, unit and choices.

    Comments at the end show alternative tables, and tables that may occur several times, such as a wall of
    `custom`.

    **Raises:** `ConfigError` for an unknown scene.
    """
    config, entry = configure(scene), scene_entry(scene)
    document = tomlkit.document()
    document.add(tomlkit.comment(f"{scene}: {entry.summary}."))
    document.add(tomlkit.comment('Numbers are in SI units; strings may carry a unit, such as "0.25 mm".'))
    groups: dict[str, type[BaseModel]] = {"options": entry.options}
    _fill(document, RunConfig, plain(config.model_dump()), groups)
    return tomlkit.dumps(document) + "".join(_listed("options", entry.options))


def _fill(
    place: Any, model: type[BaseModel], values: dict[str, Any], inner: dict[str, type[BaseModel]]
) -> None:
    """Add the values of a model to a document or a table, with tables last."""
    for name, value in sorted(values.items(), key=lambda one: isinstance(one[1], dict)):
        field = model.model_fields[name]
        if not isinstance(value, dict):
            item = tomlkit.item(value)
            if comment := _comment(field):
                item.comment(comment)
            place.add(name, item)
            continue
        part = inner.get(name) or _model_of(field, value)
        table: Table = tomlkit.table()
        for line in _documented(part):
            table.add(tomlkit.comment(line))
        _fill(table, part, value, {})
        place.add(name, table)


def _model_of(field: Any, value: dict[str, Any]) -> type[BaseModel]:
    """Return the model of a field that has the names of a value."""
    return next(one for one in models_in(field.annotation) if set(value) <= set(one.model_fields))


def _documented(model: type[BaseModel]) -> list[str]:
    return [line.strip() for line in (model.__doc__ or "").strip().splitlines() if line.strip()]


def _comment(field: Any) -> str:
    """Describe unit, choices and tables of a field."""
    unit = unit_of(field)
    parts = [_NUMBERS[kind] for kind in _NUMBERS if unit is None and _may_be(field.annotation, kind)]
    parts += [] if unit is None else [unit.symbol]
    parts += [f'"{choice}"' for choice in field.examples or _choices(field.annotation)]
    parts += [f"{{{', '.join(one.model_fields)}}}" for one in models_in(field.annotation)]
    if NoneType in typing.get_args(field.annotation):
        parts.append("none")
    # A comment with a single part and no unit repeats the value.
    return " or ".join(parts) if len(parts) > 1 or unit is not None else ""


def _may_be(annotation: Any, kind: type) -> bool:
    return annotation is kind or kind in typing.get_args(annotation)


def _choices(annotation: Any) -> list[Any]:
    """Return the words that an annotation allows, except those inside its tables."""
    if typing.get_origin(annotation) is typing.Literal:
        return list(typing.get_args(annotation))
    return [word for part in typing.get_args(annotation) for word in _choices(part)]


def _listed(place: str, model: type[BaseModel]) -> typing.Iterator[str]:
    """Yield, as comments, a table of each kind that a field of a model, or a list in it, accepts."""
    for name, field in model.model_fields.items():
        many = typing.get_origin(field.annotation) is list
        for one in models_in(field.annotation):
            if not isinstance(field.default, one):
                yield f"\n# [[{place}.{name}]]\n" if many else f"\n# [{place}.{name}]\n"
                yield from (f"# # {line}\n" for line in _documented(one))
                yield from (f"# {line}\n" for line in _lines(one))


def _lines(model: type[BaseModel]) -> typing.Iterator[str]:
    for name, field in model.model_fields.items():
        kind = _choices(field.annotation)
        default = plain(field.default) if not field.is_required() else kind[0] if len(kind) == 1 else None
        comment = _comment(field)
        value = "..." if default is None else tomlkit.item(default).as_string()
        yield f"{name} = {value}" + (f"  # {comment}" if comment else "")
