"""What the snap-through scenes share: supports, material, and the energy that a snap sets free."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

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

# Equilibria this close, in units of sqrt(A), are one and the same.
SAME = 1e-4


class Drop(NamedTuple):
    """Two equilibria under one load, and what the second stores less than the first, in J.

    `before`, `after`: outcome of `relax` on either side of the snap. `elastic`: drop of stretching and
    bending energy. `potential`: drop of that and the energy of load and walls together, which is what
    the snap turns into motion and heat. `elastic` may be negative: the load works during the snap.
    """

    before: Relaxed
    after: Relaxed
    elastic: float
    potential: float


@door
def energy_drop(scene: Scene, before: State, after: State, *, force_tolerance: float | None = None) -> Drop:
    """Drop of relaxed energy between two states, both brought to rest under the load that `before` bears.

    The result depends on the two branches of equilibria and on `before.t` alone, not on how the states
    came about: an integrator's frames before and after its snap serve as well as `relaxed_drop`'s.

    **Arguments:** `before`: a state shortly before the snap, its time below that of the limit point;
    `after`: any later state beyond the snap; `force_tolerance`: as in `relax`.

    **Raises:** ValueError when an equilibrium is not found, or both states come to rest in the same one.
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
    """`energy_drop` of a scene without any integrator.

    **Arguments:** `before`: time in s whose load the first branch still bears; it is followed from rest
    to there in `steps` equal loads, each relaxed; `after`: time in s whose load is beyond the limit
    point, where relaxation leads to the inverted side.
    """
    if not isinstance(setup, Setup):
        raise ValueError(
            f"setup has type {type(setup).__name__}; it must be a Setup, as jaxcrumple.arch makes."
        )
    scene = setup.scene
    state = initial_state(scene, setup.x)
    for t in np.linspace(0.0, before, steps + 1)[1:]:
        state = _rest(scene, state, t, force_tolerance).state
    beyond = _rest(scene, state, after, force_tolerance).state
    return energy_drop(scene, state, beyond, force_tolerance=force_tolerance)


def _rest(scene: Scene, state: State, t: ArrayLike, force_tolerance: float | None) -> Relaxed:
    t = jnp.asarray(t, float)
    x = state.x if scene.prescribed is None else scene.prescribed.position(state.x, t)
    moved = eqx.tree_at(lambda s: (s.t, s.x), state, (t, x))
    rest = relax(scene, moved, force_tolerance=force_tolerance)
    if not rest.converged:
        raise ValueError(
            f"no equilibrium found at t = {float(t):.4g} s: {float(rest.max_force):.2g} N are left on a node "
            f"after {int(rest.iterations)} iterations ({rest.reason}); choose a time away from the "
            "limit point."
        )
    return rest


def _stored(scene: Scene, state: State) -> tuple[float, float]:
    """Elastic energy and potential energy in J."""
    parts = _energies(with_contacts(scene, state.x), state.x, state.v, state.p, state.t)
    return float(parts.stretch + parts.bending), float(sum(parts[:-1], jnp.zeros(())))


def fixed(where: np.ndarray, x: np.ndarray) -> Prescribed:
    """The nodes `where` (n,) bool held at their positions `x` (n, 3) in m."""
    mask = jnp.asarray(np.repeat(where[:, None], 3, axis=1))
    return Prescribed(mask, LinearMotion(jnp.asarray(x), jnp.zeros(3)))


def sheet_material(material: Material | None, plastic: bool) -> Material:
    """`material`, by default `Material()`; elastic unless `plastic`."""
    material = material or Material()
    return material if plastic else replace(material, yield_curvature=None, yield_c0=None)


def check_positive(**values: float) -> None:
    """Refuse values that are not finite and positive; the message names the first."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value!r} must be a positive number in SI units.")


def check_gap(gap: float, thickness: float, most: float = np.inf, where: str = "") -> None:
    """Refuse a gap in m that two layers of a sheet fill, or that is `most` m or more, which is a depth
    `where` describes."""
    if not 2.0 * thickness < gap < most:
        other = f", and less than {where}, {most:.3g} m" if where else ""
        raise ValueError(
            f"gap = {gap} m must be more than twice the thickness, {2.0 * thickness:.3g} m{other}."
        )
