"""Scene files: read, written, refused with place and line, and what is said of them before they are run."""

import re

import meshio
import numpy as np
import pytest
from scene_files import config, plain_words, spoilt, valid
from typer.testing import CliRunner

import jaxcrumple as jc
from jaxcrumple.cli import cli
from jaxcrumple.options.toml import line_of
from jaxcrumple.run.check import described
from jaxcrumple.run.config import complete, configure
from jaxcrumple.run.estimate import estimate
from jaxcrumple.run.template import template
from jaxcrumple.scenes.catalogue import SCENES

FILE = """
scene = "radial"
nodes = 60
t_end = "20 ms"
frames = 2

[options]
radius = "7.2 cm"
contact = "none"
sweeps = 5

[material]
preset = "mylar"   # and its thickness
thickness = "0.25 mm"

[solver]
rtol = 1e-2
"""
OWN = """
scene = "custom"
nodes = 60
t_end = 1e-4

[options.sheet]
shape = "square"

[[options.walls]]
kind = "sphere"
radius = {times = [0, "1 s"], values = ["8 cm", "6 cm"]}

[[options.walls]]
kind = "plane"
offset = "-1 cm"
"""


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "scene.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_a_file_says_what_settings_say(file):
    settings = ["frames=2", "radius=0.072", "contact=none", "sweeps=5", "preset=Mylar", "thickness=2.5e-4"]
    expected = configure("radial", nodes=60, t_end=0.02, settings=settings)
    assert jc.read_scene_file(file(FILE)) == expected
    assert expected.material.yield_curvature == pytest.approx(2 * 0.02 / 0.25e-3)
    changed = jc.read_scene_file(file(FILE), ["radius=80 mm"], nodes=70)
    assert (changed.nodes, changed.options["radius"], changed.material) == (70, 0.08, expected.material)


@pytest.mark.parametrize("scene", SCENES)
def test_a_template_is_a_file_of_all_defaults(file, scene):
    text = template(scene)
    assert jc.read_scene_file(file(text)) == configure(scene)
    assert "# kg/m^3" in text and '# "uniform" or "area"' in text and '"Mylar" or' in text


def test_the_commented_tables_of_a_template_are_read(file):
    text = template("custom")
    shown = text[text.index("\n# [[") :]
    numbers = {"radius": "1", "offset": "-1", "height": "-1", "half_angle": "0.5", "edge": "0.1"}
    numbers |= {"nodes": '"boundary"'}
    tables = re.sub(r"^# (?=\[\[|\w+ = )", "", shown, flags=re.MULTILINE)
    for name, value in numbers.items():
        tables = re.sub(rf"^{name} = \.\.\.", f"{name} = {value}", tables, flags=re.MULTILINE)
    found = jc.read_scene_file(file(text + tables))
    kinds = ["sphere", "cylinder", "plane", "cone", "ball", "holed-plate"]
    assert [wall["kind"] for wall in found.options["walls"]] == kinds
    assert found.options["supports"][0]["velocity"] == [0, 0, 0]


def test_configurations_survive_their_files(tmp_path):
    rng = np.random.default_rng(1)
    made = [config(rng) for _ in range(60)]
    assert {one.scene for one in made} == set(SCENES)
    for one in [*made, *(configure(scene) for scene in SCENES)]:
        jc.write_scene_file(one, tmp_path / "scene.toml")
        assert jc.read_scene_file(tmp_path / "scene.toml") == one


