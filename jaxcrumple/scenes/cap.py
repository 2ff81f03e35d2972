"""Shallow spherical cap with a pinned rim that inverts under a dead load at its apex."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxcrumple._jax.door import door
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import disc
from jaxcrumple.model.loads import dead_load
from jaxcrumple.options.units import Metre
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.quantities import Damping, Duration, Length, Load, Sweeps
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.snap import check_positive, fixed, sheet_material


@door
def cap(
    nodes: int = 400,
    seed: int = 0,
    *,
    radius: Length = 0.025,
    rise: Length = 0.001,
    load: Load = 0.3,
    patch: Length = 0.01,
    offset: Metre = 0.25e-3,
    ramp: Duration = 0.03,
    sweeps: Sweeps = 100,
    plastic: bool = False,
    damping: Damping = "central",
    material: Material | None = None,
) -> Setup:
    """Build a disc whose stress-free shape is a spherical cap, with a pinned rim (fixed, but free to rotate).

    A cap as shallow as this one springs back if its rim is clamped. With a pinned rim the inverted cap is
    stable with and without the load. The load points down (-z). It has the profile of a paraboloid around the
    apex that is zero beyond the distance `patch`. It grows linearly during the time `ramp` and then stays
    constant. With the default values it passes the limit point near 0.195 N. The small `offset` of the load
    from the apex selects the direction in which the cap tilts during the snap.

    **Arguments:** `nodes`, `seed`, `sweeps`: number of nodes, seed and Lloyd sweeps of the random mesh;
    `radius` of the rim, `rise`, `patch` and `offset` (along x) in m; ``load`` in N; `ramp` in s; `plastic`:
    whether the sheet may yield; `damping`: "central" or "paper"; `material`: default `Material()`.

    **Raises:** ValueError for lengths, a load or a time that are not positive, a rise above the radius, or a
    load that reaches no free node.
    """
    check_positive(radius=radius, rise=rise, load=load, patch=patch, ramp=ramp)
    if not np.isfinite(offset):
        raise ValueError(f"offset = {offset!r} m must be finite.")
    if rise > radius:
        raise ValueError(f"rise = {rise} m is more than the radius {radius} m; choose a shallower cap.")
    flat = disc(radius, nodes, seed=seed, sweeps=sweeps)
    mesh = flat.with_rest_shape(on_sphere(flat.vertices[:, :2], radius, rise))
    rim = np.zeros(mesh.n_nodes, bool)
    rim[mesh.boundary_nodes] = True
    weight = mesh.node_area * np.where(rim, 0.0, paraboloid(flat.vertices[:, :2] - [offset, 0.0], patch))
    loaded = np.flatnonzero(weight)
    if not len(loaded):
        raise ValueError(
            f"patch = {patch} m around the offset {offset} m holds no free node; choose a larger patch, "
            "a smaller offset or more nodes."
        )
    push = np.outer(weight[loaded] / weight.sum(), [0.0, 0.0, -load])
    made_of = sheet_material(material, plastic)
    scene = sheet(
        mesh,
        made_of,
        prescribed=fixed(rim, mesh.vertices),
        extra=[dead_load(loaded, push, ramp)],
        damping=damping,
    )
    return Setup(mesh, scene, jnp.asarray(mesh.vertices), material=made_of)


def on_sphere(
    points: Float[np.ndarray, "nodes 2"], radius: float, rise: float
) -> Float[np.ndarray, "nodes 3"]:
    """Lift `points` (n, 2) in m to the sphere through the circle of `radius` and the apex: points (n, 3)."""
    sphere = (radius**2 + rise**2) / (2 * rise)
    height = np.sqrt(sphere**2 - np.sum(points**2, axis=1)) - (sphere - rise)
    return np.column_stack([points, height])


def paraboloid(points: Float[np.ndarray, "nodes 2"], patch: float) -> Float[np.ndarray, " nodes"]:
    """Return the profile (n,) of a paraboloid at points (n, 2): 1 at the origin, 0 beyond `patch`."""
    return np.maximum(1.0 - np.sum(points**2, axis=1) / patch**2, 0.0)
