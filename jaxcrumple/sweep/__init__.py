"""A scene over a grid of its numbers, on all of a device, of a machine, or of many."""

from jaxcrumple.sweep.sweep import sweep

__all__ = ["sweep"]
