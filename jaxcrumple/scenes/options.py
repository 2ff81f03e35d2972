"""Options of the scenes in the catalogue: models made from the signatures of the scene functions."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Self, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model, model_validator

from jaxcrumple.scenes.custom_options import refuse_idle_contact
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions

# Parameters of a scene function that are no options of the scene.
GIVEN = ("nodes", "seed", "material")


class SceneOptions(BaseModel):
    """Base class of all options: unknown names are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _SheetOptions(SceneOptions):
    @model_validator(mode="after")
    def _of_a_contact(self) -> Self:
        refuse_idle_contact(self)
        return self


def _shared() -> type[BaseModel]:
    """Return the model of the options that the scenes of crumpled sheets share, `SheetOptions`."""
    hints = get_type_hints(SheetOptions, include_extras=True)
    found: dict[str, Any] = {
        field.name: (hints[field.name], field.default)
        for field in fields(SheetOptions)
        if field.name not in GIVEN
    }
    return create_model("SheetModel", __base__=_SheetOptions, **found)


SheetModel = _shared()


def options_of(function: Callable[..., Setup]) -> type[BaseModel]:
    """Return the model of the options of a scene: the keyword parameters of its function, with defaults.

    A function that passes further options on to its sheet has those of `SheetOptions`, too.
    """
    parameters = inspect.signature(function).parameters
    passes_on = inspect.Parameter.VAR_KEYWORD in {parameter.kind for parameter in parameters.values()}
    base = SheetModel if passes_on else SceneOptions
    name = f"Options of `{function.__name__}`"
    return create_model(name, __base__=base, __doc__=f"{name}.", **option_fields(parameters))


def option_fields(parameters: Mapping[str, inspect.Parameter]) -> dict[str, Any]:
    """Return type and default of each parameter that is an option; `...` for a default that is missing."""
    return {
        key: (parameter.annotation, ... if parameter.default is parameter.empty else parameter.default)
        for key, parameter in parameters.items()
        if key not in GIVEN and parameter.kind is not parameter.VAR_KEYWORD
    }
