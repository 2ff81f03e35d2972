"""Scenes of one's own: functions that the command line runs by name, and setups that Python built."""

import sys
import textwrap

import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.io import RunDirectoryError
from jaxcrumple.run.check import described
from jaxcrumple.run.config import configure

SOURCE = textwrap.dedent('''
    import numpy as np

    import jaxcrumple as jc
    from jaxcrumple.scenes.quantities import Length


    def dropped(nodes, seed, *, material, width: float = 0.02, height: Length = 1e-3):
        """Square sheet that falls on a floor."""
        mesh = jc.rectangle(width, width, nodes, seed=seed, sweeps=3)
        x = mesh.vertices + np.array([0.0, 0.0, height])
        scene = jc.sheet(mesh, material, walls=[jc.Plane((0.0, 0.0, 1.0), 0.0)], gravity=(0.0, 0.0, -9.81))
        return jc.Setup(mesh, scene, x, None, material, t_end=2e-3, frames=2)


    def unending(nodes, seed, *, material):
        return dropped(nodes, seed, material=material)._replace(t_end=None)


    def nothing(nodes, seed, *, material):
        return 3


    def other(nodes, **options):
        return None
''')


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A folder with the module, as working directory; its name."""
    (tmp_path / "my_scenes.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "my_scenes", raising=False)
    return "my_scenes"


def test_a_function_is_a_scene_with_options_and_an_end(module):
    config = configure(f"{module}:dropped", nodes=40, settings=["thickness=0.2 mm"])
    assert (config.t_end, config.frames, config.options) == (2e-3, 2, {"width": 0.02, "height": 1e-3})
    # Numbers may have a unit, as those of the built-in scenes.
    setup = configure(f"{module}:dropped", nodes=40, settings=["width=3 cm"]).build()
    assert setup.mesh.n_nodes == 40 and np.ptp(setup.mesh.vertices[:, 0]) == pytest.approx(0.03)
    lines = described(config)
    assert "my_scenes:dropped, Square sheet that falls on a floor" in lines[0]
    assert "contact: as the function builds it" in lines
    assert configure(f"{module}:dropped", nodes=40, t_end=0.01).t_end == 0.01


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "my_scene:dropped",
            r"there is no module 'my_scene' in .* give MODULE:FUNCTION or FILE\.py:FUNCTION",
        ),
        ("no.py:dropped", r"there is no file 'no\.py'"),
        ("my_scenes:droped", r"my_scenes has no function 'droped'; did you mean 'dropped'\?"),
        ("my_scenes:other", r"must be a function of nodes, seed and material, and of its options by name"),
        ("my_scenes:nothing", r"must return a jaxcrumple\.Setup, not int"),
        ("my_scenes:unending", r"t_end is missing: give it, or return a Setup with t_end"),
    ],
)
def test_what_is_no_scene_is_refused(module, name, message):
    with pytest.raises(jc.ConfigError, match=message):
        configure(name, nodes=40)


def test_options_of_a_function_are_checked(module):
    for settings, message in (
        ({"widht": 0.1}, "'widht' is unknown; did you mean 'width'"),
        ({"width": "broad"}, r"options\.width = 'broad'"),
        ({"height": "3 s"}, r"options\.height = '3 s' is a time; give a length"),
        ({"height": "-1 mm"}, r"options\.height = '-1 mm': Input should be greater than 0"),
    ):
        with pytest.raises(jc.ConfigError, match=message):
            configure(f"{module}:dropped", nodes=40, settings=settings)


def test_the_command_runs_a_function_that_goes_on_from_anywhere(module, tmp_path, monkeypatch, in_process):
    for first in (["--nodes", "40"], ["--resume"]):
        code, streams = in_process(
            "run", "my_scenes.py:dropped", *first, "--out", "out", "--max-seconds", "0"
        )
        assert code == 1 and "budget" in streams.out + streams.err
        # Every call loads the file anew, as a process of its own does.
        del sys.modules[str(tmp_path.resolve() / "my_scenes.py")]
    monkeypatch.chdir("/")
    resumed = jc.resume_run(tmp_path / "out")
    assert resumed["result"] == "success" and resumed["t_reached"] == 2e-3
    run = jc.load(tmp_path / "out")
    # In free fall from rest, before it reaches the floor.
    assert run.x[-1][:, 2].mean() < 1e-3


class Creep(jc.AbstractFlowRule):
    """A sheet that forgets."""

    def rate(self, c, p):
        return 2.0 * (c - p)


class Faster(Creep):
    """The same with the same numbers, twice as fast."""

    def rate(self, c, p):
        return 4.0 * (c - p)


def setup_of(height=1e-3, law=None):
    mesh = jc.rectangle(0.02, 0.02, 40, sweeps=3)
    scene = jc.sheet(mesh, jc.Material(), gravity=(0.0, 0.0, -9.81), plasticity=law or Creep())
    return jc.Setup(mesh, scene, mesh.vertices + np.array([0.0, 0.0, height]), t_end=2e-3, frames=2)


def test_a_setup_gets_a_folder_that_goes_on_to_the_same_bits(tmp_path):
    whole = jc.start_run(setup_of(), tmp_path / "whole", solver={"rtol": 1e-3})
    assert whole["result"] == "success" and whole["rtol"] == 1e-3
    cut = jc.start_run(setup_of(), tmp_path / "cut", solver={"rtol": 1e-3}, max_seconds=0.0)
    assert cut["result"] == "budget"
    with pytest.raises(jc.ConfigError, match=r"resume_run\(folder, setup=setup\)"):
        jc.resume_run(tmp_path / "cut")
    with pytest.raises(RunDirectoryError, match="now make another start than the run began with"):
        jc.resume_run(tmp_path / "cut", setup=setup_of(2e-3))
    with pytest.raises(RunDirectoryError, match="now make another plasticity than the run began with"):
        jc.resume_run(tmp_path / "cut", setup=setup_of(law=Faster()))
    assert jc.resume_run(tmp_path / "cut", setup=setup_of())["result"] == "success"
    one, other = (jc.load(tmp_path / name) for name in ("whole", "cut"))
    np.testing.assert_array_equal(one.x, other.x)
    np.testing.assert_array_equal(one.v, other.v)


def test_what_a_setup_lacks_is_told(tmp_path):
    with pytest.raises(jc.ConfigError, match="no end time"):
        jc.start_run(setup_of()._replace(t_end=None), tmp_path / "a")
    with pytest.raises(jc.ConfigError, match="give solver only with a Setup"):
        jc.start_run(configure("arch", nodes=60), tmp_path / "b", solver={"rtol": 1e-3})
    assert not any(tmp_path.iterdir())
