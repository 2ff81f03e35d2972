"""Scenes that can be run by name, with their options."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from jaxcrumple.scenes.radial import Setup, radial


class SceneEntry(NamedTuple):
    """A scene's function, its options, the time it ends by default (s), and one line about it."""

    build: Callable[..., Setup]
    options: type[BaseModel]
    t_end: float
    summary: str


class RadialOptions(BaseModel):
    """Options of `radial`; lengths in m, speed in m/s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: float = Field(0.1, gt=0)
    radius: float = Field(0.071, gt=0)
    speed: float = Field(0.01, gt=0)
    imperfection: float = Field(25e-6, ge=0)
    sweeps: int = Field(100, ge=0)
    damping: Literal["central", "paper"] = "central"


SCENES: dict[str, SceneEntry] = {
    "radial": SceneEntry(
        radial,
        RadialOptions,
        2.6,
        "square sheet in a sphere that shrinks from 7.1 cm at 1 cm/s (Figs. 5, 6, 8)",
    )
}
