"""Pictures of sections, volume fractions and distributions show what was measured."""

import matplotlib.image
import numpy as np
import pytest
from shapes import RADIUS, icosphere

from jaxcrumple import measure
from jaxcrumple.plot import sections as plot_sections

H = 2e-3


@pytest.fixture(scope="module")
def sphere():
    return icosphere(3)


@pytest.fixture
def figures(kept_figures):
    return kept_figures(plot_sections)


def test_section_to_scale(tmp_path, sphere, figures):
    path = tmp_path / "a.png"
    options = {"point": [0, 0, 0.3 * RADIUS], "caption": "n = 642"}
    assert plot_sections.plot_section(sphere, sphere.vertices, H, **options, path=path) == path
    assert min(matplotlib.image.imread(path).shape[:2]) > 400
    axes = figures[0].axes[0]
    assert figures[0].get_suptitle() == "n = 642" and axes.get_aspect() == 1
    outlines, lines = axes.collections
    # A ring, as wide as the thickness over the cosine of the slope of the sphere.
    ring = 1e3 * RADIUS * np.sqrt(1 - 0.3**2)
    drawn = np.linalg.norm(np.concatenate([p.vertices for p in outlines.get_paths()]), axis=1)
    width = 1e3 * H / np.sqrt(1 - 0.3**2)
    assert (drawn.min(), drawn.max()) == pytest.approx((ring - width / 2, ring + width / 2), rel=0.015)
    assert np.linalg.norm(np.concatenate(lines.get_segments()), axis=1) == pytest.approx(ring, rel=0.015)
    assert axes.get_xlim()[1] >= ring


def test_volume_fraction(tmp_path, sphere, figures):
    fractions = {
        name: measure.volume_fraction(sphere, sphere.vertices * [1, 1, squeeze], H, shells=5)
        for name, squeeze in (("t = 1 s", 1.0), ("t = 2 s", 0.4))
    }
    plot_sections.plot_volume_fraction(fractions, path=tmp_path / "a.png")
    one, two, _ = figures[0].axes[0].lines
    assert one.get_xdata() == pytest.approx([0.1, 0.3, 0.5, 0.7, 0.9])
    # All of the sphere is in the outermost shell, which is 1 - 0.8^3 of its ball.
    assert one.get_ydata() == pytest.approx([0, 0, 0, 0, 1 / (1 - 0.8**3)])
    assert two.get_ydata()[2] > 0
    assert two.get_label().startswith("t = 2 s: $\\phi_0$ = 0.1")


def test_distributions(tmp_path, figures):
    steps = {"a": measure.Distribution(np.array([0.0, 1, 3, 4]), np.array([0.5, 0.0, 0.5]))}
    plot_sections.plot_distributions(steps, label="angle [rad]", path=tmp_path / "a.png")
    axes = figures[0].axes[0]
    assert axes.get_xlabel() == "angle [rad]" and axes.get_yscale() == "log"
    values = axes.patches[0].get_data()
    assert values.edges.tolist() == [0, 1, 3, 4]
    np.testing.assert_array_equal(values.values, [0.5, np.nan, 0.5])


def test_what_is_refused(tmp_path, sphere):
    path = tmp_path / "a.png"
    with pytest.raises(ValueError, match="plane does not cut the sheet"):
        plot_sections.plot_section(sphere, sphere.vertices, H, point=[1, 0, 2 * RADIUS], path=path)
    with pytest.raises(ValueError, match="no volume fraction to plot"):
        plot_sections.plot_volume_fraction({}, path=path)
    with pytest.raises(ValueError, match="no distribution to plot"):
        plot_sections.plot_distributions({}, label="angle", path=path)
    assert not path.exists()
