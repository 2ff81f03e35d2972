"""Sweeps and campaigns from files, on the command line."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from typer.testing import CliRunner

import jaxcrumple as jc
from jaxcrumple.cli.cli import app
from jaxcrumple.sweeps.file import read_sweep

FILE = """
scene = "arch"
t_end = 1e-4
frames = 2

[settings]
nodes = 60
scheme = "explicit"

[over]
load = [0.2, 0.1]
max_step = ["none"]
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "arch.toml"
    path.write_text(FILE)
    return path


def test_a_file_is_read(file):
    found = read_sweep(file)
    assert (found.scene, found.end, found.frames) == ("arch", 1e-4, 2)
    assert found.over == {"load": [0.2, 0.1], "max_step": ["none"]}


def test_values_with_units_are_numbers_in_si(file):
    units = {"t_end = 1e-4": 't_end = "0.1 ms"', "[0.2, 0.1]": '["200 mN", 0.1]', '"none"': '"1 ms", "none"'}
    text = FILE
    for plain, unit in units.items():
        text = text.replace(plain, unit)
    file.write_text(text)
    found = read_sweep(file)
    assert found.end == 1e-4
    assert found.over == {"load": [0.2, 0.1], "max_step": [1e-3, "none"]}


def test_a_limit_of_wall_time_is_read(file):
    assert read_sweep(file).max_seconds is None
    file.write_text(FILE.replace("frames = 2", 'max_seconds = "30 min"'))
    assert read_sweep(file).max_seconds == 1800.0


def test_the_command_writes_a_table_and_overwrites_none(file, tmp_path):
    folder = tmp_path / "kept"
    arguments = ["sweep", str(file), "--backend", "batch", "--folder", str(folder)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    table = xr.load_dataset(file.with_suffix(".nc"), engine="scipy")
    assert table["load"].values.tolist() == [0.2, 0.1]
    assert np.all(table.result == "success")
    np.testing.assert_allclose(table.time, [5e-5, 1e-4])
    assert np.all(table.energy.sel(term="gravity") == 0.0)
    assert table.energy.units == "J" and table.crease_length.units == "m"
    names = {f"load={load},max_step=none.nc" for load in (0.2, 0.1)}
    assert {path.name for path in folder.iterdir()} == {*names, "sweep.json", ".lock"}
    with pytest.raises(ValueError, match="exists; give another --out"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_a_campaign_is_done_once(file, tmp_path):
    folder = tmp_path / "runs"
    for before in (0, 2):
        arguments = ["campaign", str(file), "--out", str(folder)]
        result = CliRunner().invoke(app, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        assert f"2 runs, {before} of them ended before" in " ".join(result.output.split())
    table = pd.read_csv(folder / "campaign.csv", index_col="run")
    assert list(table.index) == ["load=0.2,max_step=none", "load=0.1,max_step=none"]
    assert np.all(table["t_reached"] == 1e-4)
    assert len(jc.load(folder / table.index[0]).t) == 3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('scene = "arch"', 'scene = "arc"', "scene 'arc' is unknown"),
        ('scene = "arch"', "", "scene is missing"),
        ("t_end", "t_emd", "'t_emd' is unknown; did you mean 't_end'"),
        ("t_end = 1e-4", "t_end = -1.0", "t_end = -1.0: Input should be greater than 0"),
        ("load = [0.2, 0.1]", "load = 0.2", "over.load = 0.2: Input should be a valid list"),
        ("[over]", "[over", "cannot be read as TOML"),
        ("[over]", "[overs]", "'overs' is unknown; did you mean 'over'"),
        ("nodes = 60", "frames = 3", "frames is the same for all: give it at the top"),
        ("max_step", "t_end", "t_end is the same for all"),
        ("max_step", "max_seconds", "max_seconds is the same for all"),
        ("frames = 2", 'max_seconds = "2 mm"', r"max_seconds = '2 mm' is a length; give a time"),
        ("[0.2, 0.1]", '["2 mm", 0.1]', r"over\.load = \['2 mm', 0\.1\]: one is a length; give a force"),
    ],
)
def test_what_cannot_be_is_refused_by_name_of_the_file(file, old, new, message):
    file.write_text(FILE.replace(old, new))
    with pytest.raises(jc.ConfigError, match=message) as caught:
        read_sweep(file)
    assert str(file) in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(jc.ConfigError, match=r"none\.toml does not exist"):
        read_sweep(tmp_path / "none.toml")
