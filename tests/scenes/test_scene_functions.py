"""Scenes of one's own: functions that the command line runs by name, and setups that Python built."""

import sys
import textwrap

import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.io import RunDirectoryError
from jaxcrumple.options.validation import ConfigError
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


def test_a_functions_own_material_is_the_default(module, tmp_path):
    """Options change it one by one; a preset replaces it."""
    own = SOURCE.replace("*, material,", "*, material=jc.Material(thickness=1e-4, yield_curvature=50.0),")
    (tmp_path / "thin.py").write_text(own)
    for settings, expected in (
        ([], (1e-4, 50.0, None)),
        (["yield_curvature=30"], (1e-4, 30.0, None)),
        (["yield_c0=0.2"], (1e-4, None, 0.2)),
        (["preset=paper"], (jc.preset("paper").thickness, jc.preset("paper").yield_curvature, None)),
    ):
        material = configure("thin.py:dropped", nodes=40, settings=settings).material
        assert (material.thickness, material.yield_curvature, material.yield_c0) == expected
    assert configure(f"{module}:dropped", nodes=40).material.thickness == 2.5e-4


def test_errors_of_the_users_code_are_told_with_their_line(tmp_path, monkeypatch):
    """A module beside the file is found; refusals of this package stay as they are."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "beside.py").write_text("WIDTH = 0.02\n")
    (tmp_path / "sound.py").write_text("from beside import WIDTH\n" + SOURCE)
    assert configure(f"{tmp_path}/sound.py:dropped", nodes=40).t_end == 2e-3
    (tmp_path / "missing.py").write_text("import no_such_module\n")
    with pytest.raises(ConfigError, match=r"missing.py, line 1: ModuleNotFoundError: No module named"):
        configure(f"{tmp_path}/missing.py:dropped")
    (tmp_path / "broken.py").write_text(SOURCE.replace("sweeps=3", "sweeps=three"))
    with pytest.raises(ConfigError, match=r"broken.py, line 10: NameError: name 'three'"):
        configure(f"{tmp_path}/broken.py:dropped", nodes=40)
    (tmp_path / "shapes.py").write_text(SOURCE.replace("0.0, height])", "height])"))
    with pytest.raises(ConfigError, match=r"shapes.py, line 11: ValueError: operands could not be broadcast"):
        configure(f"{tmp_path}/shapes.py:dropped", nodes=40)
    (tmp_path / "refused.py").write_text(SOURCE.replace("sweeps=3", "sweeps=-3"))
    with pytest.raises(ValueError, match=r"^sweeps = -3 is too small"):
        configure(f"{tmp_path}/refused.py:dropped", nodes=40)
    with pytest.raises(ConfigError, match="names a file: name a function in it"):
        configure(f"{tmp_path}/sound.py")


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
