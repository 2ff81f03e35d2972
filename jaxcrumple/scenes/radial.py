"""Radial confinement: a square sheet inside a shrinking sphere (Figs. 5, 6, 8)."""

import jax.numpy as jnp
import numpy as np

from jaxcrumple.material import Material
from jaxcrumple.meshgen import rectangle
from jaxcrumple.model.confinement import Ramp, Sphere
from jaxcrumple.model.contact import Potential, SelfContact
from jaxcrumple.model.fields import as_float
from jaxcrumple.model.scene import sheet
from jaxcrumple.scenes.setup import Setup

# Shortest wavelength of the initial imperfection in m, and how many modes each way it has at most.
IMPERFECTION_WAVELENGTH = 0.02


def radial(
    nodes: int = 1000,
    seed: int = 0,
    *,
    size: float = 0.1,
    radius: float = 0.071,
    speed: float = 0.01,
    hold: float | None = None,
    imperfection: float = 25e-6,
    sweeps: int = 100,
    damping: str = "central",
    contact: Potential | None = "penalty",
    contact_range: float | None = None,
    contact_level: int | None = None,
    material: Material | None = None,
) -> Setup:
    """A square sheet of edge `size` in a sphere that shrinks at `speed`.

    **Arguments:** `nodes` of the random mesh made with `seed` and `sweeps` Lloyd sweeps; `size`,
    `radius` in m; `speed` in m/s; `hold`: time in s from which the sphere keeps its radius;
    `imperfection`: largest height in m of a smooth, stress-free initial shape; `damping`: "central" or
    "paper"; `contact`: "penalty", "barrier", or None for a phantom sheet, which passes through itself, with
    `contact_range` and `contact_level` as in `SelfContact`; `material`: default `Material()`.
    """
    until = np.inf if hold is None else hold
    for name, value in (("size", size), ("radius", radius), ("speed", speed)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value!r} must be a positive length (m) or speed (m/s).")
    if hold is not None and not 0 < hold * speed < radius:
        raise ValueError(
            f"hold = {hold!r} s must be a time between 0 and {radius / speed:g} s, when the sphere has "
            "shrunk to nothing."
        )
    if not (np.isfinite(imperfection) and imperfection >= 0):
        raise ValueError(f"imperfection = {imperfection!r} m must be zero or positive.")
    if radius < size / np.sqrt(2.0):
        raise ValueError(
            f"radius = {radius} m leaves the corners of a sheet of size {size} m outside; "
            f"choose at least {size / np.sqrt(2.0):.4g} m."
        )
    flat = rectangle(size, size, nodes, seed=seed, sweeps=sweeps)
    height = smooth_imperfection(flat.vertices[:, :2], size, imperfection, seed)
    mesh = flat.with_rest_shape(flat.vertices + height[:, None] * np.array([0.0, 0.0, 1.0]))
    wall = Sphere(jnp.zeros(3), Ramp(as_float(radius), as_float(-speed), as_float(until)))
    touching = None if contact is None else SelfContact(contact, contact_range, contact_level)
    material = material or Material()
    scene = sheet(mesh, material, walls=[wall], damping=damping, contact=touching)
    return Setup(mesh, scene, jnp.asarray(mesh.vertices), touching, material)


def smooth_imperfection(points: np.ndarray, size: float, amplitude: float, seed: int) -> np.ndarray:
    """Random height (n,) of the `points` (n, 2): modes no shorter than 2 cm, largest value `amplitude`."""
    rng = np.random.default_rng([seed, 1])
    highest = max(int(2.0 * size / IMPERFECTION_WAVELENGTH), 1)
    waves = np.arange(1, highest + 1)
    x, y = (np.cos(np.pi * np.outer(points[:, i] / size + 0.5, waves)) for i in range(2))
    weights = rng.normal(size=(highest, highest))
    weights[np.hypot(*np.meshgrid(waves, waves)) > highest] = 0.0
    height = np.einsum("ni,ij,nj->n", x, weights, y)
    return amplitude * height / max(np.max(np.abs(height)), np.finfo(float).tiny)
