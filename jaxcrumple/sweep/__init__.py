"""A scene over a grid of its numbers, on all of a device, of a machine, or of many."""

from jaxcrumple.sweep.campaign import campaign
from jaxcrumple.sweep.cases import grid
from jaxcrumple.sweep.sweep import sweep

__all__ = ["campaign", "grid", "sweep"]
