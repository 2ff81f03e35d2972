"""Classical benchmarks: the quick ones here and now, and all of them in the committed table."""

import importlib

import pandas as pd
import pytest
import validate
from validation.base import BENCHMARKS

TABLE = validate.RESULTS / "validation.csv"
# Benchmarks whose programs take long to compile or to run.
SLOW = {name for name, benchmark in BENCHMARKS.items() if not benchmark.quick}


CASES = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in BENCHMARKS]


@pytest.mark.parametrize("name", CASES)
def test_a_benchmark_is_within_its_tolerance(name):
    outcomes = BENCHMARKS[name].run()
    assert outcomes
    for outcome in outcomes:
        assert outcome.accepted, outcome


def test_the_table_has_all_benchmarks_within_their_tolerance():
    rows = pd.read_csv(TABLE, keep_default_na=False)
    assert set(rows["benchmark"]) == set(BENCHMARKS)
    assert len(BENCHMARKS) >= 15
    assert rows["accepted"].all()
    assert (rows["deviation_percent"].abs() <= rows["tolerance_percent"]).all()
    # What differs by more than a hundredth has a cause.
    assert (rows.loc[rows["deviation_percent"].abs() > 1.0, "why"] != "").all()


def test_every_benchmark_tells_what_it_is_and_from_where():
    for benchmark in BENCHMARKS.values():
        assert benchmark.title and benchmark.source
        assert benchmark.group in validate.GROUPS
        assert hasattr(importlib.import_module(f"validation.{benchmark.group}"), benchmark.name)
