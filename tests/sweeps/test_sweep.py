"""Sweeps: every member of a batch is its single run, also in processes and on several devices."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import jaxcrumple as jc
from jaxcrumple.sweeps import lanes
from jaxcrumple.sweeps.cluster import connected

LOADS, TIMES = (0.3, 0.1, 0.2), (5e-4, 1e-3)
SETTINGS = {"nodes": 60, "scheme": "explicit"}


def positions(setup, state):
    return {"x": (("node", "axis"), state.x), "height": jnp.mean(state.x[:, 2])}


def batch(loads=LOADS, **options):
    options = {"settings": SETTINGS, "measure": positions, "backend": "batch"} | options
    return jc.sweep("arch", {"load": loads}, TIMES, **options)


@pytest.fixture(scope="module")
def swept():
    """The sweep of all tests, its lanes side by side as on an accelerator, and how often its program was
    traced until another one was done."""
    traces = []

    def counted(*args):
        traces.append(1)
        return jc.integrate(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lanes, "integrate", counted)
        patch.setattr(lanes, "best_side_by_side", lambda device: True)
        table = batch()
        batch((0.15, 0.25, 0.35))
    return table, len(traces)


@pytest.fixture(scope="module")
def single():
    """The same runs, one after the other."""
    runs = []
    for load in LOADS:
        setup = jc.arch(60, load=load)
        start = jc.initial_state(setup.scene, setup.x)
        runs.append(jc.simulate(setup.scene, start, TIMES, solver=jc.integrator(scheme="explicit")))
    return runs


def test_a_lane_is_its_single_run_and_other_numbers_compile_nothing(swept, single):
    table, traces = swept
    assert traces == 1
    np.testing.assert_array_equal(table["load"], LOADS)
    np.testing.assert_array_equal(table.time, TIMES)
    assert np.all(table.result == "success") and np.all(table.t_reached == TIMES[-1])
    for load, run in zip(LOADS, single, strict=True):
        here = table.sel(load=load)
        np.testing.assert_array_equal(here.steps, run.state.counters.steps)
        np.testing.assert_allclose(here.x, run.x, rtol=0, atol=1e-13)
        np.testing.assert_allclose(here.height, run.x[:, :, 2].mean(axis=1), rtol=1e-9)


def test_lanes_in_turn_give_the_same_table(swept):
    """As they go on a CPU."""
    xr.testing.assert_allclose(batch().drop_attrs(), swept[0].drop_attrs(), rtol=1e-9, atol=1e-13)


def weakened(load):
    """An arch whose springs are too stiff for float64 at one load."""
    setup = jc.arch(60, load=load)
    stiffness = setup.scene.membrane.stiffness * (1e300 if load == 0.1 else 1.0)
    return setup._replace(scene=eqx.tree_at(lambda s: s.membrane.stiffness, setup.scene, stiffness))


def test_a_lane_that_fails_stops_alone(swept):
    """The others go on as if it were not there, and what it did not reach is NaN."""
    told = {}
    table = jc.sweep(
        weakened,
        {"load": LOADS},
        TIMES,
        solver=jc.integrator(scheme="explicit"),
        measure=positions,
        backend="batch",
        tell=told.__setitem__,
    )
    assert table.result.values.tolist() == ["success", "nonfinite", "success"]
    assert told == {"load=0.3": "success", "load=0.1": "nonfinite", "load=0.2": "success"}
    assert np.all(np.isnan(table.x.sel(load=0.1))) and table.t_reached.sel(load=0.1) == 0.0
    healthy = {"load": [0.3, 0.2]}
    np.testing.assert_allclose(table.x.sel(healthy), swept[0].x.sel(healthy), rtol=0, atol=1e-13)


def test_a_budget_ends_lanes(swept):
    steps = swept[0].steps.sum("stage").values
    table = batch(max_attempts=int(steps.max()) // 2 + 1)
    assert np.all(table.result == "budget")
    assert np.all(table.steps.sum("stage") == steps.max() // 2 + 1)
    # The first frame, half way, was reached.
    assert np.all(np.isfinite(table.height.isel(time=0))) and np.all(np.isnan(table.height.isel(time=1)))


def test_a_limit_of_wall_time_ends_lanes(swept):
    """Looked at after each call of their program; compiling does not count."""
    del swept  # It has compiled the program.
    table = batch(max_seconds=0.0)
    assert np.all(table.result == "budget")
    assert np.all(table.t_reached > 0.0) and np.all(table.t_reached < TIMES[-1])


@pytest.fixture(scope="module")
def client():
    """Two workers of this machine."""
    with connected(None, 2) as client:
        yield client


@pytest.mark.slow
def test_processes_give_the_same_table(swept, client):
    told = []
    options = {"settings": SETTINGS, "measure": positions, "cluster": client}
    table = jc.sweep("arch", {"load": LOADS}, TIMES, tell=lambda *row: told.append(row), **options)
    xr.testing.assert_allclose(table.drop_attrs(), swept[0].drop_attrs(), rtol=1e-9, atol=1e-13)
    assert sorted(told) == [(f"load={load}", "success") for load in sorted(LOADS)]


FOUR = """
import jax, pickle, sys
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 4)
import test_sweep
assert len(jax.devices()) == 4
pickle.dump(test_sweep.batch(), open(sys.argv[1], "wb"))
"""


@pytest.mark.slow
def test_devices_that_share_the_lanes_give_the_same_table(swept, tmp_path):
    """Three lanes on four devices, and four lanes on three of them."""
    file = tmp_path / "table"
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    subprocess.run([sys.executable, "-c", FOUR, str(file)], check=True, env=environment)
    table = np.load(file, allow_pickle=True)
    xr.testing.assert_allclose(table.drop_attrs(), swept[0].drop_attrs(), rtol=1e-9, atol=1e-13)


def test_words_and_none_are_values():
    """A dimension keeps the order it was given in."""
    options = {"settings": SETTINGS | {"load": 0.1}, "measure": positions, "backend": "batch"}
    table = jc.sweep("arch", {"plastic": [False], "max_step": [1e-6, None]}, 1e-5, **options)
    assert table.max_step.values.tolist() == ["1e-06", "none"]
    assert table.steps.sum("stage").values[0, 0] >= 10


@pytest.mark.parametrize(
    ("over", "options", "message"),
    [
        ({}, {}, "names nothing to vary"),
        ({"load": []}, {}, "no value"),
        ({"load": [0.1, 0.1]}, {}, "a value twice"),
        ({"load": [{}]}, {}, "numbers or words"),
        ({"load": np.ones((2, 2))}, {}, "numbers or words"),
        ({"load": [0.1, np.nan]}, {}, "numbers or words"),
        ([0.1], {}, "over must be a dictionary by name, not list"),
        ({"load": [0.1]}, {"settings": {"nodse": 60}}, "^setting 'nodse' is unknown; did you mean 'nodes'"),
        ({"load": [0.1]}, {"settings": {"frames": 3}}, "a sweep measures at its times"),
        ({"load": [0.1]}, {"cluster": "tcp://127.0.0.1:1"}, "a cluster is for backend='processes'"),
        ({"load": [0.1]}, {"devices": []}, "leaves no device"),
        ({"load": [0.1]}, {"devices": jax.devices(), "backend": "processes"}, "devices are for"),
        ({"load": [0.1]}, {"max_attempts": 0}, "max_attempts = 0"),
        ({"load": [0.1]}, {"max_seconds": np.nan}, "max_seconds = nan must be zero or more"),
        ({"laod": [0.1]}, {}, "did you mean 'load'"),
        ({"load": [0.1, -1.0]}, {}, "load=-1.0: options.load = -1.0"),
        ({"rise": [0.002, 0.02]}, {}, "rise=0.02: rise = 0.02 m is more than half"),
        ({"load": [0.1]}, {"settings": {"load": 0.2}}, "in over and in settings"),
        ({"load": [0.1]}, {"settings": {"scheme": "dynamic", "linear": "direct"}}, "one sheet at a time"),
        ({"load": [0.1]}, {"solver": jc.integrator()}, "leave solver out"),
        ({"load": [0.1]}, {"backend": "gpu"}, "backend = 'gpu'"),
        ({"load": [0.1]}, {"measure": lambda setup, state: 1.0}, "must return"),
        (
            {"load": [0.1]},
            {"measure": lambda setup, state: {"x": state.x}},
            r"'x' has sizes .* and dimensions \(\)",
        ),
        ({"load": [0.1]}, {"measure": lambda setup, state: {"x": ("n", state.x)}}, "and dimensions .'n',"),
        ({"load": [0.1]}, {"measure": lambda setup, state: {"steps": 1.0}}, "'steps' of its own"),
        ({"load": [0.1]}, {"measure": lambda setup, state: {"a": ("time", [1.0])}}, "'time' of its own"),
        ({"load": [0.1]}, {"measure": lambda setup: {}}, "measure must be a function of"),
        ({"load": [0.1]}, {"measure": None}, "measure must be a function of"),
        ({"load": [0.1]}, {"measure": lambda setup, state: {"load": 1.0}}, "'load' of its own"),
    ],
)
def test_what_cannot_be_is_refused(over, options, message):
    options = {"settings": SETTINGS, "backend": "batch"} | options
    with pytest.raises(ValueError, match=message):
        jc.sweep("arch", over, 1e-5, **options)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (3, "not int"),
        (lambda rise: None, "takes other arguments than load"),
        (lambda load: 1.0, "load=0.1: .* must return a jaxcrumple.Setup, not float"),
        ("arhc", "^scene 'arhc' is unknown"),
    ],
)
def test_what_is_no_scene_is_refused(scene, message):
    with pytest.raises(ValueError, match=message):
        jc.sweep(scene, {"load": [0.1]}, 1e-5)


def test_a_cluster_that_does_not_answer_is_refused():
    with pytest.raises(ValueError, match="cannot be reached"):
        jc.sweep("arch", {"load": [0.1]}, 1e-5, settings=SETTINGS, cluster=3)


@pytest.mark.slow
def test_a_case_whose_measure_breaks_on_its_way_stops_alone(swept, client):
    """And keeps what was measured before."""

    heights = swept[0].height.isel(time=1).values
    limit = float(np.mean(np.sort(heights)[:2]))

    def height(setup, state):
        if jnp.mean(state.x[:, 2]) < limit:
            raise ZeroDivisionError("too low")
        return {"height": jnp.mean(state.x[:, 2])}

    fails = heights < limit
    for way in ({"backend": "batch"}, {"backend": "processes", "cluster": client}):
        table = batch(measure=height, **way)
        assert table.result.values.tolist() == ["error" if low else "success" for low in fails]
        assert np.all(np.isnan(table.height.isel(time=1)) == fails)
        assert np.all((table.message == "ZeroDivisionError: too low") == fails)
        np.testing.assert_allclose(table.height.isel(time=0), swept[0].height.isel(time=0), rtol=1e-9)


def test_a_worker_refuses_a_case_before_any_runs(client):
    told = []
    options = {"settings": SETTINGS, "cluster": client, "tell": lambda *row: told.append(row)}
    with pytest.raises(ValueError, match=r"rise=0\.02: rise = 0\.02 m is more than half"):
        jc.sweep("arch", {"rise": [0.002, 0.02]}, 1e-5, **options)
    assert not told


def test_cases_whose_time_is_up_stop_alone(client):
    table = batch(max_seconds=0.0, backend="processes", cluster=client)
    assert np.all(table.result == "budget") and np.all(table.t_reached == 0.0)


@pytest.mark.slow
def test_lanes_with_contact_are_their_single_runs():
    """Implicit and explicit steps, plastic flow and contact, lists that grow: to ten times the tolerance."""
    settings = {"nodes": 200, "contact_range": 2.5e-4, "linear": "two-level"}
    over = {"yield_curvature": [100.0, 300.0], "thickness": [1e-4, 2.5e-4]}
    times = [1.0, 2.0, 2.4]
    table = jc.sweep("radial", over, times, settings=settings, measure=positions, backend="batch")
    single = jc.sweep("radial", over, times, settings=settings, measure=positions, backend="processes")
    assert np.all(table.result == "success")
    apart = np.abs(table.x - single.x).max(("node", "axis"))
    assert np.all(apart.isel(time=0) < 10 * 1e-2 * 0.01)
    assert jax.default_backend() != "cpu" or np.all(apart < 1e-6)
