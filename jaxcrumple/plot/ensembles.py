"""Plot the growth of the crease length of an ensemble of sheets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import ArrayLike, Float, Real
from matplotlib.axes import Axes

from jaxcrumple.measure.ensembles import EnsembleGrowth, ensemble_growth
from jaxcrumple.measure.growth import LAWS
from jaxcrumple.plot.facets import FAINT, MEASURED, THEORY
from jaxcrumple.plot.figure import new_figure, save_figure

# Opacity of bands, and of the lines of single sheets.
BAND, SHEET = 0.25, 0.35
OTHERS = {"power": "-.", "linear": ":"}


def plot_ensemble_growth(
    cycle: Real[ArrayLike, " cycles"],
    length: Real[ArrayLike, "sheets cycles"],
    *,
    confidence: float = 0.95,
    caption: str = "",
    path: str | Path,
) -> Path:
    """Plot the crease length in m of many sheets against the cycle number, and its laws (Fig. 9b).

    Each sheet is a thin line. Above: the mean with its bootstrap interval, and the laws fitted to it, the
    logarithmic one with the limits of its band. Below: the mean minus the logarithmic law, in mm, with its
    interval.

    **Arguments:** `cycle` (m,), `length` (k, m), `confidence`: as for `measure.ensemble_growth`; `caption`:
    text above the figure.

    **Raises:** ValueError for input that `ensemble_growth` refuses or an unknown extension of `path`,
    `RunDirectoryError` if `path` cannot be written.
    """
    found = ensemble_growth(cycle, length, confidence=confidence)
    figure = new_figure((5.6, 6.2), caption)
    above, below = figure.subplots(2, sharex=True, height_ratios=[3, 1])
    above.plot(found.cycles.index, np.transpose(length), color=MEASURED, alpha=SHEET, linewidth=0.7)
    _draw_laws(above, found, confidence)
    _draw_means(above, found.cycles, len(np.asarray(length)), confidence)
    above.set_ylabel("crease length [m]")
    above.legend(frameon=False, fontsize=8)
    _draw_residual(below, found.cycles)
    for axes in (above, below):
        axes.set_xticks(found.cycles.index)
        axes.grid(alpha=0.3)
    figure.align_ylabels()
    return save_figure(figure, path)


def _draw_laws(axes: Axes, found: EnsembleGrowth, confidence: float) -> None:
    """Draw the band of the logarithmic law, and all laws; the legend tells which fits how many resamples."""
    fine = np.linspace(found.cycles.index.min(), found.cycles.index.max(), 200)
    curves = LAWS["logarithmic"](fine, found.constants[:, :1], found.constants[:, 1:])
    low, high = np.quantile(curves, [0.5 * (1 - confidence), 0.5 * (1 + confidence)], axis=0)
    axes.plot(fine, np.transpose([low, high]), color=THEORY, linewidth=0.7)
    for law, (c1, c2, rss, aicc, best) in found.laws[["c1", "c2", "rss", "aicc", "best"]].iterrows():
        fit = f"AICc {aicc:.1f}" if np.isfinite(aicc) else f"rms {_rms(rss, found):.3g} mm"
        color, style = (FAINT, OTHERS[law]) if law in OTHERS else (THEORY, "--")
        label = f"{law}: {fit}, best in {100 * best:.0f} % of resamples"
        axes.plot(fine, LAWS[law](fine, c1, c2), style, color=color, label=label)


def _rms(rss: float, found: EnsembleGrowth) -> float:
    """Return the root mean square of residuals in mm."""
    return float(1e3 * np.sqrt(rss / len(found.cycles)))


def _draw_means(axes: Axes, cycles: pd.DataFrame, sheets: int, confidence: float) -> None:
    axes.fill_between(cycles.index, cycles["low"], cycles["high"], color=MEASURED, alpha=BAND, linewidth=0)
    label = f"mean of {sheets} sheets, {100 * confidence:g} % interval"
    axes.errorbar(
        cycles.index,
        cycles["mean"],
        _bars(cycles, "mean", "low", "high"),
        fmt="o",
        color=MEASURED,
        label=label,
    )


def _draw_residual(axes: Axes, cycles: pd.DataFrame) -> None:
    bars = _bars(cycles, "residual", "residual_low", "residual_high")
    axes.axhline(0.0, color=THEORY, linestyle="--", linewidth=1.0)
    axes.errorbar(cycles.index, 1e3 * cycles["residual"], 1e3 * bars, fmt="o", color=MEASURED)
    axes.set(xlabel="cycle $n$", ylabel="residual of the\nlogarithm [mm]")


def _bars(cycles: pd.DataFrame, middle: str, low: str, high: str) -> Float[np.ndarray, "2 cycles"]:
    """Return the lengths of error bars below and above; the limits need not enclose the middle."""
    lengths = [cycles[middle] - cycles[low], cycles[high] - cycles[middle]]
    return np.maximum(np.array(lengths), 0.0)
