"""Run a scene over a grid of option values, on a device, on one machine, or on a cluster."""

from jaxcrumple.sweep.campaign import campaign
from jaxcrumple.sweep.cases import grid
from jaxcrumple.sweep.sweep import sweep

__all__ = ["campaign", "grid", "sweep"]
