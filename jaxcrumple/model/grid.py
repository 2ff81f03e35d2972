"""Candidate pairs of triangles by a grid, inside a compiled program: what a tree on the host finds otherwise.

Triangles are sorted by the cell that their centre lies in. A cell is as wide as the centres of two triangles
that may meet are apart at most, so that all partners of a triangle lie in the cells around its own: nine rows
of three cells that follow one another.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.chunks import compacted
from jaxcrumple.model.contact import Contact
from jaxcrumple.model.fans import LISTED_TURN
from jaxcrumple.model.geometry import gather
from jaxcrumple.model.near import EXCLUSION, PAIRS, Candidates, distances

# Pairs of triangles in neighbouring cells that are looked at together.
ROUGH = 4096
# Where no pair is: behind all others.
NONE = jnp.iinfo(jnp.int64).max


class _Grid(NamedTuple):
    """Triangles sorted by cell, `order` (f,); of each triangle's nine rows of cells (9 f,): the `first` place
    in that order, and the number of triangles in all rows up to this one, `until`."""

    order: Array
    first: Array
    until: Array

    def partner(self, place: Array) -> tuple[Array, Array]:
        """The `place`-th pair (m,) of a triangle with one of the cells around it."""
        row = jnp.minimum(jnp.searchsorted(self.until, place, side="right"), self.until.shape[0] - 1)
        before = jnp.where(row > 0, self.until[row - 1], 0)
        at = jnp.minimum(self.first[row] + place - before, self.order.shape[0] - 1)
        return row // 9, self.order[at]


def find_candidates(contact: Contact, theta: Array, x: Array, reach: Array) -> Candidates:
    """Pairs of triangles that may come within the range while no node moves further than `reach` (n,) from
    `x` (n, 3), where hinges have angles `theta` (h,); in a list of the same size as the one that `contact`
    has. Its `count` may be more than that."""
    room = contact.candidates.triangles.shape[0]
    folded = contact.fans.turning(theta) > LISTED_TURN
    apart, count = _apart(contact, x, reach, room)
    n_faces = contact.faces.shape[0]
    ways = contact.fans.triangles.astype(jnp.int64)
    keys = jnp.where(folded, ways[:, 0] * n_faces + ways[:, 1], NONE)
    held = jnp.where(jnp.arange(room) < count, apart, NONE)
    keys = jnp.sort(jnp.concatenate([held, keys]))
    # A pair has two ways around the node that it shares, and may have more than one such node.
    fresh = (keys < NONE) & (keys != jnp.roll(keys, 1))
    kept, fitted = compacted(lambda at: fresh[at][:, None], jnp.asarray(keys.shape[0]), 1, room, ROUGH)
    valid = jnp.arange(room) < fitted
    keys = jnp.where(valid, keys[kept], 0)
    triangles = jnp.stack([keys // n_faces, keys % n_faces], axis=1).astype(jnp.int32)
    total = jnp.maximum(count, fitted)
    return Candidates(triangles, total, x, reach, folded)


def _apart(contact: Contact, x: Array, reach: Array, room: int) -> tuple[Array, Array]:
    """Keys (room,) of pairs that share no node, and how many they are."""
    faces, n_faces = contact.faces, contact.faces.shape[0]
    corners = x[faces]
    center = jnp.mean(corners, axis=1)
    extent = jnp.max(reach[faces], axis=1)
    radius = extent + jnp.sqrt(jnp.max(jnp.sum((corners - center[:, None]) ** 2, axis=2), axis=1))
    grid = _sorted(center, contact.range + 2.0 * jnp.max(radius))

    def key(place: Array) -> Array:
        one, two = grid.partner(place)
        return one * n_faces + two

    def meets(place: Array) -> Array:
        one, two = grid.partner(place)
        gap = jnp.sqrt(jnp.sum((center[one] - center[two]) ** 2, axis=1))
        rough = (one < two) & (gap <= contact.range + radius[one] + radius[two])
        few, many = compacted(lambda at: rough[at][:, None], jnp.asarray(ROUGH), 1, ROUGH, ROUGH)

        def body(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            start, found = carry
            rows = start + jnp.arange(PAIRS)
            at = few[jnp.minimum(rows, ROUGH - 1)]
            close = _may_meet(contact, x, extent, one[at], two[at])
            return start + PAIRS, found.at[jnp.where(rows < many, at, ROUGH)].set(close, mode="drop")

        start = jnp.asarray(0), jnp.zeros(ROUGH, bool)
        return jax.lax.while_loop(lambda carry: carry[0] < many, body, start)[1][:, None]

    return compacted(meets, grid.until[-1], 1, room, ROUGH, key)


def _sorted(center: Array, width: Array) -> _Grid:
    """Triangles with centres (f, 3) in cells of a `width`."""
    cell = jnp.floor((center - jnp.min(center, axis=0)) / width).astype(jnp.int64) + 1
    # A free cell at both ends of a row keeps rows apart.
    columns, rows = jnp.max(cell[:, 0]) + 2, jnp.max(cell[:, 1]) + 2
    number = cell[:, 0] + columns * (cell[:, 1] + rows * cell[:, 2])
    order = jnp.argsort(number)
    steps = jnp.arange(-1, 2)
    row = number[:, None] + (columns * (steps[:, None] + rows * steps)).reshape(-1)
    ends = [
        jnp.searchsorted(number[order], (row + step).reshape(-1), side=side)
        for step, side in ((-1, "left"), (1, "right"))
    ]
    return _Grid(order, ends[0], jnp.cumsum(ends[1] - ends[0]))


def _may_meet(contact: Contact, x: Array, extent: Array, one: Array, two: Array) -> Array:
    """Whether triangles (m,) come within the range when each moves by its `extent` (f,), share no node, and
    have sites far enough from one another at rest."""
    first, second = contact.faces[one], contact.faces[two]
    shared = jnp.any(first[:, :, None] == second[:, None], axis=(1, 2))
    rest = gather(contact.rest, first), gather(contact.rest, second)
    squared = [sum((a - b) ** 2 for a, b in zip(p, q, strict=True)) for p in rest[0] for q in rest[1]]
    interact = jnp.max(jnp.stack(squared), axis=0) >= (EXCLUSION * contact.range) ** 2
    gap, _ = distances(x, first, second)
    return ~shared & interact & (gap <= contact.range + extent[one] + extent[two])
