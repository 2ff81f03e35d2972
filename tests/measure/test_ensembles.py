"""Intervals of ensembles hold the truth as often as they say."""

import numpy as np
import pytest

from jaxcrumple import measure
from jaxcrumple.measure import ensembles
from jaxcrumple.measure.bootstrap import mean_interval
from jaxcrumple.measure.growth import LAWS

CYCLES = np.arange(1.0, 4.0)
TRUE = LAWS["logarithmic"](CYCLES, 0.9, 0.8)


def sheets(rng, count, mean=TRUE, sizes=0.15, noise=0.05):
    """Crease lengths of sheets that differ in their overall size, and independently in each cycle."""
    return mean * (1 + sizes * rng.normal(size=(count, 1))) + noise * rng.normal(size=(count, len(mean)))


@pytest.mark.parametrize(("count", "covered"), [(8, 0.88), (24, 0.94), (64, 0.945)])
def test_interval_of_a_normal_sample_is_that_of_the_closed_form(count, covered):
    """The bootstrap has the variance with n, not n - 1, and not Student's quantiles: less for few."""
    values = 3.0 + 2.0 * np.random.default_rng(count).normal(size=(count, 1000))
    low, high = mean_interval(values, 0.95)
    plain = 2 * 1.96 * values.std(axis=0, ddof=0) / np.sqrt(count)
    assert np.mean((high - low) / plain) == pytest.approx(1.0, abs=0.02)
    # Three standard deviations of a share of 1000 samples.
    assert np.mean((low < 3.0) & (high > 3.0)) == pytest.approx(covered, abs=0.03)


def test_interval_of_a_skewed_sample_leans_to_its_tail():
    """BCa: that of an exponential sample reaches further above the mean than below, a normal one does not."""
    values = np.random.default_rng(0).exponential(size=(24, 500))
    low, high = mean_interval(values, 0.95)
    mean = values.mean(axis=0)
    assert np.mean(high - mean) > 1.15 * np.mean(mean - low)
    assert np.mean((low < 1.0) & (high > 1.0)) > 0.89


def test_interval_of_equal_values_and_of_one():
    low, high = mean_interval(np.array([[2.0, 1.0], [2.0, 3.0], [2.0, 5.0]]), 0.95)
    assert low[0] == high[0] == 2.0 and low[1] < 3.0 < high[1]
    assert np.isnan(mean_interval(np.ones((1, 2)), 0.95)).all()


@pytest.fixture
def fewer_resamples(monkeypatch):
    monkeypatch.setattr(ensembles, "RESAMPLES", 200)


def test_bands_of_the_law_hold_the_truth_in_their_share(fewer_resamples):
    rng, count = np.random.default_rng(1), 150
    tables = [measure.ensemble_growth(CYCLES, sheets(rng, 24), confidence=0.8).cycles for _ in range(count)]
    for name in ("law", ""):
        low, high = ([table[f"{name}_{end}".strip("_")] for table in tables] for end in ("low", "high"))
        # Three standard deviations of the share of 150, and two percent that a bootstrap of 24 loses.
        assert np.mean((low < TRUE) & (high > TRUE), axis=0) == pytest.approx(np.full(3, 0.78), abs=0.1)
    within = [(table["residual_low"] < 0) & (table["residual_high"] > 0) for table in tables]
    assert np.mean(within) == pytest.approx(0.78, abs=0.1)


def test_residuals_contradict_a_law_that_is_wrong():
    """Growth that speeds up is no logarithm: residuals exclude zero, and the power law fits best."""
    rng, cycles = np.random.default_rng(2), np.arange(1.0, 7.0)
    faster = LAWS["power"](cycles, 0.4, 1.5)
    found = measure.ensemble_growth(cycles, sheets(rng, 24, faster, noise=0.01))
    excluded = (found.cycles["residual_low"] > 0) | (found.cycles["residual_high"] < 0)
    assert excluded.sum() >= 4
    assert found.laws["best"].idxmax() == found.laws.index[0] == "power"
    assert found.laws.loc["power", "best"] > 0.99
    assert found.laws["aicc"].idxmin() == "power"
    assert found.laws.loc["power", "c2_low"] < 1.5 < found.laws.loc["power", "c2_high"]


def test_growth_of_an_ensemble_is_that_of_its_mean():
    rng, cycles = np.random.default_rng(3), np.arange(1, 7)
    lengths = sheets(rng, 10, LAWS["logarithmic"](cycles, 0.9, 0.8))
    found = measure.ensemble_growth(cycles, lengths)
    alone = measure.fit_growth(cycles, lengths.mean(axis=0))
    assert found.laws[alone.columns].equals(alone)
    assert found.laws["best"].sum() == pytest.approx(1.0)
    table = found.cycles
    assert table["std"].to_numpy() == pytest.approx(lengths.std(axis=0, ddof=1))
    assert (table["mean"] - table["residual"]).to_numpy() == pytest.approx(table["law"].to_numpy())
    # A factor of all lengths is one of c1 and of all that has a length.
    twice = measure.ensemble_growth(cycles, 2 * lengths)
    assert twice.cycles.to_numpy() == pytest.approx(2 * table.to_numpy(), abs=1e-9)
    assert twice.constants == pytest.approx(found.constants * [2, 1], rel=1e-6)


def test_sheets_of_one_shape_leave_no_doubt_about_it():
    """Multiples of one law: c1 varies with the mean, c2 and the residual do not."""
    factors = np.array([0.7, 0.9, 1.0, 1.2, 1.6])
    found = measure.ensemble_growth(CYCLES, np.outer(factors, TRUE))
    law = found.laws.loc["logarithmic"]
    assert [law["c2_low"], law["c2_high"]] == pytest.approx([0.8, 0.8], rel=1e-6)
    assert law["c1_low"] < 0.9 * factors.mean() < law["c1_high"]
    residuals = found.cycles[["residual", "residual_low", "residual_high"]]
    assert np.abs(residuals.to_numpy()).max() < 1e-9


def test_ensembles_without_a_spread_are_refused():
    with pytest.raises(ValueError, match="row for each of two sheets"):
        measure.ensemble_growth(CYCLES, [TRUE])
    with pytest.raises(ValueError, match="row for each of two sheets"):
        measure.ensemble_growth(CYCLES, TRUE)
    with pytest.raises(ValueError, match="2 different cycles; give three or more"):
        measure.ensemble_growth([1, 2], np.ones((3, 2)))
    with pytest.raises(ValueError, match="between 0 and 1, such as"):
        measure.ensemble_growth(CYCLES, [TRUE, TRUE], confidence=95.0)
