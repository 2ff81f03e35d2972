"""Checkpoints: exact round trips, and refusals that say why."""

import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple.io import CheckpointError, load_checkpoint, save_checkpoint
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import hexagonal
from jaxcrumple.scene import sheet
from jaxcrumple.state import RESULTS, initial_state


class Part(eqx.Module):
    """A leaf of every kind."""

    numbers: jax.Array
    host: np.ndarray
    nothing: jax.Array | None
    flag: bool
    count: int
    name: str = "static"


def bits(tree):
    """Every leaf as bytes, with its type and shape."""
    return [
        (np.asarray(leaf).tobytes(), str(np.asarray(leaf).dtype), np.shape(leaf), type(leaf).__name__)
        for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array_like))
    ]


@pytest.fixture
def state():
    mesh = hexagonal(4, 4, 1e-2)
    state = initial_state(sheet(mesh, Material()), mesh.vertices)
    return eqx.tree_at(lambda s: s.result, state, RESULTS.collapsed)


@pytest.fixture
def saved(tmp_path, state):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, state, {"frames": 3})
    return path


def test_state_round_trips(tmp_path, state):
    path = tmp_path / "checkpoint.npz"
    rng = np.random.default_rng(0)
    state = eqx.tree_at(lambda s: (s.x, s.v), state, tuple(jnp.asarray(rng.normal(size=(2, *state.x.shape)))))
    save_checkpoint(path, state, {"rows": np.int64(7), "where": [1.5, None], "big": np.arange(3)})
    zeros = jax.tree.map(jnp.zeros_like, state)
    loaded, metadata = load_checkpoint(path, zeros)
    assert bits(loaded) == bits(state)
    assert jax.tree.structure(loaded) == jax.tree.structure(state)
    assert bool(loaded.result == RESULTS.collapsed)
    assert metadata == {"rows": 7, "where": [1.5, None], "big": [0, 1, 2]}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.npz"]


def test_elastic_state_round_trips(tmp_path):
    mesh = hexagonal(4, 4, 1e-2)
    state = initial_state(sheet(mesh, Material(yield_curvature=None)), mesh.vertices)
    assert state.p is None
    save_checkpoint(tmp_path / "c.npz", state)
    loaded, metadata = load_checkpoint(tmp_path / "c.npz", state)
    assert bits(loaded) == bits(state)
    assert loaded.p is None
    assert metadata == {}


def test_every_kind_of_leaf(tmp_path):
    odd = np.array([0x7FF8000000000123, 0x8000000000000000, 0x7FF0000000000000, 1], dtype=np.uint64)
    tree = {
        "a/b": Part(
            jnp.asarray(odd.view(float)), np.arange(6, dtype=np.int16).reshape(2, 3), None, True, 2**40
        ),
        "empty": jnp.zeros((0, 3)),
        "list": [jnp.asarray(1 + 2j), np.float32(0.1), -0.0],
    }
    save_checkpoint(tmp_path / "c.npz", tree)
    loaded, _ = load_checkpoint(tmp_path / "c.npz", tree)
    assert bits(loaded) == bits(tree)
    assert loaded["a/b"].name == "static"
    assert loaded["a/b"].nothing is None
    assert np.load(tmp_path / "c.npz")["['a/b'].host"].tolist() == [[0, 1, 2], [3, 4, 5]]


def test_weak_types_survive(tmp_path):
    tree = [jnp.asarray(1.5), jnp.broadcast_to(jnp.asarray(2), (3,)), jnp.ones(2), jnp.asarray(True)]
    assert [leaf.weak_type for leaf in tree] == [True, True, False, False]
    save_checkpoint(tmp_path / "c.npz", tree)
    loaded, _ = load_checkpoint(tmp_path / "c.npz", tree)
    assert bits(loaded) == bits(tree)
    assert [leaf.weak_type for leaf in loaded] == [leaf.weak_type for leaf in tree]


def test_structure_alone_is_enough(saved, state):
    like = eqx.filter_eval_shape(lambda: state)
    loaded, _ = load_checkpoint(saved, like)
    assert bits(loaded) == bits(state)


