"""Checkpoints: one npz file holds a whole pytree. Loading restores it bit for bit or raises an error.

The file contains one array per leaf, named by the path of the leaf in the tree. A JSON header gives the
format, its version, the fingerprint, and the type and shape of every leaf. Arrays are stored uncompressed;
the checksums of the zip container detect damage.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from jaxcrumple._jax.door import door
from jaxcrumple.io.atomic import npz_bytes, to_json, write_bytes

FORMAT, VERSION = "jaxcrumple-checkpoint", 2
_HEADER = "header"
_RESTORE = "restore the file from a copy, or start the run again"

Tree = TypeVar("Tree")


class CheckpointError(ValueError):
    """A checkpoint cannot be saved or loaded. The message names the cause and the cure."""


def save_checkpoint(
    path: str | Path,
    state: Any,
    metadata: Mapping[str, Any] | None = None,
    *,
    fingerprint: Mapping[str, Any] | None = None,
) -> None:
    """Write the arrays and numbers of a pytree `state` atomically.

    Other leaves (functions, strings) count as structure and are not saved.

    **Arguments:** `metadata`: any JSON value, NumPy numbers included. `fingerprint`: values that writer and
    reader must share, for example hashes of mesh and config; `load_checkpoint` compares them.

    **Raises:** `RunDirectoryError` if the file cannot be written; the old file then stays intact.
    `CheckpointError` for a leaf that npz cannot store.
    """
    write_bytes(Path(path), pack_checkpoint(state, metadata, fingerprint=fingerprint))


def pack_checkpoint(
    state: Any,
    metadata: Mapping[str, Any] | None = None,
    *,
    fingerprint: Mapping[str, Any] | None = None,
) -> bytes:
    """Encode a checkpoint as `save_checkpoint` writes it."""
    leaves = _leaves(state)
    header = {
        "format": FORMAT,
        "version": VERSION,
        "fingerprint": dict(fingerprint or {}),
        "metadata": dict(metadata or {}),
        "leaves": {name: _describe(leaf) for name, leaf in leaves.items()},
    }
    arrays = {name: _to_numpy(name, leaf) for name, leaf in leaves.items()}
    return npz_bytes({_HEADER: np.array(to_json(header)), **arrays})


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Return the metadata of a checkpoint and verify all its arrays. **Raises:** `CheckpointError`."""
    path = Path(path)
    return _read_header(path, _read_members(path))["metadata"]


@door
def load_checkpoint(
    path: str | Path, like: Tree, *, fingerprint: Mapping[str, Any] | None = None
) -> tuple[Tree, dict[str, Any]]:
    """Read a checkpoint into the structure of `like`.

    **Arguments:** `like`: a pytree with the saved structure, shapes and types; its values are ignored.
    `fingerprint`: if given, must equal the saved one.

    **Returns:** the state, bit for bit as saved, and the metadata.

    **Raises:** `CheckpointError` if the file is missing, damaged, not a checkpoint, of another version, or if
    its fingerprint or structure does not match.
    """
    path = Path(path)
    members = _read_members(path)
    header = _read_header(path, members)
    _check_fingerprint(path, header["fingerprint"], fingerprint)
    described = header["leaves"]
    wanted = _leaves(like)
    _check_structure(path, described, {name: _describe(leaf) for name, leaf in wanted.items()})
    restored = {name: _restore(path, name, members, described[name]) for name in wanted}

    def pick(key: Any, leaf: Any) -> Any:
        return restored.get(jax.tree_util.keystr(key), leaf)

    return jax.tree_util.tree_map_with_path(pick, like), header["metadata"]


# Leaves


