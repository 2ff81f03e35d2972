"""Fits against a closed form: a sheet that falls through air."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxcrumple as jc
from jaxcrumple.calibrate.experiment import Experiment
from jaxcrumple.calibrate.fit import Parameter, fit

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


def sheet_of(values):
    scene = made_of(values["rate"], LIKE)
    return scene, jc.initial_state(scene, MESH.vertices)


def experiment(data):
    return Experiment(sheet_of, TIMES, lambda frames: (jnp.mean(frames.x[:, :, 2], axis=1) - data) / NOISE)


DATA = experiment(height(RATE) + NOISE * np.random.default_rng(0).normal(size=len(TIMES)))


def falling(experiment=DATA, rtol_of_runs=1e-6, **options):
    solver = jc.integrator(rtol_of_runs, scheme="dynamic")
    parameters = {"rate": Parameter(400.0, 20.0, 2000.0)}
    return fit(experiment, parameters, solver=solver, **options)


def other_setup(values):
    scene, state = sheet_of(values)
    return eqx.tree_at(lambda s: s.gravity.g, scene, scene.gravity.g * 1.001), state


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


@pytest.mark.slow
def test_several_experiments_are_fitted_together(found, tmp_path):
    """Two equal experiments halve the variance; the same parameters fit both, also from the file."""
    path = tmp_path / "fit.jsonl"
    both = falling([DATA, DATA], checkpoint=path)
    assert both.success and both.residuals.shape == (2 * len(TIMES),)
    assert both.values["rate"] == pytest.approx(found.values["rate"], rel=1e-6)
    assert both.std["rate"] == pytest.approx(found.std["rate"] / np.sqrt(2.0), rel=1e-6)
    assert both.loss == pytest.approx(2.0 * found.loss, rel=1e-6)
    assert falling([DATA, DATA], checkpoint=path).values == both.values
    with pytest.raises(ValueError, match="another number of experiments"):
        falling(checkpoint=path)
    late = DATA._replace(times=1.1 * TIMES)
    with pytest.raises(ValueError, match="differs in times of experiment 1"):
        falling([DATA, late], checkpoint=path)
    with pytest.raises(ValueError, match="must be an Experiment"):
        falling([])


def test_derivatives_that_contradict_the_runs_are_told():
    """Residuals whose values move with steps that their derivatives do not see."""

    def rough(frames):
        exact = DATA.residuals(frames)
        return exact + jax.lax.stop_gradient(-0.9 * exact)

    with pytest.warns(
        UserWarning, match=r"contradict its neighbour: .* The standard deviations mean nothing"
    ):
        falling(DATA._replace(residuals=rough), max_steps=12)


def test_an_optimiser_finds_the_same(found):
    again = falling(method=optax.adam(0.2), max_steps=25)
    assert again.values["rate"] == pytest.approx(found.values["rate"], rel=2e-2)


def test_a_bracket_finds_a_root_without_derivatives():
    """The drag for which the sheet has fallen so far at the end, from far above it."""
    end = height(RATE)[-1]
    run = Experiment(sheet_of, TIMES, lambda frames: (jnp.mean(frames.x[-1:, :, 2], axis=1) - end) / NOISE)
    solver = jc.integrator(1e-6, scheme="dynamic")
    found = fit(run, {"rate": Parameter(400.0, 20.0, 2000.0)}, method="root", solver=solver, rtol=1e-6)
    assert found.success
    assert found.values["rate"] == pytest.approx(RATE, rel=1e-3)
    assert abs(found.residuals[0]) < 0.1
    assert found.gradient_evaluations <= 2
    with pytest.raises(ValueError, match="needs one residual for its one parameter, not 4"):
        falling(method="root")


def test_a_fit_goes_on_from_its_file_to_the_same_answer(found, tmp_path):
    """Cut in the midst of a line."""
    path, told = tmp_path / "new" / "fit.jsonl", []
    whole = falling(checkpoint=path)
    assert whole.values == found.values
    text = path.read_text()
    path.write_text(text[: 5 * len(text) // 6])
    kept = path.read_text().count("\n") - 1
    assert kept > 2
    again = falling(checkpoint=path, tell=told.append)
    assert again.values == found.values
    assert sum(row["seconds"] > 0.0 for row in told) == len(whole.history) - kept
    kept = path.read_bytes()
    damaged = kept.replace(b'"residuals", "u": [', b'"residuals", "u": [1', 1)
    assert damaged != kept
    path.write_bytes(damaged)
    with pytest.raises(
        ValueError, match=r"line 2 of .* is damaged: its checksum does not match. Remove the line"
    ):
        falling(checkpoint=path)
    path.write_bytes(kept)
    with pytest.raises(ValueError, match="holds a fit of rate, not of other"):
        fit(
            DATA._replace(setup=lambda values: sheet_of({"rate": values["other"]})),
            {"other": Parameter(1.0, 0.5, 2.0)},
            checkpoint=path,
        )
    rate = {"rate": Parameter(400.0, 20.0, 2000.0, log=False)}
    with pytest.raises(ValueError, match="on another scale"):
        fit(experiment(height(RATE)), rate, checkpoint=path)
    for change, what in (
        ({"setup": other_setup}, "a scene or start"),
        ({"times": 1.1 * TIMES}, "times"),
        ({"residuals": lambda frames: 2.0 * experiment(height(RATE)).residuals(frames)}, "residuals"),
        ({}, "a solver"),
    ):
        with pytest.raises(ValueError, match=f"differs in {what}"):
            falling(
                experiment=DATA._replace(**change), checkpoint=path, rtol_of_runs=1e-6 if change else 1e-5
            )
    assert path.read_bytes() == kept


def barred(side):
    """An experiment whose runs fail where `side` of the drag is negative."""

    def broken(values):
        scene, state = sheet_of(values)
        stiffness = scene.membrane.stiffness * jnp.where(side(values["rate"]) < 0.0, 1e300, 1.0)
        return eqx.tree_at(lambda s: s.membrane.stiffness, scene, stiffness), state

    return experiment(height(RATE))._replace(setup=broken)


def test_a_start_whose_run_fails_is_refused_by_name_of_the_result():
    with pytest.raises(
        ValueError, match=r"the run at rate = 400 fails: nonfinite at t = 0 s \(forces are not"
    ):
        fit(barred(lambda rate: 300.0 - rate), {"rate": Parameter(400.0, 20.0, 2000.0)})


def test_a_fit_that_failing_runs_keep_from_the_minimum_has_no_success():
    solver = jc.integrator(1e-4, scheme="dynamic")
    parameters = {"rate": Parameter(400.0, 20.0, 2000.0)}
    found = fit(barred(lambda rate: rate - 250.0), parameters, solver=solver)
    assert 250.0 <= found.values["rate"] < 300.0
    assert not found.success
    assert "a failed run bars the way: the run at rate = 2" in found.message and "nonfinite" in found.message


def test_bad_files_are_refused(tmp_path):
    for text in ("a line\n", "hello", '{"kind": 1}\n'):
        (tmp_path / "fit.jsonl").write_text(text)
        with pytest.raises(ValueError, match="is not the file of a fit"):
            falling(checkpoint=tmp_path / "fit.jsonl")
        assert (tmp_path / "fit.jsonl").read_text() == text
    (tmp_path / "fit.jsonl").write_bytes(b"\xff\xfe\n")
    with pytest.raises(ValueError, match="is not the file of a fit: cannot read line 1"):
        falling(checkpoint=tmp_path / "fit.jsonl")
    with pytest.raises(ValueError, match="is a folder"):
        falling(checkpoint=tmp_path)
    with pytest.raises(ValueError, match=r"cannot write .*check the path"):
        falling(checkpoint=tmp_path / "fit.jsonl" / "inside" / "fit.jsonl")


def test_bad_parameters_are_refused():
    data = height(RATE)
    with pytest.raises(ValueError, match="must name what to find"):
        fit(experiment(data), {})
    with pytest.raises(ValueError, match="must be a Parameter"):
        fit(experiment(data), {"rate": (1.0, 0.5, 2.0)})
    with pytest.raises(ValueError, match="of finite numbers"):
        fit(experiment(data), {"rate": Parameter(1.0, 0.5, np.inf)})
    with pytest.raises(ValueError, match="between its bounds"):
        fit(experiment(data), {"rate": Parameter(1.0, 2.0, 3.0)})
    with pytest.raises(ValueError, match="positive on a logarithmic"):
        fit(experiment(data), {"rate": Parameter(1.0, -2.0, 3.0)})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "lsq"}, "method = 'lsq' must be"),
        ({"method": optax.adam}, "an optimiser of Optax, such as"),
        ({"method": optax.lbfgs()}, "wants more than gradients"),
        ({"max_steps": 0}, "max_steps = 0"),
        ({"max_steps": 2.5}, "max_steps = 2.5"),
        ({"rtol": 0.0}, "rtol = 0.0"),
        ({"experiment": {}}, "must be an Experiment"),
        ({"experiment": DATA._replace(setup=lambda values: LIKE)}, "a scene and a state, .* not Scene"),
        (
            {"experiment": DATA._replace(setup=lambda values: sheet_of({"rate": values["r"]}))},
            "asks for 'r', which",
        ),
        (
            {"experiment": DATA._replace(setup=lambda values: sheet_of({"rate": float(values["rate"])}))},
            "build the scene with Setup.made_of",
        ),
        (
            {"experiment": DATA._replace(residuals=lambda frames: np.asarray(frames.x))},
            "compute with jax.numpy",
        ),
        (
            {"experiment": DATA._replace(residuals=lambda frames: jnp.sum(frames.x))},
            r"an array \(m,\) .* not \(\)",
        ),
        ({"experiment": DATA._replace(residuals=lambda frames: None)}, "not NoneType"),
        (
            {"experiment": DATA._replace(residuals=lambda frames: frames.x[:0, 0, 0])},
            r"at least one number, not \(0,\)",
        ),
        ({"experiment": DATA._replace(times=[0.2, 0.1])}, "must be finite, increasing"),
    ],
)
def test_what_cannot_be_evaluated_is_refused_before_any_run(options, message):
    told = []
    with pytest.raises(ValueError, match=message):
        falling(tell=told.append, **options)
    assert not told


def test_a_budget_of_steps_ends_a_run_and_the_fit_says_so():
    with pytest.raises(
        ValueError, match=r"rate = 400 fails: budget at t = .* \(its max_attempts = 3 are used up\)"
    ):
        falling(max_attempts=3)


def test_a_run_out_of_budget_is_not_kept(tmp_path, found):
    path = tmp_path / "fit.jsonl"
    with pytest.raises(ValueError, match="used up"):
        falling(max_attempts=3, checkpoint=path)
    assert falling(max_attempts=10_000, checkpoint=path).values == found.values


def test_a_fit_tells_its_own_history_of_a_shared_file(tmp_path, found):
    """Another fit that shares the file has its first run from there, and does not count the others."""
    path = tmp_path / "fit.jsonl"
    falling(checkpoint=path)
    other = falling(method=optax.adam(0.2), max_steps=2, checkpoint=path)
    assert list(other.history["kind"]).count("gradient") == 2
    assert other.evaluations == 2
    assert other.history["seconds"].iloc[0] == 0.0
    again = falling(checkpoint=path)
    assert again.evaluations == found.evaluations and not again.history["seconds"].any()


def test_a_fit_that_ends_at_a_bound_says_so_and_is_no_success():
    solver = jc.integrator(1e-5, scheme="dynamic")
    ended = fit(DATA, {"rate": Parameter(400.0, 300.0, 2000.0)}, solver=solver)
    assert ended.values["rate"] == pytest.approx(300.0, rel=1e-3)
    assert not ended.success and "rate is at its lower bound 300" in ended.message
    assert "lower bound" in repr(ended) and "condition 1" in repr(ended)


def test_uncertainties_of_what_residuals_do_not_determine_are_infinite():
    """The fall's one height tells drag or gravity, not both."""

    def run(values):
        scene, state = sheet_of(values)
        return eqx.tree_at(lambda s: s.gravity.g, scene, scene.gravity.g * values["weight"]), state

    end = height(RATE)[-1:]
    one = Experiment(run, TIMES, lambda frames: (jnp.mean(frames.x[-1:, :, 2], axis=1) - end) / NOISE)
    parameters = {"rate": Parameter(220.0, 20.0, 2000.0), "weight": Parameter(1.0, 0.5, 2.0)}
    solver = jc.integrator(1e-4, scheme="dynamic")
    assert np.all(np.isinf(list(fit(one, parameters, solver=solver).std.values())))
    with pytest.raises(ValueError, match=r"requires more residuals \(1\) than parameters \(2\)"):
        fit(one, parameters, scaled=True)
    known = falling(rtol_of_runs=1e-5, scaled=True)
    spread = 2.0 * known.loss / (len(TIMES) - 1)
    assert known.std["rate"] / falling(rtol_of_runs=1e-5).std["rate"] == pytest.approx(np.sqrt(spread))
