"""Snaps in a history, and forces on walls."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import jaxcrumple as jc
from jaxcrumple.measure import avalanches, power_law_exponent, wall_force
from jaxcrumple.replays.snaps import HIGH, REST
from jaxcrumple.solvers.log import AFTER, STEP

SCALES = {"reference_acceleration": 1e8, "inertial_time": 1e-3, "length_scale": 0.1}
UNIT = 0.1 / (1e8 * 1e-6)


def history(t, share, energy, walls=0.0):
    table = pd.DataFrame({"t": t, "acceleration": np.asarray(share) * UNIT, "stretch": energy})
    zero = {"bending": 0.0, "contact": 0.0, "work_walls": walls, "work_supports": 0.0, "kind": STEP}
    return table.assign(**zero)


def test_two_bursts_and_what_they_release():
    t = np.arange(0.0, 1.0, 1e-3)
    share = np.where(((t > 0.2) & (t < 0.21)) | ((t > 0.6) & (t < 0.604)), 5.0 * HIGH, 0.1 * HIGH)
    share[603] = 8.0 * HIGH
    energy = 3.0 - 1.0 * np.clip((t - 0.2) / 0.01, 0, 1) - 0.5 * np.clip((t - 0.6) / 0.004, 0, 1)
    found = avalanches(history(t, share, energy), **SCALES)
    np.testing.assert_allclose(found["begin"], [0.2, 0.6], atol=1.1e-3)
    np.testing.assert_allclose(
        found["end"] - found["begin"], [0.01 + REST * 1e-3, 0.004 + REST * 1e-3], atol=3e-3
    )
    np.testing.assert_allclose(found["released"], [1.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(found["peak"], [5.0 * HIGH, 8.0 * HIGH])
    # What walls put in meanwhile is released too; bursts that are closer than the rest are one.
    fed = avalanches(history(t, share, energy, walls=2.0 * t), **SCALES)
    np.testing.assert_allclose(fed["released"] - found["released"], 2.0 * (found["end"] - found["begin"]))
    slow = avalanches(history(t, share, energy), **{**SCALES, "inertial_time": 0.05, "length_scale": 250.0})
    assert len(slow) == 1 and slow["released"].iloc[0] == pytest.approx(1.5)


def test_other_rows_and_calm_runs():
    t = np.arange(0.0, 0.1, 1e-3)
    calm = history(t, 0.1 * HIGH, 1.0)
    assert len(avalanches(calm, **SCALES)) == 0
    loud = pd.concat([calm, history([0.05], [10.0], [1.0]).assign(kind=AFTER)])
    assert len(avalanches(loud, **SCALES)) == 0
    with pytest.raises(ValueError, match="has no steps"):
        avalanches(calm.iloc[:0], **SCALES)
    with pytest.raises(ValueError, match="without drag has no snaps"):
        avalanches(calm, **{**SCALES, "inertial_time": np.inf})


def test_snaps_of_a_run_are_those_of_its_record():
    setup = jc.arch(100)
    state = jc.initial_state(setup.scene, setup.x)
    solution = jc.simulate(setup.scene, state, 0.03, record=True)
    scene = setup.scene
    found = avalanches(
        solution.history,
        reference_acceleration=float(scene.reference_acceleration),
        inertial_time=float(scene.inertial_time),
        length_scale=float(scene.length_scale),
    )
    known = solution.record.snaps[np.isfinite(solution.record.snaps)]
    assert len(found) == len(known) >= 1
    np.testing.assert_allclose(found["begin"], known, atol=2e-3)


def test_the_exponent_of_a_power_law():
    rng = np.random.default_rng(0)
    values = 0.3 * (1.0 - rng.uniform(size=20_000)) ** (-1.0 / 0.7)
    exponent, error = power_law_exponent(values, 0.3)
    assert exponent == pytest.approx(1.7, abs=4.0 * error)
    assert error == pytest.approx(0.7 / np.sqrt(20_000), rel=0.05)
    with pytest.raises(ValueError, match="give a positive bound that two reach"):
        power_law_exponent(values, 1e30)


def test_the_force_on_a_sphere_is_the_slope_of_its_energy():
    mesh = jc.disc(0.05, 60)
    wall = jc.Sphere(jnp.zeros(3), jc.Ramp(0.0501, -0.01))
    scene = jc.sheet(mesh, jc.Material(), walls=[wall])

    def energy(radius):
        other = eqx.tree_at(lambda s: s.walls[0].shape.radius.start, scene, jnp.asarray(radius))
        return float(other.walls[0].energy(jnp.asarray(mesh.vertices), jnp.asarray(0.0)))

    slope = (energy(0.0501 + 1e-8) - energy(0.0501 - 1e-8)) / 2e-8
    assert wall_force(scene.walls[0], mesh.vertices, 0.0) == pytest.approx(-slope, rel=1e-6)
    assert slope < 0
