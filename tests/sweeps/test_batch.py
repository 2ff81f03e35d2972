"""Batches: members that wait take the lanes of those that ended, and each is its single run."""

import os
import signal

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.run.run import start_run
from jaxcrumple.sweeps import lanes
from jaxcrumple.sweeps.cluster import connected
from jaxcrumple.sweeps.run_members import run_missing_as_lanes

LOADS, TIMES = (0.3, 0.1, 0.2, 0.15, 0.25), (5e-4, 1e-3)
SETTINGS = {"nodes": 60, "scheme": "explicit"}
RUNS = jc.grid("arch", {"load": [0.1, 0.2, 0.3, 0.4, 0.5]}, SETTINGS | {"frames": 3}, t_end=1e-3)


def positions(setup, state):
    return {"x": (("node", "axis"), state.x)}


@pytest.fixture
def traces(monkeypatch):
    """How often a program of lanes was traced."""
    found = []

    def counted(*args):
        found.append(1)
        return jc.integrate(*args)

    monkeypatch.setattr(lanes, "integrate", counted)
    return found


@pytest.fixture(params=[True, False], ids=["side-by-side", "in-turn"])
def side_by_side(request, monkeypatch):
    monkeypatch.setattr(lanes, "best_side_by_side", lambda device: request.param)


def test_ended_lanes_make_room_without_another_program(side_by_side, traces):
    told = []
    options = {"settings": SETTINGS, "measure": positions, "backend": "batch"}
    table = jc.sweep("arch", {"load": LOADS}, TIMES, lanes=2, tell=lambda *row: told.append(row), **options)
    assert sorted(told) == sorted((f"load={load}", "success") for load in LOADS)
    assert len(traces) == 1
    solver = jc.integrator(scheme="explicit")
    for load in LOADS:
        setup = jc.arch(60, load=load)
        single = jc.simulate(setup.scene, jc.initial_state(setup.scene, setup.x), TIMES, solver=solver)
        own = table.sel(load=load)
        np.testing.assert_allclose(own.x, single.x, rtol=0, atol=1e-13)
        assert int(own.steps.sum()) == int(np.sum(single.state.counters.steps))


def test_an_array_in_which_only_waiting_lanes_differ_becomes_their_own(traces):
    """The first two lanes, of all parts of the list, have the same load."""

    def scene(number):
        return jc.arch(60, load=[0.1, 0.2, 0.1, 0.3][number])

    options = {"solver": jc.integrator(scheme="explicit"), "measure": positions, "backend": "batch"}
    table = jc.sweep(scene, {"number": range(4)}, TIMES, lanes=2, **options)
    alone = jc.sweep(scene, {"number": range(4)}, TIMES, lanes=1, **options)
    np.testing.assert_allclose(table.x, alone.x, rtol=0, atol=1e-13)
    heights = table.x.isel(time=-1, axis=2).mean("node").values
    assert heights[0] == heights[2] and len(set(heights)) == 3
    assert len(traces) <= 4


def test_cases_of_other_kinds_follow():
    options = {"settings": {"scheme": "explicit"}, "backend": "batch"}
    table = jc.sweep("arch", {"nodes": [60, 200], "load": [0.1, 0.2]}, 2e-4, **options)
    options["settings"]["nodes"] = 200
    own = jc.sweep("arch", {"load": [0.1, 0.2]}, 2e-4, **options)
    assert np.all(table.result == "success")
    energy, alone = (found.energy.sum("term").isel(time=0) for found in (table, own))
    np.testing.assert_allclose(energy.sel(nodes=200), alone, rtol=1e-9)
    assert np.all(energy.sel(nodes=60) != energy.sel(nodes=200))


def test_a_waiting_case_that_cannot_begin_stops_alone():
    def scene(load):
        if load == 0.4:
            raise ValueError("too much")
        return jc.arch(60, load=load)

    options = {"solver": jc.integrator(scheme="explicit"), "backend": "batch", "lanes": 2}
    table = jc.sweep(scene, {"load": [0.1, 0.2, 0.3, 0.4]}, 2e-4, **options)
    assert table.result.values.tolist() == ["success"] * 3 + ["error"]
    assert str(table.message.values[3]) == "ValueError: load=0.4: too much"
    with pytest.raises(ValueError, match=r"load=0\.4: too much"):
        jc.sweep(scene, {"load": [0.1, 0.4]}, 2e-4, **options)


@pytest.mark.parametrize("lanes", [0, 1.5, True])
def test_a_number_of_lanes_that_is_none_is_refused(lanes):
    with pytest.raises(ValueError, match=r"lanes = .* must be at least 1"):
        jc.sweep("arch", {"load": LOADS}, TIMES, backend="batch", lanes=lanes)


def test_seeds_are_the_last_name_of_a_grid():
    runs = jc.grid("radial", {"thickness": [1e-4, 2e-4]}, {"nodes": 60}, seeds=3)
    assert list(runs)[:2] == ["thickness=0.0001,seed=0", "thickness=0.0001,seed=1"] and len(runs) == 6
    assert [run.seed for run in jc.grid("radial", {}, seeds=[4, 7]).values()] == [4, 7]
    for seeds in (0, True, 2.5):
        with pytest.raises(ValueError, match=r"seeds = .* must be a number of seeds"):
            jc.grid("radial", {}, seeds=seeds)
    with pytest.raises(ValueError, match="in over and by seeds"):
        jc.grid("radial", {"seed": [1]}, seeds=2)


