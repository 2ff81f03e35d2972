"""Statistics of ensembles: what is averaged, what is left out, and what is refused."""

import numpy as np
import pandas as pd
import pytest

import jaxcrumple as jc
from jaxcrumple.run.run import start_run
from jaxcrumple.sweeps.campaign import UNFINISHED, read_campaign

RUNS = jc.grid(
    "radial",
    {"thickness": [1e-4, 2e-4], "seed": [0, 1, 2]},
    {"nodes": 60, "sweeps": 2, "frames": 1, "contact": None, "scheme": "explicit"},
    t_end=1e-4,
)
LIMITED, MISSING = "thickness=0.0002,seed=1", "thickness=0.0002,seed=2"


def made_up(seeds=20, **columns):
    """A campaign of two thicknesses that never was."""
    rng = np.random.default_rng(0)
    table = pd.DataFrame({"thickness": np.repeat([1e-4, 2e-4], seeds), "seed": np.tile(range(seeds), 2)})
    table["result"] = "success"
    table["crease_length"] = rng.normal(0.7, 0.1, 2 * seeds) + 1e3 * table["thickness"]
    return table.assign(**columns)


def test_statistics_of_each_ensemble():
    """Mean and standard deviation as defined; the interval close to that of a normal sample."""
    table = made_up()
    found = jc.ensemble(table)
    assert found.index.names == ["thickness", "measure"] and len(found) == 2
    for thickness in (1e-4, 2e-4):
        row = found.loc[(thickness, "crease_length")]
        values = table.loc[table["thickness"] == thickness, "crease_length"]
        assert row["mean"] == pytest.approx(values.sum() / 20)
        assert row["std"] == pytest.approx(np.sqrt(((values - values.mean()) ** 2).sum() / 19))
        assert row["high"] - row["low"] == pytest.approx(2 * 1.96 * row["std"] / np.sqrt(20), rel=0.12)
        assert row["low"] < row["mean"] < row["high"]
        assert (row["runs"], row["left_out"]) == (20, 0)
    pd.testing.assert_frame_equal(jc.ensemble(table), found)
    wider = jc.ensemble(table, confidence=0.99)
    assert ((wider["low"] < found["low"]) & (wider["high"] > found["high"])).all()


def test_failed_runs_are_left_out_and_counted():
    table = made_up()
    table.loc[[0, 3, 21], ["result", "crease_length"]] = [
        ["blocked", 99.0],
        ["error", np.nan],
        ["budget", 99.0],
    ]
    found = jc.ensemble(table)
    assert found["runs"].tolist() == [18, 19] and found["left_out"].tolist() == [2, 1]
    good = table[table["result"] == "success"].groupby("thickness")["crease_length"]
    assert found["mean"].tolist() == pytest.approx(good.mean().tolist())
    table.loc[table["thickness"] == 1e-4, "result"] = "blocked"
    lost = jc.ensemble(table).loc[(1e-4, "crease_length")]
    assert (lost["runs"], lost["left_out"]) == (0, 20) and np.isnan(lost["mean"])


def test_one_seed_has_a_mean_and_no_spread():
    found = jc.ensemble(made_up(seeds=1))
    assert found["mean"].notna().all() and (found["runs"] == 1).all()
    assert found[["std", "low", "high"]].isna().to_numpy().all()


def test_measures_are_the_numbers_to_the_right_of_the_results():
    columns = {"rtol": 1e-2, "locked": [True, False] * 20, "message": "done", "min_gap": [None, 2e-4] * 20}
    found = jc.ensemble(made_up(**columns)).loc[1e-4]
    assert list(found.index) == ["crease_length", "locked", "min_gap"]
    assert found.loc["locked", "mean"] == 0.5 and found.loc["min_gap", "runs"] == 10
    # Equal values have an interval of no length.
    assert found.loc["min_gap", ["std", "low", "high"]].tolist() == [0.0, 2e-4, 2e-4]
    words = made_up().drop(columns="thickness")
    words.insert(0, "contact", [None] * 20 + ["penalty"] * 20)
    assert jc.ensemble(words).index.get_level_values("contact").tolist() == ["none", "penalty"]


def test_a_table_that_is_no_ensemble_is_refused(tmp_path):
    table = made_up()
    with pytest.raises(ValueError, match="no column result; give the table of a campaign"):
        jc.ensemble(table.drop(columns="result"))
    with pytest.raises(ValueError, match=r"no run succeeded \(blocked\)"):
        jc.ensemble(table.assign(result="blocked"))
    with pytest.raises(ValueError, match="two runs have seed 0 and equal options"):
        jc.ensemble(table.drop(columns="thickness"))
    with pytest.raises(ValueError, match="confidence = 95 must lie between 0 and 1"):
        jc.ensemble(table, confidence=95)
    with pytest.raises(ValueError, match="has no folders of runs; give the folder of a campaign"):
        jc.ensemble(tmp_path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A campaign of six runs of which one is limited and one was not started."""
    place = tmp_path_factory.mktemp("ensemble")
    for name, config in RUNS.items():
        if name != MISSING:
            start_run(config, place / name, max_seconds=0.0 if name == LIMITED else None)
    return place


def test_a_folder_is_read_as_it_is(folder, in_process):
    table = read_campaign(folder)
    assert table.columns[:3].tolist() == ["seed", "thickness", "result"]
    assert table["result"].drop(LIMITED).eq("success").all() and table["result"][LIMITED] == "budget"
    found = jc.ensemble(folder)
    assert found.xs("steps.explicit", level="measure")["runs"].tolist() == [3, 1]
    assert found["left_out"].groupby("thickness").max().tolist() == [0, 1]
    own = table[table["thickness"] == 1e-4]
    for measure in ("energy.stretch", "max_edge_strain", "steps.explicit"):
        assert found.loc[(1e-4, measure), "mean"] == pytest.approx(own[measure].mean(), rel=1e-12)
    code, streams = in_process("ensemble", folder)
    assert code == 0
    lines = streams.out.splitlines()
    assert lines[0] == "thickness = 0.0001, 3 runs"
    assert "thickness = 0.0002, 1 runs, 1 left out without success" in lines
    assert "  one run or none has no spread; give more seeds" in lines
    mean = found.loc[(1e-4, "energy.stretch"), "mean"]
    assert any(line.startswith(f"  energy.stretch: {mean:.4g} J, std ") for line in lines)
    written = pd.read_csv(folder / "ensemble.csv", index_col=["thickness", "measure"])
    pd.testing.assert_frame_equal(written, found)


def test_the_table_of_a_campaign_is_that_of_its_folder(folder):
    """An ended run is only read; one that goes on is left out."""
    (folder / LIMITED / "summary.json").unlink()
    assert read_campaign(folder)["result"][LIMITED] == UNFINISHED["result"]
    ended = {name: config for name, config in RUNS.items() if name not in (LIMITED, MISSING)}
    table = jc.campaign(ended, folder)
    assert jc.ensemble(folder)["left_out"].groupby("thickness").max().tolist() == [0, 1]
    pd.testing.assert_frame_equal(jc.ensemble(table), jc.ensemble(folder).assign(left_out=0))
