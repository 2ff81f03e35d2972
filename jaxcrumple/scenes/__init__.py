"""Ready-made scenes: the experiments of the paper, further tests of crumpling, and two snap-throughs."""

from jaxcrumple.scenes.arch import arch
from jaxcrumple.scenes.axial import axial, cylindrical
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.catalogue import SCENES, SceneEntry
from jaxcrumple.scenes.conical import conical
from jaxcrumple.scenes.custom import custom
from jaxcrumple.scenes.dcone import dcone, free_sector
from jaxcrumple.scenes.fold import fold, fold_angle
from jaxcrumple.scenes.radial import radial, unload
from jaxcrumple.scenes.ridge import ridge, ridge_curvature
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.snap import Drop, energy_drop, relaxed_drop
from jaxcrumple.scenes.stamping import shell, stamping

__all__ = [
    "SCENES",
    "Drop",
    "SceneEntry",
    "Setup",
    "arch",
    "axial",
    "cap",
    "conical",
    "custom",
    "cylindrical",
    "dcone",
    "energy_drop",
    "fold",
    "fold_angle",
    "free_sector",
    "radial",
    "relaxed_drop",
    "ridge",
    "ridge_curvature",
    "shell",
    "stamping",
    "unload",
]
