"""Laws of facet areas and of the growth of creases, against processes and constants that are known."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import kstest

from jaxcrumple import measure
from jaxcrumple.measure.growth import LAWS


@pytest.mark.parametrize("a", [0.3, 0.66, 1.0, 1.7, 4.0])
def test_density_has_unit_mass_and_mean_and_the_stated_distribution(a):
    # In u = sqrt(xi) the integrands have no pole for a > 0.5, and an integrable one below.
    def moment(k, top):
        return quad(lambda u: measure.area_density(u * u, a) * u ** (2 * k) * 2 * u, 0, top, limit=200)[0]

    assert moment(0, 60) == pytest.approx(1, abs=1e-6)
    assert moment(1, 60) == pytest.approx(1, abs=1e-6)
    for xi in (0.1, 1.0, 5.0):
        assert measure.area_cdf(xi, a) == pytest.approx(moment(0, np.sqrt(xi)), abs=1e-6)


def test_density_is_the_printed_formula():
    # a = 2: Gamma(2) = 1, so phi = 3 exp(-sqrt(6 xi)); a = 1: phi = (2 xi)^(-1/2) exp(-sqrt(2 xi)).
    xi = np.array([0.01, 0.5, 3.0])
    assert measure.area_density(xi, 2.0) == pytest.approx(3 * np.exp(-np.sqrt(6 * xi)))
    assert measure.area_density(xi, 1.0) == pytest.approx(np.exp(-np.sqrt(2 * xi)) / np.sqrt(2 * xi))


@pytest.mark.parametrize("mean", [1.0, 0.1, 0.01, 1e-3, 1e-5])
def test_maturity_solves_both_relations(mean):
    a, t = measure.maturity(mean)
    assert a == pytest.approx(np.sqrt(t / 24.04), rel=1e-12)
    assert a * (a + 1) / t**2 == pytest.approx(mean, rel=1e-12)


def fragmented(pieces, t_end, seed, sheets):
    """Areas at t_end of pieces of unit sheets that split at the rate sqrt(x) in Dirichlet proportions."""
    rng = np.random.default_rng(seed)
    area, t, done = np.ones(sheets), np.zeros(sheets), []
    while len(area):
        t = t + rng.exponential(1 / np.sqrt(area))
        done.append(area[t >= t_end])
        area, t = area[t < t_end], t[t < t_end]
        shares = rng.dirichlet(np.full(pieces, 1 / (pieces - 1)), len(area))
        area, t = (area[:, None] * shares).ravel(), np.repeat(t, pieces)
    return np.concatenate(done)


@pytest.mark.parametrize("pieces", [2, 3, 4])
def test_law_is_what_a_process_of_its_rate_leaves(pieces):
    """Splits into m = 1 + 2/a pieces at the rate sqrt(x): mean a (a + 1)/t^2 and P(a, t sqrt(x)), t large.

    Moments M_k = sum of x^k obey M_k' = ((a + 2)/(a + 2 k) - 1) M_{k + 1/2} with M_1 = 1, so that the number
    of pieces is 1 + 2 t/a + t^2/(a (a + 1)).
    """
    a, t, sheets = 2 / (pieces - 1), 60.0, 60
    areas = fragmented(pieces, t, seed=pieces, sheets=sheets)
    assert areas.sum() == pytest.approx(sheets)
    assert len(areas) / sheets == pytest.approx(1 + 2 * t / a + t**2 / (a * (a + 1)), rel=0.05)
    assert kstest(areas / areas.mean(), measure.area_cdf, args=(a,)).statistic < 0.02
    for other in (0.6 * a, 1.6 * a):
        assert kstest(areas / areas.mean(), measure.area_cdf, args=(other,)).statistic > 0.04


def sample(law, k, rng):
    if law == "exponential":
        return rng.exponential(size=k)
    if law == "lognormal":
        return rng.lognormal(0.3, 0.8, size=k)
    return rng.gamma(measure.maturity(1 / k).a, size=k) ** 2


@pytest.mark.parametrize("law", ["fragmentation", "exponential", "lognormal"])
def test_fit_prefers_the_law_that_made_the_areas(law):
    k = 400
    fit = measure.fit_areas(3e-6 * sample(law, k, np.random.default_rng(1)))
    distances = {name: getattr(fit, name) for name in ("fragmentation", "exponential", "lognormal")}
    assert min(distances, key=distances.get) == law
    assert distances[law] < 1.36 / np.sqrt(k)  # 5 % point of Kolmogorov's distribution, for given constants
    assert fit.facets == k and fit.mean == pytest.approx(1 / k)
    assert (fit.a, fit.t) == measure.maturity(1 / k)


def test_distance_by_hand():
    """Of {1/2, 3/2} to the exponential: the steps lie at F = 1 - e^-.5 = 0.393 and 1 - e^-1.5 = 0.777."""
    assert measure.fit_areas([1.0, 3.0]).exponential == pytest.approx(1 - np.exp(-0.5))


def test_sheets_alike_are_as_one_sheet():
    areas = [1.0, 3.0, 5.0]
    assert measure.fit_areas(2 * areas, sheets=2) == measure.fit_areas(areas)._replace(facets=6)
    with pytest.raises(ValueError, match="sheets = 4 with 3 facets"):
        measure.fit_areas(areas, sheets=4)


def test_areas_that_say_nothing_are_refused():
    for areas in ([1.0], [[1.0, 2.0]], [1.0, 0.0], [1.0, np.nan]):
        with pytest.raises(ValueError, match="two facets or more"):
            measure.fit_areas(areas)
    with pytest.raises(ValueError, match="all areas are equal"):
        measure.fit_areas([2.0, 2.0, 2.0])
    for mean in (0.0, 1.1, np.nan):
        with pytest.raises(ValueError, match="mean area divided by the sheet area"):
            measure.maturity(mean)


CONSTANTS = {"logarithmic": (0.52, 0.37), "linear": (0.4, 0.11), "power": (0.8, 0.45)}


@pytest.mark.parametrize("law", CONSTANTS)
@pytest.mark.parametrize("cycles", [4, 24])
def test_growth_finds_the_law_and_its_constants(law, cycles):
    n = np.arange(1, cycles + 1)
    table = measure.fit_growth(n, LAWS[law](n.astype(float), *CONSTANTS[law]))
    assert table.index[0] == law
    assert table.loc[law, ["c1", "c2"]].tolist() == pytest.approx(CONSTANTS[law], rel=1e-5)
    assert table["aicc"].isna().all() == (cycles == 4)


@pytest.mark.parametrize("law", CONSTANTS)
def test_growth_finds_the_law_in_noise(law):
    n, rng = np.arange(1.0, 25.0), np.random.default_rng(5)
    noise = 0.005 * rng.normal(size=len(n))
    table = measure.fit_growth(n, LAWS[law](n, *CONSTANTS[law]) + noise)
    assert table["aicc"].idxmin() == table.index[0] == law
    assert table.loc[law, "c2"] == pytest.approx(CONSTANTS[law][1], rel=0.1)
    assert table.loc[law, "rss"] < (noise**2).sum()  # least squares fit better than the truth
    m, k, rss = len(n), 3, table.loc[law, "rss"]
    assert table.loc[law, "aicc"] == pytest.approx(
        m * np.log(rss / m) + 2 * k + 2 * k * (k + 1) / (m - k - 1)
    )


def test_gottesman_form():
    """Crease length of Gottesman et al. (2018) at a compaction of 0.27, rounded as printed."""
    n, length = np.array([1, 2, 3, 10, 24]), np.array([11.96, 21.04, 28.36, 58.8, 87.0])
    table = measure.fit_growth(n, length)
    assert table.index[0] == "logarithmic"
    assert table.loc["logarithmic", "c1"] == pytest.approx(52 * (1 - 0.27), rel=5e-3)
    assert table.loc["logarithmic", "c2"] == pytest.approx(0.1 / 0.27, rel=1e-2)


def test_growth_that_cannot_be_fitted_is_refused():
    with pytest.raises(ValueError, match="give one length for each cycle"):
        measure.fit_growth([1, 2, 3], [1.0, 2.0])
    with pytest.raises(ValueError, match="2 different cycles; give three or more"):
        measure.fit_growth([1, 2, 2], [1.0, 2.0, 2.1])
    with pytest.raises(ValueError, match="leave out the new sheet"):
        measure.fit_growth([0, 1, 2], [0.0, 1.0, 2.0])
