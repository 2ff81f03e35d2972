"""Scenes by name: the paper's experiments, and two that snap through."""

from jaxcrumple.scenes.arch import arch
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.catalogue import SCENES, SceneEntry
from jaxcrumple.scenes.custom import custom
from jaxcrumple.scenes.fold import fold, fold_angle
from jaxcrumple.scenes.radial import radial
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.snap import Drop, energy_drop, relaxed_drop

__all__ = [
    "SCENES",
    "Drop",
    "SceneEntry",
    "Setup",
    "arch",
    "cap",
    "custom",
    "energy_drop",
    "fold",
    "fold_angle",
    "radial",
    "relaxed_drop",
]
