"""Fits against a closed form: a sheet that falls through air."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxcrumple as jc
from jaxcrumple.calibrate import Experiment, Parameter, fit

G, RATE, NOISE = 9.81, 200.0, 1e-6
TIMES = np.array([5e-3, 10e-3, 15e-3, 20e-3])
MESH = jc.hexagonal(3, 3, 1e-2)


def made_of(rate, like=None):
    material = jc.Material(drag_rate=rate, internal_damping_time=0.0, yield_curvature=None)
    return jc.sheet(MESH, material, gravity=(0.0, 0.0, -G), like=like)


LIKE = made_of(RATE)


def height(rate):
    """Of a point that falls from rest with drag."""
    return -G / rate * TIMES + G / rate**2 * (1.0 - np.exp(-rate * TIMES))


def setup(values):
    scene = made_of(values["rate"], LIKE)
    return scene, jc.initial_state(scene, MESH.vertices)


def experiment(data):
    return Experiment(setup, TIMES, lambda frames: (jnp.mean(frames.x[:, :, 2], axis=1) - data) / NOISE)


def falling(**options):
    solver = jc.integrator(1e-6, scheme="dynamic")
    data = height(RATE) + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    parameters = {"rate": Parameter(400.0, 20.0, 2000.0)}
    return fit(experiment(data), parameters, solver=solver, scaled=False, **options)


@pytest.fixture(scope="module")
def found():
    return falling()


def test_least_squares_finds_the_drag_and_how_well_it_is_known(found):
    """The uncertainty is that of the closed form's slope, and the value lies within it."""
    slope = (height(RATE * 1.001) - height(RATE * 0.999)) / (0.002 * RATE)
    expected = NOISE / np.linalg.norm(slope)
    assert found.success
    assert found.std["rate"] == pytest.approx(expected, rel=2e-2)
    assert abs(found.values["rate"] - RATE) < 3.0 * expected
    assert found.condition == pytest.approx(1.0)
    assert found.gradient_evaluations <= 8
    assert len(found.history) == found.evaluations + found.gradient_evaluations
    # The fall begins: inertia decides where it goes.
    assert found.snaps == 1 and found.history["snaps"].iloc[-1] == 1


def test_an_optimiser_finds_the_same(found):
    again = falling(method=optax.adam(0.2), max_steps=25)
    assert again.values["rate"] == pytest.approx(found.values["rate"], rel=2e-2)


def test_a_bracket_finds_a_root_without_derivatives():
    """The drag for which the sheet has fallen so far at the end, from far above it."""
    end = height(RATE)[-1]
    run = Experiment(setup, TIMES, lambda frames: (jnp.mean(frames.x[-1:, :, 2], axis=1) - end) / NOISE)
    solver = jc.integrator(1e-6, scheme="dynamic")
    found = fit(run, {"rate": Parameter(400.0, 20.0, 2000.0)}, method="root", solver=solver, rtol=1e-6)
    assert found.success
    assert found.values["rate"] == pytest.approx(RATE, rel=1e-3)
    assert abs(found.residuals[0]) < 0.1
    assert found.gradient_evaluations <= 2
    with pytest.raises(ValueError, match="one parameter from one residual"):
        falling(method="root")


def test_a_fit_goes_on_from_its_file_to_the_same_answer(found, tmp_path):
    """Cut in the midst of a line."""
    path, told = tmp_path / "new" / "fit.jsonl", []
    whole = falling(checkpoint=path)
    assert whole.values == found.values
    text = path.read_text()
    path.write_text(text[: 2 * len(text) // 3])
    kept = path.read_text().count("\n")
    again = falling(checkpoint=path, tell=told.append)
    assert again.values == found.values
    assert sum(row["seconds"] > 0.0 for row in told) == len(whole.history) - kept
    with pytest.raises(ValueError, match="holds a fit of"):
        fit(experiment(height(RATE)), {"other": Parameter(1.0, 0.5, 2.0)}, checkpoint=path)


def test_a_start_whose_run_fails_is_refused_by_name_of_the_result():
    def broken(values):
        scene, state = setup(values)
        stiffness = scene.membrane.stiffness * jnp.where(values["rate"] > 300.0, jnp.nan, 1.0)
        return eqx.tree_at(lambda s: s.membrane.stiffness, scene, stiffness), state

    run = Experiment(broken, TIMES, lambda frames: frames.x[-1, 0])
    with pytest.raises(
        ValueError, match=r"the run at rate = 400 fails: nonfinite at t = 0 s \(forces are not"
    ):
        fit(run, {"rate": Parameter(400.0, 20.0, 2000.0)})


def test_bad_files_are_refused(tmp_path):
    (tmp_path / "fit.jsonl").write_text("a line\n")
    with pytest.raises(ValueError, match="is no file of a fit"):
        falling(checkpoint=tmp_path / "fit.jsonl")
    with pytest.raises(ValueError, match="is a folder"):
        falling(checkpoint=tmp_path)


def test_bad_parameters_are_refused():
    data = height(RATE)
    with pytest.raises(ValueError, match="names nothing to find"):
        fit(experiment(data), {})
    with pytest.raises(ValueError, match="must be a Parameter"):
        fit(experiment(data), {"rate": (1.0, 0.5, 2.0)})
    with pytest.raises(ValueError, match="of finite numbers"):
        fit(experiment(data), {"rate": Parameter(1.0, 0.5, np.inf)})
    with pytest.raises(ValueError, match="between its bounds"):
        fit(experiment(data), {"rate": Parameter(1.0, 2.0, 3.0)})
    with pytest.raises(ValueError, match="positive on a logarithmic"):
        fit(experiment(data), {"rate": Parameter(1.0, -2.0, 3.0)})
