"""Options of the scenes in the catalogue: validated models in SI units; strings may contain units."""

import math
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from jaxcrumple.contact.parameters import Potential
from jaxcrumple.contact.sites import MOST_LEVEL
from jaxcrumple.options.units import LENGTH, TIME, Metre, MetrePerSecond, Newton, Radian, Second
from jaxcrumple.scenes.axial import TIMES as AXIAL
from jaxcrumple.scenes.custom_options import refuse_idle_contact
from jaxcrumple.scenes.fold import TIMES


class SceneOptions(BaseModel):
    """Base class of all options: unknown names are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SheetModel(SceneOptions):
    """Options that the scenes of crumpled sheets share; lengths in m."""

    imperfection: Metre = Field(25e-6, ge=0)
    sweeps: int = Field(100, ge=0)
    damping: Literal["central", "paper"] = "central"
    contact: Potential | None = "penalty"
    contact_range: Annotated[float | None, LENGTH] = Field(None, gt=0)
    contact_level: int | None = Field(None, ge=0, le=MOST_LEVEL)

    @model_validator(mode="after")
    def _of_a_contact(self) -> Self:
        refuse_idle_contact(self)
        return self


class RadialOptions(SheetModel):
    """Options of `radial`; lengths in m, speed in m/s, time in s."""

    size: Metre = Field(0.1, gt=0)
    radius: Metre = Field(0.071, gt=0)
    speed: MetrePerSecond = Field(0.01, gt=0)
    hold: Annotated[float | None, TIME] = Field(None, gt=0)


class UnloadOptions(SheetModel):
    """Options of `unload`; lengths in m, speed in m/s, time in s."""

    size: Metre = Field(0.1, gt=0)
    radius: Metre = Field(0.071, gt=0)
    least: Metre = Field(0.045, gt=0)
    speed: MetrePerSecond = Field(0.01, gt=0)
    hold: Second = Field(0.1, gt=0)


class CylindricalOptions(SheetModel):
    """Options of `cylindrical`; lengths in m, times in s."""

    size: Metre = Field(0.1, gt=0)
    radius: Metre = Field(0.017, gt=0)
    height: Metre = Field(0.045, gt=0)
    compress: Second = Field(AXIAL.compress, gt=0)


class AxialOptions(CylindricalOptions):
    """Options of `axial`; lengths in m, times in s."""

    cycles: int = Field(5, ge=1, le=1000)
    roll: Second = Field(AXIAL.roll, gt=0)
    gap: Metre = Field(2e-3, gt=0)
    open: Second = Field(AXIAL.open, gt=0)
    unfold: Second = Field(AXIAL.unfold, gt=0)
    flatten: Second = Field(AXIAL.flatten, gt=0)
    rest: Second = Field(AXIAL.rest, gt=0)


class StampingOptions(SheetModel):
    """Options of `stamping`; lengths in m, speed in m/s."""

    radius: Metre = Field(0.05, gt=0)
    die: Metre = Field(0.053, gt=0)
    gap: Metre = Field(5e-3, gt=0)
    speed: MetrePerSecond = Field(0.02, gt=0)


class ShellOptions(SheetModel):
    """Options of `shell`; lengths in m, speed in m/s."""

    radius: Metre = Field(0.05, gt=0)
    curvature_radius: Metre = Field(0.06, gt=0)
    gap: Metre = Field(2e-3, gt=0)
    speed: MetrePerSecond = Field(0.02, gt=0)


class ConicalOptions(SheetModel):
    """Options of `conical`; lengths in m, speed in m/s."""

    radius: Metre = Field(0.05, gt=0)
    opening: Metre = Field(0.015, gt=0)
    edge: Metre = Field(5e-3, gt=0)
    pull: Metre = Field(0.025, gt=0)
    speed: MetrePerSecond = Field(0.02, gt=0)
    grip: Metre = Field(6e-3, gt=0)


class RidgeOptions(SheetModel):
    """Options of `ridge`; lengths in m, angle in rad, time in s."""

    length: Metre = Field(0.1, gt=0)
    width: Metre = Field(0.1, gt=0)
    turn: Radian = Field(0.5 * math.pi, gt=0, lt=math.pi)
    close: Second = Field(0.2, gt=0)


class DconeOptions(SheetModel):
    """Options of `dcone`; length in m, speed in m/s."""

    radius: Metre = Field(0.05, gt=0)
    slope: float = Field(0.1, gt=0)
    speed: MetrePerSecond = Field(0.02, gt=0)


class SnapOptions(SceneOptions):
    """Options that `arch` and `cap` share; load in N, duration `ramp` of its growth in s."""

    ramp: Second = Field(0.03, gt=0)
    plastic: bool = False
    damping: Literal["central", "paper"] = "central"


class ArchOptions(SnapOptions):
    """Options of `arch`; lengths in m."""

    length: Metre = Field(0.03, gt=0)
    width: Metre = Field(0.006, gt=0)
    rise: Metre = Field(0.002, gt=0)
    load: Newton = Field(0.2, gt=0)
    imperfection: Metre = Field(25e-6, ge=0)


class CapOptions(SnapOptions):
    """Options of `cap`; lengths in m."""

    radius: Metre = Field(0.025, gt=0)
    rise: Metre = Field(0.001, gt=0)
    load: Newton = Field(0.3, gt=0)
    patch: Metre = Field(0.01, gt=0)
    offset: Metre = 0.25e-3
    sweeps: int = Field(100, ge=0)


class FoldOptions(SceneOptions):
    """Options of `fold`; lengths in m, times in s."""

    size: Metre = Field(0.1, gt=0)
    gap: Metre | None = Field(None, gt=0)
    close: Second = Field(TIMES.close, gt=0)
    press: Second = Field(TIMES.press, gt=0)
    hold: Second = Field(TIMES.hold, gt=0)
    relax: Second = Field(TIMES.relax, gt=0)
    sweeps: int = Field(100, ge=0)
