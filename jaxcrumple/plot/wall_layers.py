"""Trace rays to walls, which pictures show as translucent surfaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple._jax.tree import as_float
from jaxcrumple.model.walls import AbstractShape

# Points along each ray at which the gap is compared with that at the next one.
SAMPLES = 64
# Rays that are traced at once.
PART = 1 << 15
# Steps of Newton's method from there.
REFINED = 2
# Directions in which a camera looks for walls.
DIRECTIONS = 20_000
# Opacity of a wall that faces the camera, and what a grazing view adds to it; its colour in linear RGB.
FACING, GRAZING, SHARPNESS = 0.03, 0.45, 3.0
COLOR = (0.16, 0.27, 0.42)


class Layer(NamedTuple):
    """Hold a surface of a wall: distances (r,) in m along the rays, infinite where there is none, and its
    opacity (r,)."""

    distance: Float[np.ndarray, " rays"]
    opacity: Float[np.ndarray, " rays"]


def surface_points(
    walls: Sequence[AbstractShape], t: float, center: Float[np.ndarray, " 3"], radius: float
) -> Float[np.ndarray, "points 3"]:
    """Return points (m, 3) in m of the surfaces of `walls` at time `t` in s around the middle of a ball, of
    `radius` in m."""
    ways = _directions(DIRECTIONS)
    origins = np.broadcast_to(center, ways.shape)
    points = []
    for wall in walls:
        first, last = np.zeros(len(ways)), np.full(len(ways), radius)
        for distance in _crossed(wall, t, origins, ways, first, last)[0]:
            found = np.isfinite(distance)
            points.append(origins[found] + distance[found, None] * ways[found])
    return np.concatenate(points)


def wall_layers(
    walls: Sequence[AbstractShape],
    t: float,
    center: Float[np.ndarray, " 3"],
    radius: float,
    origins: Float[np.ndarray, "rays 3"],
    direction: Float[np.ndarray, " 3"],
) -> list[Layer]:
    """Return the surfaces of `walls` at time `t` in s along rays: the first and the last within a ball.

    **Arguments:** `center` (3,) and `radius` in m: of the ball; `origins` (r, 3) in m; `direction` (3,): unit
    vector of all rays.
    """
    offset = origins - center
    middle = -offset @ direction
    nearest = np.sum(offset**2, axis=1) - middle**2
    half = np.sqrt(np.maximum(radius**2 - nearest, 0.0))
    layers = []
    for wall in walls:
        ways = np.broadcast_to(direction, origins.shape)
        distances, facings = _crossed(wall, t, origins, ways, middle - half, middle + half)
        for distance, facing in zip(distances, facings, strict=True):
            opacity = FACING + GRAZING * np.maximum(1.0 - facing, 0.0) ** SHARPNESS
            layers.append(Layer(distance, np.where(np.isfinite(distance), opacity, 0.0)))
    return layers


def _crossed(
    wall: AbstractShape,
    t: float,
    origins: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    first: Float[np.ndarray, " rays"],
    last: Float[np.ndarray, " rays"],
) -> tuple[Float[np.ndarray, "2 rays"], Float[np.ndarray, "2 rays"]]:
    """Return what `_surfaces` returns, computed in parts of PART rays, so that one program serves all."""
    count, found = len(first), []
    for start in range(0, count, PART):
        # The last part repeats its last ray.
        own = np.minimum(np.arange(start, start + PART), count - 1)
        # In double precision, as the walls, whatever a notebook has set.
        with jax.enable_x64(True):
            rays = (as_float(values[own]) for values in (origins, directions, first, last))
            found.append(_surfaces(wall, as_float(t), *rays))
    distances, facings = (np.concatenate(parts, axis=1)[:, :count] for parts in zip(*found, strict=True))
    return distances, facings


_Rays = Float[Array, " rays"]
_Four = tuple[_Rays, _Rays, _Rays, _Rays]


@StoredJit
def _surfaces(
    wall: AbstractShape,
    t: Float[Array, ""],
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    first: Float[Array, " rays"],
    last: Float[Array, " rays"],
) -> tuple[Float[Array, "2 rays"], Float[Array, "2 rays"]]:
    """Return the distances in m from the `origins` of the first and last change of sign of the gap between
    distances `first` and `last`, infinite without one, and the cosines of the angles to the normal there."""

    def gap(distance: Float[Array, " rays"]) -> Float[Array, " rays"]:
        return jax.vmap(wall.gap, (0, None))(origins + distance[:, None] * directions, t)

    def at(share: Float[Array, ""]) -> Float[Array, " rays"]:
        return first + share * (last - first)

    def advance(carry: _Four, share: Float[Array, ""]) -> tuple[_Four, None]:
        entry, leave, before, start = carry
        end = at(share)
        after = gap(end)
        crosses = (before * after < 0) & (last > first)
        found = start + before / jnp.where(crosses, before - after, 1.0) * (end - start)
        entry = jnp.where(crosses & jnp.isinf(entry), found, entry)
        leave = jnp.where(crosses, found, leave)
        return (entry, leave, after, end), None

    none = jnp.full_like(first, jnp.inf)
    start = (none, none, gap(first), first)
    (entry, leave, _, _), _ = jax.lax.scan(advance, start, jnp.linspace(0.0, 1.0, SAMPLES)[1:])
    # A plane is crossed once.
    leave = jnp.where(leave > entry, leave, jnp.inf)
    spacing = (last - first) / SAMPLES
    for _ in range(REFINED):
        entry, leave = (_refined(gap, distance, spacing) for distance in (entry, leave))
    distances = jnp.stack([entry, leave])

    def facing(
        distance: Float[Array, ""], origin: Float[Array, " 3"], direction: Float[Array, " 3"]
    ) -> Float[Array, ""]:
        point = origin + jnp.where(jnp.isfinite(distance), distance, 0.0) * direction
        return jnp.abs(jax.grad(wall.gap)(point, t) @ direction)

    facings = jax.vmap(jax.vmap(facing), (0, None, None))(distances, origins, directions)
    return distances, facings


def _refined(gap: Callable[[_Rays], _Rays], distance: _Rays, most: _Rays) -> _Rays:
    """Return distances in m after a step of Newton's method to a zero of the `gap`; none above `most`."""
    value, slope = jax.jvp(gap, (jnp.where(jnp.isinf(distance), 0.0, distance),), (jnp.ones_like(distance),))
    step = value / jnp.where(slope == 0, 1.0, slope)
    return distance - jnp.where(jnp.abs(step) < most, step, 0.0)


def _directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Return `count` unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def over(
    image: Float[np.ndarray, "rays 4"], layer: Layer, shown: Bool[np.ndarray, " rays"]
) -> Float[np.ndarray, "rays 4"]:
    """Return an image (r, 4) behind the `shown` part of a layer: linear RGB times coverage, and coverage."""
    opacity = (shown * layer.opacity)[:, None]
    return image * (1.0 - opacity) + opacity * np.array([*COLOR, 1.0])
