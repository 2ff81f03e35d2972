"""Checks of the start of a run: reject sheets that overlap or have a force that is not finite."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from jaxcrumple._jax.arrays import Count, NodeValues, NodeVectors, NodeVectorsLike, Scalar
from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple.contact.energy import closest_sites
from jaxcrumple.contact.host_broad_phase import Search
from jaxcrumple.contact.lists import SitePairs
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.geometry.intersections import intersections
from jaxcrumple.model.bending import FOLD_STOP
from jaxcrumple.model.walls import Wall
from jaxcrumple.scene import Scene
from jaxcrumple.state import State

# Two triangles touch if their distance is below the larger of ROUNDING contact ranges and PLACES units in the
# last place of the sheet's largest coordinate.
ROUNDING, PLACES = 1e-12, 16
# Smallest height of a triangle in units of its longest edge; the same as for a mesh.
LEAST_HEIGHT = 1e-6
# A wall counts as touching a node at a distance below TOUCHING of its range.
TOUCHING = 1e-4
# Smallest distance of a hinge angle from 180 degrees, in rad. The stiffness of the fold stop grows as the
# inverse third power of this distance; below it, it exceeds the hinge's by more than float64 resolves.
LEAST_OPENING = float(np.pi - FOLD_STOP) * np.finfo(float).eps ** (1.0 / 3.0)


def pierced(scene: Scene, x: NodeVectorsLike) -> Int[np.ndarray, "places 5"]:
    """Find the edges and triangles of a self-avoiding scene that intersect at positions `x` (n, 3).

    Returns node numbers (k, 5): two of the edge, three of the triangle."""
    assert scene.contact is not None
    faces, edges = np.asarray(scene.contact.faces), np.asarray(scene.membrane.nodes)
    pairs = intersections(x, faces, edges)
    return np.concatenate([edges[pairs[:, 0]], faces[pairs[:, 1]]], axis=1)


def check_start(scene: Scene, state: State) -> None:
    """Check that a run can start from a state, without compiling more than a wall's distance.

    **Raises:** ValueError for a node behind or on a wall, an edge without length, a triangle without area, a
    hinge at 180 degrees or, in a scene with contact, an edge that pierces a triangle. It names the first one.
    """
    x = np.asarray(state.x)
    _check_walls(scene, state)
    _check_edges(scene, x)
    if scene.contact is not None:
        _check_piercing(scene, x)
    _check_hinges(scene, x)


@StoredJit
def wall_gap(wall: Wall, x: NodeVectors, t: Scalar) -> NodeValues:
    """Return the distance (n,) in m of nodes at `x` (n, 3) from a wall."""
    return wall.gap(x, t)


def _name(index: int, wall: Wall) -> str:
    return f"wall {index} ({type(wall.shape).__name__})"


def _check_walls(scene: Scene, state: State) -> None:
    for index, wall in enumerate(scene.walls):
        name = _name(index, wall)
        gap = np.asarray(wall_gap(wall, state.x, state.t))
        if np.any(np.isnan(gap)):
            node = int(np.argmax(np.isnan(gap)))
            raise ValueError(
                f"the gap between node {node} and {name} is NaN at t = {float(state.t):g} s; give the wall "
                "finite numbers and a motion that is finite from that time on."
            )
        node = int(np.argmin(gap))
        if gap[node] < 0:
            raise ValueError(
                f"node {node} starts {-gap[node]:.3g} m behind {name}; move the sheet or the wall."
            )
        if gap[node] == 0:
            raise ValueError(
                f"node {node} starts on {name}, where the wall's force is infinite; move the sheet or the "
                f"wall. A start without force needs a gap of the wall's range, {float(wall.range):.3g} m."
            )


def in_the_way(scene: Scene, state: State) -> str:
    """Name the node that a wall all but touches; return "" if none does."""
    for index, wall in enumerate(scene.walls):
        gap = np.asarray(wall_gap(wall, state.x, state.t))
        node = int(np.argmin(gap))
        if gap[node] < TOUCHING * float(wall.range):
            held = scene.prescribed is not None and bool(np.any(scene.prescribed.held(state.t)[node]))
            place = f"node {node}, where a support holds it" if held else f"node {node}"
            return f"{_name(index, wall)} comes within {gap[node]:.2g} m of {place}"
    return ""


def _check_edges(scene: Scene, x: Float[np.ndarray, "nodes 3"]) -> None:
    edges = np.asarray(scene.membrane.nodes)
    bad = np.flatnonzero(np.all(x[edges[:, 0]] == x[edges[:, 1]], axis=1))
    if bad.size:
        raise ValueError(
            f"edge {_ids(edges[bad[0]])} starts without length, so its force has no direction; move its "
            "nodes apart."
        )


def _check_piercing(scene: Scene, x: Float[np.ndarray, "nodes 3"]) -> None:
    found = pierced(scene, x)
    if len(found):
        a, b, *face = found[0].tolist()
        raise ValueError(
            f"the sheet starts passing through itself at {len(found)} places: edge ({a}, {b}) pierces "
            f"triangle {tuple(face)}; start from positions without intersections, or leave contact out."
        )


def _check_hinges(scene: Scene, x: Float[np.ndarray, "nodes 3"]) -> None:
    """Reject hinges at 180 degrees, and triangles without area, whose hinges have no angle."""
    nodes = np.asarray(scene.bending.nodes)
    corners = [x[nodes[:, k]] for k in range(4)]
    edge, one, two = (corner - corners[0] for corner in corners[1:])
    normals = np.cross(edge, one), np.cross(two, edge)
    for normal, side, third in zip(normals, (one, two), (2, 3), strict=True):
        longest = np.max([np.linalg.norm(a, axis=1) for a in (edge, side, side - edge)], axis=0)
        flat = np.flatnonzero(np.linalg.norm(normal, axis=1) <= LEAST_HEIGHT * longest**2)
        if flat.size:
            raise ValueError(
                f"triangle {_ids(nodes[flat[0], [0, 1, third]])} starts without area, so its hinges have no "
                "angle; move its nodes apart."
            )
    sine = np.linalg.norm(np.cross(*normals), axis=1)
    angle = np.arctan2(sine, np.sum(normals[0] * normals[1], axis=1))
    bad = np.flatnonzero(np.pi - angle < LEAST_OPENING)
    if bad.size:
        one_of = nodes[bad[0]]
        raise ValueError(
            f"{bad.size} hinges start folded by 180 degrees, the first at edge {_ids(one_of[:2])} between "
            f"nodes {one_of[2]} and {one_of[3]}; there the force is infinite. Open them; for a start without "
            f"force of the fold stop, to less than {np.degrees(FOLD_STOP):.0f} degrees."
        )


def has_near_layers(scene: Scene, state: State) -> bool:
    """Return whether any two triangles of a self-avoiding sheet are near enough to push each other."""
    assert scene.contact is not None
    search = Search(scene.contact, np.asarray(scene.bending.nodes))
    pairs, _ = search.find(np.asarray(state.x), np.zeros(scene.n_nodes))
    return len(pairs) > 0


def check_gap(scene: Scene, state: State) -> None:
    """Check the gaps between the layers of a scene with contact lists.

    **Raises:** ValueError for layers that touch, that are so close that the contact force has no reliable
    direction, or that lie within the core of a barrier. It states the distance and names two triangles.
    """
    contact, lists = scene.contact, scene.own_lists
    assert contact is not None
    _check_touching(contact, lists.pairs, np.abs(np.asarray(state.x)).max())
    gap, _, owner = closest_sites(contact, lists, state.x)
    least = float(contact.potential.closest(contact.range))
    if float(gap) <= least:
        raise ValueError(
            f"the sheet starts {float(gap):.3g} m from itself, at triangles "
            f"{_names(contact, lists.pairs, owner)}; contact of range {float(contact.range):.3g} m needs "
            f"more than {least:.3g} m. Start from layers farther apart, or choose another range."
        )


def _check_touching(contact: Contact, pairs: SitePairs, size: float) -> None:
    count = int(pairs.triangle_count)
    if count == 0:
        return
    distance = np.asarray(pairs.distance)[:count]
    closest = int(np.argmin(distance))
    if distance[closest] <= max(ROUNDING * float(contact.range), PLACES * np.spacing(size)):
        raise ValueError(
            f"the sheet starts touching itself, at triangles {_names(contact, pairs, closest)}, so the "
            f"contact force has no direction; separate the layers, by {float(contact.range):.3g} m for a "
            "start without force, or leave contact out."
        )


def _names(contact: Contact, pairs: SitePairs, place: Count | int) -> str:
    """Name the nodes of the two triangles at index `place` of the list."""
    triangles = np.asarray(pairs.triangles)[int(np.asarray(place))]
    return " and ".join(_ids(nodes) for nodes in np.asarray(contact.faces)[triangles])


def _ids(nodes: Iterable[int]) -> str:
    return f"({', '.join(str(int(node)) for node in nodes)})"
