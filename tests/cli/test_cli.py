"""The command line: what a run leaves behind, and one clear line for everything that cannot be."""

import importlib.metadata
import json
import os
import re
import runpy
import signal
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
from command_line import CONFIG, SMALL, current_checkpoint
from pictures import colors
from run_folders import contents

import jaxcrumple
from jaxcrumple.io import RunDirectory, RunDirectoryError
from jaxcrumple.io.checkpoint import read_metadata
from jaxcrumple.run.run import resume_run, start_run
from jaxcrumple.scenes.catalogue import SCENES

# --- What a run leaves behind --------------------------------------------------------------------


def test_run_succeeds_and_reports(finished):
    folder, result = finished
    assert result.returncode == 0, result.stderr
    # A third party's warning is no fault of the run.
    assert os.path.dirname(jaxcrumple.__file__) not in result.stderr
    for text in ("result: success", "3 switches", "mJ bending", "largest", f"all results: {folder}"):
        assert text in result.stdout
    assert "Traceback" not in result.stdout + result.stderr


def test_every_file_is_there(finished):
    folder, result = finished
    names = {path.name for path in folder.iterdir()}
    expected = {
        "run.json",
        "mesh.npz",
        "frames",
        "history.csv",
        "events.csv",
        "frames.csv",
        "checkpoints",
        "manifest.json",
        "summary.json",
    }
    assert expected | {"run.vtkhdf"} <= names
    pictures = sorted(folder.glob("*.png"))
    assert len(pictures) >= 2
    assert all(colors(picture) > 10 for picture in pictures)
    assert all(f"picture: {picture}" in result.stdout for picture in pictures)
    assert not list(folder.rglob("*.tmp"))


def test_summary_tells_the_run(finished):
    folder, _ = finished
    summary = json.loads((folder / "summary.json").read_text())
    asked = {"scene": "radial", "nodes": 60, "seed": 0, "t_end": 0.02, "t_reached": 0.02, "result": "success"}
    assert {key: summary[key] for key in asked} == asked
    steps, energy = summary["steps"], summary["energy"]
    assert set(steps) == {"quasistatic", "implicit", "explicit", "rejected"}
    assert steps["quasistatic"] > 20
    assert steps["implicit"] > 10
    assert summary["newton_iterations"] >= steps["quasistatic"] + steps["implicit"]
    assert 0 < summary["factors"] <= summary["newton_iterations"]
    # A residual of zero, at rest before the wall comes, takes no iteration.
    assert summary["linear_iterations"] >= summary["newton_iterations"] - 2
    assert summary["switches"] == 3
    assert {"stretch", "bending", "walls", "kinetic"} <= set(energy)
    assert all(energy[name] > 0 for name in ("stretch", "bending", "walls"))
    assert 0 < energy["kinetic"] < 0.1 * energy["bending"]
    assert 0 < summary["rms_edge_strain"] < summary["max_edge_strain"] < 0.01
    # The wall is soft: less than its range of one thickness.
    assert 0 <= summary["max_wall_penetration"] < 2.5e-4
    assert (summary["inverted_hinges"], summary["crease_length"]) == (0, 0.0)
    for name in ("compile_s", "run_s", "cpu_s"):
        assert 0 < summary[name] < 300, name
    assert 100 < summary["peak_memory_mb"] < 10_000
    assert summary["versions"]["jax"] == jaxcrumple.run.begun.importlib.metadata.version("jax")


def test_run_is_read_back(finished):
    folder, _ = finished
    run = jaxcrumple.load(folder)
    np.testing.assert_allclose(run.t, [0.0, 0.01, 0.02], rtol=1e-14)
    assert run.x.shape == run.v.shape == (3, 60, 3)
    assert run.p.shape == (3, len(run.mesh.hinges))
    assert run.mesh.faces.shape[1] == 3
    assert run.mesh.n_nodes == 60
    np.testing.assert_array_equal(run.x[0], run.mesh.vertices)
    assert run.summary == json.loads((folder / "summary.json").read_text())
    assert run.config["t_end"] == 0.02
    assert repr(run) == "Run(radial, n = 60, 3 frames to t = 0.02 s, success)"
    assert run.history["t"].iloc[-1] == 0.02
    assert run.events["to"].tolist() == ["quasistatic", "implicit", "quasistatic"]
    assert len(run.events) == run.summary["switches"]


def test_scenes_lists_options_with_defaults(in_process):
    code, streams = in_process("scenes")
    assert code == 0
    text = " ".join(streams.out.split())
    for item in (
        "radial",
        "ends at t = 2.6 s",
        "radius=0.071",
        "thickness=0.00025",
        "rtol=0.01",
        "frames=26",
    ):
        assert item in text


