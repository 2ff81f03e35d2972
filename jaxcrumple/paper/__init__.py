"""Reproduce the figures of the paper with their runs: `jaxcrumple figure NAME`."""

from jaxcrumple.paper import axial, axial_ensemble, fold, four, gallery, order, radial
from jaxcrumple.paper.base import Ensemble, Figure, make_ensemble, make_figure

FIGURES: dict[str, Figure] = {
    "3b": fold.FIGURE,
    "4": order.FIGURE,
    "5": radial.SNAPSHOTS,
    "6": radial.STEPS,
    "7": gallery.FIGURE,
    "8a": radial.MORPHOLOGY,
    "8b": radial.INSIDE,
    "8c": four.FIGURE,
    "8d": radial.REARRANGEMENT,
    "9": axial.FIGURE,
}

ENSEMBLES: dict[str, Ensemble] = {"9": axial_ensemble.ENSEMBLE}

__all__ = ["ENSEMBLES", "FIGURES", "Ensemble", "Figure", "make_ensemble", "make_figure"]
