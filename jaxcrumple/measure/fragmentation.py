"""Distribution of facet areas, compared with the law of a fragmentation process.

Andrejevic, Lee, Rubinstein & Rycroft, A model for the fragmentation kinetics of crumpled thin sheets, Nature
Communications 12 (2021) 1470. Facets of area x, in units of the sheet area, split at the rate $\\sqrt x$. At
time t their mean is $s = a(a+1)/t^2$, and $\\xi = x/s$ has the density

$$\\phi(\\xi) = \\frac{a(a+1)}{2\\Gamma(a)} [a(a+1)\\xi]^{a/2-1} e^{-\\sqrt{a(a+1)\\xi}}:$$

$\\sqrt{a(a+1)\\xi} = t\\sqrt x$ has the gamma distribution of shape a. For constant a this is the long-time
limit of a process in which a facet splits into $1 + 2/a$ parts, with area fractions from a Dirichlet
distribution of parameter $a/2$. The case a = 2 is a random split in two (McGrady & Ziff, Phys. Rev. Lett. 58
(1987) 892). The growth $a = \\sqrt{t/\\tau}$ is an observation on sheets.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Real
from scipy.stats import expon, gamma, kstest, lognorm

from jaxcrumple._jax.tree import require_numbers

#: $\\tau$ of $a = \\sqrt{t/\\tau}$, dimensionless.
TAU = 24.04


class Maturity(NamedTuple):
    """Degree of fragmentation of a sheet: shape `a` of the law, and time `t` of the process.

    Both are dimensionless, since areas are in units of the sheet area.
    """

    a: float
    t: float


class AreaFit(NamedTuple):
    """Comparison of facet areas with three laws whose parameters come from these areas alone.

    The Kolmogorov-Smirnov distance is the largest difference of cumulative distributions, from 0 to 1. The
    fragmentation and exponential laws have one fitted parameter, the mean area. The log-normal law has two,
    the mean and the variance of the logarithms (maximum likelihood).

    - `facets`: number of areas; `mean`: s, mean area in units of the sheet area.
    - `a`, `t`: shape and time of the fragmentation law with this mean, see `maturity`.
    - `fragmentation`, `exponential`, `lognormal`: distances to the three laws.
    """

    facets: int
    mean: float
    a: float
    t: float
    fragmentation: float
    exponential: float
    lognormal: float


def maturity(mean: float) -> Maturity:
    """Return shape and time of the law for the `mean` facet area s in units of the sheet area, 0 < s <= 1.

    With t = tau a^2 the mean s = a (a + 1) / t^2 gives s tau^2 a^3 = a + 1, which has one positive root. tau
    = 24.04 is that of Andrejevic et al., Nature Communications 12 (2021) 1470.

    **Returns:** a named tuple of the shape `a` and the time `t`, both dimensionless.

    **Raises:** ValueError if `mean` is out of range.
    """
    if not 0 < mean <= 1:
        raise ValueError(f"mean = {mean}; give the mean area divided by the sheet area, > 0 and <= 1")
    roots = np.roots([mean * TAU**2, 0, -1, -1])
    a = float(roots[np.argmax(roots.real)].real)
    return Maturity(a, TAU * a**2)


def area_density(
    xi: Real[ArrayLike, " *points"] | Sequence[float], a: float
) -> Float[np.ndarray, " *points"] | float:
    """Return the density of facets at `xi` > 0, area / mean area, for the fragmentation law of shape `a` > 0.

    With u = a (a + 1) xi it is a (a + 1) / (2 Gamma(a)) u^(a/2 - 1) exp(-sqrt(u)) (Andrejevic et al., Nature
    Communications 12 (2021) 1470).

    **Raises:** ValueError for an `xi` or `a` that is not positive.

    >>> measure.area_density([0.5, 1.0, 2.0], a=2.0).round(4)
    array([0.5308, 0.259 , 0.0939])
    """
    require_numbers("xi", xi, positive=True)
    require_numbers("a", a, positive=True)
    u = np.sqrt(a * (a + 1) * np.asarray(xi, dtype=np.float64))
    return gamma.pdf(u, a) * a * (a + 1) / (2 * u)


def area_cdf(
    xi: Real[ArrayLike, " *points"] | Sequence[float], a: float
) -> Float[np.ndarray, " *points"] | float:
    """Return the fraction of facets up to `xi` times the mean area, for the law of shape `a` > 0.

    It is P(a, sqrt(a (a + 1) xi)) with the regularised lower incomplete gamma function P: the integral of
    `area_density`.

    **Raises:** ValueError for a negative `xi`, or an `a` that is not positive.

    >>> measure.area_cdf([0.5, 1.0, 2.0], a=2.0).round(4)
    array([0.5166, 0.7022, 0.8603])
    """
    require_numbers("xi", xi)
    require_numbers("a", a, positive=True)
    return gamma.cdf(np.sqrt(a * (a + 1) * np.asarray(xi, dtype=np.float64)), a)


def fit_areas(areas: Real[ArrayLike, " facets"] | Sequence[float], sheets: int = 1) -> AreaFit:
    """Compare facet areas with the laws of `AreaFit`.

    **Arguments:** `areas` (k,): all facets of one sheet, or of `sheets` equal sheets, in any unit.

    **Raises:** ValueError unless there are at least two areas, all positive and not all equal, and 1 <=
    `sheets` <= k.
    """
    x = np.asarray(areas, dtype=np.float64)
    if x.ndim != 1 or len(x) < 2 or not np.all((x > 0) & np.isfinite(x)):
        raise ValueError(f"areas of shape {x.shape}; give the positive areas (k,) of two facets or more")
    if np.ptp(x) == 0:
        raise ValueError("all areas are equal, so there is no distribution to compare; give measured areas")
    if not 1 <= sheets <= len(x):
        raise ValueError(f"sheets = {sheets} with {len(x)} facets; give 1 or more, at most one per facet")
    xi, mean = x / x.mean(), sheets / len(x)
    a, t = maturity(mean)
    logs = np.log(xi)
    return AreaFit(
        facets=len(x),
        mean=mean,
        a=a,
        t=t,
        fragmentation=float(kstest(xi, area_cdf, args=(a,)).statistic),
        exponential=float(kstest(xi, expon.cdf).statistic),
        lognormal=float(kstest(xi, lognorm(logs.std(), scale=np.exp(logs.mean())).cdf).statistic),
    )