def test_version_and_module(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["jaxcrumple", "--version"])
    with pytest.raises(SystemExit) as caught:
        runpy.run_module("jaxcrumple", run_name="__main__")
    assert caught.value.code == 0
    assert capsys.readouterr().out.strip() == f"jaxcrumple {importlib.metadata.version('jaxcrumple')}"


def test_an_interrupted_run_says_how_to_go_on(tmp_path, monkeypatch, in_process):
    def interrupt(config, folder, *_, **__):
        folder.mkdir()
        (folder / "run.json").touch()
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("jaxcrumple.run.run.start_run", interrupt)
    code, streams = in_process("run", "radial", "--out", tmp_path / "out")
    assert code == 130
    assert f"jaxcrumple run radial --resume --out {tmp_path / 'out'}" in streams.err


def test_plot_draws_again(copy, in_process):
    for made in (*copy.glob("*.png"), copy / "run.vtkhdf"):
        made.unlink()
    code, streams = in_process("plot", copy)
    assert code == 0
    drawn = ["creases.png", "energies.png", "sheet.png", "steps.png"]
    assert sorted(path.name for path in copy.glob("*.png")) == drawn
    assert all(colors(copy / name) > 10 for name in drawn)
    with h5py.File(copy / "run.vtkhdf") as film:
        assert film["VTKHDF/Steps/Values"][:] == pytest.approx(jaxcrumple.load(copy).t)
    assert str(copy / "run.vtkhdf") in streams.out


