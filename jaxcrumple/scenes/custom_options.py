"""Options of a user-defined scene: sheet, walls and supports as tables of a file."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

from jaxcrumple.contact.parameters import Potential
from jaxcrumple.contact.sites import MOST_LEVEL
from jaxcrumple.mesh.files import MeshError
from jaxcrumple.mesh.files.sheet import unit_length
from jaxcrumple.options.units import (
    LENGTH,
    TIME,
    Metre,
    MetrePerSecond,
    MetrePerSecondSquared,
    Radian,
)


class Table(BaseModel):
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


class Motion(Table):
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


def _is_table(value: Any) -> str:
    """Return the tag of a value in a union of a plain value and a table."""
    return "table" if isinstance(value, Mapping | BaseModel) else "plain"


Moving = Annotated[
    Annotated[Metre, Tag("plain")] | Annotated[Motion, Tag("table")],
    Discriminator(_is_table),
]
"""A length in m, or its motion."""


class Bend(Table):
    """Intrinsic curvature: the rest shape lies on a sphere, or on a cylinder along the x or y `axis`, with a
    `radius` in m. The surface touches the plane z = 0 from below at the origin."""

    kind: Literal["sphere", "cylinder"]
    radius: PositiveMetre
    axis: Literal["x", "y"] = "y"


class Taper(Table):
    """A thickness in m that varies linearly along `direction`, from the first value of `between` at one end
    of the sheet to the second value at the other end."""

    between: Annotated[list[PositiveMetre], Len(2, 2)]
    direction: Axis = [1.0, 0.0, 0.0]


class GeneratedSheet(Table):
    """A flat random mesh: `imperfection` is the largest height in m of a smooth, stress-free initial shape,
    `sweeps` the number of Lloyd sweeps, `bend` the intrinsic curvature, `taper` a variable thickness."""

    imperfection: Metre = Field(25e-6, ge=0)
    sweeps: int = Field(100, ge=0, le=10_000)
    bend: Bend | None = None
    taper: Taper | None = None


class Square(GeneratedSheet):
    """A square of edge `size` in m around the origin of the plane z = 0."""

    shape: Literal["square"] = "square"
    size: PositiveMetre = 0.1


class Disc(GeneratedSheet):
    """A disc of a `radius` in m around the origin of the plane z = 0."""

    shape: Literal["disc"]
    radius: PositiveMetre = 0.05


class FileSheet(Table):
    """The surface in the file `path` (read by trimesh or meshio), flat or curved, is the rest shape.

    `path`: relative to the folder of the scene file. `unit`: unit of all lengths in the file, metres by
    default. `merge`: largest distance in m of points that become one. `remesh`: replace the mesh of a flat
    sheet by a random mesh of `nodes` nodes within its outline. `thickness`: name of the point data in the
    file that give the thickness of each node, in the same unit.
    """

    shape: Literal["file"]
    path: str
    unit: str | None = None
    merge: Annotated[Metre | None, Field(ge=0)] = None
    remesh: bool = False
    thickness: str | None = None
    taper: Taper | None = None

    @field_validator("path")
    @classmethod
    def _exists(cls, path: str, info: ValidationInfo) -> str:
        found = Path((info.context or {}).get("folder", ".")).absolute() / path
        try:
            exists = found.is_file()
        except (OSError, ValueError):  # the name is too long or contains a zero byte
            exists = False
        if not exists:
            raise ValueError("there is no such file; give the path of a mesh file")
        return str(found)

    @field_validator("unit")
    @classmethod
    def _known(cls, unit: str | None) -> str | None:
        try:
            unit_length(unit)
        except MeshError as error:
            raise ValueError(str(error).removeprefix(f"unit = {unit!r} ")) from error
        return unit

    @model_validator(mode="after")
    def _one_thickness(self) -> "FileSheet":
        if self.thickness is not None and self.taper is not None:
            raise ValueError("thickness and taper both set the thickness; leave one out")
        if self.thickness is not None and self.remesh:
            raise ValueError("remesh replaces the nodes that have the thickness; leave one out")
        return self


Sheet = Annotated[Square | Disc | FileSheet, Field(discriminator="shape")]


def _positive(moving: float | Motion) -> float | Motion:
    values = moving.values if isinstance(moving, Motion) else [moving]
    if min(values) <= 0:
        raise ValueError("a radius must be greater than 0")
    return moving


Radius = Annotated[Moving, AfterValidator(_positive)]
ORIGIN = [0.0, 0.0, 0.0]
UP = [0.0, 0.0, 1.0]


class SphereWall(Table):
    """The inside of a sphere around `center`, in m; `radius` in m or a motion."""

    kind: Literal["sphere"]
    center: Position = ORIGIN
    radius: Radius


class CylinderWall(Table):
    """The inside of a cylinder through `center`, in m, along `axis`; `radius` in m or a motion."""

    kind: Literal["cylinder"]
    center: Position = ORIGIN
    axis: Axis = UP
    radius: Radius


class PlaneWall(Table):
    """The side of a plane to which `normal` points; `offset` from the origin along it in m, or a motion."""

    kind: Literal["plane"]
    normal: Axis = UP
    offset: Moving


class ConeWall(Table):
    """The inside of a cone that opens along `axis` with `half_angle` in rad; `height`: distance of its tip
    from `center` along the axis, in m or a motion."""

    kind: Literal["cone"]
    center: Position = ORIGIN
    axis: Axis = UP
    half_angle: Radian = Field(gt=0, lt=math.pi / 2)
    height: Moving


AnyWall = Annotated[SphereWall | CylinderWall | PlaneWall | ConeWall, Field(discriminator="kind")]


class Box(Table):
    """A box between the corners `lower` and `upper`, in m; coordinates may be infinite."""

    model_config = ConfigDict(allow_inf_nan=True)

    lower: Position
    upper: Position

    @model_validator(mode="after")
    def _in_order(self) -> "Box":
        if not all(low <= high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError("lower must not lie above upper")
        return self


class Support(Table):
    """Held nodes: those in a box or on the sheet's "boundary". They are fixed, or move at a `velocity` in
    m/s. The support releases them at the time `until` in s, if given. The last support of a node applies."""

    nodes: Annotated[
        Annotated[Literal["boundary"], Tag("plain")] | Annotated[Box, Tag("table")],
        Discriminator(_is_table),
    ]
    velocity: Velocity = ORIGIN
    until: Annotated[float | None, TIME] = Field(None, gt=0)


class CustomOptions(Table):
    """Options of `custom`: a `sheet`, `walls`, `supports`, `gravity` in m/s2, and contact as in `radial`."""

    sheet: Sheet = Square()
    walls: list[AnyWall] = []
    supports: list[Support] = []
    gravity: Annotated[list[MetrePerSecondSquared], Len(3, 3)] | None = None
    damping: Literal["central", "paper"] = "central"
    contact: Potential | None = "penalty"
    contact_range: Annotated[float | None, LENGTH] = Field(None, gt=0)
    contact_level: int | None = Field(None, ge=0, le=MOST_LEVEL)

    @model_validator(mode="after")
    def _of_a_contact(self) -> "CustomOptions":
        refuse_idle_contact(self)
        return self


def refuse_idle_contact(options: Any) -> None:
    """Refuse options of contact if there is no contact."""
    given = [name for name in ("contact_range", "contact_level") if getattr(options, name) is not None]
    if options.contact is None and given:
        raise ValueError(f"{given[0]} has no effect without contact; leave it or contact=none out")


def custom_walls(options: Mapping[str, Any]) -> list[str]:
    """Describe the walls in words, from the output of `CustomOptions.model_dump`."""
    return [f"{wall['kind']}, {_measure(wall)}" for wall in options["walls"]]


def _measure(wall: Mapping[str, Any]) -> str:
    """Describe the length that may vary in time."""
    name = next(name for name in ("radius", "offset", "height") if name in wall)
    value = wall[name]
    if isinstance(value, Mapping):
        first, last = value["values"][0], value["values"][-1]
        return f"{name} from {first:g} to {last:g} m until {value['times'][-1]:g} s"
    return f"{name} {value:g} m"
