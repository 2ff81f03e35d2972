"""Damaged runs: refused with cause and cure, and repaired from what is sound."""

import numpy as np
from command_line import current_checkpoint
from run_folders import contents

import jaxcrumple
from jaxcrumple.io import RunDirectory
from jaxcrumple.run.run import resume_run


def test_checkpoints_that_are_no_good_are_refused(refused, copy):
    checkpoint = current_checkpoint(copy)
    whole = checkpoint.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    for data in (whole[:middle], flipped, b"", b"something else", (copy / "mesh.npz").read_bytes()):
        checkpoint.write_bytes(data)
        before = contents(copy)
        text = refused("run", "radial", "--resume", "--out", copy)
        assert f"{checkpoint.name}' is damaged" in text
        assert f"return to the last undamaged checkpoint: jaxcrumple repair {copy}" in text
        assert contents(copy) == before


def test_a_damaged_run_is_told_and_repaired(copy, in_process):
    """It goes back to its last checkpoint before the damage, and ends as it did before."""

    def call(*arguments):
        code, streams = in_process(*arguments)
        return code, streams.out

    assert call("verify", copy) == (0, f"{copy}: sound, 3 frames, {count_rows(copy)} rows of history\n")
    assert call("repair", copy) == (0, f"{copy} is sound; nothing was changed\n")
    whole, x = contents(copy), jaxcrumple.load(copy).x
    (copy / "frames" / "00002.npz").write_bytes(b"")
    code, text = call("verify", copy.parent)
    assert code == 1 and "00002.npz' is damaged" in text and f"jaxcrumple repair {copy}" in text
    code, text = call("repair", copy)
    assert (
        code == 0
        and f"is at t = 0.01 s again; go on with: jaxcrumple run radial --resume --out {copy}" in text
    )
    assert RunDirectory.open(copy).counts.frames == 2
    assert resume_run(copy)["result"] == "success"
    after = contents(copy)
    for name in whole:
        if name.startswith(("history", "events", "mesh")):
            assert after[name] == whole[name], name
    np.testing.assert_array_equal(jaxcrumple.load(copy).x, x)


def count_rows(folder):
    return (folder / "history.csv").read_bytes().count(b"\n") - 1


def test_a_run_of_nothing_sound_is_given_up(refused, copy):
    for name in ("run.json", "manifest.json"):
        (copy / name).write_text("{}")
    for checkpoint in (copy / "checkpoints").iterdir():
        checkpoint.write_bytes(b"")
    assert "no part of" in refused("repair", copy)