def test_truncation_is_refused(saved, state):
    data = saved.read_bytes()
    for length in sorted(
        {1, 3, 4, 30, len(data) - 1, len(data) - 22, *range(100, len(data), len(data) // 60)}
    ):
        saved.write_bytes(data[:length])
        with pytest.raises(CheckpointError, match=r"damaged|not an npz"):
            load_checkpoint(saved, state)


def test_flipped_bits_are_refused_or_harmless(saved, state):
    data, expected = saved.read_bytes(), bits(state)
    rng = np.random.default_rng(1)
    refused = 0
    places = rng.integers(0, len(data), 400)
    for place, bit in zip(places, rng.integers(0, 8, len(places)), strict=True):
        damaged = bytearray(data)
        damaged[place] ^= 1 << bit
        saved.write_bytes(damaged)
        try:
            loaded, metadata = load_checkpoint(saved, state)
        except CheckpointError:
            refused += 1
        else:
            assert bits(loaded) == expected
            assert metadata == {"frames": 3}
    assert refused > 0.6 * len(places)  # the rest hit times and attributes of the container


@pytest.mark.parametrize(
    ("content", "match"),
    [(b"", "is empty"), (b"t,x\n1,2\n", "not an npz"), (b"PK\x03\x04 and then nonsense", "damaged")],
)
def test_other_files_are_refused(tmp_path, state, content, match):
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=match):
        load_checkpoint(path, state)


def test_missing_files_are_refused(tmp_path, state):
    with pytest.raises(CheckpointError, match="does not exist"):
        load_checkpoint(tmp_path / "nothing.npz", state)
    with pytest.raises(CheckpointError, match="is a folder"):
        load_checkpoint(tmp_path, state)


@pytest.mark.parametrize("header", [None, "no json", "[1]", '{"format": "other"}'])
def test_foreign_npz_is_refused(tmp_path, state, header):
    arrays = {"x": np.zeros(3)} if header is None else {"header": np.array(header)}
    np.savez(tmp_path / "f.npz", **arrays)
    with pytest.raises(CheckpointError, match="not a jaxcrumple checkpoint"):
        load_checkpoint(tmp_path / "f.npz", state)


def test_npz_with_a_pickle_is_refused(tmp_path, state):
    np.savez(tmp_path / "f.npz", header=np.array([{"a": 1}], dtype=object))
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path / "f.npz", state)


def test_other_version_is_refused(saved, state):
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["header"] = np.array(str(arrays["header"]).replace('"version": 2', '"version": 9'))
    np.savez(saved, **arrays)
    with pytest.raises(CheckpointError, match="format version 9, this program reads 2"):
        load_checkpoint(saved, state)


def test_missing_leaf_is_refused(saved, state):
    with zipfile.ZipFile(saved) as file:
        members = {name: file.read(name) for name in file.namelist() if name != ".v.npy"}
    with zipfile.ZipFile(saved, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)
    with pytest.raises(CheckpointError, match=r"\.v of .* is missing"):
        load_checkpoint(saved, state)


def test_misfit_names_the_leaf(saved, state):
    def change(where, value):
        return eqx.tree_at(where, state, value, is_leaf=lambda leaf: leaf is None)

    with pytest.raises(CheckpointError, match=r"leaf \.p is in the file but not in this run"):
        load_checkpoint(saved, change(lambda s: s.p, None))
    with pytest.raises(CheckpointError, match=r"shape of leaf \.x is \[20, 3\] in the file and \[5, 3\]"):
        load_checkpoint(saved, change(lambda s: s.x, jnp.zeros((5, 3))))
    with pytest.raises(CheckpointError, match=r"dtype of leaf \.v is float64 .* float32 .*x64"):
        load_checkpoint(saved, change(lambda s: s.v, jnp.zeros((20, 3), jnp.float32)))
    save_checkpoint(saved, change(lambda s: s.p, None))
    with pytest.raises(CheckpointError, match=r"leaf \.p is missing from the file"):
        load_checkpoint(saved, state)


def test_fingerprint(tmp_path, state):
    path = tmp_path / "c.npz"
    save_checkpoint(path, state, fingerprint={"mesh": "abc", "rtol": 1e-4})
    load_checkpoint(path, state)
    load_checkpoint(path, state, fingerprint={"mesh": "abc", "rtol": np.float64(1e-4)})
    with pytest.raises(CheckpointError, match=r"written with rtol = 0\.0001, this run has 0\.001"):
        load_checkpoint(path, state, fingerprint={"mesh": "abc", "rtol": 1e-3})


def test_unsavable_leaf_is_refused(tmp_path):
    for leaf in (jax.random.key(0), jnp.ones(2, jnp.bfloat16)):
        with pytest.raises(CheckpointError, match=r"leaf \['k'\] .* cannot be saved"):
            save_checkpoint(tmp_path / "c.npz", {"k": leaf})
    assert list(tmp_path.iterdir()) == []
