"""Scenes that can be run by name, with their options."""

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from jaxcrumple.model.contact import Potential
from jaxcrumple.scenes.arch import arch
from jaxcrumple.scenes.axial import AxialTimes, axial, cylindrical
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.conical import conical
from jaxcrumple.scenes.dcone import dcone, dcone_time
from jaxcrumple.scenes.fold import TIMES, FoldTimes, fold
from jaxcrumple.scenes.radial import radial, unload
from jaxcrumple.scenes.ridge import ridge
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.stamping import shell, shell_time, stamping, stamping_time

AXIAL = AxialTimes()


class SceneEntry(NamedTuple):
    """A scene's function, its options, the time it `ends` by default (s) as a function of them, and one line
    about it.

    `lasts`: the time in s, of the options, that a run cannot reach, and `why_it_ends` there.
    """

    build: Callable[..., Setup]
    options: type[BaseModel]
    ends: Callable[[Mapping[str, Any]], float]
    summary: str
    lasts: Callable[[Mapping[str, Any]], float] = lambda options: math.inf
    why_it_ends: str = ""

    @property
    def t_end(self) -> float:
        """Time in s at which it ends with all options as they are by default."""
        return self.ends(self.options().model_dump())


class SheetModel(BaseModel):
    """Options that the scenes of crumpled sheets share; lengths in m."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    imperfection: float = Field(25e-6, ge=0)
    sweeps: int = Field(100, ge=0)
    damping: Literal["central", "paper"] = "central"
    contact: Potential | None = "penalty"
    contact_range: float | None = Field(None, gt=0, allow_inf_nan=False)
    contact_level: int | None = Field(None, ge=0, le=200)

    @model_validator(mode="after")
    def _of_a_contact(self) -> Self:
        given = [name for name in ("contact_range", "contact_level") if getattr(self, name) is not None]
        if self.contact is None and given:
            raise ValueError(f"{given[0]} is of no use to a phantom sheet; leave it or contact=none out")
        return self


class RadialOptions(SheetModel):
    """Options of `radial`; lengths in m, speed in m/s, time in s."""

    size: float = Field(0.1, gt=0)
    radius: float = Field(0.071, gt=0)
    speed: float = Field(0.01, gt=0)
    hold: float | None = Field(None, gt=0, allow_inf_nan=False)


class UnloadOptions(SheetModel):
    """Options of `unload`; lengths in m, speed in m/s, time in s."""

    size: float = Field(0.1, gt=0)
    radius: float = Field(0.071, gt=0)
    least: float = Field(0.045, gt=0)
    speed: float = Field(0.01, gt=0)
    hold: float = Field(0.1, gt=0)


class CylindricalOptions(SheetModel):
    """Options of `cylindrical`; lengths in m, times in s."""

    size: float = Field(0.1, gt=0)
    radius: float = Field(0.017, gt=0)
    height: float = Field(0.03, gt=0)
    roll: float = Field(AXIAL.roll, gt=0)
    compress: float = Field(AXIAL.compress, gt=0)


class AxialOptions(CylindricalOptions):
    """Options of `axial`; lengths in m, times in s."""

    cycles: int = Field(5, ge=1, le=1000)
    height: float = Field(0.027, gt=0)
    gap: float = Field(2e-3, gt=0)
    open: float = Field(AXIAL.open, gt=0)
    unfold: float = Field(AXIAL.unfold, gt=0)
    flatten: float = Field(AXIAL.flatten, gt=0)
    rest: float = Field(AXIAL.rest, gt=0)


class StampingOptions(SheetModel):
    """Options of `stamping`; lengths in m, speed in m/s."""

    radius: float = Field(0.05, gt=0)
    die: float = Field(0.053, gt=0)
    gap: float = Field(5e-3, gt=0)
    speed: float = Field(0.02, gt=0)


class ShellOptions(SheetModel):
    """Options of `shell`; lengths in m, speed in m/s."""

    radius: float = Field(0.05, gt=0)
    curvature_radius: float = Field(0.06, gt=0)
    gap: float = Field(2e-3, gt=0)
    speed: float = Field(0.02, gt=0)


class ConicalOptions(SheetModel):
    """Options of `conical`; lengths in m, speed in m/s."""

    radius: float = Field(0.05, gt=0)
    opening: float = Field(0.015, gt=0)
    edge: float = Field(5e-3, gt=0)
    pull: float = Field(0.025, gt=0)
    speed: float = Field(0.02, gt=0)
    grip: float = Field(6e-3, gt=0)


class RidgeOptions(SheetModel):
    """Options of `ridge`; lengths in m, angle in rad, time in s."""

    length: float = Field(0.1, gt=0)
    width: float = Field(0.1, gt=0)
    turn: float = Field(0.5 * math.pi, gt=0, lt=math.pi)
    close: float = Field(0.2, gt=0)


class DconeOptions(SheetModel):
    """Options of `dcone`; length in m, speed in m/s."""

    radius: float = Field(0.05, gt=0)
    slope: float = Field(0.1, gt=0)
    speed: float = Field(0.02, gt=0)


class SnapOptions(BaseModel):
    """Options that `arch` and `cap` share; load in N, its time of growth `ramp` in s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ramp: float = Field(0.03, gt=0)
    plastic: bool = False
    damping: Literal["central", "paper"] = "central"


