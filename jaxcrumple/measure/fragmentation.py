"""Areas of facets against the law of a fragmentation process.

Andrejevic, Lee, Rubinstein & Rycroft, A model for the fragmentation kinetics of crumpled thin sheets, Nature
Communications 12 (2021) 1470. Facets of area x, in units of the sheet's, split at the rate $\\sqrt x$. At
time t their mean is $s = a(a+1)/t^2$, and $\\xi = x/s$ has the density

$$\\phi(\\xi) = \\frac{a(a+1)}{2\\Gamma(a)} [a(a+1)\\xi]^{a/2-1} e^{-\\sqrt{a(a+1)\\xi}}:$$

$\\sqrt{a(a+1)\\xi} = t\\sqrt x$ has the gamma distribution of shape a. At constant a this is what comes
about in the long run where a facet splits into $1 + 2/a$ with areas in Dirichlet proportions of parameter
$a/2$; a = 2 is a split in two at random (McGrady & Ziff, Phys. Rev. Lett. 58 (1987) 892). That $a =
\\sqrt{t/\\tau}$ grows is an observation on sheets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import expon, gamma, kstest, lognorm

from jaxcrumple.mesh.mesh import FloatArray

#: $\\tau$ of $a = \\sqrt{t/\\tau}$, dimensionless.
TAU = 24.04


class Maturity(NamedTuple):
    """How far a sheet is fragmented. Dimensionless, as areas are in units of the sheet's."""

    a: float  # shape of the law
    t: float  # time of the process


class AreaFit(NamedTuple):
    """Areas of facets against three laws that use nothing but these areas.

    Kolmogorov-Smirnov distances are largest differences of cumulative distributions, from 0 to 1. The
    fragmentation law and the exponential one take one number from the areas, their mean; the log-normal law
    takes two, the mean and the variance of their logarithms (maximum likelihood).
    """

    facets: int  # number of areas
    mean: float  # s, mean area in units of a sheet's
    a: float  # shape of the fragmentation law with this mean
    t: float  # its time
    fragmentation: float  # distance to that law
    exponential: float  # distance to the exponential law of the same mean
    lognormal: float  # distance to the log-normal law of greatest likelihood


def maturity(mean: float) -> Maturity:
    """Shape and time of the law for the `mean` area s of the facets in units of the sheet's, 0 < s <= 1.

    With $t = \\tau a^2$ the mean $s = a(a+1)/t^2$ gives $s \\tau^2 a^3 = a + 1$, which has one positive root.

    **Raises:** ValueError if `mean` is out of range.
    """
    if not 0 < mean <= 1:
        raise ValueError(f"mean = {mean}; give the mean area over the area of the sheet, above 0, at most 1")
    roots = np.roots([mean * TAU**2, 0, -1, -1])
    a = float(roots[np.argmax(roots.real)].real)
    return Maturity(a, TAU * a**2)


def area_density(xi: ArrayLike, a: float) -> FloatArray:
    """Density $\\phi$ of areas `xi` > 0 over their mean, for the law of shape `a` > 0, dimensionless."""
    u = np.sqrt(a * (a + 1) * np.asarray(xi, dtype=np.float64))
    return gamma.pdf(u, a) * a * (a + 1) / (2 * u)


def area_cdf(xi: ArrayLike, a: float) -> FloatArray:
    """Part $P(a, \\sqrt{a(a+1)\\xi})$ of facets of at most `xi` times the mean area, for shape `a` > 0."""
    return gamma.cdf(np.sqrt(a * (a + 1) * np.asarray(xi, dtype=np.float64)), a)


def fit_areas(areas: ArrayLike, sheets: int = 1) -> AreaFit:
    """All facets' `areas` (k,) of one sheet, or of several `sheets` alike, in m2 or any other unit, against
    the laws of `AreaFit`.

    **Raises:** ValueError unless there are at least two areas, all positive, and not all equal, of no more
    sheets than that.
    """
    x = np.asarray(areas, dtype=np.float64)
    if x.ndim != 1 or len(x) < 2 or not np.all((x > 0) & np.isfinite(x)):
        raise ValueError(f"areas of shape {x.shape}; give the positive areas (k,) of two facets or more")
    if np.ptp(x) == 0:
        raise ValueError("all areas are equal, which leaves no distribution to compare; give measured ones")
    if not 1 <= sheets <= len(x):
        raise ValueError(f"sheets = {sheets} with {len(x)} facets; give how many sheets these are of")
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
