"""The folder of a run: what it holds, what a kill or a full disk does to it, and reading it back."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields

import numpy as np
import pytest

from jaxcrumple.io import Frame, RunDirectory, RunDirectoryError, load
from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.mesh import Mesh
from jaxcrumple.meshgen import hexagonal, rectangle
from jaxcrumple.solvers.log import Row

COLUMNS = list(Row._fields)


@pytest.fixture(scope="module")
def mesh():
    return rectangle(0.1, 0.08, 60, sweeps=20)


@pytest.fixture
def folder(tmp_path):
    return RunDirectory.create(tmp_path / "run", {"nodes": np.int64(60), "rtol": 1e-4})


def rows(first, count):
    """History rows that differ from each other, with numbers of many digits."""
    table = np.zeros((count, len(COLUMNS)))
    table[:, COLUMNS.index("t")] = (first + np.arange(count)) / 7
    table[:, COLUMNS.index("stage")] = np.arange(count) % 2
    table[:, COLUMNS.index("quasistatic_steps")] = first + np.arange(count)
    return table


def fill(folder, mesh, frames=3):
    """A run with a few frames, rows and events; returns the frames."""
    rng = np.random.default_rng(0)
    saved = []
    for index in range(frames):
        x, v = rng.normal(size=(2, mesh.n_nodes, 3))
        saved.append(Frame(index / 3, x, v, rng.normal(size=len(mesh.hinges))))
        folder.save_frame(index, *saved[-1])
        folder.append_history(COLUMNS, rows(2 * index, 2))
        folder.append_events([{"t": index / 3, "from": "quasistatic", "to": "implicit"}])
    return saved


def contents(path):
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


# Making and opening


def test_config_round_trips(folder):
    assert folder.config == {"nodes": 60, "rtol": 1e-4}
    assert RunDirectory.open(folder.path).config == folder.config
    assert RunDirectory.open(str(folder.path)).counts == (0, 0, 0)


def test_empty_folder_is_accepted(tmp_path):
    RunDirectory.create(tmp_path, {})


def test_occupied_places_are_refused(tmp_path, folder):
    with pytest.raises(RunDirectoryError, match="holds a run already; resume it"):
        RunDirectory.create(folder.path, {})
    with pytest.raises(RunDirectoryError, match="is not empty"):
        RunDirectory.create(tmp_path, {})
    file = tmp_path / "file"
    file.write_text("precious")
    with pytest.raises(RunDirectoryError, match="is a file"):
        RunDirectory.create(file, {})
    with pytest.raises(RunDirectoryError, match=r"cannot write .*Not a directory; check the path"):
        RunDirectory.create(file / "below", {})
    assert file.read_text() == "precious"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that nobody may write to")
def test_forbidden_place_is_refused():
    with pytest.raises(RunDirectoryError, match="cannot write '/proc/jaxcrumple"):
        RunDirectory.create("/proc/jaxcrumple/run", {})


def test_other_folders_are_not_opened(tmp_path, folder):
    with pytest.raises(RunDirectoryError, match="does not exist"):
        RunDirectory.open(tmp_path / "nothing")
    with pytest.raises(RunDirectoryError, match="is a file"):
        RunDirectory.open(folder.path / "run.json")
    with pytest.raises(RunDirectoryError, match=r"is not a run: it has no run\.json"):
        RunDirectory.open(tmp_path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "cannot read"),
        ("[1]", "no JSON object"),
        ('{"format": "other"}', "not of this program"),
        ('{"format": "jaxcrumple-run", "version": 7, "config": {}}', "format version 7"),
    ],
)
def test_foreign_config_is_refused(folder, text, match):
    (folder.path / "run.json").write_text(text)
    with pytest.raises(RunDirectoryError, match=match):
        RunDirectory.open(folder.path)


def test_config_without_json_form_is_refused(tmp_path):
    with pytest.raises(TypeError, match="has no JSON form"):
        RunDirectory.create(tmp_path / "run", {"f": len})


# Round trips


def test_mesh_round_trips_bit_for_bit(folder, mesh):
    bent = mesh.with_rest_shape(mesh.vertices + 1e-3 * np.sin(90 * mesh.vertices[:, [1, 2, 0]]))
    for original in (mesh, bent, hexagonal(5, 4, 0.1, reorder=False)):
        folder.save_mesh(original)
        loaded = folder.load_mesh()
        for field in fields(Mesh):
            a, b = getattr(original, field.name), getattr(loaded, field.name)
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes(), field.name
            assert not b.flags.writeable


def test_run_round_trips(folder, mesh):
    folder.save_mesh(mesh)
    saved = fill(folder, mesh)
    folder.write_summary({"end_time": np.float64(0.5), "result": "success"})
    run = load(folder.path)
    assert run.t.tolist() == [frame.t for frame in saved]
    for name in ("x", "v", "p"):
        assert getattr(run, name).tobytes() == np.stack([getattr(f, name) for f in saved]).tobytes()
    assert run.summary == {"end_time": 0.5, "result": "success"}
    assert run.config["nodes"] == 60
    assert list(run.history.columns) == COLUMNS
    assert run.history["t"].tolist() == (np.arange(6) / 7).tolist()  # to the last digit
    assert run.history["stage"].tolist() == ["quasistatic", "implicit"] * 3
    assert run.history["quasistatic_steps"].dtype.kind == run.history["kind"].dtype.kind == "i"
    assert run.events["to"].tolist() == ["implicit"] * 3


def test_elastic_run_keeps_its_rest_curvature(folder, mesh):
    folder.save_mesh(mesh)
    folder.save_frame(0, 0.0, mesh.vertices, 0 * mesh.vertices, None)
    assert folder.load_frame(0).p is None
    assert load(folder.path).p.tolist() == [mesh.rest_curvature.tolist()]


def test_killed_run_loads(folder, mesh):
    folder.save_mesh(mesh)
    fill(folder, mesh)
    with folder.history.path.open("a") as file:
        file.write("0,1.23,quasi")  # a row cut short
    run = load(folder.path)
    assert run.summary == {}
    assert len(run.history) == 6


def test_run_without_frames_is_refused(folder, mesh):
    folder.save_mesh(mesh)
    with pytest.raises(RunDirectoryError, match="has no frames yet"):
        load(folder.path)


def test_damaged_frames_are_refused(folder, mesh):
    folder.save_mesh(mesh)
    fill(folder, mesh)
    frame = folder.path / "frames" / "00001.npz"
    data = frame.read_bytes()
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 4
    for damage in (b"", data[: len(data) // 2], bytes(flipped), b"text"):
        frame.write_bytes(damage)
        with pytest.raises(RunDirectoryError, match=r"00001\.npz' is damaged"):
            load(folder.path)
    np.savez(frame, x=np.zeros(3))
    with pytest.raises(RunDirectoryError, match="has no t, v"):
        load(folder.path)
    (folder.path / "mesh.npz").unlink()
    with pytest.raises(RunDirectoryError, match=r"mesh\.npz' does not exist"):
        load(folder.path)


# Tables


def test_events_may_bring_new_keys(folder):
    folder.append_events([{"t": 0.1, "event": "switch", "cause": "a, b\nc"}])
    folder.append_events([{"t": 0.2, "event": "retry", "capacity": 12}, {"t": 0.3}])
    folder.append_events([])
    events = RunDirectory.open(folder.path).events
    table = events.read()
    assert events.columns == ["t", "event", "cause", "capacity"]
    assert table["t"].tolist() == [0.1, 0.2, 0.3]
    assert table["cause"][0] == "a, b c"
    assert table["capacity"][1] == 12
    assert events.count == 3


def test_history_keeps_its_columns(folder):
    folder.append_history(COLUMNS, rows(0, 1))
    with pytest.raises(ValueError, match="has the columns"):
        folder.append_history(COLUMNS[:-1], rows(0, 1)[:, :-1])
    assert folder.counts.history_rows == 1


def test_stages_may_be_words(folder):
    numbers = rows(0, 3)
    words = numbers.astype(object)
    words[:, COLUMNS.index("stage")] = ["quasistatic", "implicit", "quasistatic"]
    folder.append_history(COLUMNS, numbers)
    first = folder.history.path.read_bytes()
    folder.rewind(0, 0, 0)
    folder.append_history(COLUMNS, words)
    assert folder.history.path.read_bytes() == first


def test_no_rows_leave_no_file(folder):
    folder.append_history(COLUMNS, np.zeros((0, len(COLUMNS))))
    assert not folder.history.path.exists()


def test_events_whose_columns_are_known_have_a_header(folder):
    """So that a run without events can be read like any other."""
    folder.append_events([])
    assert not folder.events.path.exists()
    for _ in range(2):
        folder.append_events([], ["t", "to"])
        again = RunDirectory.open(folder.path)
        assert (again.events.count, list(again.events.read().columns)) == (0, ["t", "to"])
    folder.append_events([{"t": 1.5, "to": "explicit"}], ["t", "to"])
    assert folder.events.path.read_text() == "t,to\n1.5,explicit\n"


def test_appending_drops_a_line_that_was_cut(folder):
    folder.append_history(COLUMNS, rows(0, 2))
    whole = folder.history.path.read_bytes()
    folder.history.path.write_bytes(whole + b"0,1.2")
    again = RunDirectory.open(folder.path)
    again.append_history(COLUMNS, rows(2, 1))
    assert again.history.read()["t"].tolist() == [0, 1 / 7, 2 / 7]
    assert again.history.path.read_bytes().startswith(whole)


# Rewinding


def test_rewind_returns_to_the_checkpoint(folder, mesh):
    folder.save_mesh(mesh)
    fill(folder, mesh, 2)
    counts = json.loads(json.dumps(folder.counts._asdict()))
    before = contents(folder.path)
    folder.append_history(COLUMNS, rows(50, 9))
    folder.append_events([{"t": 1.0, "to": "quasistatic"}])
    folder.save_frame(2, 1.0, mesh.vertices, mesh.vertices, None)
    folder.write_summary({"result": "stale"})
    (folder.path / ".checkpoint.npz.tmp").write_text("killed in the middle")
    with folder.history.path.open("a") as file:
        file.write("0,1.23")
    again = RunDirectory.open(folder.path)
    again.rewind(**counts)
    assert contents(folder.path) == before
    assert again.counts == RunDirectory.open(folder.path).counts == (4, 2, 2)
    assert again.read_summary() == {}


def test_rewind_to_nothing(folder, mesh):
    fill(folder, mesh, 1)
    folder.rewind(0, 0, 0)
    assert folder.counts == (0, 0, 0)
    folder.append_history(COLUMNS, rows(0, 1))
    assert len(folder.history.read()) == 1


def test_rewind_refuses_what_is_not_there(folder, mesh):
    fill(folder, mesh, 2)
    before = contents(folder.path)
    with pytest.raises(RunDirectoryError, match="has 4 rows but the checkpoint knows 5"):
        folder.rewind(5, 2, 1)
    with pytest.raises(RunDirectoryError, match=r"lacks some of the frames 0\.\.2"):
        folder.rewind(4, 2, 3)
    assert contents(folder.path) == before


# Disks that fail


def no_space(*args, **kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_no_space_is_told_and_harmless(folder, mesh, monkeypatch):
    folder.save_mesh(mesh)
    fill(folder, mesh)
    folder.write_summary({"result": "success"})
    before = contents(folder.path)
    monkeypatch.setattr(os, "fsync", no_space)
    writes = [
        lambda: folder.save_mesh(hexagonal(4, 4, 1.0)),
        lambda: folder.save_frame(0, 1.0, mesh.vertices, mesh.vertices, None),
        lambda: folder.save_frame(9, 1.0, mesh.vertices, mesh.vertices, None),
        lambda: folder.write_summary({}),
        lambda: folder.append_history(COLUMNS, rows(9, 3)),
        lambda: folder.append_events([{"t": 9.0, "from": "quasistatic", "to": "implicit"}]),
        lambda: folder.append_events([{"new": 1}]),
    ]
    for write in writes:
        with pytest.raises(RunDirectoryError, match=r"cannot write '.*No space left.*; free some space"):
            write()
        assert contents(folder.path) == before
    assert folder.counts == (6, 3, 3)


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 256 KiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("cannot mount a small file system here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def fill_up(write):
    for index in range(1000):
        write(index)


def test_full_disk(small_disk, mesh):
    folder = RunDirectory.create(small_disk / "run", {})
    folder.save_mesh(mesh)
    with pytest.raises(RunDirectoryError, match="No space left"):
        fill_up(lambda index: folder.save_frame(index, 0.0, mesh.vertices, mesh.vertices, None))
    with pytest.raises(RunDirectoryError, match="No space left"):
        fill_up(lambda index: folder.append_history(COLUMNS, rows(20 * index, 20)))
    assert not list(small_disk.rglob("*.tmp"))
    run = load(folder.path)
    assert len(run.t) == len(folder.frames()) > 3
    assert len(run.history) == folder.counts.history_rows


def test_kill_while_writing_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_bytes(path, b"old")

    def die(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(path, b"new")
    assert contents(tmp_path) == {"file": b"old"}


def test_sigkill_at_any_moment_leaves_a_whole_file(tmp_path):
    path = tmp_path / "file"
    code = (
        "import itertools, pathlib, sys; from jaxcrumple.io.atomic import write_bytes\n"
        "for i in itertools.count(): write_bytes(pathlib.Path(sys.argv[1]), bytes([i % 256]) * 300_000)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(path)])
    rng = np.random.default_rng(0)
    try:
        while not path.exists():
            assert process.poll() is None
            time.sleep(0.01)
        for _ in range(30):
            process.send_signal(signal.SIGSTOP)  # what a kill at this moment would leave
            data = path.read_bytes()
            assert len(data) == 300_000
            assert data.count(data[:1]) == len(data)
            process.send_signal(signal.SIGCONT)
            time.sleep(rng.uniform(0, 0.01))
    finally:
        process.kill()
        process.wait()
    assert len(set(path.read_bytes())) == 1
    assert {p.name for p in tmp_path.iterdir()} <= {"file", ".file.tmp"}
    write_bytes(path, b"next")
    assert contents(tmp_path) == {"file": b"next"}
