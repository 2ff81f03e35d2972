"""Tables of the walls of a scene file: one class for each kind, which builds its shape."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from jaxcrumple._jax.tree import as_float
from jaxcrumple.model import walls
from jaxcrumple.options.units import Radian
from jaxcrumple.scenes.tables import (
    ORIGIN,
    UP,
    Axis,
    Motion,
    Moving,
    OptionTable,
    Position,
    PositiveMetre,
    Radius,
)


class SphereWall(OptionTable):
    """The inside of a sphere around `center`, in m; `radius` in m or a motion."""

    kind: Literal["sphere"]
    center: Position = ORIGIN
    radius: Radius

    def shape(self) -> walls.AbstractShape:
        """Build the shape."""
        return walls.Sphere(jnp.asarray(self.center), _of_time(self.radius))


class CylinderWall(OptionTable):
    """The inside of a cylinder through `center`, in m, along `axis`; `radius` in m or a motion."""

    kind: Literal["cylinder"]
    center: Position = ORIGIN
    axis: Axis = UP
    radius: Radius

    def shape(self) -> walls.AbstractShape:
        """Build the shape."""
        return walls.Cylinder(jnp.asarray(self.center), unit_vector(self.axis), _of_time(self.radius))


class PlaneWall(OptionTable):
    """The side of a plane to which `normal` points; `offset` from the origin along it in m, or a motion."""

    kind: Literal["plane"]
    normal: Axis = UP
    offset: Moving

    def shape(self) -> walls.AbstractShape:
        """Build the shape."""
        return walls.Plane(unit_vector(self.normal), _of_time(self.offset))


class ConeWall(OptionTable):
    """The inside of a cone that opens along `axis` with `half_angle` in rad; `height`: distance of its tip
    from `center` along the axis, in m or a motion."""

    kind: Literal["cone"]
    center: Position = ORIGIN
    axis: Axis = UP
    half_angle: Radian = Field(gt=0, lt=math.pi / 2)
    height: Moving

    def shape(self) -> walls.AbstractShape:
        """Build the shape."""
        center, axis = jnp.asarray(self.center), unit_vector(self.axis)
        return walls.Cone(center, axis, as_float(self.half_angle), _of_time(self.height))


class BallWall(OptionTable):
    """The outside of a ball of `radius` in m; `height`: distance of its centre from `center` along `axis`, in
    m or a motion."""

    kind: Literal["ball"]
    center: Position = ORIGIN
    axis: Axis = UP
    radius: PositiveMetre
    height: Moving = 0.0

    def shape(self) -> walls.AbstractShape:
        """Build the shape."""
        center, axis = jnp.asarray(self.center), unit_vector(self.axis)
        return walls.Ball(center, axis, as_float(self.radius), _of_time(self.height))


class HoledPlateWall(OptionTable):
    """A plate through `center`, normal to `axis`, with a round hole of `radius`, in m or a motion. The rim
    has the rounding radius `edge` in m, and the plate twice that thickness."""

    kind: Literal["holed-plate"]
    center: Position = ORIGIN
    axis: Axis = UP
    radius: Radius
    edge: PositiveMetre

    def shape(self) -> walls.AbstractShape:
        """Build the shape."""
        center, axis = jnp.asarray(self.center), unit_vector(self.axis)
        return walls.HoledPlate(center, axis, _of_time(self.radius), as_float(self.edge))


AnyWall = Annotated[
    SphereWall | CylinderWall | PlaneWall | ConeWall | BallWall | HoledPlateWall, Field(discriminator="kind")
]


def _of_time(value: float | Motion) -> Any:
    """Return a length, or the function of time of its motion."""
    if not isinstance(value, Motion):
        return value
    return walls.PiecewiseLinear(jnp.array(value.times), jnp.array(value.values))


def unit_vector(direction: Sequence[float]) -> Float[Array, " 3"]:
    """Return the unit vector (3,) of a direction."""
    # Scale first, so that no square overflows.
    scaled = np.array(direction) / np.max(np.abs(direction))
    return jnp.asarray(scaled / np.linalg.norm(scaled))
