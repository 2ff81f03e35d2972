"""The paper's experiments, by name."""

from jaxcrumple.scenes.catalogue import SCENES, SceneEntry
from jaxcrumple.scenes.radial import Setup, radial

__all__ = ["SCENES", "SceneEntry", "Setup", "radial"]
