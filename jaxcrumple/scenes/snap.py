"""Helpers of the snap-through scenes: supports, material, and the energy that a snap releases."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxcrumple._jax.arrays import ScalarLike
from jaxcrumple._jax.door import door
from jaxcrumple.material.material import Material
from jaxcrumple.model.loads import LinearMotion, Prescribed
from jaxcrumple.scene import Scene
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.solvers.contact.reallocate import with_contacts
from jaxcrumple.solvers.relax import Relaxed, relax
from jaxcrumple.state import State, check_state, initial_state
from jaxcrumple.system import energies

_energies = eqx.filter_jit(energies)

# Distance, in units of sqrt(A), below which two equilibria count as the same.
SAME = 1e-4


class Drop(NamedTuple):
    """Two equilibria under the same load, and the drop of energy in J from the first to the second.

    `before`, `after`: results of `relax` on both sides of the snap. `elastic`: drop of stretching and bending
    energy; it may be negative, since the load does work during the snap. `potential`: drop of the total
    potential energy, load and walls included; the snap converts it to motion and heat.
    """

    before: Relaxed
    after: Relaxed
    elastic: float
    potential: float


@door
def energy_drop(scene: Scene, before: State, after: State, *, force_tolerance: float | None = None) -> Drop:
    """Relax two states under the load of `before` and return the drop of energy between them.

    The result depends only on the two branches of equilibria and on `before.t`. The states may be frames of a
    time integration before and after the snap, or those of `relaxed_drop`.

    **Arguments:** `before`: a state shortly before the snap, earlier than the limit point; `after`: any later
    state beyond the snap; `force_tolerance`: as in `relax`.

    **Raises:** ValueError if a relaxation does not converge, or if both states relax to the same equilibrium.
    """
    check_state(scene, before)
    check_state(scene, after)
    first = _rest(scene, before, before.t, force_tolerance)
    second = _rest(scene, after, before.t, force_tolerance)
    if float(jnp.max(jnp.abs(first.state.x - second.state.x))) < SAME * float(scene.length_scale):
        raise ValueError(
            f"both states come to rest in the same equilibrium at t = {float(before.t):.4g} s; give a state "
            "before the snap and one beyond it, and a load between the two limit points."
        )
    one, two = (_stored(scene, rest.state) for rest in (first, second))
    return Drop(first, second, one[0] - two[0], one[1] - two[1])


@door
def relaxed_drop(
    setup: Setup, before: float, after: float, *, steps: int = 20, force_tolerance: float | None = None
) -> Drop:
    """Return the `energy_drop` of a scene, by relaxation without time integration.

    **Arguments:** `setup`: of `arch` or `cap`, or another; `before`: time in s of a load below the limit
    point; the function follows the first branch to it from rest in `steps` equal increments, each relaxed;
    `after`: time in s of a load beyond the limit point, where the sheet relaxes to the inverted shape;
    `steps`: number of increments; `force_tolerance`: as in `relax`.

    **Raises:** ValueError for an object that is not a Setup, and as `energy_drop`.
    """
    if not isinstance(setup, Setup):
        raise ValueError(
            f"setup has type {type(setup).__name__}; it must be a Setup, as jaxcrumple.arch returns."
        )
    scene = setup.scene
    state = initial_state(scene, setup.x)
    for t in np.linspace(0.0, before, steps + 1)[1:]:
        state = _rest(scene, state, t, force_tolerance).state
    beyond = _rest(scene, state, after, force_tolerance).state
    return energy_drop(scene, state, beyond, force_tolerance=force_tolerance)


def _rest(scene: Scene, state: State, t: ScalarLike, force_tolerance: float | None) -> Relaxed:
    rest = relax(scene, state, t=t, force_tolerance=force_tolerance)
    if not rest.converged:
        raise ValueError(
            f"no equilibrium found at t = {float(rest.state.t):.4g} s: the largest force is "
            f"{float(rest.max_force):.2g} N after {int(rest.iterations)} iterations ({rest.reason}); choose "
            "a time away from the limit point."
        )
    return rest


def _stored(scene: Scene, state: State) -> tuple[float, float]:
    """Return elastic energy and potential energy in J."""
    parts = _energies(with_contacts(scene, state.x), state.x, state.v, state.p, state.t)
    return float(parts.stretch + parts.bending), float(sum(parts[:-1], jnp.zeros(())))


def fixed(where: Bool[np.ndarray, " nodes"], x: Float[np.ndarray, "nodes 3"]) -> Prescribed:
    """Fix the nodes with mask `where` (n,) at their positions `x` (n, 3) in m."""
    mask = jnp.asarray(np.repeat(where[:, None], 3, axis=1))
    return Prescribed(mask, LinearMotion(jnp.asarray(x), jnp.zeros(3)))


def sheet_material(material: Material | None, plastic: bool) -> Material:
    """Return `material`, default `Material()`, without yield unless `plastic`."""
    material = material or Material()
    return material if plastic else replace(material, yield_curvature=None, yield_c0=None)


def check_positive(**values: float) -> None:
    """Refuse values that are not finite and positive; the message names the first."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value!r} must be a positive number in SI units.")


def check_gap(gap: float, thickness: float, most: float = np.inf, where: str = "") -> None:
    """Refuse a gap in m of at most two thicknesses or at least `most` in m; `where` names that limit."""
    if not 2.0 * thickness < gap < most:
        other = f", and less than {where}, {most:.3g} m" if where else ""
        raise ValueError(
            f"gap = {gap} m must be more than twice the thickness, {2.0 * thickness:.3g} m{other}."
        )
