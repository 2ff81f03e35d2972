"""Growth laws of the crease length of a repeatedly crumpled sheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from jaxtyping import ArrayLike, Float, Real
from scipy.optimize import least_squares

#: Growth laws with two constants each, as functions of the cycle n, c1 and c2.
LAWS: dict[str, Callable[[Float[np.ndarray, " cycles"], float, float], Float[np.ndarray, " cycles"]]] = {
    "logarithmic": lambda n, c1, c2: c1 * np.log1p(c2 * n),
    "linear": lambda n, c1, c2: c1 + c2 * n,
    "power": lambda n, c1, c2: c1 * n**c2,
}

_CONSTANTS = 2
_DECADES = 6  # search range of c2 of the logarithmic law, on both sides of 1 / last cycle
_STEEPEST = 10.0  # largest exponent of the power law


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
    n, y = _checked(cycle, length)
    rows = {"logarithmic": _logarithmic(n, y), "linear": _linear(n, y), "power": _power(n, y)}
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["c1", "c2"])
    table.index.name = "law"
    table["rss"] = [float(np.sum((LAWS[law](n, c1, c2) - y) ** 2)) for law, (c1, c2) in rows.items()]
    table["aicc"] = [_aicc(rss, y) for rss in table["rss"]]
    return table.sort_values("rss")


def _logarithmic(n: Float[np.ndarray, " cycles"], y: Float[np.ndarray, " cycles"]) -> tuple[float, float]:
    limit = _DECADES * np.log(10.0)
    c1, q = _separable(n, y, lambda q: np.log1p(np.exp(q) * n / n.max()), (-limit, limit))
    return c1, float(np.exp(q) / n.max())


def _linear(n: Float[np.ndarray, " cycles"], y: Float[np.ndarray, " cycles"]) -> tuple[float, float]:
    slope, start = np.polyfit(n, y, 1)
    return float(start), float(slope)


def _power(n: Float[np.ndarray, " cycles"], y: Float[np.ndarray, " cycles"]) -> tuple[float, float]:
    return _separable(n, y, lambda q: n**q, (-_STEEPEST, _STEEPEST))


def _separable(
    n: Float[np.ndarray, " cycles"],
    y: Float[np.ndarray, " cycles"],
    basis: Callable[[float], Float[np.ndarray, " cycles"]],
    bounds: tuple[float, float],
) -> tuple[float, float]:
    """Minimise |`c * basis(q) - y`|^2 with c eliminated (variable projection); return c and q."""

    def factor(q: float) -> float:
        return float(basis(q) @ y / (basis(q) @ basis(q)))

    def residual(q: Float[np.ndarray, " 1"]) -> Float[np.ndarray, " cycles"]:
        return (factor(q[0]) * basis(q[0]) - y) / np.linalg.norm(y)

    starts = np.linspace(*bounds, 9)[1:-1]
    fits = [least_squares(residual, [q], bounds=bounds, xtol=1e-14, ftol=1e-14, gtol=1e-14) for q in starts]
    q = float(min(fits, key=lambda fit: fit.cost).x[0])
    return factor(q), q


def _aicc(rss: float, y: Float[np.ndarray, " cycles"]) -> float:
    m, k = len(y), _CONSTANTS + 1
    if m <= k + 1:
        return float("nan")
    variance = max(rss / m, (np.finfo(float).eps * np.abs(y).max()) ** 2)  # >= rounding error
    return float(m * np.log(variance) + 2 * k + 2 * k * (k + 1) / (m - k - 1))


def _checked(
    cycle: Real[ArrayLike, " cycles"] | Sequence[float], length: Real[ArrayLike, " cycles"] | Sequence[float]
) -> tuple[Float[np.ndarray, " cycles"], Float[np.ndarray, " cycles"]]:
    n, y = np.asarray(cycle, dtype=np.float64), np.asarray(length, dtype=np.float64)
    if n.ndim != 1 or n.shape != y.shape:
        raise ValueError(f"cycle has shape {n.shape}, length {y.shape}; give one length for each cycle")
    if len(np.unique(n)) < _CONSTANTS + 1:
        raise ValueError(f"{len(np.unique(n))} different cycles; give three or more, laws have two constants")
    if not np.all((n >= 1) & np.isfinite(n)) or not np.all((y > 0) & np.isfinite(y)):
        raise ValueError("cycles count from 1 and lengths are positive; leave out the new sheet, n = 0")
    return n, y
