"""Sheets bent into shapes whose measures are known."""

import numpy as np
from scipy.spatial import ConvexHull

from jaxcrumple.mesh.mesh import Mesh

RADIUS = 0.03


def rolled(mesh, angle=0.0, radius=RADIUS):
    """The sheet on a cylinder, outside up, its axis turned by `angle`."""
    c, s = np.cos(angle), np.sin(angle)
    u, w = (mesh.vertices[:, :2] @ np.array([[c, -s], [s, c]])).T
    return np.column_stack([radius * np.sin(u / radius), w, radius * np.cos(u / radius)])


def single_hinge(angle):
    """Two equilateral triangles of edge 1 over the x axis, bent by `angle`, convex seen from above."""
    h = np.sqrt(3) / 2
    flat = np.array([[0, 0, 0], [1, 0, 0], [0.5, h, 0], [0.5, -h, 0]])
    mesh = Mesh.from_arrays(flat, [[0, 1, 2], [1, 0, 3]], reorder=False)
    x = flat.copy()
    x[3] = [0.5, -h * np.cos(angle), -h * np.sin(angle)]
    return mesh, x


def icosphere(levels):
    """An icosahedron whose edges are halved `levels` times, on a sphere."""
    golden = (1 + np.sqrt(5)) / 2
    signs = np.array([[a, b * golden, 0] for a in (-1, 1) for b in (-1, 1)])
    x = np.concatenate([np.roll(signs, k, axis=1) for k in range(3)])
    for _ in range(levels):
        edges = Mesh.from_arrays(x, ConvexHull(x).simplices, reorder=False).edges
        x = np.concatenate([x, x[edges].mean(axis=1)])
        x /= np.linalg.norm(x, axis=1, keepdims=True)
    return Mesh.from_arrays(RADIUS * x, ConvexHull(x).simplices, reorder=True)
