"""A run that is killed again and again ends as one that was left alone, bit for bit."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import meshio
import numpy as np
import pytest

from jaxcrumple.io import RunDirectory, RunDirectoryError
from jaxcrumple.io.verify import damages
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.run import run
from jaxcrumple.run.config import complete, configure
from jaxcrumple.run.run import resume_run, start_run

PROGRAM = """
import sys, jax
jax.config.update("jax_enable_x64", True)
from jaxcrumple.run.config import RunConfig
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.run.run import resume_run, start_run
config, folder, resume = sys.argv[1:]
resume_run(folder) if resume == "resume" else start_run(RunConfig.model_validate_json(config), folder)
"""
KILLS, FRAMES = 3, 12


def config():
    """A phantom sheet that snaps at once, then folds and yields."""
    settings = [
        "contact=none",
        "sweeps=5",
        f"frames={FRAMES}",
        "yield_curvature=20",
        "plastic_time=1e-2",
        "drag_rate=1500",
    ]
    settings += ["scheme=alternating", "rtol=1e-4"]
    return configure("radial", nodes=60, t_end=0.6, settings=settings)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Folder and summary of the run that nobody kills."""
    folder = tmp_path_factory.mktemp("restart") / "run"
    return folder, start_run(config(), folder)


def arrays(path):
    """Arrays of an npz file but the header, which holds seconds spent."""
    with np.load(path) as file:
        return {name: file[name] for name in file.files if name != "header"}


def same_bits(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        assert a[name].tobytes() == b[name].tobytes(), name


def checkpoint_of(folder):
    return folder / RunDirectory.open(folder).manifest.checkpoint


def assert_same_run(folder, reference):
    assert damages(folder) == {}
    same_bits(arrays(checkpoint_of(folder)), arrays(checkpoint_of(reference)))
    for table in ("history.csv", "events.csv"):
        assert (folder / table).read_text() == (reference / table).read_text(), table
    frames = sorted(path.name for path in (reference / "frames").iterdir())
    assert sorted(path.name for path in (folder / "frames").iterdir()) == frames
    for name in frames:
        same_bits(arrays(folder / "frames" / name), arrays(reference / "frames" / name))


def killed(folder, resume, frame, seconds):
    """Start or resume the run in another process and kill it `seconds` after it saved frame number `frame`.

    False if it came to its end before.
    """
    manifest = folder / "manifest.json"
    before = manifest.stat().st_mtime_ns if manifest.exists() else 0
    # A kill must not leave half an entry among the compiled programs that all tests share.
    settings = os.environ | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e9"}
    arguments = [config().model_dump_json(), str(folder), "resume" if resume else "start"]
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, *arguments], env=settings)
    deadline = time.monotonic() + 600
    while not (
        manifest.exists()
        and manifest.stat().st_mtime_ns > before
        and (folder / "frames" / f"{frame:05d}.npz").exists()
    ):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.001)
    time.sleep(seconds)
    if process.poll() is not None:
        assert process.returncode == 0
        return False
    process.send_signal(signal.SIGKILL)
    process.wait()
    return True


def test_two_runs_are_equal(undisturbed):
    folder, summary = undisturbed
    assert summary["result"] == "success"
    start_run(config(), folder.with_name("again"))
    assert_same_run(folder.with_name("again"), folder)
    # It has both stages, and plastic flow: else the test below would show little.
    assert summary["switches"] >= 2
    assert summary["steps"]["implicit"] > 10
    with np.load(checkpoint_of(folder)) as file:
        assert np.max(np.abs(file[".p"])) > 1e-3


def test_killed_runs_end_as_one_left_alone(undisturbed, tmp_path):
    reference, _ = undisturbed
    folder = tmp_path / "run"
    rng = random.Random(time.time_ns())
    kills, rows = 0, []
    for session, frame in enumerate(sorted(rng.sample(range(FRAMES), KILLS))):
        wait = rng.uniform(0, 0.05)
        kills += killed(folder, session > 0, frame, wait)
        rows.append(RunDirectory.open(folder).counts.history_rows)
        print(f"killed {wait:.4f} s after frame {frame}, with {rows[-1]} rows")
    assert kills > 0
    assert rows[-1] > 0
    assert resume_run(folder)["result"] == "success"
    assert_same_run(folder, reference)


def test_what_a_kill_leaves_half_done_is_dropped(undisturbed, tmp_path):
    reference, _ = undisturbed
    folder = shutil.copytree(reference, tmp_path / "run")
    (folder / "summary.json").unlink()
    frames = sorted((folder / "frames").iterdir())
    (folder / "frames" / f"{len(frames):05d}.npz").write_bytes(frames[-1].read_bytes())
    (folder / "frames" / ".00003.npz.tmp").write_bytes(b"half")
    (folder / "checkpoints" / ".latest-0.npz.tmp").write_bytes(b"half")
    with (folder / "history.csv").open("a") as file:
        file.write("0,0.6,quasistatic,1e-3")
    resume_run(folder)
    assert_same_run(folder, reference)
    assert not list(folder.rglob("*.tmp"))


@pytest.mark.filterwarnings("ignore:the mesh of .* is not isotropic")
@pytest.mark.parametrize(("edit", "part"), [("vertices", "mesh"), ("thickness", "mass")])
def test_a_mesh_file_that_was_edited_meanwhile_is_refused(tmp_path, monkeypatch, edit, part):
    """The options are the same, but not what is built from them."""
    path, folder = tmp_path / "sheet.vtu", tmp_path / "run"
    mesh = rectangle(0.1, 0.1, 80, sweeps=20)
    data = {"vertices": mesh.vertices.copy(), "thickness": np.full(mesh.n_nodes, 1e-4)}

    def write():
        points = {"h": data["thickness"]}
        meshio.Mesh(data["vertices"], [("triangle", mesh.faces)], point_data=points).write(path)

    def killed_at_once(*_, **__):
        raise KeyboardInterrupt

    write()
    sheet = {"shape": "file", "path": str(path), "thickness": "h"}
    asked = {"scene": "custom", "t_end": 0.1, "options": {"sheet": sheet, "contact": None}}
    monkeypatch.setattr(run, "simulate", killed_at_once)
    with pytest.raises(KeyboardInterrupt):
        start_run(complete(asked), folder)
    with pytest.raises(KeyboardInterrupt):  # goes on
        resume_run(folder)
    data[edit][0] *= 1.01
    write()
    with pytest.raises(RunDirectoryError, match=rf"now make another {part} than the run began with: a file"):
        resume_run(folder)
    data[edit][0] /= 1.01
    write()
    with pytest.raises(KeyboardInterrupt):
        resume_run(folder)
