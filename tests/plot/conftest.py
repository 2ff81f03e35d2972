"""A sheet that tests of pictures share."""

import numpy as np
import pytest

from jaxcrumple.mesh.generate import rectangle


@pytest.fixture(scope="module")
def mesh():
    return rectangle(0.1, 0.1, 300, sweeps=20)


@pytest.fixture(scope="module")
def bent(mesh):
    """Positions of a sheet with a mountain and a valley along y."""
    u = mesh.vertices[:, 0]
    x = mesh.vertices * [0.8, 1, 1]
    x[:, 2] = 0.6 * (np.abs(u - 0.02) - np.abs(u + 0.02))
    return x