def _leaves(tree: Any) -> dict[str, Any]:
    """Return the numeric leaves of a tree, keyed by path."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(key): leaf for key, leaf in pairs if _has_numbers(leaf)}


def _has_numbers(leaf: Any) -> bool:
    return eqx.is_array_like(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _describe(leaf: Any) -> dict[str, Any]:
    weak = bool(getattr(leaf, "weak_type", False))
    if isinstance(leaf, jax.Array | jax.ShapeDtypeStruct):
        return {"dtype": str(leaf.dtype), "shape": list(leaf.shape), "kind": "jax", "weak": weak}
    kinds = {np.ndarray: "numpy", np.generic: "scalar"}
    kind = next((kind for base, kind in kinds.items() if isinstance(leaf, base)), "python")
    value = np.asarray(leaf)
    return {"dtype": str(value.dtype), "shape": list(value.shape), "kind": kind, "weak": weak}


def _to_numpy(name: str, leaf: Any) -> Shaped[np.ndarray, " ..."]:
    native = isinstance(getattr(leaf, "dtype", np.dtype(float)), np.dtype)
    if not native or np.asarray(leaf).dtype.kind not in "biufc":
        dtype = getattr(leaf, "dtype", type(leaf).__name__)
        raise CheckpointError(
            f"leaf {name} of type {dtype} cannot be saved; make it an array of plain numbers"
        )
    return np.asarray(leaf)


def _restore(path: Path, name: str, members: dict[str, bytes], description: dict[str, Any]) -> Any:
    value = _array(path, members, name)
    if str(value.dtype) != description["dtype"] or list(value.shape) != description["shape"]:
        raise CheckpointError(f"leaf {name} of {str(path)!r} contradicts the header; {_RESTORE}")
    if description["kind"] != "jax":
        return {"numpy": value, "scalar": value[()], "python": value.tolist()}[description["kind"]]
    if not description["weak"]:
        return jnp.array(value)
    # Keep the weak type (that of a Python number): it is part of the key in the JIT cache.
    weak = jnp.broadcast_to(jnp.asarray(value.dtype.type(0).item()), value.shape)
    return weak.at[...].set(value)


# Reading and checking


def _read_members(path: Path) -> dict[str, bytes]:
    """Read all members of the file; zipfile verifies the checksum of each member."""
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise CheckpointError(f"checkpoint {str(path)!r} {what}; check the path, or start the run again")
    try:
        data = path.read_bytes()
        if not data.startswith(b"PK\x03\x04"):
            what = "is empty" if not data else "is not an npz file"
            raise CheckpointError(f"{str(path)!r} {what}, so it is not a checkpoint; {_RESTORE}")
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            return {name.removesuffix(".npy"): file.read(name) for name in file.namelist()}
    except CheckpointError:
        raise
    except Exception as error:  # zipfile raises exceptions of many types for a damaged file
        raise CheckpointError(
            f"checkpoint {str(path)!r} is truncated or damaged ({error}); {_RESTORE}"
        ) from error


def _array(path: Path, members: dict[str, bytes], name: str) -> Shaped[np.ndarray, " ..."]:
    try:
        return np.load(io.BytesIO(members[name]), allow_pickle=False)
    except Exception as error:
        raise CheckpointError(
            f"{name} of {str(path)!r} is missing or damaged ({error}); {_RESTORE}"
        ) from error


def _read_header(path: Path, members: dict[str, bytes]) -> dict[str, Any]:
    foreign = f"{str(path)!r} is an npz file but not a jaxcrumple checkpoint; check the path"
    if _HEADER not in members:
        raise CheckpointError(foreign)
    try:
        header = json.loads(str(_array(path, members, _HEADER)))
    except json.JSONDecodeError as error:
        raise CheckpointError(foreign) from error
    parts = ("fingerprint", "metadata", "leaves")
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise CheckpointError(foreign)
    if not all(isinstance(header.get(part), dict) for part in parts):
        raise CheckpointError(f"the header of {str(path)!r} is incomplete; {_RESTORE}")
    if header.get("version") != VERSION:
        raise CheckpointError(
            f"checkpoint {str(path)!r} has format version {header.get('version')}, this program reads "
            f"{VERSION}; use the version of jaxcrumple that wrote it, or start the run again"
        )
    return header


def _check_fingerprint(path: Path, saved: dict[str, Any], given: Mapping[str, Any] | None) -> None:
    if given is None:
        return
    expected = json.loads(to_json(given))
    for key in sorted(saved.keys() | expected.keys()):
        if saved.get(key) != expected.get(key):
            raise CheckpointError(
                f"checkpoint {str(path)!r} was written with {key} = {saved.get(key)!r}, this run has "
                f"{expected.get(key)!r}; resume with the same settings, or start a new run"
            )


def _check_structure(path: Path, saved: dict[str, Any], wanted: dict[str, Any]) -> None:
    cure = "resume with the scene, mesh and options of the run that wrote it"
    for name in sorted(saved.keys() ^ wanted.keys()):
        where = "in the file but not in this run" if name in saved else "missing from the file"
        raise CheckpointError(f"checkpoint {str(path)!r} does not fit: leaf {name} is {where}; {cure}")
    for name, leaf in wanted.items():
        for what in ("shape", "dtype"):
            if saved[name][what] != leaf[what]:
                found, here = saved[name][what], leaf[what]
                hint = " (is jax_enable_x64 on?)" if what == "dtype" else ""
                raise CheckpointError(
                    f"checkpoint {str(path)!r} does not fit: {what} of leaf {name} is {found} in the file "
                    f"and {here} in this run{hint}; {cure}"
                )
