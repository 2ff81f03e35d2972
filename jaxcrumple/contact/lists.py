"""Who meets whom: candidate pairs of triangles, and the pairs of sites among them, as lists that hold for a
while.

Two tiers, and a third one in `jaxcrumple.contact.active_set`. `Candidates` are pairs of triangles that may
come within the contact range while no node moves further than its reach, which is that of many steps. `Near`
are those that may do so within a few steps, with their pairs of sites. Motion counts from the positions at
which a list was made, less the mean motion of the sheet, which changes no distance. Lists are ordered and
what does not interact adds exact zeros, so results do not depend on when a list was made.
"""

from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.geometry.hinge import dot

# Sites that are nearer than this many ranges in the rest state never interact.
EXCLUSION = 2.0
# Behind the keys of all pairs of triangles.
NONE = jnp.iinfo(jnp.int64).max
# A list that grows has room for so many times what it must hold: to compile again takes longer than many
# steps.
SOON = 1.5


class Around(eqx.Module):
    """What a list is made for: motions up to `reach` (n,) m from positions `x` (n, 3) m."""

    x: Array
    reach: Array

    def equals(self, other: "Around") -> Array:
        """Whether the other one is the same."""
        return jnp.all(self.x == other.x) & jnp.all(self.reach == other.reach)

    def covers(self, x: Array, spare: Array | float = 0.0) -> Array:
        """Whether each node of `x` (n, 3) may go `spare` m further before it leaves its reach."""
        return jnp.all(motion(self.x, x) + spare <= self.reach)


class Candidates(eqx.Module):
    """Pairs of triangles that may meet.

    `triangles` (c, 2), first below second, sorted, the first `count` of them valid, for motions `around`.
    `folded` (w,): which of the ways of `Fans` are among them; `turn`: the largest one in rad of the others,
    where hinges have angles `theta` (h,).
    """

    triangles: Array
    count: Array
    around: Around
    folded: Array
    theta: Array
    turn: Array


class Near(eqx.Module):
    """Pairs of sites that may interact.

    - `triangles` (T, 2), and `distance` (T,) m between the parts of the two that share no node; the first
      `pair_count` are valid.
    - `found` (K,): sites of the first triangle that lie near the second, as place in `triangles` * s + site.
    - `picked` (P,): pairs of sites, as place in `found` * s + site of the second triangle, `owner` (P,) their
      place in `triangles`, and `apart` (P,) m how far apart they are; the first `site_count` are valid.
    - `around`: the motions for which it holds.
    - `needed` (3,): as `Room`, at least; the list holds nowhere where that is more than there is.
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
        """Which (3,) of the sizes were too small."""
        return self.needed > jnp.asarray(self.room)

    @property
    def room(self) -> "Room":
        """The sizes of the list."""
        return Room(self.triangles.shape[0], self.found.shape[0], self.picked.shape[0])

    def covers(self, x: Array, spare: Array | float = 0.0) -> Array:
        """Whether each node may go `spare` m further before it leaves its reach, and all pairs fitted."""
        return self.around.covers(x, spare) & ~jnp.any(self.overflow)

    def moved(self, faces: Array, *positions: Array) -> Array:
        """How much nearer (T,) in m points of the two triangles may be to each other, at any of some
        `positions` (n, 3), than where the list was made."""
        return self.nearer(faces, reduce(jnp.maximum, [motion(self.around.x, x) for x in positions]))

    def nearer(self, faces: Array, moves: Array) -> Array:
        """How much nearer (T,) in m points of the two triangles may come where nodes move by `moves` (n,)."""
        most = reduce(jnp.maximum, [moves[faces[:, k]] for k in range(3)])
        return most[self.triangles[:, 0]] + most[self.triangles[:, 1]]


class Room(NamedTuple):
    """Sizes of a `Near`: pairs of triangles, sites at triangles, pairs of sites."""

    triangles: int = 1
    sites: int = 1
    pairs: int = 1


SMALLEST = Room()
# First sizes for a sheet, by node, and the least of them: sites that meet are as many in a coarse mesh. What
# a crumple to a third of its size needs fits; more costs each step, for lists are written whole.
ROOM_PER_NODE, SMALLEST_ROOM = Room(1, 16, 32), Room(1000, 32_000, 64_000)


def first_room(n: int) -> Room:
    """Sizes of the first list of a sheet with `n` nodes."""
    return Room(*(max(share * n, least) for share, least in zip(ROOM_PER_NODE, SMALLEST_ROOM, strict=True)))


def doubled(size: int, needed: int) -> int:
    """The size, doubled as often as it takes to be `needed`."""
    while size < needed:
        size *= 2
    return size


def pair_key(triangles: Any, n_faces: int) -> Any:
    """Keys (m,) of pairs of triangles (m, 2), first below second, in the order of sorted pairs."""
    wide = triangles.astype(jnp.int64)
    return wide[:, 0] * n_faces + wide[:, 1]


def place_type(size: int) -> type:
    """Integers that count up to `size`: wider ones take longer."""
    return jnp.int32 if size <= jnp.iinfo(jnp.int32).max else jnp.int64


def split(place: Array, width: int) -> tuple[Array, Array]:
    """Row and column of places row * `width` + column, none negative."""
    columns = jnp.asarray(width, place.dtype)
    return jax.lax.div(place, columns), jax.lax.rem(place, columns)


def motion(start: Array, end: Array) -> Array:
    """Distance (n,) that each node moved, less the mean motion."""
    # By columns: rows of three do not vectorise.
    columns = [end[:, k] - start[:, k] for k in range(3)]
    x, y, z = (column - jnp.mean(column) for column in columns)
    return jnp.sqrt(dot((x, y, z), (x, y, z)))


def nowhere(n: int) -> Around:
    """No motions at all."""
    return Around(jnp.full((n, 3), jnp.nan, float), jnp.zeros(n))


def no_candidates(n: int, hinges: int, ways: int, room: int = 1) -> Candidates:
    """A list that holds nowhere."""
    triangles, folded = jnp.zeros((room, 2), jnp.int32), jnp.zeros(ways, bool)
    unknown = jnp.full(hinges, jnp.nan, float), jnp.asarray(jnp.nan, float)
    return Candidates(triangles, jnp.zeros((), int), nowhere(n), folded, *unknown)


def no_neighbors(n: int, sites: int, room: Room = SMALLEST) -> Near:
    """A list that holds nowhere, for so many `sites` a triangle."""
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
