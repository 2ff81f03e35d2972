"""Encode a run for its page: small numbers in one compressed block, and what they mean.

Positions take 16 bits a coordinate, so that a sheet of 10 cm is drawn to 2 um; field values take 8.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Shaped, UInt

from jaxcrumple.io.run import Run
from jaxcrumple.measure import DAMAGE, crease_pattern
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model import walls as shapes
from jaxcrumple.model.walls import AbstractShape
from jaxcrumple.plot.fields import FIELDS
from jaxcrumple.plot.plot import ENERGY_COLORS, about
from jaxcrumple.plot.sheet import color_scale
from jaxcrumple.plot.surroundings import wall_shapes
from jaxcrumple.solvers.log import STEP

# Fields of a page: those that need no contact lists. Labels are plain text there.
SHOWN = {
    "curvature": "mean curvature [1/m]",
    "damage": "damage: change of 2 sin(rest angle / 2)",
    "strain": "largest edge strain [%]",
}
# Largest value of positions and of fields.
FINE, COARSE = 65535, 255
# Rows of the history that a page keeps at most.
ROWS = 1500

# The number of each kind of wall that is a function of time.
MOVING: Mapping[type, str] = {
    shapes.Sphere: "radius",
    shapes.Cylinder: "radius",
    shapes.HoledPlate: "radius",
    shapes.Plane: "offset",
    shapes.Cone: "height",
    shapes.Ball: "height",
}

Json = dict[str, Any]


class Block:
    """Collect arrays in one block of bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, values: Shaped[np.ndarray, " *axes"]) -> Json:
        """Append an array and return where it is: its type, first byte and number of values."""
        self._pad()
        place = {"type": values.dtype.name, "start": self._length, "count": values.size}
        self._append(np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<")).tobytes())
        return place

    def encoded(self) -> str:
        """Return all bytes, compressed by gzip, as base64."""
        return base64.b64encode(gzip.compress(b"".join(self._parts), 6, mtime=0)).decode()

    def _pad(self) -> None:
        """Let the next array begin at a multiple of 4 bytes, as typed arrays of browsers must."""
        self._append(bytes(-self._length % 4))

    def _append(self, part: bytes) -> None:
        self._parts.append(part)
        self._length += len(part)


class SharedField(NamedTuple):
    """Hold the values (frames, nodes) of a field for each run, and the range of their colours."""

    values: list[Float[np.ndarray, "frames nodes"]]
    low: float
    high: float
    signed: bool


def shared_fields(runs: Sequence[Run]) -> dict[str, SharedField]:
    """Return the fields of a page, each with one range for all `runs`."""
    return {name: _shared(runs, name) for name in SHOWN}


def _shared(runs: Sequence[Run], name: str) -> SharedField:
    kind = FIELDS[name]
    assert kind is not None
    values = [
        np.stack([_on_nodes(run.mesh, kind.values(run, frame)) for frame in range(len(run.t))])
        for run in runs
    ]
    low, high = kind.scale(*(frame for one in values for frame in one)).get_clim()
    return SharedField(values, low, high, kind.signed)


def encode(run: Run, name: str, fields: Mapping[str, SharedField], number: int) -> tuple[Json, str]:
    """Return what a page tells of a run of this `name`, and its block of numbers.

    `fields`: of all runs of the page, of which this is the one with this `number`.
    """
    block, mesh = Block(), run.mesh
    low, high = run.x.min(axis=(0, 1)), run.x.max(axis=(0, 1))
    unit = max(float((high - low).max()), 1e-12) / FINE
    described = {
        "name": name,
        "about": about(run),
        "result": run.summary.get("result", "unfinished"),
        "t": run.t.tolist(),
        "nodes": mesh.n_nodes,
        "low": low.tolist(),
        "high": high.tolist(),
        "unit": unit,
        "faces": block.add(mesh.faces.astype(np.uint32)),
        "rest": block.add(mesh.vertices[:, :2].astype(np.float32)),
        "x": block.add(_steps(np.rint((run.x - low) / unit).astype(np.uint16))),
        "hinges": block.add(mesh.hinges[:, :2].astype(np.uint32)),
        "creases": block.add(np.stack([crease_pattern(mesh, p, DAMAGE) for p in run.p]).astype(np.int8)),
        "fields": {key: _field(key, found, number, block) for key, found in fields.items()},
        "walls": [wall for shape in wall_shapes(run) if (wall := _wall(shape, run.t)) is not None],
        "history": _history(run),
    }
    return described, block.encoded()


def _steps(values: UInt[np.ndarray, "frames nodes 3"]) -> UInt[np.ndarray, "frames nodes 3"]:
    """Return the first frame, and the changes from frame to frame (modulo 2^16), which compress well."""
    return np.concatenate([values[:1], np.diff(values, axis=0)])


def _field(name: str, field: SharedField, number: int, block: Block) -> Json:
    share = np.clip((field.values[number] - field.low) / (field.high - field.low), 0.0, 1.0)
    coarse = block.add(np.rint(COARSE * share).astype(np.uint8))
    about = {"label": SHOWN[name], "signed": field.signed, "low": field.low, "high": field.high}
    return {**about, "values": coarse}


def _on_nodes(mesh: Mesh, values: Float[np.ndarray, " ..."]) -> Float[np.ndarray, " nodes"]:
    """Return values of nodes, or for each node the largest magnitude among its triangles."""
    if len(values) == mesh.n_nodes:
        return values
    high, low = np.full(mesh.n_nodes, -np.inf), np.full(mesh.n_nodes, np.inf)
    for corner in mesh.faces.T:
        np.maximum.at(high, corner, values)
        np.minimum.at(low, corner, values)
    return np.where(high > -low, high, low)


def _wall(shape: AbstractShape, times: Float[np.ndarray, " frames"]) -> Json | None:
    """Return the kind of a wall and its numbers at all times; None for a shape of the user's own."""
    moving = MOVING.get(type(shape))
    if moving is None:
        return None
    found: Json = {"kind": type(shape).__name__}
    for name in ("center", "axis", "normal"):
        if hasattr(shape, name):
            found[name] = np.asarray(getattr(shape, name)).tolist()
    for name in ("half_angle", "edge", "radius"):
        if hasattr(shape, name) and name != moving:
            found[name] = float(getattr(shape, name))
    with jax.enable_x64(True):
        found["moves"] = [float(getattr(shape, moving)(float(t))) for t in times]
    return found


def _history(run: Run) -> Json:
    """Return time, step, stage and energies of at most `ROWS` steps, evenly chosen."""
    table = run.history
    steps = table[table["kind"] == STEP] if len(table) else table
    if not len(steps):
        return {"t": [], "h": [], "stage": [], "energies": {}}
    chosen = steps.iloc[np.unique(np.linspace(0, len(steps) - 1, min(len(steps), ROWS)).astype(int))]
    energies = {name: chosen[name] for name in ENERGY_COLORS if (chosen[name] != 0).any()}
    return {
        "t": _short(chosen["t"], 7),
        "h": _short(chosen["h"], 4),
        "stage": list(chosen["stage"]),
        "energies": {name: _short(values, 5) for name, values in energies.items()},
    }


def _short(values: Any, digits: int) -> list[float | None]:
    """Return numbers with so many significant digits, which take less room as text; None if not finite."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values]


def color_table(signed: bool) -> list[int]:
    """Return 256 colours of a scale as 768 numbers from 0 to 255."""
    scale = color_scale(np.array([0.0, 1.0]), signed=signed)
    low, high = scale.get_clim()
    rgba = scale.to_rgba(np.linspace(low, high, COARSE + 1), bytes=True)
    return rgba[:, :3].reshape(-1).tolist()


def palette() -> Mapping[str, Any]:
    """Return the colours that all runs of a page share."""
    return {"signed": color_table(True), "plain": color_table(False), "energies": ENERGY_COLORS}
