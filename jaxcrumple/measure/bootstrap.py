"""Bootstrap: confidence intervals from a sample alone.

Efron & Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, chapter 14.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.stats import bootstrap

#: Resamples of an interval, and seed of their random numbers.
RESAMPLES, SEED = 2000, 0


def mean_interval(
    values: Float[np.ndarray, "samples columns"], confidence: float
) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " columns"]]:
    """Return the limits of the bias-corrected and accelerated (BCa) bootstrap interval of the mean.

    A column of equal values has an interval of length zero. One sample has none: the limits are NaN.
    """
    mean = values.mean(axis=0)
    if len(values) < 2:
        return np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    low, high = mean.copy(), mean.copy()
    spread = np.ptp(values, axis=0) > 0
    if np.any(spread):
        found = bootstrap(
            (values[:, spread],),
            np.mean,
            n_resamples=RESAMPLES,
            axis=0,
            confidence_level=confidence,
            random_state=np.random.default_rng(SEED),
        ).confidence_interval
        low[spread], high[spread] = found.low, found.high
    return low, high


def check_confidence(confidence: float) -> None:
    """Refuse a probability that is not between 0 and 1.

    **Raises:** ValueError that names it.
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence = {confidence!r} must lie between 0 and 1, such as 0.95.")
