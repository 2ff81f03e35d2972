"""Neighbour lists with a skin: candidate pairs of triangles, and the site pairs among them.

There are two tiers here, and a third one in `jaxcrumple.contact.active_set`. `Candidates` holds the pairs of
triangles that may come within the contact range while no node moves further than its skin, `reach`, which
covers many steps. `Near` holds the pairs that may do so within a few steps, with their site pairs. Motion
counts from the positions at which a list was built, without the mean motion of the sheet, which changes no
distance. The lists are ordered, and pairs that do not interact add exact zeros. Results therefore do not
depend on when a list was built.
"""

from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.geometry.hinge import dot

# Sites closer than this many ranges at rest are neighbours at rest: they never interact.
EXCLUSION = 2.0
# Key of an unused entry: larger than the keys of all pairs of triangles.
NONE = jnp.iinfo(jnp.int64).max
# Capacity of a list that grows over its required size. A new capacity needs a compilation, which takes longer
# than many steps.
SOON = 1.5


class Around(eqx.Module):
    """Describe the motions that a list covers: up to the skin `reach` (n,) m from positions `x` (n, 3) m."""

    x: Array
    reach: Array

    def equals(self, other: "Around") -> Array:
        """Return whether positions and skin equal those of `other`."""
        return jnp.all(self.x == other.x) & jnp.all(self.reach == other.reach)

    def covers(self, x: Array, spare: Array | float = 0.0) -> Array:
        """Return whether each node of `x` (n, 3) can move `spare` m further and stay within its skin."""
        return jnp.all(motion(self.x, x) + spare <= self.reach)


class Candidates(eqx.Module):
    """Hold the candidate pairs of triangles.

    - `triangles` (c, 2): sorted pairs, lower index first; the first `count` are valid.
    - `around`: the motions that the list covers.
    - `folded` (w,): which ways of `Fans` are listed.
    - `theta` (h,): hinge angles in rad when the list was built.
    - `turn`: largest turn in rad at these angles of the ways that are not listed.
    """

    triangles: Array
    count: Array
    around: Around
    folded: Array
    theta: Array
    turn: Array


class Near(eqx.Module):
    """Hold the site pairs that may interact, and their pairs of triangles.

    - `triangles` (T, 2): pairs of triangles; `distance` (T,) in m: between the parts of the two that share no
      node; the first `pair_count` are valid.
    - `found` (K,): sites of the first triangle near the second, as place in `triangles` * s + site.
    - `picked` (P,): site pairs, as place in `found` * s + site of the second triangle; `owner` (P,): place in
      `triangles`; `apart` (P,) in m: distance of the two sites; the first `site_count` are valid.
    - `around`: the motions that the list covers.
    - `needed` (3,): lower bound of the required capacities, as `Room`. If one exceeds the capacity, the list
      has overflowed and is not valid anywhere.
    """

    triangles: Array
    distance: Array
    pair_count: Array
    found: Array
    picked: Array
    owner: Array
    apart: Array
    site_count: Array
    around: Around
    needed: Array

    @property
    def overflow(self) -> Array:
        """Return which (3,) of the capacities are too small."""
        return self.needed > jnp.asarray(self.room)

    @property
    def room(self) -> "Room":
        """Return the capacities of the list."""
        return Room(self.triangles.shape[0], self.found.shape[0], self.picked.shape[0])

    def covers(self, x: Array, spare: Array | float = 0.0) -> Array:
        """Return whether each node of `x` can move `spare` m further within its skin, without overflow."""
        return self.around.covers(x, spare) & ~jnp.any(self.overflow)

    def moved(self, faces: Array, *positions: Array) -> Array:
        """Return a bound (T,) in m on the approach of two triangles since the last rebuild, at any of the
        `positions` (n, 3)."""
        return self.nearer(faces, reduce(jnp.maximum, [motion(self.around.x, x) for x in positions]))

    def nearer(self, faces: Array, moves: Array) -> Array:
        """Return a bound (T,) in m on the approach of two triangles whose nodes move by `moves` (n,) in m."""
        most = reduce(jnp.maximum, [moves[faces[:, k]] for k in range(3)])
        return most[self.triangles[:, 0]] + most[self.triangles[:, 1]]


class Room(NamedTuple):
    """Hold the capacities of a `Near` list: pairs of triangles, sites near triangles, site pairs."""

    triangles: int = 1
    sites: int = 1
    pairs: int = 1


SMALLEST = Room()
# First capacities per node, and their lower limits: a coarse mesh has as many interacting sites. They suffice
# for a crumple to a third of its size. Larger ones slow every step, because lists are written whole.
ROOM_PER_NODE, SMALLEST_ROOM = Room(1, 16, 32), Room(1000, 32_000, 64_000)


def first_room(n: int) -> Room:
    """Return the capacities of the first list of a sheet with `n` nodes."""
    return Room(*(max(share * n, least) for share, least in zip(ROOM_PER_NODE, SMALLEST_ROOM, strict=True)))


def doubled(size: int, needed: int) -> int:
    """Double `size` until it is at least `needed`."""
    while size < needed:
        size *= 2
    return size


def pair_key(triangles: Any, n_faces: int) -> Any:
    """Return integer keys (m,) of pairs of triangles (m, 2), lower index first; keys sort like the pairs."""
    wide = triangles.astype(jnp.int64)
    return wide[:, 0] * n_faces + wide[:, 1]


def place_type(size: int) -> type:
    """Return the narrowest integer type that counts up to `size`; wider integers are slower."""
    return jnp.int32 if size <= jnp.iinfo(jnp.int32).max else jnp.int64


def split(place: Array, width: int) -> tuple[Array, Array]:
    """Split places row * `width` + column, which must not be negative, into row and column."""
    columns = jnp.asarray(width, place.dtype)
    return jax.lax.div(place, columns), jax.lax.rem(place, columns)


def motion(start: Array, end: Array) -> Array:
    """Return the distance (n,) that each node moved from `start` to `end` (n, 3), without the mean motion."""
    # By columns, because rows of three do not vectorise.
    columns = [end[:, k] - start[:, k] for k in range(3)]
    x, y, z = (column - jnp.mean(column) for column in columns)
    return jnp.sqrt(dot((x, y, z), (x, y, z)))


def nowhere(n: int) -> Around:
    """Return the `Around` that covers no positions: those of `n` nodes are NaN."""
    return Around(jnp.full((n, 3), jnp.nan, float), jnp.zeros(n))


def no_candidates(n: int, hinges: int, ways: int, room: int = 1) -> Candidates:
    """Return an empty list of candidates of capacity `room` that covers no positions."""
    triangles, folded = jnp.zeros((room, 2), jnp.int32), jnp.zeros(ways, bool)
    unknown = jnp.full(hinges, jnp.nan, float), jnp.asarray(jnp.nan, float)
    return Candidates(triangles, jnp.zeros((), int), nowhere(n), folded, *unknown)


def no_neighbors(n: int, sites: int, room: Room = SMALLEST) -> Near:
    """Return an empty list of site pairs that covers no positions, for `sites` sites per triangle."""
    t, zero = room.triangles, jnp.zeros((), int)
    return Near(
        triangles=jnp.zeros((t, 2), jnp.int32),
        distance=jnp.zeros(t),
        pair_count=zero,
        found=jnp.zeros(room.sites, place_type(t * sites)),
        picked=jnp.zeros(room.pairs, place_type(room.sites * sites)),
        owner=jnp.zeros(room.pairs, place_type(t)),
        apart=jnp.zeros(room.pairs),
        site_count=zero,
        around=nowhere(n),
        needed=jnp.zeros(3, int),
    )
