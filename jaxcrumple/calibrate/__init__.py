"""Fit parameters of runs to measurements, with derivatives from replays."""

from jaxcrumple.calibrate.experiment import Experiment
from jaxcrumple.calibrate.fit import Fit, Parameter, fit
from jaxcrumple.calibrate.fold import FoldCalibration, calibrate_fold
from jaxcrumple.calibrate.pattern import calibrate_pattern

__all__ = [
    "Experiment",
    "Fit",
    "FoldCalibration",
    "Parameter",
    "calibrate_fold",
    "calibrate_pattern",
    "fit",
]
