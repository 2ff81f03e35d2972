"""Growth laws of the crease length of a repeatedly crumpled sheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from jaxtyping import ArrayLike, Float, Real

#: Growth laws with two constants each, as functions of the cycle n (m,) and of c1 and c2, numbers or (k, 1).
LAWS: dict[str, Callable[..., Float[np.ndarray, "*samples cycles"]]] = {
    "logarithmic": lambda n, c1, c2: c1 * np.log1p(c2 * n),
    "linear": lambda n, c1, c2: c1 + c2 * n,
    "power": lambda n, c1, c2: c1 * n**c2,
}

_CONSTANTS = 2
_DECADES = 6  # search range of c2 of the logarithmic law, on both sides of 1 / last cycle
_STEEPEST = 10.0  # largest exponent of the power law
# Grids of a search of c2, and their points: 16^-12 of the range is the resolution of float64.
_GRIDS, _POINTS = 12, 33


def fit_growth(
    cycle: Real[ArrayLike, " cycles"] | Sequence[float], length: Real[ArrayLike, " cycles"] | Sequence[float]
) -> pd.DataFrame:
    """Fit three laws to the crease `length` (m,) in m after each `cycle` (m,), from 1, by least squares.

    The laws are "logarithmic", c1 ln(1 + c2 n) (Gottesman et al., Communications Physics 1 (2018) 70),
    "linear", c1 + c2 n, and "power", c1 n^c2.

    **Returns:** one row per law, the best first, with `c1`, `c2`, the residual sum of squares `rss` in m2,
    and `aicc`, Akaike's information criterion for small samples, m ln(rss/m) + 2k + 2k (k+1) / (m-k-1) with k
    = 3: two constants and the variance (Hurvich & Tsai, Biometrika 76 (1989) 297). `aicc` is NaN for m < 5,
    where it is undefined. All laws have two constants, so `aicc` and `rss` rank them equally. If the lengths
    lie on a line through zero, c2 of the logarithmic law goes to its lower limit and only c1 c2 is
    meaningful.

    **Raises:** ValueError for fewer than three different cycles (any law fits two points exactly), cycles
    below 1, lengths that are not positive, or different shapes.

    >>> table = measure.fit_growth([1, 2, 3, 5, 8], [1.0, 1.6, 2.1, 2.7, 3.3])
    >>> print(table[["c1", "c2", "rss"]].round(3))
                    c1     c2    rss
    law
    logarithmic  1.573  0.905  0.003
    power        1.113  0.533  0.034
    linear       0.938  0.316  0.172
    """
    n, y = checked_growth(cycle, length)
    rows = {law: (float(c1[0]), float(c2[0])) for law, (c1, c2) in fit_laws(n, y[None]).items()}
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["c1", "c2"])
    table.index.name = "law"
    table["rss"] = [float(np.sum((LAWS[law](n, c1, c2) - y) ** 2)) for law, (c1, c2) in rows.items()]
    table["aicc"] = [_aicc(rss, y) for rss in table["rss"]]
    return table.sort_values("rss")


def fit_laws(
    n: Float[np.ndarray, " cycles"], y: Float[np.ndarray, "samples cycles"]
) -> dict[str, tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]]:
    """Fit each law to each row of `y`; return c1 and c2 of all rows."""
    return {"logarithmic": _logarithmic(n, y), "linear": _linear(n, y), "power": _power(n, y)}


def _logarithmic(
    n: Float[np.ndarray, " cycles"], y: Float[np.ndarray, "samples cycles"]
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    limit = _DECADES * np.log(10.0)
    c1, q = _separable(y, lambda q: np.log1p(np.exp(q) * n / n.max()), (-limit, limit))
    return c1, np.exp(q) / n.max()


def _linear(
    n: Float[np.ndarray, " cycles"], y: Float[np.ndarray, "samples cycles"]
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    slope, start = np.polyfit(n, y.T, 1)
    return start, slope


def _power(
    n: Float[np.ndarray, " cycles"], y: Float[np.ndarray, "samples cycles"]
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    return _separable(y, lambda q: n**q, (-_STEEPEST, _STEEPEST))


def _separable(
    y: Float[np.ndarray, "samples cycles"],
    basis: Callable[[Float[np.ndarray, "samples points 1"]], Float[np.ndarray, "samples points cycles"]],
    bounds: tuple[float, float],
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    """Minimise |`c * basis(q) - y`|^2 for each row of `y` with c eliminated (variable projection), on grids
    of q of which each spans two intervals of the one before; return c and q."""
    low, high = (np.full(len(y), bound) for bound in bounds)
    row = np.arange(len(y))
    for _ in range(_GRIDS):
        q = np.linspace(low, high, _POINTS, axis=-1)
        curves = basis(q[..., None])
        c = np.einsum("spc,sc->sp", curves, y) / np.sum(curves**2, axis=-1)
        best = np.argmin(np.sum((c[..., None] * curves - y[:, None]) ** 2, axis=-1), axis=-1)
        low, high = q[row, np.maximum(best - 1, 0)], q[row, np.minimum(best + 1, _POINTS - 1)]
    return c[row, best], q[row, best]


def _aicc(rss: float, y: Float[np.ndarray, " cycles"]) -> float:
    m, k = len(y), _CONSTANTS + 1
    if m <= k + 1:
        return float("nan")
    variance = max(rss / m, (np.finfo(float).eps * np.abs(y).max()) ** 2)  # >= rounding error
    return float(m * np.log(variance) + 2 * k + 2 * k * (k + 1) / (m - k - 1))


def checked_growth(
    cycle: Real[ArrayLike, " cycles"] | Sequence[float], length: Real[ArrayLike, " cycles"] | Sequence[float]
) -> tuple[Float[np.ndarray, " cycles"], Float[np.ndarray, " cycles"]]:
    """Return cycles and lengths as arrays.

    **Raises:** ValueError as `fit_growth`.
    """
    n, y = np.asarray(cycle, dtype=np.float64), np.asarray(length, dtype=np.float64)
    if n.ndim != 1 or n.shape != y.shape:
        raise ValueError(f"cycle has shape {n.shape}, length {y.shape}; give one length for each cycle")
    if len(np.unique(n)) < _CONSTANTS + 1:
        raise ValueError(f"{len(np.unique(n))} different cycles; give three or more, laws have two constants")
    if not np.all((n >= 1) & np.isfinite(n)) or not np.all((y > 0) & np.isfinite(y)):
        raise ValueError("cycles count from 1 and lengths are positive; leave out the new sheet, n = 0")
    return n, y
