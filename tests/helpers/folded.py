"""Sheets folded onto themselves, and their contact energy by brute force."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxcrumple as jc

COLUMNS, ROWS, STEP = (9, 9), 5, 1.1e-3


def strip(
    gap: float,
    columns: tuple[int, ...] = COLUMNS,
    rows: int = ROWS,
    step: float = STEP,
    pitch: float | None = None,
) -> jc.Mesh:
    """A flat strip of crossed rectangles, `step` m wide and `pitch` m high, of several layers of so many
    `columns` each, `gap` m apart, where `folded` folds it.

    The rectangles of all strips with as many columns in sum are connected in the same way.
    """
    s = np.arange(sum(columns)) * step
    s += np.repeat(np.arange(len(columns)), columns) * (gap - step)
    y = (step if pitch is None else pitch) * (np.arange(rows) - 0.5 * (rows - 1))
    points = np.stack(np.meshgrid(s - s.mean(), y, indexing="ij"), axis=-1).reshape(-1, 2)
    faces = []
    for i in range(len(s) - 1):
        for j in range(rows - 1):
            a, b, c, d = i * rows + j, (i + 1) * rows + j, (i + 1) * rows + j + 1, i * rows + j + 1
            faces += [(a, b, c), (a, c, d)] if (i + j) % 2 else [(a, b, d), (b, c, d)]
    return jc.Mesh.from_arrays(points, faces, reorder=True)


def layer_of(mesh: jc.Mesh, columns: tuple[int, ...] = COLUMNS) -> np.ndarray:
    """The layer (n,) of a strip's nodes, 0 the lowest."""
    _, column = np.unique(np.round(mesh.vertices[:, 0], 9), return_inverse=True)
    return np.repeat(np.arange(len(columns)), columns)[column]


def folded(mesh: jc.Mesh, gap: float, columns: tuple[int, ...] = COLUMNS) -> np.ndarray:
    """Positions (n, 3) of a `strip` with creases of 90 degrees: layers `gap` apart, nothing stretched, the
    first fold at x = 0, the next one left of it, and so on in turn."""
    x, layer = mesh.vertices.copy(), layer_of(mesh, columns)
    fold, way = 0.0, 1.0
    for k in range(len(columns)):
        s = mesh.vertices[layer == k, 0]
        length = s.max() - s.min()
        start = -length if k == 0 else fold
        x[layer == k, 0] = start + way * (s - s.min())
        x[layer == k, 2] = (k - 0.5 * (len(columns) - 1)) * gap
        fold, way = start + way * length, -way
    return x


def folded_sheet(gap: float, contact: jc.SelfContact) -> tuple[jc.Scene, jax.Array]:
    """An elastic strip folded in half, its layers `gap` m apart: scene with contact lists, and positions."""
    columns = (5, 5)
    mesh = strip(gap, columns, rows=7)
    x = jnp.asarray(folded(mesh, gap, columns))
    material = jc.Material(thickness=3e-4, yield_curvature=None)
    return jc.with_contacts(jc.sheet(mesh, material, contact=contact), x), x


def site_lattice(parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric weights of a triangle's sites and their shares of its area, from the small triangles."""
    index = {}
    for i in range(parts + 1):
        for j in range(parts + 1 - i):
            index[i, j] = len(index)
    share = np.zeros(len(index))
    for i in range(parts):
        for j in range(parts - i):
            triangles = [((i, j), (i + 1, j), (i, j + 1))]
            if i + j < parts - 1:
                triangles.append(((i + 1, j + 1), (i + 1, j), (i, j + 1)))
            for triangle in triangles:
                for corner in triangle:
                    share[index[corner]] += 1.0 / (3.0 * parts**2)
    weights = np.array([(i, j, parts - i - j) for i, j in index]) / parts
    return weights, share


def brute_force(
    mesh: jc.Mesh, x: np.ndarray, ks: float, sigma: float, parts: int
) -> tuple[float, np.ndarray]:
    """Contact energy and nodal forces by a sum over all pairs of merged sites of the sheet."""
    weights, share = site_lattice(parts)
    rest = np.einsum("sk,fki->fsi", weights, mesh.vertices[mesh.faces]).reshape(-1, 3)
    area = np.outer(mesh.face_area, share).reshape(-1) / (np.sqrt(3.0) / 2.0 * sigma**2)
    rows = np.repeat(np.arange(len(mesh.faces)), len(weights))
    matrix = np.zeros((len(rest), mesh.n_nodes))
    for k in range(3):
        np.add.at(
            matrix, (np.arange(len(rest)), mesh.faces[rows, k]), np.tile(weights[:, k], len(mesh.faces))
        )
    # Sites of several triangles at one place are one site.
    _, first, place = np.unique(np.round(rest / 1e-9), axis=0, return_index=True, return_inverse=True)
    area, times = np.bincount(place.reshape(-1), area), np.bincount(place.reshape(-1))
    matrix, rest = matrix[first], rest[first]
    # On the rim of the strip they stand for half of what is inside, and less at a corner.
    rim = np.any(np.abs(np.abs(rest[:, :2]) - mesh.vertices[:, :2].max(axis=0)) < 1e-9, axis=1)
    node = np.max(matrix, axis=1) > 1.0 - 1e-9
    area *= np.where(rim, np.where(node, 6.0 / times, 2.0), 1.0)
    y = matrix @ x
    i, j = np.triu_indices(len(y), 1)
    r = y[i] - y[j]
    distance = np.linalg.norm(r, axis=1)
    apart = np.linalg.norm(rest[i] - rest[j], axis=1)
    active = (distance < sigma) & (apart >= 2.0 * sigma)
    i, j, r, distance = i[active], j[active], r[active], distance[active]
    energy = area[i] * area[j] * ks * sigma**2 * np.exp(sigma / (distance - sigma))
    pull = energy * sigma / (distance - sigma) ** 2
    push = (pull / distance)[:, None] * r
    force = np.zeros_like(y)
    np.add.at(force, i, push)
    np.add.at(force, j, -push)
    return float(energy.sum()), matrix.T @ force
