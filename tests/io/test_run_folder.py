"""The folder of a run: what it holds, what a kill or a full disk does to it, and reading it back."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import numpy as np
import pytest

from jaxcrumple.io import Frame, RunDirectory, RunDirectoryError, load, load_checkpoint
from jaxcrumple.io.atomic import to_json, write_bytes
from jaxcrumple.io.lock import writing
from jaxcrumple.io.manifest import sealed, unsealed
from jaxcrumple.io.verify import check_sound, damages, go_back
from jaxcrumple.mesh.generate import hexagonal, rectangle
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.solvers.log import COLUMNS, EVENT_COLUMNS


@pytest.fixture(scope="module")
def mesh():
    return rectangle(0.1, 0.08, 60, sweeps=20)


def stiffness_of(mesh):
    return np.full(len(mesh.edges), 3.0), np.full(len(mesh.hinges), 2.0)


@pytest.fixture
def folder(tmp_path, mesh):
    config = {"nodes": np.int64(60), "rtol": 1e-4}
    return RunDirectory.create(tmp_path / "run", config, mesh, stiffness_of(mesh))


def rows(first, count):
    """History rows that differ from each other, with numbers of many digits."""
    table = np.zeros((count, len(COLUMNS)))
    table[:, COLUMNS.index("t")] = (first + np.arange(count)) / 7
    table[:, COLUMNS.index("stage")] = np.arange(count) % 2
    table[:, COLUMNS.index("quasistatic_steps")] = first + np.arange(count)
    return table


def write(folder, frame, first):
    """A frame, two rows and an event, not yet part of the run."""
    folder.save_frame(*frame)
    folder.append_history(rows(first, 2))
    folder.append_events([{"t": frame.t, "origin": "quasistatic", "to": "implicit"}])


def fill(folder, mesh, frames=3):
    """A run with a few frames, rows and events, each with a checkpoint; returns the frames."""
    rng = np.random.default_rng(0)
    saved = []
    for index in range(frames):
        x, v = rng.normal(size=(2, mesh.n_nodes, 3))
        saved.append(Frame(index / 3, x, v, rng.normal(size=len(mesh.hinges))))
        write(folder, saved[-1], 2 * index)
        folder.commit({"x": x}, {"t": index / 3}, keep=index == 0)
    return saved


def contents(path):
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


# Making and opening


def test_config_round_trips(folder):
    assert folder.config == {"nodes": 60, "rtol": 1e-4}
    assert RunDirectory.open(folder.path).config == folder.config
    assert RunDirectory.open(str(folder.path)).counts == (0, 0, 0)


def test_empty_folder_is_accepted(tmp_path, mesh):
    created = RunDirectory.create(tmp_path, {"nodes": 7}, mesh, stiffness_of(mesh))
    assert (created.path, created.counts) == (tmp_path, (0, 0, 0))
    assert RunDirectory.open(tmp_path).config == {"nodes": 7}


def test_occupied_places_are_refused(tmp_path, folder, mesh):
    more = {}, mesh, stiffness_of(mesh)
    with pytest.raises(RunDirectoryError, match="holds a run already; resume it"):
        RunDirectory.create(folder.path, *more)
    with pytest.raises(RunDirectoryError, match="is not empty"):
        RunDirectory.create(tmp_path, *more)
    file = tmp_path / "file"
    file.write_text("precious")
    with pytest.raises(RunDirectoryError, match="is a file"):
        RunDirectory.create(file, *more)
    with pytest.raises(RunDirectoryError, match=r"cannot write .*Not a directory; check the path"):
        RunDirectory.create(file / "below", *more)
    assert file.read_text() == "precious"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that nobody may write to")
def test_forbidden_place_is_refused(mesh):
    with pytest.raises(RunDirectoryError, match="cannot write '/proc/jaxcrumple"):
        RunDirectory.create("/proc/jaxcrumple/run", {}, mesh, stiffness_of(mesh))


def test_other_folders_are_not_opened(tmp_path, folder):
    with pytest.raises(RunDirectoryError, match="does not exist"):
        RunDirectory.open(tmp_path / "nothing")
    with pytest.raises(RunDirectoryError, match="is a file"):
        RunDirectory.open(folder.path / "run.json")
    with pytest.raises(RunDirectoryError, match=r"has no manifest\.json; it holds runs; give .* 'run'"):
        RunDirectory.open(tmp_path)


def test_a_start_cut_off_before_its_manifest_is_no_run(folder, mesh):
    (folder.path / "manifest.json").unlink()
    (folder.path / ".manifest.json.tmp").write_text("half")
    RunDirectory.create(folder.path, {"again": True}, mesh, stiffness_of(mesh))
    assert RunDirectory.open(folder.path).config == {"again": True}
    assert not list(folder.path.glob("*.tmp"))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b"{", "is not JSON"),
        (b"\xff\xfe", "is not JSON"),
        (b"[1]", "is not of the format 'jaxcrumple-thing'"),
        (b'{"format": "other"}', "is not of the format 'jaxcrumple-thing'"),
        (sealed({"a": 1}, "jaxcrumple-thing", 7), "format version is 7, this program reads 2"),
        (sealed({"a": 1}, "jaxcrumple-thing", 2).replace(b"1", b"3"), "checksum does not match"),
        (sealed({"a": 1}, "jaxcrumple-thing", 2).replace(b'"a"', b'"b"'), "checksum does not match"),
    ],
)
def test_foreign_or_damaged_json_is_refused(text, match):
    with pytest.raises(ValueError, match=match):
        unsealed(text, "jaxcrumple-thing", 2)


def test_config_without_json_form_is_refused(tmp_path, mesh):
    with pytest.raises(TypeError, match="has no JSON form"):
        RunDirectory.create(tmp_path / "run", {"f": len}, mesh, stiffness_of(mesh))


def test_numbers_that_are_not_finite_are_null_in_json():
    text = to_json({"a": [float("nan"), np.inf, 1.5], "b": np.array([np.nan, 2.0]), "c": None})
    assert text == '{"a": [null, null, 1.5], "b": [null, 2.0], "c": null}'


# Round trips


def test_mesh_round_trips_bit_for_bit(tmp_path, mesh):
    bent = mesh.with_rest_shape(mesh.vertices + 1e-3 * np.sin(90 * mesh.vertices[:, [1, 2, 0]]))
    for number, original in enumerate((mesh, bent, hexagonal(5, 4, 0.1, reorder=False))):
        folder = RunDirectory.create(tmp_path / str(number), {}, original, stiffness_of(original))
        loaded = folder.load_mesh()
        for field in fields(Mesh):
            a, b = getattr(original, field.name), getattr(loaded, field.name)
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes(), field.name
            assert not b.flags.writeable
        for a, b in zip(folder.load_sheet()[1], stiffness_of(original), strict=True):
            assert a.tobytes() == b.tobytes()


def test_run_round_trips(folder, mesh):
    saved = fill(folder, mesh)
    folder.finish({"end_time": np.float64(0.5), "result": "success", "strange": np.nan})
    run = load(folder.path)
    assert run.t.tolist() == [frame.t for frame in saved]
    for name in ("x", "v", "p"):
        assert getattr(run, name).tobytes() == np.stack([getattr(f, name) for f in saved]).tobytes()
    assert run.summary == {"end_time": 0.5, "result": "success", "strange": None}
    assert run.config["nodes"] == 60
    assert list(run.history.columns) == list(COLUMNS)
    assert run.history["t"].tolist() == (np.arange(6) / 7).tolist()  # to the last digit
    assert run.history["stage"].tolist() == ["quasistatic", "implicit"] * 3
    assert run.history["quasistatic_steps"].dtype.kind == run.history["kind"].dtype.kind == "i"
    assert run.events["to"].tolist() == ["implicit"] * 3


def test_elastic_run_keeps_its_rest_curvature(folder, mesh):
    folder.save_frame(0.0, mesh.vertices, 0 * mesh.vertices, None)
    folder.commit({}, {"t": 0.0})
    assert next(folder.load_frames()).p is None
    assert load(folder.path).p.tolist() == [mesh.rest_curvature.tolist()]


def test_run_without_frames_is_refused(folder):
    with pytest.raises(RunDirectoryError, match="has no frames yet; wait for the first"):
        load(folder.path)
    folder.finish({"result": "nonfinite"})
    with pytest.raises(RunDirectoryError, match="ended before its first frame"):
        load(folder.path)


def test_a_run_in_which_nothing_happened_has_tables_with_columns(folder):
    folder.append_history(np.zeros((0, len(COLUMNS))))
    folder.append_events([])
    folder.commit({}, {"t": 0.0})
    again = RunDirectory.open(folder.path)
    assert (len(again.read_history()), list(again.read_history().columns)) == (0, list(COLUMNS))
    assert (len(again.read_events()), list(again.read_events().columns)) == (0, list(EVENT_COLUMNS))


def test_stages_may_be_words(folder):
    numbers = rows(0, 3)
    words = numbers.astype(object)
    words[:, COLUMNS.index("stage")] = ["quasistatic", "implicit", "quasistatic"]
    folder.append_history(numbers)
    folder.append_history(words)
    header, *lines = folder.history.path.read_text().splitlines()
    assert header == ",".join(COLUMNS)
    assert lines[:3] == lines[3:]


def test_cells_hold_no_line_break(folder):
    folder.append_events([{"t": 1.5, "origin": "a, b\nc"}, {"t": 2.5}])
    table = folder.read_events()
    assert table["origin"][0] == "a, b c"
    assert table["t"].tolist() == [1.5, 2.5]


# What is not part of the run


def test_readers_see_what_was_committed_last(folder, mesh):
    saved = fill(folder, mesh, 2)
    write(folder, Frame(1.0, *saved[0][1:]), 4)
    with folder.history.path.open("a") as file:
        file.write("0,1.23,quasi")
    run = load(folder.path)
    assert (len(run.t), len(run.history), len(run.events), run.summary) == (2, 4, 2, {})


def test_cutting_returns_to_the_last_commit(folder, mesh):
    saved = fill(folder, mesh, 2)
    before = contents(folder.path)
    folder.finish({"result": "stale"})
    (folder.path / "run.vtkhdf").write_text("stale")
    write(folder, Frame(1.0, *saved[0][1:]), 4)
    for name in (".manifest.json.tmp", "frames/.00003.npz.tmp", "checkpoints/.latest-0.npz.tmp"):
        (folder.path / name).write_text("killed in the middle")
    with folder.history.path.open("a") as file:
        file.write("0,1.23")
    again = RunDirectory.open(folder.path)
    assert again.finished
    again.cut()
    assert contents(folder.path) == before
    assert again.counts == RunDirectory.open(folder.path).counts == (4, 2, 2)
    assert again.read_summary() == {}


def test_rows_after_a_cut_line_begin_a_line_of_their_own(folder, mesh):
    saved = fill(folder, mesh, 1)
    with folder.history.path.open("a") as file:
        file.write("0,1.2")
    again = RunDirectory.open(folder.path)
    write(again, Frame(1.0, *saved[0][1:]), 2)
    assert again.read_history()["t"].tolist() == [0, 1 / 7, 2 / 7, 3 / 7]


def test_only_the_last_checkpoint_and_those_to_be_kept_stay(folder, mesh):
    fill(folder, mesh, 4)
    names = {path.name for path in (folder.path / "checkpoints").iterdir()}
    assert names == {"frame-00001.npz", "latest-0.npz"}
    assert {f"checkpoints/{name}" for name in names} < set(folder.manifest.files)


# Damage

TOUCHED = ("run.json", "mesh.npz", "frames/00001.npz", "history.csv", "events.csv", "frames.csv")


@pytest.mark.parametrize("name", [*TOUCHED, "manifest.json"])
@pytest.mark.parametrize("kind", ["empty", "half", "flipped", "text", "gone", "other"])
def test_damage_is_told_by_readers(folder, mesh, name, kind):
    fill(folder, mesh)
    path = folder.path / name
    data = path.read_bytes()
    if kind == "gone":
        path.unlink()
    else:
        flipped = bytearray(data)
        flipped[len(data) // 2] ^= 4
        other = (folder.path / "frames/00000.npz").read_bytes()
        path.write_bytes(
            {
                "empty": b"",
                "half": data[: len(data) // 2],
                "flipped": flipped,
                "text": b"text",
                "other": other,
            }[kind]
        )
    cause = r"(is damaged|is cut short|does not exist)"
    wanted = rf"{path.name}' {cause}.*restore it from a copy, or return to .*: jaxcrumple repair "
    with pytest.raises(RunDirectoryError, match=wanted):
        load(folder.path)
    assert re.search(cause, damages(folder.path)[name])
    with pytest.raises(RunDirectoryError, match=wanted):
        check_sound(folder.path)


def test_a_frame_in_place_of_another_is_damage(folder, mesh):
    fill(folder, mesh)
    one, two = (folder.path / "frames" / f"0000{index}.npz" for index in (0, 1))
    data = one.read_bytes()
    one.write_bytes(two.read_bytes())
    two.write_bytes(data)
    assert set(damages(folder.path)) == {"frames/00000.npz", "frames/00001.npz"}
    with pytest.raises(
        RunDirectoryError, match=r"00000\.npz' is damaged.* \(and 1 more, see: jaxcrumple verify"
    ):
        check_sound(folder.path)


def test_what_a_run_writes_again_does_not_stop_it(folder, mesh):
    fill(folder, mesh)
    (folder.path / "run.vtkhdf").write_text("a film")
    folder.finish({"result": "success"})
    assert not check_sound(folder.path)
    (folder.path / "run.vtkhdf").write_text("a FILM")
    assert set(damages(folder.path)) == {"run.vtkhdf"}
    assert check_sound(folder.path)


def test_damage_while_the_run_goes_on_is_told(folder, mesh):
    fill(folder, mesh)
    folder.history.path.write_bytes(folder.history.path.read_bytes()[:-9])
    with pytest.raises(RunDirectoryError, match="was cut short while the run wrote to it"):
        folder.append_history(rows(6, 1))
    (folder.path / "frames" / "00001.npz").unlink()
    with pytest.raises(RunDirectoryError, match=r"00001\.npz' does not exist, but the run wrote it"):
        list(folder.load_frames())


@pytest.mark.parametrize(
    ("damaged", "t", "frames"),
    [
        ("summary.json", 2 / 3, 3),
        ("run.json", 2 / 3, 3),
        ("manifest.json", 2 / 3, 3),
        ("frames/00001.npz", 0.0, 1),
        ("checkpoints/latest-1.npz", 0.0, 1),
        ("mesh.npz", None, None),
        ("frames/00000.npz", None, None),
    ],
)
def test_going_back_to_what_is_sound(folder, mesh, damaged, t, frames):
    """To the last checkpoint all of whose files are sound: the current one, or the one that was kept."""
    saved = fill(folder, mesh)
    folder.finish({"result": "success"})
    (folder.path / damaged).write_bytes(b"text")
    assert go_back(folder.path) == t
    if t is None:
        return
    again = RunDirectory.open(folder.path)
    again.cut()
    assert damages(folder.path) == {}
    assert not again.finished
    assert again.counts == (2 * frames, frames, frames)
    run = load(folder.path)
    assert run.x.tobytes() == np.stack([frame.x for frame in saved[:frames]]).tobytes()
    state, metadata = load_checkpoint(folder.path / again.manifest.checkpoint, {"x": run.x[0]})
    assert metadata["t"] == t
    assert state["x"].tobytes() == saved[frames - 1].x.tobytes()


# Writers


def test_one_writer_at_a_time(folder):
    with writing(folder.path):
        with writing(folder.path):  # the same thread may go in again
            pass
        with (
            ThreadPoolExecutor() as pool,
            pytest.raises(RunDirectoryError, match="another run is writing into"),
        ):
            pool.submit(lambda: writing(folder.path).__enter__()).result()
        code = "import sys, pathlib; from jaxcrumple.io.lock import writing\n"
        code += "with writing(pathlib.Path(sys.argv[1])): pass"
        other = subprocess.run([sys.executable, "-c", code, folder.path], capture_output=True, text=True)
        assert "another run is writing into" in other.stderr
    with ThreadPoolExecutor() as pool:
        pool.submit(lambda: writing(folder.path, wait=True).__enter__()).result()


# Disks that fail


def no_space(*args, **kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_no_space_is_told_and_harmless(folder, mesh, monkeypatch):
    saved = fill(folder, mesh)
    folder.finish({"result": "success"})
    before = contents(folder.path)
    monkeypatch.setattr(os, "fsync", no_space)
    writes = [
        lambda: folder.save_frame(*saved[0]),
        lambda: folder.finish({}),
        lambda: folder.append_history(rows(9, 3)),
        lambda: folder.append_events([{"t": 9.0, "origin": "quasistatic", "to": "implicit"}]),
        lambda: folder.commit({"x": np.zeros(9)}, {"t": 1.0}),
    ]
    for action in writes:
        with pytest.raises(RunDirectoryError, match=r"cannot write '.*No space left.*; free some space"):
            action()
        assert contents(folder.path) == before
    assert folder.counts == RunDirectory.open(folder.path).counts == (6, 3, 3)


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
    folder = RunDirectory.create(small_disk / "run", {}, mesh, stiffness_of(mesh))

    def step(index):
        folder.save_frame(0.1 * index, mesh.vertices, mesh.vertices, None)
        folder.append_history(rows(20 * index, 20))
        folder.commit({"x": mesh.vertices}, {"t": 0.1 * index})

    with pytest.raises(RunDirectoryError, match="No space left"):
        fill_up(step)
    assert not list(small_disk.rglob("*.tmp"))
    run = load(folder.path)
    assert damages(folder.path) == {}
    assert len(run.t) == len(RunDirectory.open(folder.path).frames()) > 3
    assert len(run.history) == 20 * len(run.t)


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