REFUSED = [
    (FILE, 'thickness = "0.25 mm"', 'thickness = "3 s"',
     r"line 14: material\.thickness = '3 s' is a time; give a length, such as '0\.25 mm'\.$"),
    (FILE, "0.25 mm", "0.25 mmm", r"line 14: material\.thickness = '0\.25 mmm' has an unknown unit, 'mmm'"),
    (FILE, "0.25 mm", "-1 mm", r"line 14: thickness = -0\.001 \[m\] is not usable; give a finite"),
    (FILE, "thickness =", "thicknes =", r"line 14: 'material\.thicknes' is unknown; did you mean 'thickn"),
    (FILE, "[solver]", "[solvers]", r"line 16: 'solvers' is unknown; did you mean 'solver'\?$"),
    (FILE, "nodes = 60", "rtol = 60", r"line 3: 'rtol' is unknown here; move it to the table \[solver\]\.$"),
    (FILE, "mylar", "milar", r"line 13: material\.preset = 'milar': .* is unknown; did you mean 'Mylar'\?"),
    (FILE, '"radial"', '"radal"', r"line 2: scene 'radal' is unknown; did you mean 'radial'\?$"),
    (FILE, 'scene = "radial"', "", r"toml: scene is missing; give one of radial"),
    (FILE, "20 ms", "20 s", r"line 4: t_end = 20 s must be less than 7\.2 s, when its sphere"),
    (FILE, "[material]", "[material", r"cannot be read as TOML: .*line 12"),
    (OWN, '"8 cm"', '"8 s"', r"line 11: options\.walls\[0\]\.radius\.values\[0\] = '8 s' is a time"),
    (OWN, "times", "time", r"line 11: 'options\.walls\[0\]\.radius\.time' is unknown; did you mean 'times'"),
    (OWN, "offset", "ofset", r"line 15: 'options\.walls\[1\]\.ofset' is unknown; did you mean 'offset'\?$"),
    (OWN, 'offset = "-1 cm"', "", r"line 13: options\.walls\[1\]\.offset is missing; give one\.$"),
    (OWN, '"plane"', '"plain"', r"line 14: options\.walls\[1\]\.kind = 'plain' is unknown; did you mean 'pl"),
    (OWN, '"6 cm"]', "]", r"line 11: options\.walls\[0\]\.radius\.values = .* at least 2 items"),
    (OWN, '"6 cm"', "-1", r"line 11: options\.walls\[0\]\.radius = .*: a radius must be greater than 0\.$"),
    (OWN, '[0, "1 s"]', '["1 s", 0]', r"line 11: options\.walls\[0\]\.radius = .*: times must increase\.$"),
    (OWN, '"square"', '"file"\npath = "none.vtu"', r"line 8: options\.sheet\.path = 'none\.vtu': there is"),
    (OWN, '"square"', '"sqare"', r"line 7: options\.sheet\.shape = 'sqare' is unknown; did you mean 'squ"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "old", "new", "message"), REFUSED)
def test_what_cannot_be_is_refused_with_its_place(file, text, old, new, message):
    assert text.count(old) == 1
    path = file(text.replace(old, new))
    with pytest.raises(jc.ConfigError, match=message) as caught:
        jc.read_scene_file(path)
    assert str(caught.value).startswith(str(path))


def test_what_replaces_a_value_of_a_file_has_no_line_there(file):
    with pytest.raises(jc.ConfigError, match=r"toml: options\.radius = '1 s' is a time"):
        jc.read_scene_file(file(FILE), ["radius=1 s"])


def test_lines_of_places():
    text = '[a.b]\n"c" = 1\n[[d]]\nx = 1\n[[d]]\ny.z = [\n 1,\n]\n[d.e]\nf = 2\n'
    places = {("a", "b", "c"): 2, ("d", 0, "x"): 4, ("d", 1, "y", "z", 0): 6, ("d", 1, "e", "f"): 10}
    assert {place: line_of(text, place) for place in places} == places
    assert line_of(text, ("d", 1, "missing")) == 5
    assert line_of(text, ("q",)) is None


def _refusal(path):
    """The ConfigError that refuses a file, None for one that is read; nothing else may be raised."""
    try:
        jc.read_scene_file(path)
    except jc.ConfigError as error:
        return error
    return None


def _check_refusals(file, rng, count):
    """Each refusal names the file and the place."""
    found = [error for error in (_refusal(file(spoilt(rng))) for _ in range(count)) if error is not None]
    assert 0.5 * count < len(found) < count
    for error in found:
        assert "scene.toml" in str(error)
        assert error.place or "TOML" in str(error)


def test_spoilt_files_are_refused_and_nothing_else_happens(file):
    _check_refusals(file, np.random.default_rng(0), 300)


@pytest.mark.slow
def test_ten_thousand_spoilt_files(file):
    _check_refusals(file, np.random.default_rng(7), 10_000)


def test_check_says_what_will_run(file):
    result = CliRunner().invoke(cli.app, ["check", str(file(FILE)), "--set", "scheme=paper"])
    assert result.exit_code == 0, result.output
    for line in (
        "nodes: 60, seed 0",
        "walls: sphere, radius 0.072 m, shrinking at 0.01 m/s",
        "contact: none: the sheet passes through itself",
        "material: Mylar, 4.9 GPa, 1390 kg/m3, 0.25 mm thick, yields at 160 1/m",
        "solver: paper, rtol 0.01",
        "until: t = 0.02 s, in 2 frames",
    ):
        assert line in result.output.splitlines()
    assert "rough" in result.output
    assert result.output.splitlines()[-1] == "starts in balance, clear of itself and its walls"


