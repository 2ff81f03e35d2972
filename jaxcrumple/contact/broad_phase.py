"""Candidate pairs of triangles by a grid, inside a compiled program: what a tree on the host finds otherwise.

Triangles are sorted by the cell that their centre lies in. A cell is as wide as the centres of two triangles
that may meet are apart at most, so that all partners of a triangle lie in the cells around its own: nine rows
of three cells that follow one another. A pair is met once, from the triangle that comes first.
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple._jax.padded import compacted, counted
from jaxcrumple.contact.adjacency import LISTED_TURN, largest_turn
from jaxcrumple.contact.energy import Contact
from jaxcrumple.contact.lists import EXCLUSION, NONE, Around, Candidates, pair_key
from jaxcrumple.geometry.distance import TINY, boxes, boxes_meet
from jaxcrumple.geometry.hinge import Vec, add, cross, dot, gather, sub

# Pairs of triangles in neighbouring cells that are looked at together; of these, those whose boxes meet; of
# these, those that share no node.
ROUGH, FIRST, SECOND = 8192, 512, 128


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
        # By comparisons, so that the compiler sees that two calls do the same.
        first = jnp.searchsorted(self.until, pair[0], side="right", method="compare_all")
        # As many pairs have no more runs than that, since none is empty.
        ends = self.until[jnp.minimum(first + jnp.arange(width), self.until.shape[0] - 1)] - pair[0]
        last = jnp.zeros(width, bool).at[jnp.where(ends > 0, ends, width)].set(True, mode="drop")
        run = jnp.minimum(first + counted(last), self.until.shape[0] - 1)
        partner = jnp.clip(self.before[run] + pair, 0, self.order.shape[0] - 1)
        return self.owner[run], partner


def find_candidates(contact: Contact, theta: Array, around: Around) -> Candidates:
    """Pairs of triangles that may come within the range by motions `around` positions where hinges have
    angles `theta` (h,), in a list of the same size as the one that `contact` has. Its `count` may be more
    than that."""
    room = contact.candidates.triangles.shape[0]
    turning = contact.fans.turning(theta)
    folded = turning > LISTED_TURN
    apart, count = _apart(contact, around, room)
    n_faces = contact.faces.shape[0]
    ways = contact.fans.triangles
    sharp, ways_count = compacted(lambda at: folded[at][:, None], jnp.asarray(len(ways)), 1, room, ROUGH)
    parts = ((apart, count), (pair_key(ways[sharp], n_faces), ways_count))
    keys = jnp.sort(jnp.concatenate([jnp.where(jnp.arange(room) < m, key, NONE) for key, m in parts]))
    # A pair has two ways around the node that it shares, and may have more than one such node.
    fresh = (keys < NONE) & (keys != jnp.roll(keys, 1))
    size = jnp.asarray(keys.shape[0])
    kept, fitted = compacted(lambda at: fresh[at][:, None], size, 1, room, ROUGH, lambda at: keys[at])
    triangles = jnp.stack([kept // n_faces, kept % n_faces], axis=1).astype(jnp.int32)
    # Ways outnumber their pairs, so that they only count where they did not fit.
    needed = jnp.maximum(count, ways_count)
    count = jnp.where(needed > room, needed, fitted)
    return Candidates(triangles, count, around, folded, theta, largest_turn(turning, folded))


def _apart(contact: Contact, around: Around, room: int) -> tuple[Array, Array]:
    """Keys (room,) of pairs that share no node, and how many they are."""
    faces, n_faces, x = contact.faces, contact.faces.shape[0], around.x
    corners = x[faces]
    center = jnp.mean(corners, axis=1)
    extent = jnp.max(around.reach[faces], axis=1)
    radius = extent + jnp.sqrt(jnp.max(jnp.sum((corners - center[:, None]) ** 2, axis=2), axis=1))
    grid = _sorted(center, contact.range + 2.0 * jnp.max(radius))
    # Sorted as the grid is, which spares a look at its order for every pair.
    low, high = boxes(corners[grid.order], extent[grid.order])
    faces, extent = faces[grid.order], extent[grid.order]

    def meets(pair: Array) -> Array:
        one, two = grid.places(pair)
        passed = boxes_meet(low, high, one, two, contact.range)
        passed = _those(passed, lambda at: _no_neighbors(faces, one[at], two[at]), FIRST)

        def touch(at: Array) -> Array:
            sides = [(faces[k[at]], extent[k[at]]) for k in (one, two)]
            return _may_touch(contact, x, *sides)

        return _those(passed, touch, SECOND)[:, None]

    def both(pair: Array) -> Array:
        one, two = grid.places(pair)
        return one.astype(jnp.int64) * n_faces + two

    found, count = compacted(meets, grid.pairs, 1, room, ROUGH, both)
    first, second = grid.order[found // n_faces], grid.order[found % n_faces]
    ordered = jnp.stack([jnp.minimum(first, second), jnp.maximum(first, second)], axis=1)
    return pair_key(ordered, n_faces), count


def _those(asked: Array, test: Callable[[Array], Array], block: int) -> Array:
    """Which (m,) of those that are `asked` about pass a `test` of places (block,)."""
    size = asked.shape[0]
    few, many = compacted(lambda at: asked[at][:, None], jnp.asarray(size), 1, size, size)

    def body(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        start, passed = carry
        rows = start + jnp.arange(block)
        at = few[jnp.minimum(rows, size - 1)]
        return start + block, passed.at[jnp.where(rows < many, at, size)].set(test(at), mode="drop")

    start = jnp.asarray(0), jnp.zeros(size, bool)
    return jax.lax.while_loop(lambda carry: carry[0] < many, body, start)[1]


def _sorted(center: Array, width: Array) -> _Grid:
    """Triangles with centres (f, 3) in cells of a `width`."""
    cell = jnp.floor((center - jnp.min(center, axis=0)) / width).astype(jnp.int64) + 1
    # A free cell at both ends of a row keeps rows apart.
    columns, rows = jnp.max(cell[:, 0]) + 2, jnp.max(cell[:, 1]) + 2
    number = cell[:, 0] + columns * (cell[:, 1] + rows * cell[:, 2])
    order = jnp.argsort(number).astype(jnp.int32)
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
    until = jnp.cumsum(length).astype(jnp.int32)
    before = first.reshape(-1)[runs] - (until - length)
    return _Grid(order, runs // later.shape[0], before.astype(jnp.int32), until)


def _no_neighbors(faces: Array, one: Array, two: Array) -> Array:
    """Whether triangles (m,) share no node."""
    same = [faces[:, i][one] == faces[:, j][two] for i in range(3) for j in range(3)]
    return ~reduce(jnp.logical_or, same)


def _may_touch(contact: Contact, x: Array, one: tuple[Array, Array], two: tuple[Array, Array]) -> Array:
    """Whether triangles, given by nodes (m, 3) and how far these move (m,), may come within the range, and
    have sites far enough from one another at rest."""
    (first, one_moves), (second, two_moves) = one, two
    rest = gather(contact.rest, first), gather(contact.rest, second)
    squared = [dot(sub(p, q), sub(p, q)) for p in rest[0] for q in rest[1]]
    interact = reduce(jnp.maximum, squared) >= (EXCLUSION * contact.range) ** 2
    gap = _gap(gather(x, first), gather(x, second))
    return interact & (gap <= contact.range + one_moves + two_moves)


def _gap(first: tuple[Vec, ...], second: tuple[Vec, ...]) -> Array:
    """Lower bound (m,) of the distance of triangles: that of their bounding boxes, or the largest separation
    along the line of their centres or a normal."""
    zero = jnp.zeros_like(first[0][0])
    apart = [jnp.maximum(_apart_by([c[i] for c in first], [c[i] for c in second]), zero) for i in range(3)]
    gap = jnp.sqrt(sum((side * side for side in apart), zero))
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
