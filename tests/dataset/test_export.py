"""A data set holds the runs of its campaign exactly, whole or not at all."""

import importlib.util
import json
import tracemalloc

import numpy as np
import pytest
import zarr
from campaign_folders import write_campaign, write_run
from run_folders import contents

import jaxcrumple as jc
from jaxcrumple.dataset import arrays, export
from jaxcrumple.dataset.maps import CHANNELS, SheetMaps
from jaxcrumple.measure.raster import Raster
from jaxcrumple.sweeps.campaign import TABLE

SPLITS = ("train", "validation", "test")
PIXELS = 16


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A campaign of ten runs, of which one failed and one is unfinished, its meshes and frames by name."""
    folder = tmp_path_factory.mktemp("campaign") / "runs"
    written = write_campaign(folder)
    mesh = next(iter(written.values()))[0]
    frames = [(0.0, mesh.vertices, None)]
    write_run(folder / "failed", mesh, frames, result="blocked", seed=20)
    write_run(folder / "begun", mesh, frames, result=None, seed=21)
    (folder / TABLE).write_text("run\n")
    (folder / "notes").mkdir()
    return folder, written


@pytest.fixture(scope="module")
def exported(campaign, tmp_path_factory):
    """Folder and card of its data set, in shards of three samples."""
    out = tmp_path_factory.mktemp("data") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrays, "SHARD", 3 * len(CHANNELS) * PIXELS**2 * 4)
        return out, jc.export_dataset(campaign[0], out, pixels=PIXELS)


def group_of(exported, split):
    return zarr.open_group(exported[0] / "data.zarr" / split, mode="r")


def test_meshes_and_states_are_exact(campaign, exported):
    """Those of each run, which have various numbers of nodes, and each run is there once."""
    _, written = campaign
    found, sizes = {}, set()
    for split in SPLITS:
        group = group_of(exported, split)
        for row, name in enumerate(group.attrs["runs"]):
            mesh, frames = written[name]
            nodes, faces, edges, hinges = group["rows"][row]
            sizes.add(int(nodes))
            again = jc.Mesh.from_arrays(group["vertices"][row, :nodes], group["faces"][row, :faces])
            for field in vars(mesh):
                if field != "source_nodes":
                    np.testing.assert_array_equal(getattr(again, field), getattr(mesh, field))
            np.testing.assert_array_equal(group["edges"][row, :edges], mesh.edges)
            np.testing.assert_array_equal(group["hinges"][row, :hinges], mesh.hinges)
            samples = np.flatnonzero(group["run"][:] == row)
            assert group["frame"][:][samples].tolist() == [0, 1]
            for sample, (t, x, p) in zip(samples, frames, strict=True):
                assert group["t"][sample] == t
                np.testing.assert_array_equal(group["x"][sample, :nodes], x)
                np.testing.assert_array_equal(group["p"][sample, :hinges], p)
                assert not np.any(group["x"][sample, nodes:]) and not np.any(group["p"][sample, hinges:])
            found[name] = split
    assert sorted(found) == sorted(written) and len(sizes) == 10


def test_maps_lie_on_one_grid(campaign, exported):
    """All of them, across shards, which end within a split."""
    root = zarr.open_group(exported[0] / "data.zarr", mode="r")
    raster = Raster(np.array(root.attrs["origin"]), root.attrs["pixel"], (PIXELS, PIXELS))
    assert root.attrs["channels"] == list(CHANNELS)
    corners = np.concatenate([mesh.vertices[:, :2] for mesh, _ in campaign[1].values()])
    rows, columns = raster.pixels(corners)
    assert {rows.min(), columns.min()} == {0} and max(rows.max(), columns.max()) == PIXELS - 1
    for split in SPLITS:
        group = root[split]
        assert group["maps"].chunks == (1, 7, PIXELS, PIXELS)
        assert group["maps"].shards[0] == min(3, group["maps"].shape[0])
        for sample, row in enumerate(group["run"][:]):
            mesh, frames = campaign[1][group.attrs["runs"][row]]
            _, x, p = frames[group["frame"][sample]]
            np.testing.assert_array_equal(group["maps"][sample], SheetMaps(mesh, raster).of(x, p))


def test_no_seed_is_in_two_splits(exported):
    seeds = {split: set(group_of(exported, split)["seed"][:].tolist()) for split in SPLITS}
    assert seeds == {"train": {0, *range(3, 10)}, "test": {1}, "validation": {2}}
    counts = exported[1]["splits"]
    assert {name: (one["runs"], one["samples"]) for name, one in counts.items()} == {
        "train": (8, 16),
        "validation": (1, 2),
        "test": (1, 2),
    }
    assert {name: set(one["seeds"]) for name, one in counts.items()} == seeds


def test_the_card_tells_what_there_is(exported):
    out, card = exported
    assert json.loads((out / "card.json").read_text()) == card
    assert card["left_out"] == {"failed": "blocked: told", "begun": "unfinished"}
    assert card["parameters"] == {
        "nodes": {"unit": None, "min": 40, "max": 67},
        "thickness": {"unit": "m", "min": 1e-4, "max": 2e-4},
    }
    assert card["options"]["young_modulus"] == {"unit": "Pa", "value": 1e9}
    assert card["scenes"] == ["radial"] and card["simulated_by"]["jax"] == ["0.10"]
    text = (out / "README.md").read_text()
    for line in (
        "| thickness | m | 0.0001 to 0.0002 |",
        "| train | 16 | 8 | 0, 3, 4, 5, 6, 7, 8, 9 |",
        "* failed: blocked: told",
        "| young_modulus | Pa | 1000000000.0 |",
    ):
        assert line in text.splitlines()
    assert "licen" not in text.lower()


def test_statistics_are_those_of_the_training_maps(exported):
    maps = group_of(exported, "train")["maps"][:].astype(float)
    on = maps[:, -1] > 0
    for channel, found in enumerate(exported[1]["channels"].values()):
        values = maps[:, channel][on]
        expected = [values.min(), values.max(), values.mean(), values.std()]
        shown = [found[name] for name in ("min", "max", "mean", "std")]
        np.testing.assert_allclose(shown, expected, rtol=1e-9, atol=1e-12)


def test_parameters_are_those_of_the_runs(campaign, exported):
    root = zarr.open_group(exported[0] / "data.zarr", mode="r")
    assert root.attrs["parameters"] == ["nodes", "thickness"]
    for split in SPLITS:
        for seed, row in zip(root[split]["seed"][:], root[split]["parameters"][:], strict=True):
            assert row.tolist() == [40 + 3 * seed, 1e-4 * (1 + seed % 2)]


def test_again_gives_the_same_bytes(campaign, exported, tmp_path, monkeypatch):
    monkeypatch.setattr(arrays, "SHARD", 3 * len(CHANNELS) * PIXELS**2 * 4)
    jc.export_dataset(campaign[0], tmp_path / "again", pixels=PIXELS)
    assert contents(tmp_path / "again") == contents(exported[0])


def test_the_last_frames_alone(campaign, tmp_path):
    card = jc.export_dataset(campaign[0], tmp_path / "last", pixels=PIXELS, frames="last")
    group = group_of((tmp_path / "last",), "train")
    assert card["splits"]["train"]["samples"] == 8 and set(group["frame"][:].tolist()) == {1}
    x = campaign[1][group.attrs["runs"][0]][1][-1][1]
    np.testing.assert_array_equal(group["x"][0, : len(x)], x)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "full")])
def test_an_interrupted_export_leaves_nothing(campaign, tmp_path, monkeypatch, error):
    """Wherever it is: within a shard, and when only the card is missing."""
    for name, module in (("flush", arrays.SampleArray), ("text_of", export)):
        calls = []

        def stop(*args, calls=calls):
            calls.append(args)
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(module, name, stop)
            with pytest.raises(KeyboardInterrupt if error is KeyboardInterrupt else jc.RunDirectoryError):
                jc.export_dataset(campaign[0], tmp_path / "set", pixels=PIXELS)
        assert calls and list(tmp_path.iterdir()) == []


def test_a_killed_export_is_replaced(campaign, exported, tmp_path, monkeypatch):
    """What it leaves has another name, and no card."""
    left = tmp_path / ".set.tmp" / "data.zarr"
    left.mkdir(parents=True)
    (left / "junk").touch()
    jc.export_dataset(campaign[0], tmp_path / "set", pixels=PIXELS)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert not list((tmp_path / "set").rglob("junk"))


def test_memory_does_not_grow_with_the_runs(tmp_path, monkeypatch):
    """The peak of 16 runs is that of 4, but for lists of names and numbers."""
    monkeypatch.setattr(arrays, "SHARD", 2**16)
    mesh, peaks = jc.disc(0.05, 40, sweeps=3), {}
    for count in (4, 16):
        for seed in range(count):
            write_run(tmp_path / f"{count}" / f"{seed}", mesh, [(0.0, mesh.vertices, None)], seed=seed)
    # The first export imports, too.
    for name, count in {"first": 4, "few": 4, "many": 16}.items():
        tracemalloc.start()
        jc.export_dataset(tmp_path / f"{count}", tmp_path / name, pixels=192)
        peaks[name] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    more = 12 * len(CHANNELS) * 192**2 * 4  # bytes of the maps of 12 more runs
    assert peaks["many"] - peaks["few"] < 0.2 * more


def test_too_few_seeds_warn(tmp_path):
    write_campaign(tmp_path / "runs", seeds=[7])
    with pytest.warns(UserWarning, match=r"1 seed\(s\) leave no run for test and validation"):
        card = jc.export_dataset(tmp_path / "runs", tmp_path / "set", pixels=PIXELS)
    assert card["splits"]["test"] == {"samples": 0, "runs": 0, "seeds": []}
    assert group_of((tmp_path / "set",), "test")["maps"].shape == (0, 7, PIXELS, PIXELS)


def test_words_are_numbered(tmp_path):
    """And a missing number is NaN."""
    mesh = jc.disc(0.05, 40, sweeps=3)
    frames = [(0.0, mesh.vertices, None)]
    for seed, contact, limit in ((0, "penalty", 0.1), (1, None, None), (2, "inverse-power", 0.2)):
        settings = {"contact": contact, "max_step": limit}
        write_run(tmp_path / "runs" / f"{seed}", mesh, frames, seed=seed, settings=settings)
    card = jc.export_dataset(tmp_path / "runs", tmp_path / "set", pixels=PIXELS)
    assert card["parameters"]["contact"] == {"unit": None, "words": ["None", "inverse-power", "penalty"]}
    assert card["parameters"]["max_step"] == {"unit": "s", "min": 0.1, "max": 0.2}
    columns = zarr.open_group(tmp_path / "set" / "data.zarr", mode="r").attrs["parameters"]
    rows = {split: group_of((tmp_path / "set",), split)["parameters"][0] for split in SPLITS}
    table = [[rows[split][columns.index(name)] for name in ("contact", "max_step")] for split in SPLITS]
    np.testing.assert_array_equal(table, [[2, 0.1], [1, 0.2], [0, np.nan]])
    assert (
        "| contact |  | 0: None, 1: inverse-power, 2: penalty |" in (tmp_path / "set/README.md").read_text()
    )


def refused(folder, out, message, error=jc.ConfigError, **options):
    with pytest.raises(error, match=message):
        jc.export_dataset(folder, out, **options)
    assert not out.exists()


def test_wrong_options_are_refused(campaign, tmp_path, monkeypatch):
    folder, out = campaign[0], tmp_path / "set"
    refused(folder, out, "pixels = 2; give a whole number from 8 to 4096", pixels=2)
    refused(folder, out, r"pixels = 9\.5; give", pixels=9.5)
    refused(folder, out, "frames = 'first' is unknown; give 'all' or 'last'", frames="first")
    refused(tmp_path, out, "holds no runs; give the folder of a campaign")
    refused(folder / "seed=0", out, "is a single run; give the folder of a campaign")
    with pytest.raises(jc.ConfigError, match="exists; give another folder"):
        jc.export_dataset(folder, tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    refused(folder, out, r"needs Zarr, version 3 \(pip install", ImportError)


def test_runs_that_cannot_be_mapped_are_refused(tmp_path):
    mesh = jc.disc(0.05, 40, sweeps=3)
    frames = [(0.0, mesh.vertices, None)]
    write_run(tmp_path / "a" / "one", mesh, frames, result="collapsed")
    refused(tmp_path / "a", tmp_path / "set", r"no run in .* ended with success \(one: collapsed: told\)")
    upright = jc.Mesh.from_arrays(mesh.vertices[:, [0, 2, 1]], mesh.faces)
    write_run(tmp_path / "b" / "one", upright, frames)
    refused(tmp_path / "b", tmp_path / "set", "one: the rest shape is not flat; the maps", ValueError)
    write_run(tmp_path / "c" / "one", mesh, frames)
    (tmp_path / "c" / "one" / "frames" / "00000.npz").write_bytes(b"half")
    refused(tmp_path / "c", tmp_path / "set", "damaged.*jaxcrumple repair", jc.RunDirectoryError)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_from_the_command_line(campaign, exported, in_process, tmp_path):
    code, streams = in_process("dataset", campaign[0], "--out", tmp_path / "set", "--pixels", PIXELS)
    assert code == 0
    told = streams.out.splitlines()
    assert told[-1] == f"data set: {tmp_path / 'set'}"
    assert "left out failed: blocked: told" in told and "train: 16 samples of 8 runs, 8 seeds" in told
    np.testing.assert_array_equal(
        group_of((tmp_path / "set",), "train")["maps"][:], group_of(exported, "train")["maps"][:]
    )
    code, streams = in_process("dataset", campaign[0], "--out", tmp_path / "set")
    assert code == 2 and "exists; give another folder" in streams.err
