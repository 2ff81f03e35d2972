"""Turn an error of Pydantic into one line that names place, cause and cure."""

import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from jaxcrumple.options.suggest import nearest

# Most characters of a wrong value that a message quotes.
QUOTED = 80

Place = tuple[str | int, ...]


class ConfigError(ValueError):
    """An invalid option; the message names the option, the cause and the cure.

    `place`: the path of names and indices to the option in a file, as far as it is known.
    """

    def __init__(self, message: str, place: Place = ()):
        super().__init__(message)
        self.place = place


def validated(
    model: type[BaseModel], values: Mapping[str, Any], place: Place = (), context: Any = None
) -> Any:
    """Validate the values at `place` in a file, and return them as a model.

    **Raises:** `ConfigError` that names the first invalid value.
    """
    try:
        return model.model_validate(values, context=context)
    except ValidationError as error:
        # A misspelt name also makes a name missing; report the misspelt one, which shows the cause.
        first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        inner = _given(first, values)
        raise ConfigError(_said(first, model, (*place, *inner), inner), (*place, *inner)) from error


def dotted(place: Sequence[str | int]) -> str:
    """Write a place as text, e.g. "options.walls[0].radius"."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).removeprefix(".")


def _said(first: Any, model: type[BaseModel], place: Place, inner: Place) -> str:
    where = dotted(place)
    if first["type"] in ("missing", "union_tag_not_found"):
        return f"{where} is missing; give one."
    if first["type"] == "union_tag_invalid":
        tags = [tag.strip("' ") for tag in first["ctx"]["expected_tags"].split(",")]
        return (
            f"{where} = {shortened(first['ctx']['tag'])} is unknown{nearest(str(first['ctx']['tag']), tags)}"
        )
    if first["type"] == "extra_forbidden":
        return f"{where!r} is unknown{nearest(str(inner[-1]), _names(model, first['loc']))}"
    said = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("model_type", "model_attributes_type", "dict_type"):
        said = "Input should be a table of names and values"
    quoted = f"{where} = {shortened(first.get('input'))}" if where and inner else where
    joint = " " if first["type"] == "unit" else ": " if quoted else ""
    said = f"{said.removesuffix('.')}{', or none' if _optional(model, first['loc']) else ''}"
    return f"{quoted}{joint}{said}" + ("" if said.endswith("?") else ".")


def shortened(value: Any) -> str:
    """Quote a value for a message, cut to `QUOTED` characters."""
    text = repr(value)
    return text if len(text) <= QUOTED else f"{text[:QUOTED]}..."


def _given(error: Any, values: Any) -> Place:
    """Return the place of an error, without the names that Pydantic adds for union members."""
    found: list[str | int] = []
    for part in error["loc"]:
        if _holds(values, part):
            values = values[part]
            found.append(part)
    if error["type"] == "missing":
        found.append(error["loc"][-1])
    elif error["type"] in ("union_tag_not_found", "union_tag_invalid"):
        found.append(error["ctx"]["discriminator"].strip("'"))
    return tuple(found)


def _holds(values: Any, part: str | int) -> bool:
    if isinstance(values, list):
        return isinstance(part, int) and part < len(values)
    return isinstance(values, Mapping) and part in values


def _parents(model: type[BaseModel], loc: Place) -> list[type[BaseModel]]:
    """Return the models that may have the last part of `loc` as a field."""
    models = [model]
    for part in loc[:-1]:
        owned = [one.model_fields[part].annotation for one in models if part in one.model_fields]
        # A part that is not a field name is an index or the tag of a union member.
        tagged = [one for one in models if any(part in get_args(f.annotation) for f in _fields(one))]
        models = [found for annotation in owned for found in models_in(annotation)] or tagged or models
    return models


def _names(model: type[BaseModel], loc: Place) -> list[str]:
    """Return the known names at the place where `loc` has an unknown one."""
    return [name for one in _parents(model, loc) for name in one.model_fields]


def _optional(model: type[BaseModel], loc: Place) -> bool:
    fields = [one.model_fields.get(str(loc[-1])) for one in _parents(model, loc)] if loc else []
    return any(types.NoneType in get_args(field.annotation) for field in fields if field is not None)


def _fields(model: type[BaseModel]) -> Iterator[Any]:
    return iter(model.model_fields.values())


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models in an annotation, without the models nested in these."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif typing.get_origin(annotation) is not None:
        for part in get_args(annotation):
            yield from models_in(part)
