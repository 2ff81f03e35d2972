"""A mesh and a run folder that tests of files share."""

import numpy as np
import pytest
from run_folders import stiffness_of

from jaxcrumple.io import RunDirectory
from jaxcrumple.mesh.generate import rectangle


@pytest.fixture(scope="module")
def mesh():
    return rectangle(0.1, 0.08, 60, sweeps=20)


@pytest.fixture
def folder(tmp_path, mesh):
    config = {"nodes": np.int64(60), "rtol": 1e-4}
    return RunDirectory.create(tmp_path / "run", config, mesh, stiffness_of(mesh))
