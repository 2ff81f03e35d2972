"""The paper's figures: the runs they ask for, what they compute, and a small one by the command."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from pictures import colors
from typer.testing import CliRunner

import jaxcrumple as jc
from jaxcrumple.cli.cli import app
from jaxcrumple.io import Run
from jaxcrumple.paper import FIGURES, Figure, axial, fold, make_figure, order, panels, radial
from jaxcrumple.paper.panels import frames_at, moments, plot_moments, table_of
from jaxcrumple.scenes.fold import TIMES
from jaxcrumple.solvers.log import STEP


@pytest.mark.parametrize("name", FIGURES)
def test_figures_ask_for_runs_that_can_be(name):
    for full in (False, True):
        configs = FIGURES[name].runs(full)
        assert bool(configs) == (name != "4")
        assert all(config.t_end > 0 for config in configs.values())


def test_the_release_of_a_fold_is_a_frame():
    for config in FIGURES["3b"].runs(True).values():
        times = jc.frame_times(config.t_end, config.frames)
        assert np.abs(times - TIMES.release).min() < 1e-12


def test_the_collapse_of_folds_finds_a_known_map():
    rng = np.random.default_rng(0)
    density, c0 = np.repeat([200.0, 500.0, 900.0], 10), np.tile(np.linspace(0.05, 0.3, 10), 3)
    line = 2.4 - 8e-3 * density * c0 + 3e-4 * density
    table = pd.DataFrame({"lambda": density, "c0": c0, "c_f": line + 1e-3 * rng.normal(size=30)})
    found, with_, without = fold.collapse(table)
    np.testing.assert_allclose(found, [2.4, 8e-3, 3e-4], rtol=0.05)
    assert with_ < 2e-3 < 0.02 < without


def test_blocks_along_a_hilbert_curve_hold_most_of_the_tangent():
    mesh = jc.rectangle(0.1, 0.1, 400, sweeps=10)
    pattern = order.coupling(mesh)
    assert pattern.diagonal().all() and (pattern != pattern.T).nnz == 0
    # A node, its neighbours, and those across its triangles: 1 + 6 + 6 of most.
    assert pattern.sum() / 400 == pytest.approx(12.0, abs=0.5)
    hilbert, rows = np.arange(400), np.argsort(mesh.vertices[:, 1])
    assert order.share_in_blocks(pattern, hilbert, 400) == 1.0
    assert order.share_in_blocks(pattern, hilbert, 1) == pytest.approx(400 / pattern.sum())
    # Where blocks hold less than a row of the sheet.
    assert order.share_in_blocks(pattern, hilbert, 10) > 2.0 * order.share_in_blocks(pattern, rows, 10)


def made_up(mesh, x, p, scene="radial", **options):
    """A run that never was."""
    config = jc.configure(scene, settings=options).model_dump(mode="json")
    t = np.arange(len(x)) * 1.0
    steps = {"kind": STEP, "stage": "implicit", "h": 1.0, "acceleration_mean": 1e-9}
    history = pd.DataFrame({"t": t, "stretch": 0.1 * t, "bending": 0.2 * t}).assign(**steps)
    summary = {"intersections": 0, "cpu_s": 1.0}
    return Run(t, np.array(x), np.zeros_like(x), np.array(p), mesh, config, summary, history, pd.DataFrame())


@pytest.fixture(scope="module")
def rolled():
    """Frames of a sheet that rolls up more and more, with one jump."""
    mesh = jc.rectangle(0.1, 0.1, 120, sweeps=10)
    radii = [1.0, 0.5, 0.4, 0.35, 0.1, 0.09]
    x = [np.stack([r * np.sin(mesh.vertices[:, 0] / r), mesh.vertices[:, 1],
                   r * np.cos(mesh.vertices[:, 0] / r)], axis=1) for r in radii]  # fmt: skip
    return made_up(mesh, x, np.zeros((len(x), len(mesh.hinges))))


def test_a_rearrangement_is_where_curvature_changes_most(rolled):
    assert radial.rearrangement(rolled) == 4


def test_panels_show_the_moments_that_are_asked_for(rolled, tmp_path, kept_figures):
    shown = moments(rolled, frames_at(rolled, (0.2, 1.0)))
    assert [one.frame for one in shown] == [1, 5]
    table = table_of(shown)
    np.testing.assert_allclose(table["rms_curvature"], [1 / 0.5, 1 / 0.09], rtol=0.35)
    np.testing.assert_allclose(table["bending"], [0.2, 1.0])
    figures = kept_figures(panels)
    assert colors(plot_moments(shown, "caption", tmp_path / "a.png")) > 100
    titles = [axes.get_title() for axes in figures[0].axes if axes.get_title()]
    assert titles == ["t = 1 s", "t = 5 s"]


def test_creases_after_each_cycle(rolled):
    run = cycled(rolled.mesh)
    assert axial.cycle_frames(run) == [4, 8, 12]
    lengths = np.cumsum(rolled.mesh.hinge_length)[[19, 29, 34]]
    np.testing.assert_allclose(axial.growth(run)["crease_length"], lengths)


def cycled(mesh):
    """Three cycles that damage 20 hinges, 10 more and 5 more."""
    times, p = axial.AxialTimes(), np.zeros((13, len(mesh.hinges)))
    p[4:, :20], p[8:, 20:30], p[12:, 30:35] = 0.5, 0.5, 0.5
    run = made_up(mesh, np.zeros((13, mesh.n_nodes, 3)), p, "axial", **{**times._asdict(), "cycles": 3})
    return dataclasses.replace(run, t=np.arange(13) * times.cycle / 4.0)


@pytest.mark.parametrize(
    "name",
    ["5", "6", "7", "8a", "8c", "9", *(pytest.param(name, marks=pytest.mark.slow) for name in ("8b", "8d"))],
)
def test_figures_are_drawn_with_the_data_behind_them(rolled, tmp_path, name):
    run = cycled(rolled.mesh) if name == "9" else rolled
    paths = FIGURES[name].draw({"radial": run}, tmp_path)
    assert {path.suffix for path in paths} == {".png", ".csv"}
    assert all(colors(path) > 10 for path in paths if path.suffix == ".png")
    tables = {path.stem: pd.read_csv(path) for path in paths if path.suffix == ".csv"}
    assert all(len(table) for table in tables.values())
    if name == "8b":
        # What is cut lies in the plane, within the sheet's size, and each triangle once.
        size = np.ptp(run.x[-1], axis=0).max()
        cut = tables["figure_8b_2"]
        assert 0.5 * size < np.ptp(cut[["u0", "u1", "w0", "w1"]].to_numpy()) < 1.5 * size
        assert cut["face"].is_unique
    if name == "9":
        areas = tables["figure_9d_areas"].groupby("cycle")["area"].sum()
        np.testing.assert_allclose(areas, run.mesh.area, rtol=1e-12)


@pytest.mark.slow
def test_a_figure_does_only_the_runs_that_are_missing(tmp_path):
    settings = {"sweeps": 2, "frames": 2, "contact": None}
    configs = {str(seed): jc.configure("radial", nodes=60, seed=seed, t_end=2e-3, settings=settings)
               for seed in (0, 1)}  # fmt: skip
    drawn, told = [], []

    def draw(runs, folder):
        drawn.append({name: run.t[-1] for name, run in runs.items()})
        return [folder / "picture.png"]

    figure = Figure("two", lambda full: configs, draw)
    for _ in range(2):
        made = make_figure(figure, tmp_path / "new", tell=lambda name, result: told.append((name, result)))
        assert made == [tmp_path / "new" / "picture.png"]
    assert drawn == 2 * [{"0": 2e-3, "1": 2e-3}]
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.glob("new/runs/*/summary.json")}
    assert len(stamps) == 2 and len(told) == 4
    make_figure(figure, tmp_path / "new")
    assert stamps == {path: path.stat().st_mtime_ns for path in tmp_path.glob("new/runs/*/summary.json")}


def test_the_command_draws_a_figure_and_refuses_others(tmp_path):
    answer = CliRunner().invoke(app, ["figure", "4", "--out", str(tmp_path / "four")])
    assert answer.exit_code == 0, answer.output
    assert sorted(path.name for path in (tmp_path / "four").iterdir()) == ["figure_4.csv", "figure_4.png"]
    table = pd.read_csv(tmp_path / "four" / "figure_4.csv")
    # Blocks of one size hold what entries fill of them.
    both = table[["Hilbert curve", "y coordinate"]].to_numpy()
    filled = table[["Hilbert curve: filled", "y coordinate: filled"]].to_numpy()
    np.testing.assert_allclose(filled[:, 0] / filled[:, 1], both[:, 0] / both[:, 1])
    assert filled[0, 0] > 0.5 and (np.diff(filled[:, 0]) < 0.02).all()
    assert (table["Hilbert curve"].diff().dropna() > -0.05).all() and table["Hilbert curve"].iloc[-1] > 0.8
    (tmp_path / "file").write_text("")
    refused = CliRunner().invoke(app, ["figure", "4", "--out", str(tmp_path / "file")])
    assert refused.exit_code != 0 and "is a file; give a folder" in str(refused.exception)
    refused = CliRunner().invoke(app, ["figure", "8e"])
    assert refused.exit_code != 0 and "figure '8e' is unknown" in str(refused.exception)