def test_the_configuration_of_a_loaded_run_is_written_as_a_file(tmp_path):
    asked = configure("radial", nodes=60, settings=["contact=none"])
    jc.write_scene_file(asked.model_dump(mode="json"), tmp_path / "again.toml")
    assert jc.read_scene_file(tmp_path / "again.toml") == asked
    with pytest.raises(ValueError, match=r"nosuch.toml does not exist; give a TOML file"):
        jc.read_scene_file(tmp_path / "nosuch.toml")


def test_check_counts_the_nodes_of_a_mesh_file(file, tmp_path):
    jc.disc(0.03, 40, sweeps=2).save(tmp_path / "disc.vtu")
    path = file(OWN.replace('"square"', '"file"\npath = "disc.vtu"'))
    lines = described(jc.read_scene_file(path))
    assert "nodes: 40, seed 0" in lines
    assert "walls: sphere, radius from 0.08 to 0.06 m until 1 s; plane, offset -0.01 m" in lines


def test_estimates_of_what_was_measured():
    """The numbers of docs/numbers.md, of one day and machine, lie in the range or not far off."""
    measured = [
        (configure("radial", t_end=3.7, settings=["contact=none"]), 1000, 21),
        (configure("radial", t_end=3.7, settings=["contact=none"]), 3000, 139),
        (configure("radial", t_end=4.5), 3000, 17.6 * 60),
        (configure("radial", t_end=3.0, settings=["rtol=3e-2", "thickness=0.1mm"]), 500, 16),
        (configure("cap"), 500, 0.9),
        (configure("stamping"), 1000, 3.1 * 60),
        (configure("shell"), 1000, 4.7 * 60),
        (configure("cylindrical"), 3000, 21.3 * 60),
        (configure("conical", settings=["pull=0.045"]), 1000, 11.6 * 60),
        (configure("axial", settings=["cycles=5"]), 2000, 94.5 * 60),
    ]
    for asked, nodes, seconds in measured:
        least, most = estimate(asked, nodes).run
        assert least / 2 < seconds < 2 * most


def test_the_commands(file, tmp_path, in_process):
    """A run of a file from beginning to end, its resumption, and a template."""
    path, out = file(OWN), tmp_path / "out"
    assert in_process("run", path, "--set", "contact=none", "--out", out)[0] == 0
    run = jc.load(out)
    assert run.config["options"]["walls"][1] == {"kind": "plane", "normal": [0, 0, 1], "offset": -0.01}
    assert run.summary["result"] == "success"
    code, streams = in_process("run", path, "--resume", "--out", out)
    assert code == 2 and "was started with contact = None, not 'inverse-power'" in streams.err
    assert in_process("run", path, "--set", "contact=none", "--resume", "--out", out)[0] == 0
    code, streams = in_process("scenes", "--toml", "fold")
    assert code == 0 and 'scene = "fold"' in streams.out


@pytest.mark.filterwarnings("ignore:the mesh of .* is not isotropic")
def test_a_sheet_of_ones_own(file, tmp_path):
    flat = jc.disc(0.03, 60, sweeps=3)
    thick = 1e-4 + 1e-3 * (flat.vertices[:, 0] + 0.03)
    meshio.Mesh(flat.vertices, [("triangle", flat.faces)], point_data={"h": thick}).write(tmp_path / "a.vtu")
    text = OWN.replace('"square"', '"file"\npath = "a.vtu"\nthickness = "h"')
    setup = jc.read_scene_file(file(text)).build()
    order = setup.mesh.source_nodes
    np.testing.assert_allclose(setup.material.thickness, thick[order])
    # The surface yields at one strain.
    strain = setup.material.yield_curvature * setup.material.thickness / 2
    np.testing.assert_allclose(strain, 200 * 0.25e-3 / 2)
    with pytest.raises(ValueError, match=r"'g' is not among the point data of .*: 'h'\."):
        jc.read_scene_file(file(text.replace('"h"', '"g"'))).build()


def test_valid_files_are_accepted(file):
    import tomlkit

    rng = np.random.default_rng(5)
    for _ in range(100):
        values = valid(rng)
        assert jc.read_scene_file(file(tomlkit.dumps(values))) == complete(plain_words(values))
