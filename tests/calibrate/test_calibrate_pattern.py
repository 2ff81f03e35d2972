"""A hidden sheet from patterns of its plastic curvature."""

import numpy as np
import pytest

import jaxcrumple as jc

HIDDEN = {"yield_curvature": 20.0, "thickness": 2.5e-4, "plastic_time": 0.1}
TIMES, NOISE = (0.8, 1.2, 1.8), 0.01
SOLVER = jc.integrator(1e-2, scheme="dynamic")


@pytest.fixture(scope="module")
def setup():
    """The hidden sheet's scene, in a sphere that stops after 1.2 s."""
    return jc.radial(80, contact=None, hold=1.2, imperfection=5e-4, sweeps=20, material=jc.Material(**HIDDEN))


@pytest.fixture(scope="module")
def seen(setup):
    """The patterns of the hidden sheet with noise, and its standard deviation."""
    start = jc.initial_state(setup.scene, setup.x)
    p = jc.simulate(setup.scene, start, TIMES, solver=SOLVER, throw=True).p
    std = NOISE * np.max(np.abs(p - np.asarray(setup.mesh.rest_curvature)))
    return p + std * np.random.default_rng(0).normal(size=p.shape), std


@pytest.mark.slow
def test_a_hidden_sheet_is_found(setup, seen):
    """Within two standard deviations, which are what the noise allows; the residuals are the noise."""
    patterns, std = seen
    factors = {"yield_curvature": 1.3, "thickness": 0.95, "plastic_time": 1.5}
    parameters = {
        name: jc.Parameter(factor * HIDDEN[name], 0.3 * HIDDEN[name], 3.0 * HIDDEN[name])
        for name, factor in factors.items()
    }
    fit = jc.calibrate_pattern(setup, TIMES, patterns, parameters, std=std, solver=SOLVER)
    assert fit.success, fit.message
    for name, value in HIDDEN.items():
        assert abs(fit.values[name] - value) < 2.5 * fit.std[name], name
        assert fit.std[name] < 0.05 * value, name
    assert np.sqrt(np.mean(fit.residuals**2)) == pytest.approx(1.0, abs=0.1)
    assert 1.0 < fit.condition < 100.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"patterns": np.zeros((2, 3))}, "a row of hinges for each time"),
        ({"std": 0.0}, "must be positive"),
        ({"std": [0.1, 0.2]}, "one number for all patterns"),
        ({"parameters": {}}, "must name what to find"),
        ({"parameters": {"colour": jc.Parameter(1.0, 0.5, 2.0)}}, "'colour' is no number"),
        ({"parameters": {"yield_c0": jc.Parameter(1.0, 0.5, 2.0)}}, "'yield_c0' is no number"),
    ],
)
def test_what_cannot_be_is_refused(setup, change, message):
    patterns = np.zeros((len(TIMES), len(setup.mesh.hinges)))
    options = {"patterns": patterns, "std": 0.1, "parameters": {"thickness": jc.Parameter(2e-4, 1e-4, 4e-4)}}
    options |= change
    with pytest.raises(ValueError, match=message):
        jc.calibrate_pattern(setup, TIMES, **options, solver=SOLVER)


def test_a_setup_says_its_material():
    setup = jc.radial(60, sweeps=5, contact=None)
    assert setup.material.thickness == jc.Material().thickness
    for other in (setup._replace(material=None), setup.scene):
        with pytest.raises(ValueError, match="a Setup with a material"):
            jc.calibrate_pattern(other, TIMES, np.zeros((3, 1)), {}, std=1.0)


def test_an_elastic_sheet_leaves_no_pattern():
    setup = jc.radial(60, sweeps=5, contact=None, material=jc.Material(yield_curvature=None))
    with pytest.raises(ValueError, match="leaves no pattern"):
        jc.calibrate_pattern(setup, TIMES, np.zeros((3, 1)), {}, std=1.0)
