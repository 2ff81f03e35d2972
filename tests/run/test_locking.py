"""Meshes that are too coarse for the folds of a confined sheet."""

import numpy as np
import pytest

from jaxcrumple.run.check import described
from jaxcrumple.run.config import configure
from jaxcrumple.run.locking import fold_size, folds, is_locked, locking

FREE = {"stretch": 0.03, "bending": 0.16, "contact": 0.02, "walls": 0.001}


def test_a_mesh_locks_where_stretching_holds_more_than_bending_under_pressure():
    assert not is_locked(FREE) and locking(FREE) == ""
    # The energies in J of a sheet of 0.125 mm and 1000 nodes at R = 1.9 cm.
    stuck = {"stretch": 0.159, "bending": 0.056, "contact": 0.055, "walls": 0.0}
    assert locking(stuck) == "the mesh locks: stretching holds 74% of the elastic energy"
    assert not is_locked(stuck | {"contact": 0.0})


def test_folds_are_as_wide_as_the_sphere_until_layers_fill_it():
    """One layer across the sphere, a disc of its radius, needs no fold; nine layers need a third."""
    radius = 0.02
    assert np.isclose(fold_size(np.pi * radius**2, radius), radius)
    assert np.isclose(fold_size(9.0 * np.pi * radius**2, radius), radius / 3.0)


@pytest.mark.parametrize(
    ("scene", "nodes", "t_end", "radius"),
    [
        ("radial", 1000, 5.2, 19),
        ("radial", 3000, 4.5, 26),
        ("unload", 1000, 5.3, 45),
        ("unload", 1000, 1.1, 60),
    ],
)
def test_check_compares_folds_and_edges(scene, nodes, t_end, radius):
    config = configure(scene, nodes=nodes, t_end=t_end)
    (line,) = folds(config, nodes)
    assert f"at R = {radius} mm" in line and line in described(config)
    assert ("give at least 1200 nodes" in line) == (radius == 19)
    # As many as it asks for are enough.
    assert "too few" not in folds(config, 1200)[0]


def test_other_scenes_and_a_sphere_that_rests_say_nothing_new():
    assert folds(configure("cylindrical"), 1000) == []
    assert folds(configure("radial", settings=["contact=none"]), 1000) == []
    (line,) = folds(configure("radial", t_end=6.0, settings=["hold=2 s"]), 1000)
    assert "at R = 51 mm" in line
