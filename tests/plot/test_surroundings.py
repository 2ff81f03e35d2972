"""Pictures show the walls that a run had."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folding import folding_run

from jaxcrumple import configure
from jaxcrumple.plot.surroundings import wall_shapes
from jaxcrumple.plot.wall_layers import surface_points
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.viewer.encode import encode, shared_fields


@pytest.mark.parametrize("scene", sorted(SCENES))
def test_walls_are_those_of_the_run(scene):
    config = configure(scene, nodes=120)
    setup, t = config.build(), 0.3 * config.t_end
    walls = wall_shapes(folding_run(scene, nodes=120))
    assert len(walls) == len(setup.scene.walls)
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3)))
    for shape, wall in zip(walls, setup.scene.walls, strict=True):
        gap = jax.vmap(shape.gap, (0, None))(points, t)
        # Plates rest on the nodes of a mesh that is made faster, with fewer sweeps.
        np.testing.assert_allclose(gap, jax.vmap(wall.shape.gap, (0, None))(points, t), atol=1e-4)


def test_a_run_of_another_scene_or_version_has_none():
    run = folding_run()
    for change in ({"scene": "python"}, {"scene": "file.py:mine"}, {"options": {"long_ago": 1}}):
        assert wall_shapes(replace(run, config={**run.config, **change})) == ()


def test_single_precision_draws_walls_too():
    """A notebook that only draws has not set double precision."""
    run = folding_run()
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("error")
        (shape,) = wall_shapes(run)
        points = surface_points([shape], 0.0, np.zeros(3), 0.1)
        assert encode(run, "a", shared_fields([run]), 0)[0]["walls"][0]["moves"][0] == pytest.approx(0.071)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.071, rtol=1e-9)
