"""Rebuild the walls of a run for its pictures."""

from __future__ import annotations

from pydantic import ValidationError

from jaxcrumple.io.run import Run
from jaxcrumple.plot.sheet import NO_WALLS, Walls
from jaxcrumple.run.config import RunConfig
from jaxcrumple.scenes.catalogue import SCENES

# Options of scenes that do not move walls, at values for which a scene is built quickly.
QUICK = {"contact": None, "contact_range": None, "contact_level": None, "sweeps": 0}


def walls_of(run: Run, frame: int) -> Walls:
    """Return the walls of a run at the time of a frame; none for a scene that its options do not tell."""
    if run.config.get("scene") not in SCENES:
        return NO_WALLS
    try:
        config = RunConfig(**run.config)
        options = {**config.options, **{name: QUICK[name] for name in QUICK if name in config.options}}
        scene = config.model_copy(update={"options": options}).build().scene
    except (ValidationError, ValueError, TypeError):
        # A run of an older version.
        return NO_WALLS
    return Walls([wall.shape for wall in scene.walls], float(run.t[frame]))
