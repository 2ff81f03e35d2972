"""Fig. 9 of many seeds: its law and intervals, and the seeds that are left out."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from pictures import colors

import jaxcrumple as jc
from jaxcrumple.io import Run
from jaxcrumple.measure.growth import LAWS
from jaxcrumple.paper import ENSEMBLES, Ensemble, axial, base, make_ensemble
from jaxcrumple.plot import ensembles
from jaxcrumple.run.run import start_run

LEFT_OUT = {"seed7": "collapsed", "seed15": "blocked", "seed16": "blocked"}
SETTINGS = {"sweeps": 2, "frames": 1, "contact": None, "scheme": "explicit"}


@pytest.fixture(scope="module")
def runs():
    """Twelve runs of three cycles whose damaged hinges grow by a logarithm, up to the length of a hinge."""
    mesh, rng, times = jc.rectangle(0.1, 0.1, 500, sweeps=5), np.random.default_rng(0), axial.AxialTimes()
    config = jc.configure("axial", settings={"cycles": 3}).model_dump(mode="json")
    x, t, made = np.zeros((13, mesh.n_nodes, 3)), np.arange(13) * times.cycle / 4.0, {}
    for seed in range(12):
        order = rng.permutation(len(mesh.hinges))
        lengths = LAWS["logarithmic"](np.arange(1.0, 4.0), 0.9 * (1 + 0.15 * rng.normal()), 0.8)
        p = np.zeros((13, len(mesh.hinges)))
        for cycle, length in enumerate(lengths, 1):
            p[4 * cycle :, order[: np.searchsorted(np.cumsum(mesh.hinge_length[order]), length)]] = 0.5
        made[f"seed{seed}"] = Run(
            t, x, x, p, mesh, {**config, "seed": seed}, {}, pd.DataFrame(), pd.DataFrame()
        )
    return made


@pytest.fixture
def drawn(runs, tmp_path, kept_figures):
    """The figure, and its tables by name."""
    figures = kept_figures(ensembles)
    paths = ENSEMBLES["9"].draw(
        {name: run for name, run in runs.items() if name != "seed7"}, LEFT_OUT, tmp_path
    )
    assert colors(paths[0]) > 10
    return figures[0], {path.stem: pd.read_csv(path) for path in paths if path.suffix == ".csv"}


def test_the_figure_shows_seeds_mean_and_law(runs, drawn):
    figure, tables = drawn
    cycles, laws = tables["figure_9_ensemble_cycles"], tables["figure_9_ensemble_laws"].set_index("law")
    above, below = figure.axes
    assert len([line for line in above.lines if line.get_alpha() == ensembles.SHEET]) == 11
    law = next(line for line in above.lines if line.get_label().startswith("logarithmic"))
    n, curve = law.get_data()
    assert curve == pytest.approx(LAWS["logarithmic"](n, *laws.loc["logarithmic", ["c1", "c2"]]))
    shown = below.lines[1].get_ydata()
    assert shown == pytest.approx(1e3 * (cycles["mean"] - cycles["law"]))
    # Lengths are right to a hinge of 5 mm, and factors leave c2 as it is.
    assert laws.index[0] == "logarithmic" and laws.loc["logarithmic", "c2"] == pytest.approx(0.8, rel=0.1)
    assert np.abs(cycles["residual"]).max() < 3e-3
    seeds = [axial.growth(run)["crease_length"] for name, run in runs.items() if name != "seed7"]
    assert cycles["mean"].to_numpy() == pytest.approx(np.mean(seeds, axis=0))


def test_seeds_that_failed_are_named(drawn):
    figure, tables = drawn
    caption = figure.get_suptitle()
    assert "seeds 0-6 8-11" in caption
    assert "left out, collapsed: seed 7" in caption and "left out, blocked: seeds 15 16" in caption
    table = tables["figure_9_ensemble"].set_index("seed")
    assert (table["result"] == "success").sum() == 33
    for seed, result in ((7, "collapsed"), (15, "blocked"), (16, "blocked")):
        assert table.loc[seed, "result"] == result and np.isnan(table.loc[seed, "crease_length"])


def test_ensembles_ask_for_24_seeds_that_differ_in_nothing_else():
    for full, nodes in ((False, 500), (True, 2000)):
        configs = ENSEMBLES["9"].runs(full)
        assert [config.seed for config in configs.values()] == list(range(24))
        assert (
            len({config.model_copy(update={"seed": 0}).model_dump_json() for config in configs.values()}) == 1
        )
        assert configs["seed5"].nodes == nodes
    # The runs of the figure with fewer seeds are among them.
    assert configs["seed2"] == axial.configurations(True, 3)["seed2"]


def test_a_figure_of_finished_runs_starts_none(tmp_path, monkeypatch):
    configs = {f"seed{seed}": jc.configure("radial", nodes=60, seed=seed, t_end=1e-4, settings=SETTINGS)
               for seed in range(4)}  # fmt: skip
    drawn = []

    def draw(runs, left_out, folder):
        drawn.append(({name: run.t[-1] for name, run in runs.items()}, left_out))
        return [folder / "picture.png"]

    def refuse(*arguments, **options):
        raise AssertionError("a run was started")

    monkeypatch.setattr(base, "campaign", refuse)
    figure = Ensemble("four", lambda full: configs, draw)
    with pytest.raises(ValueError, match="has no folders of runs"):
        make_ensemble(figure, tmp_path / "new", finished=True)
    assert not (tmp_path / "new").exists()
    start_run(configs["seed0"], tmp_path / "new" / "runs" / "seed0")
    start_run(configs["seed2"], tmp_path / "new" / "runs" / "seed2", max_seconds=0.0)
    with pytest.raises(ValueError, match="needs two runs that succeed; its 4 runs are: 2 not started, 1 "):
        make_ensemble(figure, tmp_path / "new", finished=True)
    start_run(configs["seed1"], tmp_path / "new" / "runs" / "seed1")
    assert make_ensemble(figure, tmp_path / "new", finished=True) == [tmp_path / "new" / "picture.png"]
    assert drawn == [({"seed0": 1e-4, "seed1": 1e-4}, {"seed2": "budget", "seed3": "not started"})]
    other = {name: config.model_copy(update={"t_end": 2e-4}) for name, config in configs.items()}
    with pytest.raises(ValueError, match=r"holds a run with t_end = 0\.0001, but 'seed0' asks for 0\.0002"):
        make_ensemble(figure._replace(runs=lambda full: other), tmp_path / "new", finished=True)


def test_a_failed_run_leaves_the_others(tmp_path, monkeypatch, runs):
    """After all have ended: the campaign's table has one that did not succeed."""
    results = pd.DataFrame({"result": ["success", "blocked", "success"]}, index=["seed0", "seed1", "seed2"])
    told = []
    monkeypatch.setattr(
        base, "campaign", lambda configs, folder, tell: (tell("seed1", "blocked"), results)[1]
    )
    monkeypatch.setattr(base, "load", lambda folder: runs[folder.name])
    figure = Ensemble("three", lambda full: {}, lambda found, left_out, folder: [*found, left_out])
    made = make_ensemble(figure, tmp_path, tell=lambda *words: told.append(words))
    assert made == ["seed0", "seed2", {"seed1": "blocked"}] and told == [("seed1", "blocked")]


def test_the_command_refuses_ensembles_that_are_not(in_process):
    code, streams = in_process("figure", "8b", "--ensemble")
    assert code == 2 and "figure 8b has no ensemble; figure 9 has one" in streams.err
    code, streams = in_process("figure", "9", "--finished")
    assert code == 2 and "--finished needs --ensemble" in streams.err


def test_captions_join_seeds(runs):
    from jaxcrumple.plot.plot import about

    some = [dataclasses.replace(run, config={**run.config, "seed": seed})
            for run, seed in zip(runs.values(), (0, 1, 4, 5, 6, 9), strict=False)]  # fmt: skip
    assert about(*some) == "axial, n = 500, seeds 0 1 4-6 9, rtol 0.01"
