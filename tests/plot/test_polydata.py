"""Frames as meshes of PyVista."""

import numpy as np
import pytest
from folding import folding_run

from jaxcrumple.measure import mean_curvature
from jaxcrumple.plot.polydata import polydata

pytest.importorskip("pyvista", reason="the extra view is not installed")


def test_a_frame_keeps_positions_triangles_and_fields():
    run = folding_run()
    sheet = polydata(run, 2, fields=["curvature", "strain", "paper"])
    np.testing.assert_array_equal(sheet.points, run.x[2])
    np.testing.assert_array_equal(sheet.regular_faces, run.mesh.faces)
    np.testing.assert_allclose(sheet.point_data["curvature"], mean_curvature(run.mesh, run.x[2]))
    assert list(sheet.cell_data) == ["strain"]
    # The run stretches a square of 10 cm by 2 % along x.
    assert polydata(run, 0).area == pytest.approx(0.0102)


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match="field 'stretch' is unknown"):
        polydata(folding_run(), fields=["stretch"])
    with pytest.raises(ValueError, match="frame 9 does not exist"):
        polydata(folding_run(), 9)
