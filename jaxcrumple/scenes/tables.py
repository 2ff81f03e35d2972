"""Base and value types of the tables of a scene file: directions, lengths, motions."""

from collections.abc import Mapping
from typing import Annotated, Any

from annotated_types import Len
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from jaxcrumple.options.units import TIME, Metre, MetrePerSecond


class OptionTable(BaseModel):
    """Base class of all tables: unknown names and non-finite numbers are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Position = Annotated[list[Metre], Len(3, 3)]
Velocity = Annotated[list[MetrePerSecond], Len(3, 3)]


def _nonzero(value: list[float]) -> list[float]:
    if not any(value):
        raise ValueError("a direction must not be zero")
    return value


Axis = Annotated[list[float], Len(3, 3), AfterValidator(_nonzero)]
PositiveMetre = Annotated[Metre, Field(gt=0)]


class Motion(OptionTable):
    """A length in m that is linear in time between the `values` at `times` in s. It is constant before the
    first and after the last time."""

    times: Annotated[list[Annotated[float, TIME]], Len(2)]
    values: Annotated[list[Metre], Len(2)]

    @model_validator(mode="after")
    def _in_order(self) -> "Motion":
        if len(self.times) != len(self.values):
            raise ValueError(
                f"{len(self.times)} times for {len(self.values)} values; give one time for each value"
            )
        if any(later <= sooner for sooner, later in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must increase")
        return self


def is_table(value: Any) -> str:
    """Return the tag of a value in a union of a plain value and a table."""
    return "table" if isinstance(value, Mapping | BaseModel) else "plain"


Moving = Annotated[
    Annotated[Metre, Tag("plain")] | Annotated[Motion, Tag("table")],
    Discriminator(is_table),
]
"""A length in m, or its motion."""


def _positive(moving: float | Motion) -> float | Motion:
    values = moving.values if isinstance(moving, Motion) else [moving]
    if min(values) <= 0:
        raise ValueError("a radius must be greater than 0")
    return moving


Radius = Annotated[Moving, AfterValidator(_positive)]
ORIGIN = [0.0, 0.0, 0.0]
UP = [0.0, 0.0, 1.0]
