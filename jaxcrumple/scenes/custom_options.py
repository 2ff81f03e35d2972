"""What a scene of the user's own is made of: sheet, walls and supports as tables of a file."""

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

from jaxcrumple.contact.energy import Potential
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
    """Base of all tables: unknown names and numbers that are not finite are errors."""

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
    """A length in m that goes straight from one of `values` to the next at `times` in s, and rests before the
    first and after the last."""

    times: Annotated[list[Annotated[float, TIME]], Len(2)]
    values: Annotated[list[Metre], Len(2)]

    @model_validator(mode="after")
    def _in_order(self) -> "Motion":
        if len(self.times) != len(self.values):
            raise ValueError(f"{len(self.times)} times for {len(self.values)} values; give one to each")
        if any(later <= sooner for sooner, later in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must increase")
        return self


def _is_table(value: Any) -> str:
    """The member of a union of a plain value and a table that a value is to be."""
    return "table" if isinstance(value, Mapping | BaseModel) else "plain"


Moving = Annotated[
    Annotated[Metre, Tag("plain")] | Annotated[Motion, Tag("table")],
    Discriminator(_is_table),
]
"""A length in m, or how it changes."""


class Bend(Table):
    """Intrinsic curvature: the rest shape lies on a sphere, or on a cylinder along the x or y `axis`, of a
    `radius` in m. It touches the plane z = 0 from below at the origin."""

    kind: Literal["sphere", "cylinder"]
    radius: PositiveMetre
    axis: Literal["x", "y"] = "y"


class Taper(Table):
    """A thickness in m that goes linearly from the first of `between` to the second along `direction`, from
    one end of the sheet to the other."""

    between: Annotated[list[PositiveMetre], Len(2, 2)]
    direction: Axis = [1.0, 0.0, 0.0]


class GeneratedSheet(Table):
    """A flat random mesh: `imperfection` is the largest height in m of a smooth, stress-free initial shape,
    `sweeps` those of Lloyd's algorithm; `bend` its intrinsic curvature, `taper` a thickness that varies."""

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
    """The surface in the file `path`, which trimesh or meshio reads: its rest shape as it is, curved or not.

    `unit` of all lengths in the file, metres by default; points up to `merge` in m apart become one.
    `remesh`: fill the outline of a flat sheet with a random mesh of `nodes` nodes instead. `thickness`: the
    name of point data in the file with the thickness of each node in that unit. A path is taken from the
    folder of the scene file.
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
        except (OSError, ValueError):  # a name too long, or with a zero byte
            exists = False
        if not exists:
            raise ValueError("there is no such file; give that of a mesh")
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
            raise ValueError("remesh leaves no node of the file that has the thickness; leave one out")
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
    """The side of a plane to which `normal` points; `offset` along it from the origin in m, or a motion."""

    kind: Literal["plane"]
    normal: Axis = UP
    offset: Moving


class ConeWall(Table):
    """The inside of a cone that opens along `axis` by `half_angle` in rad; its tip is `height` away from
    `center` along the axis, in m or a motion."""

    kind: Literal["cone"]
    center: Position = ORIGIN
    axis: Axis = UP
    half_angle: Radian = Field(gt=0, lt=math.pi / 2)
    height: Moving


AnyWall = Annotated[SphereWall | CylinderWall | PlaneWall | ConeWall, Field(discriminator="kind")]


class Box(Table):
    """The points from the corner `lower` to the corner `upper`, in m, which may be infinite."""

    model_config = ConfigDict(allow_inf_nan=True)

    lower: Position
    upper: Position

    @model_validator(mode="after")
    def _in_order(self) -> "Box":
        if not all(low <= high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError("lower must not lie above upper")
        return self


class Support(Table):
    """Nodes that are held, those in a box or on the sheet's "boundary": fixed, or moved at a `velocity` in
    m/s, `until` a time in s if they are let go. Of two supports of one node the later one holds it."""

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
    """Refuse options of a contact that there is none of."""
    given = [name for name in ("contact_range", "contact_level") if getattr(options, name) is not None]
    if options.contact is None and given:
        raise ValueError(f"{given[0]} is of no use to a phantom sheet; leave it or contact=none out")


def custom_walls(options: Mapping[str, Any]) -> list[str]:
    """The walls in words, of options as `CustomOptions.model_dump` has them."""
    return [f"{wall['kind']}, {_measure(wall)}" for wall in options["walls"]]


def _measure(wall: Mapping[str, Any]) -> str:
    """The length that may move, in words."""
    name = next(name for name in ("radius", "offset", "height") if name in wall)
    value = wall[name]
    if isinstance(value, Mapping):
        first, last = value["values"][0], value["values"][-1]
        return f"{name} from {first:g} to {last:g} m until {value['times'][-1]:g} s"
    return f"{name} {value:g} m"