@pytest.fixture(scope="module")
def sheets():
    """Strips of paper that bend under their weight, held at one end."""
    mesh = jc.hexagonal(12, 3, 2e-3)
    near = mesh.vertices[:, 0] < mesh.vertices[:, 0].min() + 3e-3
    held = jc.Prescribed(np.repeat(near[:, None], 3, axis=1), jc.LinearMotion(mesh.vertices, (0.0, 0.0, 0.0)))
    scenes = [
        jc.sheet(mesh, jc.Material(thickness=thickness), gravity=(0, 0, -9.81), prescribed=held)
        for thickness in (1e-4, 2e-4, 3e-4)
    ]
    return scenes, [jc.initial_state(scene, mesh.vertices) for scene in scenes]


@pytest.mark.slow
def test_sheets_of_ones_own_are_their_single_runs_and_can_be_replayed(sheets):
    """Batches record what `replay` needs: with the steps of a lane, it gives the positions of the lane."""
    scenes, states = sheets
    solver = jc.integrator(linear="two-level", rtol=1e-3)
    found = jc.simulate_batch(scenes, states, [0.005, 0.01], solver=solver, lanes=2, record=True)
    for scene, state, lane in zip(scenes, states, found, strict=True):
        single = jc.simulate(scene, state, [0.005, 0.01], solver=solver, record=True)
        assert lane.result == "success" and lane.t.tolist() == [0.005, 0.01]
        np.testing.assert_allclose(lane.x, single.x, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(lane.state.counters.steps, single.state.counters.steps)
        assert len(lane.history) == len(single.history)
        np.testing.assert_allclose(lane.history["t"], single.history["t"], rtol=1e-9)
        again = jc.replay(scene, lane.record)
        np.testing.assert_allclose(again.x, lane.x, rtol=0, atol=1e-9)
    assert len({lane.x[-1, :, 2].min() for lane in found}) == 3


def test_a_sheet_that_does_not_fit_its_state_is_refused(sheets):
    scenes, states = sheets
    with pytest.raises(ValueError, match="3 scenes and 2 states"):
        jc.simulate_batch(scenes, states[:2], 0.01)
    through = eqx.tree_at(lambda s: s.x, states[0], states[0].x.at[-1].set(states[0].x[-2]))
    with pytest.raises(ValueError, match=r"sheet 1: edge .* starts without length"):
        jc.simulate_batch(scenes[:2], [states[0], through], 0.01)


def test_runs_as_lanes_go_on_from_their_checkpoints(tmp_path):
    """Bit for bit as the single runs, after each of them was stopped again and again."""
    runs = {tmp_path / name: config for name, config in RUNS.items()}
    results = [summary["result"] for summary in run_missing_as_lanes(runs, 2, max_seconds=0.0)]
    assert results == ["budget"] * 5
    for _ in range(100):
        summaries = run_missing_as_lanes(runs, 2, max_seconds=1e-3)
        if all(summary["result"] == "success" for summary in summaries):
            break
    first, *_ = runs
    assert (first / "history.csv").stat().st_size and summaries[0]["run_s"] > 0
    for folder, config in runs.items():
        start_run(config, tmp_path / "alone" / folder.name)
        alone, lane = jc.load(tmp_path / "alone" / folder.name), jc.load(folder)
        np.testing.assert_allclose(lane.x, alone.x, rtol=0, atol=1e-13)
        assert lane.summary["steps"] == alone.summary["steps"]


def test_runs_whose_solver_takes_one_sheet_are_refused_as_lanes(tmp_path):
    runs = jc.grid("radial", {"thickness": [1e-4]}, {"nodes": 60, "linear": "direct"})
    with pytest.raises(ValueError, match=r"thickness=0\.0001: linear = 'direct' handles one"):
        jc.campaign(runs, tmp_path / "runs", lanes=2)


@pytest.mark.slow
def test_a_killed_worker_with_lanes_loses_nothing(tmp_path):
    """Two workers with two lanes each; one is killed when the first group has ended."""
    runs = jc.grid("arch", {"load": np.linspace(0.1, 0.5, 20)}, SETTINGS | {"frames": 3}, t_end=3e-3)
    told = []
    with connected(None, 2) as client:

        def tell(name, result):
            told.append((name, result))
            if len(told) == 1:
                process = next(iter(client.run(os.getpid).values()))
                os.kill(process, signal.SIGKILL)

        table = jc.campaign(runs, tmp_path / "runs", cluster=client, lanes=2, tell=tell)
    assert list(table.index) == list(runs) and np.all(table["result"] == "success")
    assert sorted(told) == sorted((name, "success") for name in runs)
    for name in list(runs)[::7]:
        start_run(runs[name], tmp_path / name)
        np.testing.assert_allclose(
            jc.load(tmp_path / "runs" / name).x, jc.load(tmp_path / name).x, rtol=0, atol=1e-13
        )


def test_meshes_and_patterns_of_equal_arguments_are_one():
    """And go with the last one that uses them."""
    one, other = (jc.radial(60, material=jc.Material(thickness=h)) for h in (1e-4, 2e-4))
    assert one.mesh is other.mesh
    assert one.scene.pattern is other.scene.pattern
    assert one.scene.contact.fans is other.scene.contact.fans
    assert jc.radial(60, seed=1, contact=None).mesh is not one.mesh

    @jax.jit
    def traced(h):
        scene = jc.sheet(one.mesh, jc.Material(thickness=h), like=other.scene, contact=other.contact)
        return scene.mass.sum()

    np.testing.assert_allclose(traced(2e-4), other.scene.mass.sum(), rtol=1e-12)
