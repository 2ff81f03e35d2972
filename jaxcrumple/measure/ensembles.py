"""Growth of the crease length of an ensemble of sheets: mean, laws, and their bootstrap intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import ArrayLike, Float, Real

from jaxcrumple.measure.bootstrap import RESAMPLES, SEED, check_confidence, mean_interval
from jaxcrumple.measure.growth import LAWS, checked_growth, fit_growth, fit_laws


class EnsembleGrowth(NamedTuple):
    """Growth of the crease length of an ensemble of sheets. Lengths are in m.

    - `cycles`: a row for each cycle. `mean` and standard deviation `std` of the sheets; `low` and `high`,
      limits of the interval of the mean; `law`, `law_low`, `law_high`: the logarithmic law of the mean, and
      limits of its band; `residual`, `residual_low`, `residual_high`: mean minus law, with limits.
    - `laws`: the table of `fit_growth` for the mean, with limits `c1_low`, `c1_high`, `c2_low`, `c2_high` of
      the constants and `best`, the share of the resamples that a law fits best.
    - `constants` (resamples, 2): c1 and c2 of the logarithmic law of each resample.
    """

    cycles: pd.DataFrame
    laws: pd.DataFrame
    constants: Float[np.ndarray, "resamples 2"]


def ensemble_growth(
    cycle: Real[ArrayLike, " cycles"] | Sequence[float],
    length: Real[ArrayLike, "sheets cycles"] | Sequence[Sequence[float]],
    *,
    confidence: float = 0.95,
) -> EnsembleGrowth:
    """Fit the laws of `fit_growth` to the mean crease `length` (k, m) of k sheets after each `cycle` (m,).

    Lengths are in m. Intervals hold the truth with the probability `confidence`. Those of the mean are
    bias-corrected and accelerated (BCa). The others are the quantiles of 2000 bootstrap resamples: each draws
    k sheets with replacement and fits the laws to their mean, so the lengths of one sheet stay together. The
    random numbers are the same in each call. A residual whose interval excludes zero contradicts the
    logarithmic law.

    **Raises:** ValueError for one sheet, which has no spread, a `confidence` that is not between 0 and 1, or
    what `fit_growth` refuses.

    >>> cycle = np.arange(1, 6)
    >>> length = np.outer([0.9, 1.0, 1.1, 1.2], np.log1p(0.5 * cycle))
    >>> table = measure.ensemble_growth(cycle, length).cycles
    >>> print(table[["mean", "std", "low", "high", "law"]].round(2))
           mean   std   low  high   law
    cycle
    1      0.43  0.05  0.39  0.47  0.43
    2      0.73  0.09  0.66  0.80  0.73
    3      0.96  0.12  0.87  1.05  0.96
    4      1.15  0.14  1.04  1.26  1.15
    5      1.32  0.16  1.19  1.44  1.32
    """
    check_confidence(confidence)
    sheets = np.asarray(length, dtype=np.float64)
    if sheets.ndim != 2 or len(sheets) < 2:
        raise ValueError(f"length has shape {sheets.shape}; give a row for each of two sheets or more.")
    for one in sheets:
        n, _ = checked_growth(cycle, one)
    draws = np.random.default_rng(SEED).integers(len(sheets), size=(RESAMPLES, len(sheets)))
    means = sheets[draws].mean(axis=1)
    fits = fit_laws(n, means)
    laws = _laws(fit_growth(n, sheets.mean(axis=0)), fits, n, means, confidence)
    law = LAWS["logarithmic"](n, *laws.loc["logarithmic", ["c1", "c2"]])
    curves = LAWS["logarithmic"](n, *(c[:, None] for c in fits["logarithmic"]))
    cycles = {
        **_means(sheets, confidence),
        "law": law,
        **_limits("law", curves, confidence),
        "residual": sheets.mean(axis=0) - law,
        **_limits("residual", means - curves, confidence),
    }
    index = pd.Index(np.asarray(cycle), name="cycle")
    return EnsembleGrowth(pd.DataFrame(cycles, index), laws, np.column_stack(fits["logarithmic"]))


def _means(
    sheets: Float[np.ndarray, "sheets cycles"], confidence: float
) -> dict[str, Float[np.ndarray, " cycles"]]:
    """Return mean, standard deviation and limits of the mean after each cycle."""
    low, high = mean_interval(sheets, confidence)
    return {"mean": sheets.mean(axis=0), "std": sheets.std(axis=0, ddof=1), "low": low, "high": high}


def _laws(
    laws: pd.DataFrame,
    fits: dict[str, tuple[Float[np.ndarray, " resamples"], Float[np.ndarray, " resamples"]]],
    n: Float[np.ndarray, " cycles"],
    means: Float[np.ndarray, "resamples cycles"],
    confidence: float,
) -> pd.DataFrame:
    """Append limits of the constants to the table of laws, and the share of resamples that each fits best."""
    c1, c2 = (np.column_stack([fits[law][constant] for law in laws.index]) for constant in (0, 1))
    curves = [LAWS[law](n, *(c[:, None] for c in fits[law])) for law in laws.index]
    first = np.argmin([np.sum((curve - means) ** 2, axis=1) for curve in curves], axis=0)
    best = np.bincount(first, minlength=len(laws)) / len(means)
    return laws.assign(**_limits("c1", c1, confidence), **_limits("c2", c2, confidence), best=best)


def _limits(
    name: str, values: Float[np.ndarray, "resamples columns"], confidence: float
) -> dict[str, Float[np.ndarray, " columns"]]:
    """Return the limits between which the share `confidence` of the resamples lies, by column name."""
    low, high = np.quantile(values, [0.5 * (1 - confidence), 0.5 * (1 + confidence)], axis=0)
    return {f"{name}_low": low, f"{name}_high": high}
