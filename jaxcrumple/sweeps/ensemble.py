"""Statistics of ensembles: runs of a campaign that differ in their seeds."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.measure.bootstrap import check_confidence, mean_interval
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.sweeps.campaign import read_campaign
from jaxcrumple.sweeps.cases import named

TABLE = "ensemble.csv"
# Columns of options in a summary. They measure nothing.
OPTIONS = ("scene", "nodes", "seed", "t_end", "rtol")


def ensemble(runs: pd.DataFrame | str | Path, *, confidence: float = 0.95) -> pd.DataFrame:
    """Compute mean, spread and bootstrap interval over the seeds for each numeric measure of a campaign.

    Runs that differ in no other option than the seed form an ensemble. Runs without the result "success" are
    left out and counted.

    **Arguments:** `runs`: the table of `campaign`, or its `campaign.csv`, to which you may append columns.
    Columns to the left of result are options, those to the right are measures. Or the folder of a campaign,
    also while it runs. `confidence`: probability with which an interval holds the true mean.

    **Returns:** a table in SI units, indexed by the options other than the seed, if any, and by `measure`,
    such as crease_length. `mean`; `std`, the standard deviation over the seeds (with n - 1); `low` and
    `high`, limits of the bias-corrected and accelerated (BCa) bootstrap interval of the mean; `runs`, number
    of values; `left_out`, number of runs left out. One run has NaN for `std`, `low` and `high`. A measure
    that is true or false has the share of true as its mean. Bootstrap intervals of few runs are too short:
    of a normal sample, 95 % are 88 % with 8 runs and 94 % with 24. Random numbers are the same in each call.

    **Raises:** ValueError for a table without results, without a run that succeeded or with two runs of one
    seed in an ensemble, for a folder without runs, or a `confidence` that is not between 0 and 1.

    >>> import pandas as pd
    >>> results = 5 * ["success"] + ["blocked"]
    >>> lengths = [0.61, 0.84, 0.72, 0.69, 0.75, 0.10]
    >>> table = pd.DataFrame({"seed": range(6), "result": results, "crease_length": lengths})
    >>> print(jc.ensemble(table).round(3))
                    mean    std   low  high  runs  left_out
    measure
    crease_length  0.722  0.084  0.66  0.79     5         1
    """
    check_confidence(confidence)
    table = runs if isinstance(runs, pd.DataFrame) else read_campaign(runs)
    options = _options(table)
    measures = _measures(table)
    parts = [
        _statistics(group, measures, confidence).assign(**dict(zip(options, values, strict=True)))
        for values, group in _groups(table, options)
    ]
    return pd.concat(parts).set_index([*options, "measure"])


def write_ensemble(folder: str | Path) -> tuple[pd.DataFrame, Path]:
    """Write the statistics of a campaign into its folder; return them and the file."""
    found, path = ensemble(folder), Path(folder) / TABLE
    write_bytes(path, found.to_csv().encode(errors="backslashreplace"))
    return found, path


def _options(table: pd.DataFrame) -> list[str]:
    """Return the columns of options other than the seed.

    **Raises:** ValueError for a table that has no results, or only bad ones.
    """
    if "result" not in table:
        raise ConfigError("the table has no column result; give the table of a campaign, or its folder.")
    if not (table["result"] == "success").any():
        found = ", ".join(sorted(set(table["result"].astype(str)))) or "no runs"
        raise ConfigError(f"no run succeeded ({found}), so the ensemble has no statistics.")
    left = list(table.columns)[: list(table.columns).index("result")]
    return [name for name in left if name not in ("run", "seed")]


def _measures(table: pd.DataFrame) -> list[str]:
    """Return the columns with a number or a truth value of a run that succeeded."""
    right = [name for name in table.columns[list(table.columns).index("result") :] if name not in OPTIONS]
    good = table.loc[table["result"] == "success", right].dropna(axis="columns", how="all")
    return list(good.infer_objects().select_dtypes(["number", "bool"]))


def _groups(table: pd.DataFrame, options: list[str]) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
    """Yield the values of the options of each ensemble, and its rows.

    **Raises:** ValueError for two runs of one seed.
    """
    keys = [_key(table[name]) for name in options]
    for values, group in table.groupby(keys, sort=False, dropna=False) if keys else [((), table)]:
        if "seed" in group and group["seed"].duplicated().any():
            seed = group["seed"][group["seed"].duplicated()].iloc[0]
            equal = named(dict(zip(options, values, strict=True)))
            raise ConfigError(
                f"two runs have seed {seed} and equal options {equal}; "
                "keep the columns of the options in which runs differ to the left of result."
            )
        yield values, group


def _key(values: pd.Series) -> pd.Series:
    """Return values of an option that can be compared: numbers, or all as words."""
    if pd.api.types.is_numeric_dtype(values):
        return values
    return values.astype(object).where(values.notna(), "none").astype(str)


def _statistics(group: pd.DataFrame, measures: list[str], confidence: float) -> pd.DataFrame:
    """Return a row of statistics for each measure of an ensemble."""
    good = group.loc[group["result"] == "success", measures].astype(float)
    rows = [_row(good[name].dropna().to_numpy(), confidence) for name in measures]
    statistics = pd.DataFrame(rows, columns=["mean", "std", "low", "high", "runs"])
    return statistics.assign(left_out=len(group) - len(good), measure=measures)


def _row(values: Float[np.ndarray, " runs"], confidence: float) -> tuple[float, float, float, float, int]:
    """Return the statistics of a measure; NaN where it has too few values."""
    if not len(values):
        return np.nan, np.nan, np.nan, np.nan, 0
    low, high = mean_interval(values[:, None], confidence)
    std = values.std(ddof=1) if len(values) > 1 else np.nan
    return float(values.mean()), float(std), float(low[0]), float(high[0]), len(values)