# --- What is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["radal"], "scene 'radal' is unknown; did you mean 'radial'?"),
        (["radial", "--set", "thicknes=1"], "did you mean 'thickness'?"),
        (["radial", "--set", "thickness"], "must read key=value"),
        (["radial", "--set", "thickness=-1"], "thickness = -1.0 [m] is not usable"),
        (["radial", "--t-end", "nan"], "t_end = 'nan': Input should be a finite number"),
        (["radial", "--nodes", "3"], "nodes = 3: Input should be greater than or equal to 16"),
        (["radial", "--nodes", "60", "--set", "radius=0.07"], "choose at least 0.07071 m"),
        (["radial", "--resume"], "does not exist; give the output folder of a run"),
        (["radial", "--resume", "--nodes", "60"], "does not exist; give the output folder of a run"),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else "",
)
def test_impossible_runs_leave_nothing_behind(refused, tmp_path, arguments, message):
    assert message in refused("run", *arguments, "--out", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_taken_folders_are_refused(refused, finished, tmp_path):
    folder, _ = finished
    before = contents(folder)
    assert "holds a run already; resume it, or choose a new folder" in refused(
        "run", "radial", *SMALL, "--out", folder
    )
    assert contents(folder) == before
    (tmp_path / "file").write_text("precious")
    assert "is not empty; choose a new folder" in refused("run", "radial", *SMALL, "--out", tmp_path)
    assert "is a file; choose a new folder" in refused("run", "radial", *SMALL, "--out", tmp_path / "file")
    message = refused("run", "radial", *SMALL, "--out", tmp_path / "file" / "run")
    assert "Not a directory; check the path" in message
    assert contents(tmp_path) == {"file": b"precious"}


def test_folders_that_cannot_be_written_are_refused(refused, tmp_path):
    # The kernel's own tree refuses new folders even to an administrator.
    place = "/proc/run" if os.geteuid() == 0 else tmp_path / "locked" / "run"
    (tmp_path / "locked").mkdir(mode=0o500)
    message = refused("run", "radial", *SMALL, "--out", place)
    assert f"cannot write '{place}'" in message


def test_no_results_of_a_run_that_is_none(refused, tmp_path):
    assert "has no manifest.json; give a run's folder" in refused("plot", tmp_path)
    assert "does not exist" in refused("plot", tmp_path / "none")
    (tmp_path / "manifest.json").write_text('{"format": "other"}')
    message = refused("run", "radial", "--resume", "--out", tmp_path)
    assert "is not of the format 'jaxcrumple-manifest'" in message
    assert "no part of" in refused("repair", tmp_path)


def test_resuming_with_other_options_is_refused(refused, finished):
    folder, _ = finished
    before = contents(folder)
    message = refused("run", "radial", *SMALL, "--t-end", "0.03", "--resume", "--out", folder)
    assert "was started with t_end = 0.02, not 0.03; resume it with the values it has" in message
    # Only what is given counts: the folder's other options are not the defaults.
    message = refused("run", "radial", "--set", "thickness=1e-4", "--resume", "--out", folder)
    assert "was started with thickness = 0.00025, not 0.0001; resume" in message
    assert "scene = 'radial', not 'square'" in refused("run", "square", "--resume", "--out", folder)
    assert contents(folder) == before


def test_a_scene_that_is_built_otherwise_is_refused(refused, copy, monkeypatch):
    """Such as one whose mesh file was edited: the same options, another sheet."""
    entry = SCENES["radial"]

    def thicker(nodes, seed, *, material, **options):
        return entry.build(nodes, seed, material=replace(material, thickness=2e-4), **options)

    monkeypatch.setitem(SCENES, "radial", entry._replace(build=thicker))
    folder = RunDirectory.open(copy)
    folder.cut()
    before = contents(copy)
    text = refused("run", "radial", "--resume", "--out", copy)
    assert re.search(r"now make another \w+ than the run began with: a file that they name was changed", text)
    assert contents(copy) == before


# --- Going on ------------------------------------------------------------------------------------


def test_resuming_a_finished_run_changes_nothing(copy):
    before = contents(copy)
    assert resume_run(copy) == json.loads(before["summary.json"])
    assert contents(copy) == before


@pytest.mark.parametrize("lost", ["summary.json", "run.vtkhdf"])
def test_an_ending_that_is_lost_is_written_again(copy, lost, monkeypatch):
    """Without a simulation: the last checkpoint holds all there is to tell."""
    monkeypatch.delattr(jaxcrumple.run.run, "simulate")
    before = contents(copy)
    (copy / lost).unlink()
    summary = resume_run(copy)
    old = json.loads(before["summary.json"])
    assert summary.keys() == old.keys()
    for name in ("result", "message", "t_reached", "steps", "energy", "switches"):
        assert summary[name] == old[name]
    after = contents(copy)
    assert after.keys() == before.keys()
    for name in ("history.csv", "events.csv", "frames.csv", "run.json", "mesh.npz"):
        assert after[name] == before[name]
    # Time adds up from what the checkpoint knew.
    spent = read_metadata(current_checkpoint(copy))["spent"]
    assert all(0 < spent[name] <= summary[name] for name in ("run_s", "cpu_s"))


@pytest.fixture
def small_disk(tmp_path):
    """An empty disk of 2 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("only an administrator can mount a small disk")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


# Too little for the first checkpoint, for its replacement beside it, and for the rows that follow.
@pytest.mark.parametrize("free", [140_000, 200_000, 260_000])
def test_a_full_disk_ends_the_run_and_spoils_nothing(small_disk, finished, free):
    (small_disk / "other").write_bytes(bytes(2 * 2**20 - free))
    folder = small_disk / "run"
    with pytest.raises(RunDirectoryError, match=r"No space left on device; free some space .* is intact"):
        start_run(CONFIG, folder)
    opened = RunDirectory.open(folder)
    saved = list(opened.load_frames())
    assert len(saved) >= 1
    assert opened.read_summary() == {}
    assert not list(folder.rglob("*.tmp"))
    whole = jaxcrumple.load(finished[0])
    for index, frame in enumerate(saved):
        np.testing.assert_array_equal(frame.x, whole.x[index])
    (small_disk / "other").unlink()
    assert resume_run(folder)["result"] == "success"
    again = jaxcrumple.load(folder)
    np.testing.assert_array_equal(again.x, whole.x)
    np.testing.assert_array_equal(again.history["h"], whole.history["h"])


def test_float32_is_refused_with_the_cure():
    program = """
import jax, jaxcrumple
assert not jax.config.jax_enable_x64
mesh = jaxcrumple.rectangle(0.1, 0.1, 60, sweeps=2)
try:
    jaxcrumple.sheet(mesh, jaxcrumple.Material())
except ValueError as error:
    print(error)
"""
    clean = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=clean)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("jaxcrumple needs float64")
    assert 'jax.config.update("jax_enable_x64", True)' in result.stdout


def test_a_page_and_a_picture_are_written(in_process, refused, copy, tmp_path):
    code, streams = in_process("view", copy)
    assert code == 0 and streams.out.replace("\n", "") == str(copy / "view.html")
    assert (copy / "view.html").read_text().startswith("<!doctype html>")
    code, _ = in_process("verify", copy)
    assert code == 0
    target = tmp_path / "a.png"
    code, _ = in_process("plot", copy, "--out", target, "--field", "paper", "--view", "1,0,0.5")
    assert code == 0 and target.read_bytes()[1:4] == b"PNG"
    assert "must be three numbers" in refused("plot", copy, "--out", target, "--view", "1,0")
    assert "must be a positive length" in refused("plot", copy, "--out", target, "--width", "86 kg")
    assert "--field and --width need --out" in refused("plot", copy, "--field", "damage", "--width", "86 mm")
