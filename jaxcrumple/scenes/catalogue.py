"""Scenes that can be run by name, with their options."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from jaxcrumple.model.contact import Potential
from jaxcrumple.scenes.arch import arch
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.custom import custom
from jaxcrumple.scenes.custom_options import CustomOptions, custom_walls, refuse_idle_contact
from jaxcrumple.scenes.fold import TIMES, fold
from jaxcrumple.scenes.radial import radial
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.units import LENGTH, TIME, Metre, MetrePerSecond, Newton, Second


class SceneEntry(NamedTuple):
    """A scene's function, its options, the time it ends by default (s), and one line about it.

    `lasts`: the time in s, of the options, that a run cannot reach, and `why_it_ends` there; `walls`: what
    confines the sheet, of the options, in words.
    """

    build: Callable[..., Setup]
    options: type[BaseModel]
    t_end: float
    summary: str
    lasts: Callable[[Mapping[str, Any]], float] = lambda options: math.inf
    why_it_ends: str = ""
    walls: Callable[[Mapping[str, Any]], Sequence[str]] = lambda options: ()


class RadialOptions(BaseModel):
    """Options of `radial`; lengths in m, speed in m/s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: Metre = Field(0.1, gt=0)
    radius: Metre = Field(0.071, gt=0)
    speed: MetrePerSecond = Field(0.01, gt=0)
    hold: Annotated[float | None, TIME] = Field(None, gt=0, allow_inf_nan=False)
    imperfection: Metre = Field(25e-6, ge=0)
    sweeps: int = Field(100, ge=0)
    damping: Literal["central", "paper"] = "central"
    contact: Potential | None = "penalty"
    contact_range: Annotated[float | None, LENGTH] = Field(None, gt=0, allow_inf_nan=False)
    contact_level: int | None = Field(None, ge=0, le=200)

    @model_validator(mode="after")
    def _of_a_contact(self) -> "RadialOptions":
        refuse_idle_contact(self)
        return self


class SnapOptions(BaseModel):
    """Options that `arch` and `cap` share; load in N, its time of growth `ramp` in s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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


class FoldOptions(BaseModel):
    """Options of `fold`; lengths in m, times in s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: Metre = Field(0.1, gt=0)
    gap: Metre | None = Field(None, gt=0)
    close: Second = Field(TIMES.close, gt=0)
    press: Second = Field(TIMES.press, gt=0)
    hold: Second = Field(TIMES.hold, gt=0)
    relax: Second = Field(TIMES.relax, gt=0)
    sweeps: int = Field(100, ge=0)


def _radial_lasts(options: Mapping[str, Any]) -> float:
    """When the sphere of `radial` has shrunk to nothing."""
    return options["radius"] / options["speed"] if options["hold"] is None else math.inf


def _radial_walls(options: Mapping[str, Any]) -> Sequence[str]:
    until = "" if options["hold"] is None else f" until {options['hold']:g} s"
    return (f"sphere, radius {options['radius']:g} m, shrinking at {options['speed']:g} m/s{until}",)


SCENES: dict[str, SceneEntry] = {
    "radial": SceneEntry(
        radial,
        RadialOptions,
        2.6,
        "square sheet in a sphere that shrinks from 7.1 cm at 1 cm/s (Figs. 5, 6, 8)",
        lasts=_radial_lasts,
        why_it_ends="when its sphere has shrunk to nothing",
        walls=_radial_walls,
    ),
    "arch": SceneEntry(
        arch, ArchOptions, 0.05, "clamped shallow arch that snaps through under a load at midspan"
    ),
    "cap": SceneEntry(
        cap, CapOptions, 0.05, "shallow spherical cap, pinned at its rim, that a load turns inside out"
    ),
    "fold": SceneEntry(
        fold,
        FoldOptions,
        TIMES.end,
        "square sheet folded in half, pressed and let go (Fig. 3b)",
        walls=lambda options: ("two plates that close and move away",),
    ),
    "custom": SceneEntry(
        custom,
        CustomOptions,
        1.0,
        "a sheet, walls and supports of one's own, from the tables of a scene file",
        walls=custom_walls,
    ),
}
