"""Writing a run folder: one writer, and what no space or a kill does to files."""

import errno
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from run_folders import contents, fill, rows, stiffness_of

from jaxcrumple.io import RunDirectory, RunDirectoryError, load
from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.io.lock import writing
from jaxcrumple.io.verify import damages


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
