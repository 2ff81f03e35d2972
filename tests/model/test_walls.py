"""Gaps to the walls of the scenes, against closed forms."""

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.model import walls
from jaxcrumple.scenes.wall_options import AnyWall, BallWall

UP = jnp.array([0.0, 0.0, 1.0])


def test_a_number_with_corners_goes_straight_between_them():
    number = jc.PiecewiseLinear([1.0, 2.0, 4.0], [0.0, 3.0, -1.0])
    for t, value in ((0.0, 0.0), (1.5, 1.5), (3.0, 1.0), (9.0, -1.0)):
        assert float(number(jnp.asarray(t))) == pytest.approx(value)
    assert float(jax.grad(number)(3.5)) == pytest.approx(-2.0)


def test_the_gap_to_a_ball_that_comes_down():
    ball = jc.Ball([0.01, 0.0, 0.0], UP, 0.02, jc.PiecewiseLinear([0.0, 1.0], [0.05, 0.0]))
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
    plate = jc.HoledPlate(jnp.zeros(3), UP, 0.02, 0.003)
    assert float(plate.gap(jnp.array(point), 0.0)) == pytest.approx(gap, abs=1e-12)


def test_the_distance_to_a_plate_with_a_hole_has_slope_one_outside_of_it():
    plate = jc.HoledPlate(jnp.zeros(3), UP, 0.02, 0.003)
    points = np.random.default_rng(0).uniform(-0.04, 0.04, (200, 3))
    outside = [p for p in points if float(plate.gap(jnp.asarray(p), 0.0)) > 1e-4 and np.hypot(*p[:2]) > 1e-3]
    slopes = jax.vmap(jax.grad(lambda p: plate.gap(p, 0.0)))(jnp.asarray(outside))
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=1), 1.0, rtol=1e-9)


def test_a_scene_file_knows_every_shape():
    """Each table builds a shape of its own kind, and no shape of the package is left out."""
    given = {"radius": 0.05, "offset": -0.01, "height": 0.02, "half_angle": 0.6, "edge": 1e-3}
    tables = get_args(get_args(AnyWall)[0])
    shapes = []
    for table in tables:
        (kind,) = get_args(table.model_fields["kind"].annotation)
        own = {name: given[name] for name in table.model_fields if name in given}
        shapes.append(type(table(kind=kind, **own).shape()))
    known = {shape for shape in walls.AbstractShape.__subclasses__() if shape.__module__ == walls.__name__}
    assert len(shapes) == len(set(shapes)) and set(shapes) == known


def test_a_table_gives_the_wall_of_its_numbers():
    table = BallWall(
        kind="ball", radius=0.02, height={"times": [0.0, 1.0], "values": [0.05, 0.0]}, axis=[0, 0, 3]
    )
    ball = jc.Ball(jnp.zeros(3), UP, 0.02, jc.PiecewiseLinear([0.0, 1.0], [0.05, 0.0]))
    for t in (0.0, 0.3, 2.0):
        point = jnp.array([0.01, 0.03, 0.01])
        assert float(table.shape().gap(point, t)) == pytest.approx(float(ball.gap(point, t)), rel=1e-14)
