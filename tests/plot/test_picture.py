"""Pictures and films of a run show what was asked for, with one camera and one scale."""

import importlib.util
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from folding import folding_run
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.text import Text
from PIL import Image

from jaxcrumple.io.run import Run
from jaxcrumple.measure import edge_strain
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.plot import picture as picture_module
from jaxcrumple.plot.fields import FIELDS
from jaxcrumple.plot.figure import new_figure
from jaxcrumple.plot.film import film
from jaxcrumple.plot.picture import picture
from jaxcrumple.plot.surroundings import wall_shapes
from jaxcrumple.run.config import RunConfig
from jaxcrumple.simulation import Solution
from jaxcrumple.state import initial_state


@pytest.fixture(scope="module")
def run():
    return folding_run()


@pytest.mark.parametrize("field", list(FIELDS))
def test_fields(run, field, tmp_path):
    drawn = picture(run, field=field, walls=False, pixels=120)
    kind = FIELDS[field]
    assert [axes.get_ylabel() for axes in drawn.figure.axes[1:]] == ([] if kind is None else [kind.label])
    assert drawn._repr_png_()[1:4] == b"PNG"
    with rc_context({"figure.dpi": 20}), Image.open(BytesIO(drawn._repr_png_())) as image:
        assert image.size == (144, 120)
    assert drawn.save(tmp_path / "a.pdf").read_bytes()[:4] == b"%PDF"


def test_a_picture_for_print_has_the_width_of_a_column(run, tmp_path):
    drawn = picture(run, walls=False, width="86 mm", pixels=120)
    path = drawn.save(tmp_path / "a.png")
    with Image.open(path) as image:
        assert image.width == pytest.approx(600 * 86 / 25.4, abs=1)
    drawn.figure.draw_without_rendering()
    letters = {text.get_fontsize() for text in drawn.figure.findobj(Text) if text.get_text()}
    assert letters and max(letters) <= 8
    long = picture(run, field="damage", walls=False, width="40 mm", pixels=120).figure
    long.draw_without_rendering()
    label = long.axes[1].yaxis.label
    assert "\n" in label.get_text() and "$p = 2 \\sin(\\theta_{rest} / 2)$" in label.get_text()
    box = label.get_window_extent()
    assert box.y0 >= 0 and box.y1 <= long.bbox.y1
    assert picture(run, walls=False, width=0.086, pixels=120).figure.get_size_inches()[0] == pytest.approx(
        3.386, abs=1e-3
    )


def test_pictures_into_axes(run):
    """They have neither caption nor colour bar; what they share is the caller's."""
    figure = new_figure((4.0, 2.0), "")
    left, right = figure.subplots(1, 2)
    scale = ScalarMappable(Normalize(-1.0, 1.0), "RdBu_r")
    for axes, field in ((left, "curvature"), (right, "paper")):
        drawn = picture(run, field=field, walls=False, axes=axes, scale=scale, pixels=120)
        assert drawn.figure is figure
    assert figure.axes == [left, right] and figure.get_suptitle() == ""
    assert len(left.texts) == len(right.texts) == 1
    with pytest.raises(ValueError, match="width is that of a new figure"):
        picture(run, axes=left, width="86 mm")


def test_values(run):
    damage = FIELDS["damage"].values(run, 3)
    ends = run.mesh.hinges[5, :2]
    assert damage[ends] == pytest.approx(0.7) and np.delete(damage, ends).max() == 0
    strain = FIELDS["strain"].values(run, 0)
    assert np.abs(strain).max() == pytest.approx(100 * np.abs(edge_strain(run.mesh, run.x[0])).max())
    assert strain.shape == (len(run.mesh.faces),) and strain.min() > -1e-9


def test_contact_force_of_two_layers(run):
    """The halves of the flat sheet do not touch; at half the range and less they do."""
    flat = FIELDS["contact"].values(run, 0)
    pressed = FIELDS["contact"].values(run, 3)
    away = np.abs(run.mesh.vertices[:, 1]) > 0.02
    assert flat.max() == 0 and np.median(pressed[away]) > 0


def test_a_solution_in_memory_is_drawn_as_its_run(run):
    """Walls and contact come from the scene; without plastic flow the rest curvature is that of the mesh."""
    scene = RunConfig(**run.config).build().scene
    state = initial_state(scene, run.x[0])
    solution = Solution(
        state, "success", "", run.t, run.x, run.v, None, run.history, run.events, compile_s=0.0, run_s=0.0
    )
    own = Run.from_solution(run.mesh, scene, solution)
    assert np.array_equal(FIELDS["contact"].values(own, 3), FIELDS["contact"].values(run, 3))
    assert [type(shape) for shape in wall_shapes(own)] == [type(shape) for shape in wall_shapes(run)]
    assert FIELDS["damage"].values(own, 3).max() == 0
    with pytest.raises(ValueError, match="give the mesh of its scene"):
        Run.from_solution(rectangle(0.1, 0.1, 30, sweeps=0), scene, solution)
    with pytest.raises(ValueError, match="has no frames"):
        Run.from_solution(run.mesh, scene, replace(solution, t=run.t[:0], x=run.x[:0], v=run.v[:0]))


def test_a_film_has_one_camera_and_one_scale(run, tmp_path, monkeypatch):
    drawn, figure = [], picture_module.sheet_figure

    def kept(*args, **kwargs):
        drawn.append((args[2], kwargs))
        return figure(*args, **kwargs)

    monkeypatch.setattr(picture_module, "sheet_figure", kept)
    path = film(run, tmp_path / "a.gif", field="strain", pixels=100, rate=5)
    assert len({id(scale) for scale, _ in drawn}) == len({id(kwargs["camera"]) for _, kwargs in drawn}) == 1
    assert [kwargs["walls"].t for _, kwargs in drawn] == pytest.approx(run.t)
    with Image.open(path) as image:
        assert image.n_frames == 4 and image.info["duration"] == 200
    film(run, tmp_path / "b.gif", frames=[-1, 0], pixels=100)
    assert [kwargs["walls"].t for _, kwargs in drawn[4:]] == pytest.approx([0.3, 0.0])


def test_mp4(run, tmp_path):
    av = pytest.importorskip("av", reason="the extra film is not installed")
    path = film(run, tmp_path / "a.mp4", pixels=100, walls=False)
    with av.open(str(path)) as video:
        assert len(list(video.decode(video=0))) == 4
        assert float(video.streams.video[0].average_rate) == 10


def test_an_mp4_without_its_extra_is_refused_before_drawing(run, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(picture_module, "sheet_figure", None)
    with pytest.raises(ImportError, match="pip install av"):
        film(run, tmp_path / "a.mp4")


def test_wrong_input_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match="field 'curvatur' is unknown; did you mean 'curvature'"):
        picture(run, field="curvatur")
    with pytest.raises(ValueError, match="frame 4 does not exist: the run has 4 frames"):
        picture(run, 4)
    with pytest.raises(ValueError, match="is no film: end its name in"):
        film(run, tmp_path / "a.avi")
    for width in ("86 kg", "wide", -0.1, np.nan, [1.0]):
        with pytest.raises(ValueError, match="must be a positive length in m"):
            picture(run, width=width)
    assert list(tmp_path.iterdir()) == []
