"""Triangles that share a node, and the hinges that must fold for them to meet."""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple._jax.memory import require
from jaxcrumple.mesh.mesh import Mesh

# Bytes of a way around a node while it is found, and of a hinge in the table of all nodes.
WAY, ENTRY = 200.0, 12.0
# Two sites on triangles that share a node come nearer than half of their distance at rest only if the sheet
# between them turns by 120 degrees: a polygon's chord is at least its length times the cosine of half its
# turning (Schur), and the rest is room for stretching. Folds are listed from LISTED_TURN on; those that are
# not must not pass MOST_TURN, and a new list is due before. In the matrix they have a place from PLACED_TURN
# on.
PLACED_TURN, LISTED_TURN, DUE_TURN, MOST_TURN = np.deg2rad([60.0, 80.0, 95.0, 115.0])


class Fans(eqx.Module):
    """Pairs of triangles at a node, by the way around the node from one to the other.

    `triangles` (w, 2), first below second, of each way; `hinges` (n, k): those around each node in order,
    twice where they close, padded with the number of hinges; `ends` (w, 2): where a way begins and ends
    among them, as places in (n, k + 1); `longest`: most hinges on a way.
    """

    triangles: Array
    hinges: Array
    ends: Array
    longest: Array

    def turning(self, theta: Array) -> Array:
        """By how much (w,) the sheet turns along each way where hinges have angles `theta` (h,)."""
        angles = jnp.append(jnp.abs(theta), 0.0)
        # One sum around each node serves all ways there, of which there are thirty.
        turned, before = jnp.zeros(self.hinges.shape[0]), []
        for k in range(self.hinges.shape[1]):
            before.append(turned)
            turned = turned + angles[self.hinges[:, k]]
        sums = jnp.stack([*before, turned], axis=1).reshape(-1)
        return sums[self.ends[:, 1]] - sums[self.ends[:, 0]]


def largest_turn(turning: Array, left_out: Array) -> Array:
    """Largest of the turns `turning` (w,) in rad, some of them `left_out` (w,)."""
    return jnp.max(jnp.where(left_out, 0.0, turning), initial=0.0)


def build_fans(mesh: Mesh) -> Fans:
    """All ways around every node; one of half a turn or more, which no straight line takes, crosses nothing.

    Meshes of the same connectivity have fans of the same size.

    **Raises:** ValueError for so many triangles at a node that the ways around it exceed the memory.
    """
    valence = np.bincount(mesh.faces.ravel()).astype(float)
    node, most = int(np.argmax(valence)), float(valence.max())
    require(
        WAY * float(np.sum(valence * (valence - 1.0))) + ENTRY * 2.0 * most * len(valence),
        f"contact at {int(most)} triangles around node {node}",
        "remesh around that node, or choose no contact",
    )
    fans = list(_fans(mesh, _corner_angles(mesh)))
    hinge_of = _hinge_table(mesh)
    width = 2 * max(len(fan) for fan, _, _ in fans)
    hinges = np.full((len(fans), width), len(mesh.hinges))
    pairs: list[tuple[int, int]] = []
    ends: list[tuple[int, int]] = []
    for node, (fan, angles, closed) in enumerate(fans):
        turn, around, first = sum(angles), 2 * fan if closed else fan, node * (width + 1)
        crossed = [hinge_of[a, b] for a, b in itertools.pairwise(around)]
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
    return Fans(*(jnp.asarray(part, jnp.int32) for part in (triangles, hinges, places, longest)))


def _corner_angles(mesh: Mesh) -> np.ndarray:
    """Angles (f, 3) of the triangles at rest."""
    x = mesh.vertices[mesh.faces]
    one, two = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    cosine = np.sum(one * two, axis=2) / (np.linalg.norm(one, axis=2) * np.linalg.norm(two, axis=2))
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def _hinge_table(mesh: Mesh) -> dict[tuple[int, int], int]:
    table = {}
    for hinge, (a, b) in enumerate(mesh.hinge_faces.tolist()):
        table[a, b] = table[b, a] = hinge
    return table


def _fans(mesh: Mesh, angles: np.ndarray):
    """Triangles around each node in order, their angles there, and whether the last meets the first."""
    # In a triangle (i, j, k) that is turned about i, the next one in the fan of i is that across (i, k).
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
