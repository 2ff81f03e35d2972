"""Catalogue of the scenes that the command line runs by name."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic import BaseModel

from jaxcrumple.material.material import Material
from jaxcrumple.scenes.arch import arch
from jaxcrumple.scenes.axial import AxialTimes, axial, cylindrical
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.conical import conical
from jaxcrumple.scenes.custom import custom
from jaxcrumple.scenes.custom_options import CustomOptions, custom_walls
from jaxcrumple.scenes.dcone import dcone, dcone_time
from jaxcrumple.scenes.fold import FoldTimes, fold
from jaxcrumple.scenes.options import options_of
from jaxcrumple.scenes.radial import radial, unload
from jaxcrumple.scenes.ridge import ridge
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.stamping import shell, shell_time, stamping, stamping_time

# Least default end time of a scene in s.
SOONEST = 1e-3
# Values of the options by name, and functions of them.
Given = Mapping[str, Any]
OfOptions = Callable[[Given], float]


class SceneEntry(NamedTuple):
    """Entry of a scene: its function `build`, its `options`, its default end time and a one-line `summary`.

    `ends`: default end time in s as a function of the options; `lasts`: time in s, as a function of the
    options, that a run must end before, with the reason `why_it_ends`; `walls`: description of the walls, as
    a function of the options; `confines`: radius in m to which a sphere confines the sheet, as a function of
    the options and the end time in s; `own`: whether it is a function of the user, whose `Setup` has the end
    time; `material`: its default material, if it has one of its own.
    """

    build: Callable[..., Setup]
    options: type[BaseModel]
    ends: OfOptions
    summary: str
    lasts: OfOptions = lambda options: math.inf
    why_it_ends: str = ""
    walls: Callable[[Given], Sequence[str]] = lambda options: ()
    confines: Callable[[Given, float], float] = lambda options, t_end: math.inf
    own: bool = False
    material: Material | None = None

    def end(self, given: Given) -> float:
        """Return the default end time in s for these options, to nine digits."""
        return float(f"{self.ends(given):.9g}")

    @property
    def t_end(self) -> float:
        """End time in s with all options at their defaults."""
        return self.end(self.options().model_dump())


def _radial_lasts(given: Given) -> float:
    """Return the time in s at which the sphere of `radial` has zero radius."""
    return given["radius"] / given["speed"] if given["hold"] is None else math.inf


def _radial_walls(given: Given) -> Sequence[str]:
    until = "" if given["hold"] is None else f" until {given['hold']:g} s"
    return (f"sphere, radius {given['radius']:g} m, shrinking at {given['speed']:g} m/s{until}",)


def _radial_confines(given: Given, t_end: float) -> float:
    """Return the radius in m of the sphere of `radial` at the end time `t_end` in s."""
    last = t_end if given["hold"] is None else min(t_end, given["hold"])
    return given["radius"] - given["speed"] * last


def _unload_confines(given: Given, t_end: float) -> float:
    """Return the least radius in m of the sphere of `unload` until `t_end` in s."""
    return max(given["least"], given["radius"] - given["speed"] * t_end)


def _way_back(given: Given) -> float:
    """Return the time in s at which the sphere of `unload` has its initial radius again."""
    return 2.0 * max(given["radius"] - given["least"], 0.0) / given["speed"] + given["hold"]


def _of(function: Callable[..., float], *names: str) -> OfOptions:
    """Return an end time as a function of the named options, at least `SOONEST`.

    The scene itself refuses options that give no positive time.
    """
    return lambda given: max(function(*(given[name] for name in names)), SOONEST)


def _sum(names: Sequence[str]) -> OfOptions:
    return lambda given: sum(given[name] for name in names)


def _always(t_end: float) -> OfOptions:
    return lambda given: t_end


def _told(*words: str) -> Callable[[Given], Sequence[str]]:
    """Return a function that inserts the options into the descriptions of walls."""
    return lambda given: [word.format(**given) for word in words]


SCENES: dict[str, SceneEntry] = {
    "radial": SceneEntry(
        radial,
        options_of(radial),
        _always(2.6),
        "square sheet in a sphere that shrinks from 7.1 cm at 1 cm/s (Figs. 5, 6, 8)",
        lasts=_radial_lasts,
        why_it_ends="when its sphere has zero radius",
        walls=_radial_walls,
        confines=_radial_confines,
    ),
    "unload": SceneEntry(
        unload,
        options_of(unload),
        _way_back,
        "square sheet in a sphere that shrinks, rests and expands again: hysteresis and springback",
        walls=_told("sphere, from {radius:g} to {least:g} m and back at {speed:g} m/s"),
        confines=_unload_confines,
    ),
    "cylindrical": SceneEntry(
        cylindrical,
        options_of(cylindrical),
        lambda given: given["compress"],
        "square sheet rolled up in a cylinder and compressed along the axis (Fig. 7)",
        walls=_told("cylinder of radius {radius:g} m", "two planes across it, down to {height:g} m"),
    ),
    "axial": SceneEntry(
        axial,
        options_of(axial),
        lambda given: given["cycles"] * _sum(AxialTimes._fields)(given),
        "square sheet repeatedly rolled up, compressed, unfolded and flattened (Fig. 9)",
        walls=_told(
            "cylinder, down to {radius:g} m",
            "two planes across it, down to {height:g} m",
            "two planes along it, down to {gap:g} m; {cycles} cycles",
        ),
    ),
    "stamping": SceneEntry(
        stamping,
        options_of(stamping),
        _of(stamping_time, "die", "radius", "gap", "speed"),
        "disc pressed into a spherical die by a ball (Fig. 7)",
        walls=_told("die of radius {die:g} m", "ball that descends to {gap:g} m above it at {speed:g} m/s"),
    ),
    "shell": SceneEntry(
        shell,
        options_of(shell),
        _of(shell_time, "radius", "curvature_radius", "gap", "speed"),
        "curved shell pressed flat between two plates",
        walls=_told("two plates, down to {gap:g} m at {speed:g} m/s"),
    ),
    "conical": SceneEntry(
        conical,
        options_of(conical),
        lambda given: given["pull"] / given["speed"],
        "disc pulled by its middle through a small hole (Fig. 7)",
        walls=_told("plate with a hole of radius {opening:g} m"),
    ),
    "ridge": SceneEntry(
        ridge,
        options_of(ridge),
        lambda given: 1.5 * given["close"],
        "sheet bent to a sharp corner at both ends, with a ridge in between",
    ),
    "dcone": SceneEntry(
        dcone,
        options_of(dcone),
        lambda given: 1.5 * dcone_time(given["radius"], given["slope"], given["speed"]),
        "disc pushed into a hollow cone at its middle: a developable cone",
        walls=_told("cone of slope {slope:g} that rises at {speed:g} m/s"),
    ),
    "arch": SceneEntry(
        arch,
        options_of(arch),
        _always(0.05),
        "clamped shallow arch that snaps through under a load at midspan",
    ),
    "cap": SceneEntry(
        cap,
        options_of(cap),
        _always(0.05),
        "shallow spherical cap, pinned at its rim, inverted by a load",
    ),
    "fold": SceneEntry(
        fold,
        options_of(fold),
        _sum(FoldTimes._fields),
        "square sheet folded in half, pressed and released (Fig. 3b)",
        walls=_told("two plates that close and retract"),
    ),
    "custom": SceneEntry(
        custom,
        CustomOptions,
        _always(1.0),
        "user-defined sheet, walls and supports, from the tables of a scene file",
        walls=custom_walls,
    ),
}