class ArchOptions(SnapOptions):
    """Options of `arch`; lengths in m."""

    length: float = Field(0.03, gt=0)
    width: float = Field(0.006, gt=0)
    rise: float = Field(0.002, gt=0)
    load: float = Field(0.2, gt=0)
    imperfection: float = Field(25e-6, ge=0)


class CapOptions(SnapOptions):
    """Options of `cap`; lengths in m."""

    radius: float = Field(0.025, gt=0)
    rise: float = Field(0.001, gt=0)
    load: float = Field(0.3, gt=0)
    patch: float = Field(0.01, gt=0)
    offset: float = 0.25e-3
    sweeps: int = Field(100, ge=0)


class FoldOptions(BaseModel):
    """Options of `fold`; lengths in m, times in s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: float = Field(0.1, gt=0)
    gap: float | None = Field(None, gt=0)
    close: float = Field(TIMES.close, gt=0)
    press: float = Field(TIMES.press, gt=0)
    hold: float = Field(TIMES.hold, gt=0)
    relax: float = Field(TIMES.relax, gt=0)
    sweeps: int = Field(100, ge=0)


def _radial_lasts(options: Mapping[str, Any]) -> float:
    """When the sphere of `radial` has shrunk to nothing."""
    return options["radius"] / options["speed"] if options["hold"] is None else math.inf


def _some(function: Callable[..., float], *names: str) -> Callable[[Mapping[str, Any]], float]:
    """A function of some of the options."""
    return lambda options: function(*(options[name] for name in names))


def _always(t_end: float) -> Callable[[Mapping[str, Any]], float]:
    return lambda options: t_end


SCENES: dict[str, SceneEntry] = {
    "radial": SceneEntry(
        radial,
        RadialOptions,
        _always(2.6),
        "square sheet in a sphere that shrinks from 7.1 cm at 1 cm/s (Figs. 5, 6, 8)",
        lasts=_radial_lasts,
        why_it_ends="when its sphere has shrunk to nothing",
    ),
    "unload": SceneEntry(
        unload,
        UnloadOptions,
        lambda o: 2.0 * (o["radius"] - o["least"]) / o["speed"] + o["hold"],
        "square sheet in a sphere that shrinks, rests and grows back: hysteresis and springback",
    ),
    "cylindrical": SceneEntry(
        cylindrical,
        CylindricalOptions,
        lambda o: o["roll"] + o["compress"],
        "square sheet that is rolled into a cylinder and compressed along it (Fig. 7)",
    ),
    "axial": SceneEntry(
        axial,
        AxialOptions,
        lambda o: o["cycles"] * sum(o[name] for name in AxialTimes._fields),
        "square sheet rolled up, compressed, unfolded and flattened, again and again (Fig. 9)",
    ),
    "stamping": SceneEntry(
        stamping,
        StampingOptions,
        _some(stamping_time, "die", "radius", "gap", "speed"),
        "disc pressed into a spherical die by a ball (Fig. 7)",
    ),
    "shell": SceneEntry(
        shell,
        ShellOptions,
        _some(shell_time, "radius", "curvature_radius", "gap", "speed"),
        "curved shell that a plate presses flat onto another",
    ),
    "conical": SceneEntry(
        conical,
        ConicalOptions,
        lambda o: o["pull"] / o["speed"],
        "disc whose middle is pulled through a small hole (Fig. 7)",
    ),
    "ridge": SceneEntry(
        ridge,
        RidgeOptions,
        lambda o: 1.5 * o["close"],
        "sheet whose ends are bent to a sharp corner, with a ridge between them",
    ),
    "dcone": SceneEntry(
        dcone,
        DconeOptions,
        lambda o: 1.5 * dcone_time(o["radius"], o["slope"], o["speed"]),
        "disc whose middle is pushed into a hollow cone: a developable cone",
    ),
    "arch": SceneEntry(
        arch, ArchOptions, _always(0.05), "clamped shallow arch that snaps through under a load at midspan"
    ),
    "cap": SceneEntry(
        cap,
        CapOptions,
        _always(0.05),
        "shallow spherical cap, pinned at its rim, that a load turns inside out",
    ),
    "fold": SceneEntry(
        fold,
        FoldOptions,
        lambda o: sum(o[name] for name in FoldTimes._fields),
        "square sheet folded in half, pressed and let go (Fig. 3b)",
    ),
}
