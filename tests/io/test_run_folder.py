"""The folder of a run: what it holds, and reading it back."""

import os
from dataclasses import fields

import numpy as np
import pytest
from run_folders import contents, fill, rows, stiffness_of, write

from jaxcrumple.io import Frame, RunDirectory, RunDirectoryError, load
from jaxcrumple.io.atomic import to_json
from jaxcrumple.io.manifest import sealed, unsealed
from jaxcrumple.mesh.generate import hexagonal
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.solvers.log import COLUMNS, EVENT_COLUMNS


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
