"""Rebuild the walls of a run for its pictures."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence

import jax

from jaxcrumple.io.run import Run
from jaxcrumple.model.walls import AbstractShape
from jaxcrumple.run.config import RunConfig
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.scenes.functions import is_function

# Options of scenes that do not move walls, at values for which a scene is built quickly.
QUICK = {"contact": None, "contact_range": None, "contact_level": None, "sweeps": 0}


def wall_shapes(run: Run) -> Sequence[AbstractShape]:
    """Return the walls of a run; none for a scene that its configuration does not tell."""
    if run.scene is not None:
        return [wall.shape for wall in run.scene.walls]
    name = run.config.get("scene")
    return _shapes(json.dumps(run.config)) if name in SCENES or is_function(name) else ()


@functools.lru_cache(maxsize=4)
def _shapes(text: str) -> Sequence[AbstractShape]:
    """Return the walls of a configuration as JSON, which all frames of its run share."""
    try:
        config = RunConfig(**json.loads(text))
        options = {**config.options, **{name: QUICK[name] for name in QUICK if name in config.options}}
        # Scenes need double precision, which a notebook that draws pictures may not have set.
        with jax.enable_x64(True):
            walls = config.model_copy(update={"options": options}).build().scene.walls
    except (ValueError, TypeError, ImportError):
        # A run of an older version, or of a function that is not here any more.
        return ()
    return [wall.shape for wall in walls]
