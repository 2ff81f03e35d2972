"""Gaps to the walls of the scenes, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc

UP = jnp.array([0.0, 0.0, 1.0])


def test_a_number_with_corners_goes_straight_between_them():
    number = jc.Corners([1.0, 2.0, 4.0], [0.0, 3.0, -1.0])
    for t, value in ((0.0, 0.0), (1.5, 1.5), (3.0, 1.0), (9.0, -1.0)):
        assert float(number(jnp.asarray(t))) == pytest.approx(value)
    assert float(jax.grad(number)(3.5)) == pytest.approx(-2.0)


def test_the_gap_to_a_ball_that_comes_down():
    ball = jc.Ball([0.01, 0.0, 0.0], UP, 0.02, jc.Corners([0.0, 1.0], [0.05, 0.0]))
    point = jnp.array([0.01, 0.03, 0.01])
    assert float(ball.gap(point, 0.0)) == pytest.approx(0.03)
    assert float(ball.gap(point, 1.0)) == pytest.approx(np.sqrt(1e-3) - 0.02)


@pytest.mark.parametrize(
    ("point", "gap"),
    [
        ([0.05, 0.0, 0.01], 0.007),  # over the plate
        ([0.0, -0.05, -0.01], 0.007),  # under it
        ([0.0, 0.0, 0.0], 0.02),  # in the middle of the hole
        ([0.015, 0.0, 0.0], 0.005),  # in the hole, on its way to the rim
        ([0.019, 0.0, 0.003], np.hypot(0.004, 0.003) - 0.003),  # beside the round rim
        ([0.03, 0.0, 0.001], -0.002),  # inside the plate
    ],
)
def test_the_gap_to_a_plate_with_a_hole(point, gap):
    plate = jc.Opening(jnp.zeros(3), UP, 0.02, 0.003)
    assert float(plate.gap(jnp.array(point), 0.0)) == pytest.approx(gap, abs=1e-12)


def test_the_distance_to_a_plate_with_a_hole_has_slope_one_outside_of_it():
    plate = jc.Opening(jnp.zeros(3), UP, 0.02, 0.003)
    points = np.random.default_rng(0).uniform(-0.04, 0.04, (200, 3))
    outside = [p for p in points if float(plate.gap(jnp.asarray(p), 0.0)) > 1e-4 and np.hypot(*p[:2]) > 1e-3]
    slopes = jax.vmap(jax.grad(lambda p: plate.gap(p, 0.0)))(jnp.asarray(outside))
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=1), 1.0, rtol=1e-9)
