"""Draw a sheet by ray casting on the CPU, with hidden surfaces, soft shadows and ambient occlusion.

It needs neither a display nor a graphics library; Embree finds where rays meet triangles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int

from jaxcrumple.plot.camera import Camera
from jaxcrumple.plot.light import LAMP
from jaxcrumple.plot.normals import corner_normals, face_normals
from jaxcrumple.plot.wall_layers import Layer, over

# Rays through each pixel are RAYS * RAYS. From each hit go OCCLUSION more to the sky, and SHADOW to the lamp.
RAYS, OCCLUSION, SHADOW = 2, 7, 3
# Radius of the disc of the lamp, as seen from the sheet, in its distance.
LAMP_RADIUS = 0.12
# Light of the surroundings and of the lamp on a surface that faces it.
AMBIENT, DIRECT = 0.62, 0.5
# Reach of ambient occlusion and offset of secondary rays, as shares of the size of the sheet.
REACH, OFFSET = 0.35, 2e-5
# The back of the sheet keeps this share of the light, and tends towards BACK (linear RGB) by TINT.
BACK_LIGHT, BACK, TINT = 0.72, (0.42, 0.5, 0.62), 0.25

Image = Float[np.ndarray, "rows columns 4"]
Rays = Float[np.ndarray, "rays 3"]
Colors = Float[np.ndarray, "hits 3"]


class Hits(NamedTuple):
    """Hold where rays meet the sheet.

    `rays`: indices of the rays that do; `distances` in m along them; `faces`: triangles; `shares` (hits, 3):
    barycentric coordinates; `points` (hits, 3) in m; `normals` (hits, 3): of smooth shading, towards the
    camera; `flat` (hits, 3): of the triangles, towards the camera; `back`: whether the ray meets the side
    opposite to the face normals.
    """

    rays: Int[np.ndarray, " hits"]
    distances: Float[np.ndarray, " hits"]
    faces: Int[np.ndarray, " hits"]
    shares: Float[np.ndarray, "hits 3"]
    points: Float[np.ndarray, "hits 3"]
    normals: Float[np.ndarray, "hits 3"]
    flat: Float[np.ndarray, "hits 3"]
    back: Bool[np.ndarray, " hits"]


class Caster:
    """Cast rays at a sheet.

    **Arguments:** `faces` (f, 3), `x` (n, 3): triangles and positions in m; `camera`: positions are taken
    relative to its centre, so that single precision suffices.
    """

    def __init__(
        self, faces: Int[np.ndarray, "faces 3"], x: Float[np.ndarray, "nodes 3"], camera: Camera
    ) -> None:
        self.x = (x - camera.center).astype(np.float32)
        self.faces = faces
        self.size = float(np.linalg.norm(np.ptp(x, axis=0)))
        self.camera = camera
        self._corners = corner_normals(faces, x).astype(np.float32)
        self._flat = face_normals(faces, x).astype(np.float32)
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, self.x, faces.astype(np.int32))

    def hits(self, origins: Rays) -> Hits:
        """Return where rays from `origins` (r, 3) in m along the view first meet the sheet."""
        ahead = np.broadcast_to(-self.camera.axes[2], origins.shape).astype(np.float32)
        found = self._scene.run(origins.astype(np.float32), ahead, output=1)
        rays = np.flatnonzero(found["geomID"] >= 0)
        faces, u, v = (found[name][rays] for name in ("primID", "u", "v"))
        shares = np.stack([1.0 - u - v, u, v], axis=1)
        points = _mixed(shares, self.x[self.faces[faces]])
        smooth = _mixed(shares, self._corners[faces])
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), np.finfo(np.float32).tiny)
        flat = self._flat[faces]
        back = flat @ self.camera.axes[2] < 0
        turn = np.where(back, np.float32(-1.0), np.float32(1.0))[:, None]
        return Hits(rays, found["tfar"][rays], faces, shares, points, turn * smooth, turn * flat, back)

    def distances(self, points: Rays, directions: Rays) -> Float[np.ndarray, " rays"]:
        """Return the distances in m at which rays from `points` (r, 3) meet the sheet along the unit vectors
        `directions` (r, 3); huge where they do not."""
        return self._scene.run(points.astype(np.float32), directions.astype(np.float32), query="DISTANCE")


def cast(
    caster: Caster,
    color: Callable[[Hits], Colors],
    pixels: int,
    *,
    layers: Sequence[Layer] = (),
    seed: int = 0,
) -> Image:
    """Draw the sheet; return an image (rows, columns, 4) of linear RGB times coverage, and coverage.

    **Arguments:** `color`: returns the colours (hits, 3) of hits in linear RGB; `pixels`: number of pixels of
    the longer side; `layers`: of walls, along the rays through the middles of the pixels; `seed`: of the
    random directions to the lamp and the sky.
    """
    shape = caster.camera.shape(pixels)
    rng = np.random.default_rng(seed)
    turn = (2.0 * np.pi * rng.random(shape[0] * shape[1])).astype(np.float32)
    image = np.zeros((shape[0] * shape[1], 4))
    sky, lamp = _spread(RAYS**2 * OCCLUSION), _spread(RAYS**2 * SHADOW)
    for k in range(RAYS**2):
        shift = (np.array([k % RAYS, k // RAYS]) + rng.random((*shape, 2))) / RAYS
        origins = caster.camera.origins(shape, shift)
        hits = caster.hits(origins)
        # Slightly above the surface, from where rays do not meet it again.
        above, rotation = hits.points + np.float32(OFFSET * caster.size) * hits.flat, turn[hits.rays]
        light = _ambient(caster, hits, above, sky[k :: RAYS**2], rotation)
        for place in lamp[k :: RAYS**2]:
            light += _lamp(caster, hits, above, place, rotation) / SHADOW
        seen = np.zeros_like(image)
        seen[hits.rays, :3] = _sided(color(hits), hits.back) * light[:, None]
        seen[hits.rays, 3] = 1.0
        depth = np.full(len(origins), np.inf)
        depth[hits.rays] = hits.distances
        for layer in layers:
            seen = over(seen, layer, layer.distance < depth)
        image += seen
    return image.reshape(*shape, 4) / RAYS**2


def _mixed(shares: Rays, corners: Float[np.ndarray, "rays 3 3"]) -> Rays:
    """Return the values at points with barycentric coordinates `shares` from those at the corners."""
    return np.einsum("hc,hci->hi", shares, corners)


def _sided(
    color: Float[np.ndarray, "hits 3"], back: Bool[np.ndarray, " hits"]
) -> Float[np.ndarray, "hits 3"]:
    """Return the colours as they appear on the side of each hit."""
    behind = BACK_LIGHT * ((1.0 - TINT) * color + TINT * np.array(BACK))
    return np.where(back[:, None], behind, color)


def _ambient(
    caster: Caster,
    hits: Hits,
    points: Rays,
    sky: Float[np.ndarray, "directions 2"],
    turn: Float[np.ndarray, " hits"],
) -> Float[np.ndarray, " hits"]:
    """Return the light of the surroundings that the sheet does not block.

    `points` (hits, 3) in m: starts of the rays; `sky` (d, 2): directions as points of the unit square; `turn`
    (hits,) in rad: rotation of all directions of a hit around its normal.
    """
    normals, reach = hits.normals, REACH * caster.size
    first, second = _tangents(normals, turn)
    light = np.zeros(len(hits.rays), np.float32)
    for square, angle in sky:
        # The density is proportional to the cosine.
        flat, steep = np.sqrt(square), np.sqrt(1.0 - square)
        across = flat * np.cos(2.0 * np.pi * angle), flat * np.sin(2.0 * np.pi * angle)
        directions = np.float32(across[0]) * first + np.float32(across[1]) * second
        directions += np.float32(steep) * normals
        # Below the triangle itself there is no light.
        above = np.einsum("hi,hi->h", directions, hits.flat) > 0
        light += np.where(above, np.minimum(caster.distances(points, directions), reach) / reach, 0.0)
    return AMBIENT * light / len(sky)


def _lamp(
    caster: Caster,
    hits: Hits,
    points: Rays,
    place: Float[np.ndarray, " 2"],
    turn: Float[np.ndarray, " hits"],
) -> Float[np.ndarray, " hits"]:
    """Return the light of the lamp, a disc far away, that reaches the hits.

    `points` (hits, 3) in m: starts of the rays; `place` (2,): point of the disc as a point of the unit
    square; `turn` (hits,) in rad: rotation of it.
    """
    axis = np.array(LAMP) @ caster.camera.axes
    axis = axis / np.linalg.norm(axis)
    right = np.cross(axis, caster.camera.axes[2])
    right /= np.linalg.norm(right)
    radius, angle = LAMP_RADIUS * np.sqrt(place[0]), turn + 2.0 * np.pi * place[1]
    plane = np.cos(angle)[:, None] * right + np.sin(angle)[:, None] * np.cross(axis, right)
    directions = ((axis + radius * plane) / np.sqrt(1.0 + radius**2)).astype(np.float32)
    slope = np.einsum("hi,hi->h", directions, hits.normals)
    facing = (slope > 0) & (np.einsum("hi,hi->h", directions, hits.flat) > 0)
    free = caster.distances(points, directions) > 10.0 * caster.size
    return DIRECT * np.where(facing & free, slope, 0.0)


def _tangents(normals: Rays, turn: Float[np.ndarray, " rays"]) -> tuple[Rays, Rays]:
    """Return two unit vectors perpendicular to each of the `normals` and to each other, rotated by `turn`."""
    least = np.eye(3, dtype=np.float32)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(normals, least)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    second = np.cross(normals, first)
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return cos * first + sin * second, cos * second - sin * first


def _spread(count: int) -> Float[np.ndarray, "count 2"]:
    """Return `count` evenly spread points of the unit square (the R2 sequence of Roberts 2018)."""
    golden = 1.32471795724474602596
    return (0.5 + np.arange(count)[:, None] * np.array([1.0 / golden, 1.0 / golden**2])) % 1.0
