"""Candidate pairs of triangles by a grid, inside a compiled program: what a tree on the host finds otherwise.

Triangles are sorted by the cell that their centre lies in. A cell is as wide as the centres of two triangles
that may meet are apart at most, so that all partners of a triangle lie in the cells around its own: nine rows
of three cells that follow one another. A pair is met once, from the triangle that comes first.
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.chunks import compacted, counted
from jaxcrumple.model.contact import Contact
from jaxcrumple.model.distance import TINY
from jaxcrumple.model.fans import LISTED_TURN
from jaxcrumple.model.geometry import Vec, add, cross, dot, gather, sub
from jaxcrumple.model.near import EXCLUSION, Candidates

# Pairs of triangles in neighbouring cells that are looked at together.
ROUGH = 4096
# and those whose balls meet.
PAIRS = 512
# Where no pair is: behind all others.
NONE = jnp.iinfo(jnp.int64).max


class _Grid(NamedTuple):
    """Triangles sorted by cell, `order` (f,), and runs (5 f,) of partners: a triangle at place `owner` may
    meet those at the places after `before` plus the number of a pair; there are `until` pairs in all runs up
    to this one. Those beyond the last run add none."""

    order: Array
    owner: Array
    before: Array
    until: Array

    @property
    def pairs(self) -> Array:
        """Number of pairs."""
        return self.until[-1]

    def places(self, pair: Array) -> tuple[Array, Array]:
        """Places (m,) in the order of the two triangles of pairs, whose numbers (m,) follow one another."""
        width = pair.shape[0]
        first = jnp.searchsorted(self.until, pair[0], side="right")
        # As many pairs have no more runs than that, since none is empty.
        ends = self.until[jnp.minimum(first + jnp.arange(width), self.until.shape[0] - 1)] - pair[0]
        last = jnp.zeros(width, bool).at[jnp.where(ends > 0, ends, width)].set(True, mode="drop")
        run = jnp.minimum(first + counted(last), self.until.shape[0] - 1)
        partner = jnp.clip(self.before[run] + pair, 0, self.order.shape[0] - 1)
        return self.owner[run], partner


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
    size = jnp.asarray(keys.shape[0])
    kept, fitted = compacted(lambda at: fresh[at][:, None], size, 1, room, ROUGH, lambda at: keys[at])
    triangles = jnp.stack([kept // n_faces, kept % n_faces], axis=1).astype(jnp.int32)
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
    near, size = center[grid.order], radius[grid.order]

    def key(pair: Array) -> Array:
        one, two = (grid.order[place] for place in grid.places(pair))
        return jnp.minimum(one, two) * n_faces + jnp.maximum(one, two)

    def meets(pair: Array) -> Array:
        one, two = grid.places(pair)
        offset = sub(*gather(near, jnp.stack([one, two], axis=1)))
        rough = dot(offset, offset) <= (contact.range + size[one] + size[two]) ** 2
        few, many = compacted(lambda at: rough[at][:, None], jnp.asarray(ROUGH), 1, ROUGH, ROUGH)

        def body(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            start, found = carry
            rows = start + jnp.arange(PAIRS)
            at = few[jnp.minimum(rows, ROUGH - 1)]
            close = _may_meet(contact, x, extent, grid.order[one[at]], grid.order[two[at]])
            return start + PAIRS, found.at[jnp.where(rows < many, at, ROUGH)].set(close, mode="drop")

        start = jnp.asarray(0), jnp.zeros(ROUGH, bool)
        return jax.lax.while_loop(lambda carry: carry[0] < many, body, start)[1][:, None]

    return compacted(meets, grid.pairs, 1, room, ROUGH, key)


def _sorted(center: Array, width: Array) -> _Grid:
    """Triangles with centres (f, 3) in cells of a `width`."""
    cell = jnp.floor((center - jnp.min(center, axis=0)) / width).astype(jnp.int64) + 1
    # A free cell at both ends of a row keeps rows apart.
    columns, rows = jnp.max(cell[:, 0]) + 2, jnp.max(cell[:, 1]) + 2
    number = cell[:, 0] + columns * (cell[:, 1] + rows * cell[:, 2])
    order = jnp.argsort(number)
    number = number[order]
    # Of the nine rows of cells around one, those that come later; and what comes later in its own.
    later = jnp.stack(
        [jnp.zeros_like(rows), columns, columns * (rows - 1), columns * rows, columns * (rows + 1)]
    )
    row = number[:, None] + later
    first = jnp.searchsorted(number, row - 1, side="left").astype(int)
    first = first.at[:, 0].set(jnp.arange(number.shape[0]) + 1)
    length = (jnp.searchsorted(number, row + 1, side="right") - first).reshape(-1)
    room = length.shape[0]
    runs, many = compacted(lambda at: (length[at] > 0)[:, None], jnp.asarray(room), 1, room, ROUGH)
    length = jnp.where(jnp.arange(room) < many, length[runs], 0)
    until = jnp.cumsum(length)
    return _Grid(order, runs // later.shape[0], first.reshape(-1)[runs] - (until - length), until)


def _may_meet(contact: Contact, x: Array, extent: Array, one: Array, two: Array) -> Array:
    """Whether triangles (m,) may come within the range when each moves by its `extent` (f,), share no node,
    and have sites far enough from one another at rest."""
    first, second = contact.faces[one], contact.faces[two]
    shared = jnp.any(first[:, :, None] == second[:, None], axis=(1, 2))
    rest = gather(contact.rest, first), gather(contact.rest, second)
    squared = [dot(sub(p, q), sub(p, q)) for p in rest[0] for q in rest[1]]
    interact = reduce(jnp.maximum, squared) >= (EXCLUSION * contact.range) ** 2
    gap = _gap(gather(x, first), gather(x, second))
    return ~shared & interact & (gap <= contact.range + extent[one] + extent[two])


def _gap(first: tuple[Vec, ...], second: tuple[Vec, ...]) -> Array:
    """Lower bound (m,) of the distance of triangles: that of their bounding boxes, or the largest separation
    along the line of their centres or a normal."""
    zero = jnp.zeros_like(first[0][0])
    boxes = [jnp.maximum(_apart_by([c[i] for c in first], [c[i] for c in second]), zero) for i in range(3)]
    gap = jnp.sqrt(sum((side * side for side in boxes), zero))
    centers = [reduce(add, side) for side in (first, second)]
    normals = [cross(sub(side[1], side[0]), sub(side[2], side[0])) for side in (first, second)]
    for axis in (sub(centers[1], centers[0]), *normals):
        length = jnp.sqrt(dot(axis, axis)) + TINY
        heights = ([dot(c, axis) for c in side] for side in (first, second))
        gap = jnp.maximum(gap, _apart_by(*heights) / length)
    return gap


def _apart_by(one: list[Array], two: list[Array]) -> Array:
    """How far two intervals are apart, each that of three numbers (m,); negative where they overlap."""
    highest, lowest = ([reduce(f, side) for side in (one, two)] for f in (jnp.maximum, jnp.minimum))
    return jnp.maximum(lowest[1] - highest[0], lowest[0] - highest[1])
