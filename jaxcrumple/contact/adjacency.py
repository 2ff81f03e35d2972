"""Pairs of triangles that share a node, and the hinges that must fold before the two can touch."""

import itertools
from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Count, HingeValues, Scalar
from jaxcrumple._jax.memory import require
from jaxcrumple._jax.shared import kept_with_first
from jaxcrumple._jax.tree import as_indices
from jaxcrumple.mesh.mesh import Mesh

# Bytes of a way around a node during construction, and of a hinge in the table of all nodes.
WAY, ENTRY = 200.0, 12.0
# Sizes are rounded up: hinges around a node to a multiple of AROUND, ways to one of a power of 2 that is at
# most a WAYS-th of them.
AROUND, WAYS = 8, 16
# Two sites on triangles that share a node come closer than half of their distance at rest only if the sheet
# between them turns by 120 degrees: a polygon's chord is at least its length times the cosine of half its
# turning (Schur). All thresholds are lower, as a margin for stretching. The candidates include ways that turn
# by more than LISTED_TURN. A way that is not listed must not exceed MOST_TURN; the list is rebuilt before, at
# DUE_TURN. The merged matrix has entries for ways from PLACED_TURN on.
PLACED_TURN, LISTED_TURN, DUE_TURN, MOST_TURN = np.deg2rad([60.0, 80.0, 95.0, 115.0])


class Fans(eqx.Module):
    """Hold the pairs of triangles at each node, one entry per way around the node from one to the other.

    - `triangles` (w, 2): the pair of each way, lower index first.
    - `hinges` (n, k): the hinges around each node in order, twice if the fan is closed, padded with the
      number of hinges.
    - `ends` (w, 2): start and end of each way among these hinges, as flat indices into (n, k + 1).
    - `longest`: largest number of hinges on a way.
    """

    triangles: Int[Array, "ways 2"]
    hinges: Int[Array, "nodes around"]
    ends: Int[Array, "ways 2"]
    longest: Count

    def padded(self, around: int, ways: int) -> "Fans":
        """Return the fans with room for `around` hinges at a node, and more `ways`, which never turn."""
        width, spare = self.hinges.shape[1], ways - len(self.ends)
        ends, none = np.asarray(self.ends), np.max(self.hinges, initial=0)
        rows, places = ((0, spare), (0, 0)), ends // (width + 1) * (around + 1) + ends % (width + 1)
        return Fans(
            as_indices(np.pad(self.triangles, rows)),
            as_indices(np.pad(self.hinges, ((0, 0), (0, around - width)), constant_values=none)),
            as_indices(np.pad(places, rows)),
            self.longest,
        )

    def turning(self, theta: HingeValues) -> Float[Array, " ways"]:
        """Return the total turn (w,) in rad along each way, for hinge angles `theta` (h,) in rad."""
        angles = jnp.append(jnp.abs(theta), 0.0)
        # One cumulative sum around a node serves all its ways, about thirty.
        around = angles[self.hinges]
        width = around.shape[1]
        sums = (around @ jnp.triu(jnp.ones((width, width + 1)), 1)).reshape(-1)
        return sums[self.ends[:, 1]] - sums[self.ends[:, 0]]


def largest_turn(turning: Float[Array, " ways"], left_out: Bool[Array, " ways"]) -> Scalar:
    """Return the largest of the turns `turning` (w,) in rad, without the ways flagged in `left_out` (w,)."""
    return jnp.max(jnp.where(left_out, 0.0, turning), initial=0.0)


@kept_with_first
def build_fans(mesh: Mesh) -> Fans:
    """Build all ways around every node.

    A way of 180 degrees or more around an inner node is not the shortest: it gets no hinges, so that its turn
    is 0. Meshes of the same connectivity have fans of the same size.

    **Raises:** ValueError if the ways around a node with very many triangles exceed the memory.
    """
    valence = np.bincount(mesh.faces.ravel()).astype(float)
    node, most = int(np.argmax(valence)), float(valence.max())
    require(
        WAY * float(np.sum(valence * (valence - 1.0))) + ENTRY * 2.0 * most * len(valence),
        f"contact at {int(most)} triangles around node {node}",
        "remesh around that node, or choose no contact",
    )
    around = list(_fans(mesh, _corner_angles(mesh)))
    hinge_of = _hinge_table(mesh)
    width = 2 * max(len(fan) for fan, _, _ in around)
    hinges = np.full((len(around), width), len(mesh.hinges))
    pairs: list[tuple[int, int]] = []
    ends: list[tuple[int, int]] = []
    for node, (fan, angles, closed) in enumerate(around):
        turn, row, first = sum(angles), 2 * fan if closed else fan, node * (width + 1)
        crossed = [hinge_of[a, b] for a, b in itertools.pairwise(row)]
        hinges[node, : len(crossed)] = crossed
        for i, j in itertools.combinations(range(len(fan)), 2):
            ways, between = [(i, j)], [sum(angles[i + 1 : j])]
            if closed:
                ways.append((j, i + len(fan)))
                between.append(turn - angles[i] - angles[j] - between[0])
            for (begin, end), angle in zip(ways, between, strict=True):
                straight = angle < np.pi or not closed
                pairs.append((min(fan[i], fan[j]), max(fan[i], fan[j])))
                ends.append((first + begin, first + (end if straight else begin)))
    triangles, places = (np.array(part, int).reshape(-1, 2) for part in (pairs, ends))
    longest = np.max(places[:, 1] - places[:, 0], initial=0)
    fans = Fans(*map(as_indices, (triangles, hinges, places, longest)))
    # Meshes of other seeds then have arrays of the same sizes, and use one program.
    return fans.padded(_rounded(width, AROUND), _rounded(len(places), max(len(places) // WAYS, 1)))


def _rounded(size: int, step: int) -> int:
    """Round a size up to a multiple of the largest power of 2 up to `step`."""
    unit = 1 << (step.bit_length() - 1)
    return -(-size // unit) * unit


def _corner_angles(mesh: Mesh) -> Float[np.ndarray, "faces 3"]:
    """Return the corner angles (f, 3) in rad of the triangles at rest."""
    x = mesh.vertices[mesh.faces]
    one, two = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    cosine = np.sum(one * two, axis=2) / (np.linalg.norm(one, axis=2) * np.linalg.norm(two, axis=2))
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def _hinge_table(mesh: Mesh) -> dict[tuple[int, int], int]:
    table = {}
    for hinge, (a, b) in enumerate(mesh.hinge_faces.tolist()):
        table[a, b] = table[b, a] = hinge
    return table


def _fans(mesh: Mesh, angles: Float[np.ndarray, "faces 3"]) -> Iterator[tuple[list[int], list[float], bool]]:
    """Yield for each node the triangles around it in order, their angles there in rad, and whether the fan is
    closed."""
    # In a triangle written as (i, j, k), the next triangle in the fan of i lies across the edge (i, k).
    following = [dict[int, tuple[int, int, float]]() for _ in range(mesh.n_nodes)]
    for face, corners in enumerate(mesh.faces.tolist()):
        for k in range(3):
            node, right, left = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
            following[node][right] = (left, face, angles[face, k])
    for spokes in following:
        starts = set(spokes) - {left for left, _, _ in spokes.values()}
        spoke = first = min(starts or spokes)
        fan, turned = [], []
        while spoke in spokes:
            spoke, face, angle = spokes[spoke]
            fan.append(face)
            turned.append(angle)
            if spoke == first:
                break
        yield fan, turned, not starts
