"""Options of a user-defined scene: sheet, walls and supports as tables of a file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import (
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

from jaxcrumple.contact.potentials import DEFAULT_POTENTIAL, Potential
from jaxcrumple.mesh.files import MeshError
from jaxcrumple.mesh.files.sheet import unit_length
from jaxcrumple.options.units import (
    TIME,
    Metre,
    MetrePerSecondSquared,
)
from jaxcrumple.scenes.quantities import ContactLevel, Damping, Length
from jaxcrumple.scenes.tables import ORIGIN, Axis, OptionTable, Position, PositiveMetre, Velocity, is_table
from jaxcrumple.scenes.wall_options import AnyWall


class Bend(OptionTable):
    """Intrinsic curvature: the rest shape lies on a sphere, or on a cylinder along the x or y `axis`, with a
    `radius` in m. The surface touches the plane z = 0 from below at the origin."""

    kind: Literal["sphere", "cylinder"]
    radius: PositiveMetre
    axis: Literal["x", "y"] = "y"


class Taper(OptionTable):
    """A thickness in m that varies linearly along `direction`, from the first value of `between` at one end
    of the sheet to the second value at the other end."""

    between: Annotated[list[PositiveMetre], Len(2, 2)]
    direction: Axis = Field([1.0, 0.0, 0.0])


class GeneratedSheet(OptionTable):
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


class FileSheet(OptionTable):
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


class Box(OptionTable):
    """A box between the corners `lower` and `upper`, in m; coordinates may be infinite."""

    model_config = ConfigDict(allow_inf_nan=True)

    lower: Position
    upper: Position

    @model_validator(mode="after")
    def _in_order(self) -> "Box":
        if not all(low <= high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError("lower must not lie above upper")
        return self


class Support(OptionTable):
    """Held nodes: those in a box or on the sheet's "boundary". They are fixed, or move at a `velocity` in
    m/s. The support releases them at the time `until` in s, if given. The last support of a node applies."""

    nodes: Annotated[
        Annotated[Literal["boundary"], Tag("plain")] | Annotated[Box, Tag("table")],
        Discriminator(is_table),
    ]
    velocity: Velocity = ORIGIN
    until: Annotated[float | None, TIME] = Field(None, gt=0)


class CustomOptions(OptionTable):
    """Options of `custom`: a `sheet`, `walls`, `supports`, `gravity` in m/s2, and contact as in `radial`."""

    sheet: Sheet = Square()
    walls: list[AnyWall] = Field([])
    supports: list[Support] = Field([])
    gravity: Annotated[list[MetrePerSecondSquared], Len(3, 3)] | None = None
    damping: Damping = "central"
    contact: Potential | None = DEFAULT_POTENTIAL
    contact_range: Length | None = None
    contact_level: ContactLevel | None = None

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
