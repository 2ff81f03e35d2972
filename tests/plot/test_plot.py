"""Pictures are written, whole and with something in them, and leave matplotlib as it was."""

import matplotlib as mpl
import matplotlib.colors
import numpy as np
import pandas as pd
import pytest
from pictures import colors

from jaxcrumple import Material
from jaxcrumple.io import RunDirectory
from jaxcrumple.measure import hinge_curvature
from jaxcrumple.plot import plot
from jaxcrumple.plot.draw import draw_sheet
from jaxcrumple.solvers.log import AFTER, BEFORE, COLUMNS, STEP


@pytest.fixture(scope="module")
def folded(mesh, bent):
    """The bent sheet, and its rest curvature."""
    return bent, 0.8 * hinge_curvature(mesh, bent)


@pytest.fixture(scope="module")
def history():
    count = 40
    table = pd.DataFrame(np.zeros((count, len(COLUMNS))), columns=list(COLUMNS))
    table["t"] = np.linspace(0, 1, count)
    table["kind"] = STEP
    table["h"] = np.geomspace(1e-6, 1e-2, count)
    table["acceleration_mean"] = np.geomspace(1e-3, 1e-10, count)
    table["bending"], table["kinetic"] = 1e-3 * table["t"], 1e-15
    table["stage"] = ["implicit"] * 20 + ["quasistatic"] * 20
    table.loc[19, "kind"], table.loc[20, "kind"] = BEFORE, AFTER
    return table


def stiffness_of(mesh):
    return np.ones(len(mesh.edges)), np.ones(len(mesh.hinges))


def test_creases(tmp_path, mesh, folded, kept_figures):
    figures = kept_figures(plot)
    assert colors(plot.plot_creases(mesh, *folded, path=tmp_path / "c.png")) > 100
    axes = figures[0].axes[0]
    mountain, valley = (lines.get_segments() for lines in axes.collections[1:])
    middles = [1e-3 * np.median([segment.mean(axis=0)[0] for segment in kind]) for kind in (mountain, valley)]
    # z = 0.6 (|u - 0.02| - |u + 0.02|) is convex seen from below at 0.02 and from above at -0.02.
    upward = np.sign(
        np.cross(*(mesh.vertices[mesh.faces[0, k]] - mesh.vertices[mesh.faces[0, 0]] for k in (1, 2)))
    )
    assert middles == pytest.approx([-0.02 * upward[2], 0.02 * upward[2]], abs=5e-3)
    labels = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert [label.split(",")[0] for label in labels] == ["mountain", "valley"]


def test_creases_of_a_new_sheet(tmp_path, mesh, kept_figures):
    figures = kept_figures(plot)
    plot.plot_creases(mesh, mesh.vertices, mesh.rest_curvature, path=tmp_path / "b.png")
    (creases,) = figures
    assert [len(lines.get_segments()) for lines in creases.axes[0].collections[1:]] == [0, 0]
    assert [text.get_text() for text in creases.legends[0].get_texts()] == ["mountain, 0 cm", "valley, 0 cm"]


def test_steps(tmp_path, history, kept_figures):
    figures = kept_figures(plot)
    path = tmp_path / "s.png"
    assert colors(plot.plot_steps(history, thresholds=(3e-6, 1e-5), path=path)) > 10
    top, bottom = figures[0].axes
    assert top.get_yscale() == bottom.get_yscale() == "log"
    assert top.get_ylabel() == "step $h$ [s]"
    assert sum(line.get_linestyle() == "--" for line in bottom.lines) == 2
    assert "1 switches" in [text.get_text() for text in figures[0].legends[0].get_texts()]
    events = pd.DataFrame({"t": [0.1, 0.5, 0.7], "to": ["implicit", "quasistatic", None]})
    plot.plot_steps(history, events, path=path)
    assert "2 switches" in [text.get_text() for text in figures[1].legends[0].get_texts()]


def test_energies(tmp_path, history, kept_figures):
    figures = kept_figures(plot)
    plot.plot_energies(history, caption="n = 300", path=tmp_path / "e.png")
    axes = figures[0].axes[0]
    assert [line.get_label() for line in axes.lines] == ["bending", "kinetic"]
    assert axes.get_ylabel() == "energy [J]"


def test_empty_histories_are_refused(tmp_path, history):
    for table in (history[:0], pd.DataFrame()):
        with pytest.raises(ValueError, match="no steps to plot"):
            plot.plot_steps(table, path=tmp_path / "s.png")
        with pytest.raises(ValueError, match="no rows to plot"):
            plot.plot_energies(table, path=tmp_path / "s.png")


def test_pictures_of_a_run(tmp_path, mesh, folded, history):
    x, p = folded
    config = {"scene": "radial", "solver": {"rtol": 1e-4, "switch_up": 1e-5, "switch_down": 3e-6}}
    folder = RunDirectory.create(tmp_path / "run", config, mesh, stiffness_of(mesh))
    folder.save_frame(0.0, x, 0 * x, p)
    folder.commit({}, {"t": 0.0})
    assert [path.name for path in plot.plot_run(folder.path)] == ["sheet.png", "creases.png"]
    folder.append_history(history.to_numpy())
    folder.commit({}, {"t": 0.0})
    names = ["sheet.png", "creases.png", "steps.png", "energies.png"]
    assert [path.name for path in plot.plot_run(folder.path)] == names
    assert all(colors(folder.path / name) > 10 for name in names)


@pytest.mark.parametrize(
    ("solver", "up", "down"),
    [
        ({"scheme": "alternating", "rtol": 1e-4}, 3e-4, 1e-4),
        ({"scheme": "alternating", "rtol": 1e-5, "switch_up": 1e-3}, 1e-3, 1e-3 / 3),
        ({"scheme": "paper"}, None, None),
        ({"scheme": "dynamic"}, None, None),
    ],
)
def test_thresholds_are_drawn_in_the_unit_of_the_axis(
    tmp_path, kept_figures, mesh, history, solver, up, down
):
    """A switch at `up` sees a_max (m/b)^2 / sqrt(A); the axis shows a_max/a_ref, a_ref = ks/(m lambda)."""
    figures = kept_figures(plot)
    config = {"scene": "radial", "solver": solver}
    folder = RunDirectory.create(tmp_path / "run", config, mesh, stiffness_of(mesh))
    folder.save_frame(0.0, mesh.vertices, 0 * mesh.vertices, mesh.rest_curvature)
    folder.append_history(history.to_numpy())
    folder.commit({}, {"t": 0.0})
    plot.plot_run(folder.path)
    dashed = [line.get_ydata()[0] for line in figures[1].axes[1].lines if line.get_linestyle() == "--"]
    if up is None:
        assert dashed == ([1e-6, 1e-3] if solver["scheme"] == "paper" else [])
        return
    drag_rate, constants = 1e3, Material().discretize(mesh)
    unit = constants.a_ref / drag_rate**2 / np.sqrt(mesh.area)
    np.testing.assert_allclose(dashed, [down / unit, up / unit], rtol=1e-12)


def test_matplotlib_is_left_as_it_was(tmp_path, mesh, folded):
    import matplotlib.pyplot as plt

    before = dict(mpl.rcParams)
    draw_sheet(mesh, folded[0]).save(tmp_path / "a.svg")
    assert dict(mpl.rcParams) == before
    assert plt.get_fignums() == []
