"""Damage of a run folder: readers tell it, and going back leaves what is sound."""

import re

import numpy as np
import pytest
from run_folders import fill, rows

from jaxcrumple.io import RunDirectory, RunDirectoryError, load, load_checkpoint
from jaxcrumple.io.verify import check_sound, damages, go_back

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
