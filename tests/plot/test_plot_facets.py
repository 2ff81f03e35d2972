"""Pictures of facets, areas and growth show what was measured."""

import numpy as np
import pytest
from pictures import colors

from jaxcrumple import measure
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.plot import facets as plot_facets


@pytest.fixture
def figures(kept_figures):
    return kept_figures(plot_facets)


def test_facets(tmp_path, figures):
    mesh = rectangle(0.1, 0.1, 100, sweeps=10)
    label = (mesh.vertices[mesh.faces, 0].mean(axis=1) > 0).astype(int)
    crossing = np.ptp(label[mesh.hinge_faces], axis=1) > 0
    path = plot_facets.plot_facets(mesh, label, 0.5 * crossing, caption="n = 100", path=tmp_path / "f.png")
    assert colors(path) > 10
    triangles, lines = figures[0].axes[0].collections
    assert len(np.unique(triangles.get_facecolor(), axis=0)) == 2
    assert len(triangles.get_facecolor()) == len(mesh.faces)
    assert len(lines.get_segments()) == crossing.sum()
    with pytest.raises(ValueError, match=r"label has shape \(3,\)"):
        plot_facets.plot_facets(mesh, [0, 1, 1], 0.5 * crossing, path=path)


def test_areas(tmp_path, figures):
    areas = np.random.default_rng(0).gamma(1.0, size=2000) ** 2
    plot_facets.plot_areas(areas, bins=10, path=tmp_path / "a.png")
    axes = figures[0].axes[0]
    law = next(line for line in axes.lines if line.get_label().startswith("fragmentation"))
    a = measure.fit_areas(areas).a
    assert law.get_ydata() == pytest.approx(measure.area_density(law.get_xdata(), a))
    xi, density = axes.lines[0].get_data()
    width = xi * 2 * np.sinh(0.5 * np.log(xi[-1] / xi[-2]))  # of bins equal on the logarithmic axis
    assert np.sum(density * width) == pytest.approx(1)


def test_growth(tmp_path, figures):
    n = np.arange(1, 7)
    length = 0.4 * np.log1p(0.7 * n)
    plot_facets.plot_growth(n, length, path=tmp_path / "g.png")
    lines = {line.get_label().split(",")[0]: line for line in figures[0].axes[0].lines}
    assert lines["measured"].get_ydata() == pytest.approx(length)
    x, y = lines["logarithmic"].get_data()
    assert y == pytest.approx(0.4 * np.log1p(0.7 * x), rel=1e-6)
    assert set(lines) == {"measured", "logarithmic", "linear", "power"}


def test_growth_of_several_sheets_is_that_of_their_mean(tmp_path, figures):
    n = np.arange(1, 6)
    sheets = np.outer([0.3, 0.5], np.log1p(0.7 * n))
    plot_facets.plot_growth(n, sheets, path=tmp_path / "g.png")
    lines = figures[0].axes[0].lines
    assert np.array([line.get_ydata() for line in lines[:2]]) == pytest.approx(sheets)
    assert lines[2].get_label() == "mean"
    assert lines[2].get_ydata() == pytest.approx(0.4 * np.log1p(0.7 * n))
    law = next(line for line in lines if line.get_label().startswith("logarithmic"))
    x, y = law.get_data()
    assert y == pytest.approx(0.4 * np.log1p(0.7 * x), rel=1e-6)
