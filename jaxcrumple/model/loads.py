"""Loads and supports: gravity, prescribed motion, and energies of the user's own."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxcrumple.model.fields import as_float
from jaxcrumple.model.stencil import upper_pairs

# Share of a time of release by which the end of a step may miss it.
ROUNDING = 1e-12


class Gravity(eqx.Module):
    """Uniform acceleration `g` (3,) in m/s2 acting on the nodal masses `mass` (n,) in kg."""

    g: Array = eqx.field(converter=as_float)
    mass: Array = eqx.field(converter=as_float)

    def energy(self, x: Array) -> Array:
        """Potential energy in J, zero at the origin."""
        return -jnp.sum(self.mass[:, None] * self.g * x)

    def force(self) -> Array:
        """Nodal forces (n, 3) in N."""
        return self.mass[:, None] * self.g


class AbstractMotion(eqx.Module):
    """Positions of the nodes as a smooth function of time."""

    @abc.abstractmethod
    def __call__(self, t: Array) -> Array:
        """Positions (n, 3) in m at time `t`; only prescribed components are used."""


class LinearMotion(AbstractMotion):
    """Uniform motion: `position` (n, 3) in m at t = 0 and `velocity` (n, 3) or (3,) in m/s."""

    position: Array = eqx.field(converter=as_float)
    velocity: Array = eqx.field(converter=as_float)

    def __call__(self, t: Array) -> Array:
        """Positions at time `t`."""
        return self.position + self.velocity * t


class Prescribed(eqx.Module):
    """Node components that follow a given motion (fixed nodes: zero velocity), for good or for some time.

    **Arguments:** `mask` (n, 3) bool, True where prescribed; `motion` an `AbstractMotion`; `until`: time in
    s of the release, after which all are free, or (n, 1) times of each node. Make them frame times, so that a
    step ends there.
    """

    mask: Array
    motion: AbstractMotion
    until: Array = eqx.field(default=jnp.inf, converter=as_float)

    def held(self, t: Array) -> Array:
        """Components (n, 3) that are prescribed at time `t`; rounding does not release them."""
        return self.mask & (t <= (1.0 + ROUNDING) * self.until)

    def position(self, x: Array, t: Array) -> Array:
        """`x` (n, 3) with the prescribed components put in place."""
        return jnp.where(self.held(t), self.motion(t), x)

    def velocity(self, v: Array, t: Array) -> Array:
        """`v` (n, 3) with the prescribed components' velocities."""
        return jnp.where(self.held(t), _derivative(self.motion, t), v)

    def acceleration(self, a: Array, t: Array) -> Array:
        """`a` (n, 3) with the prescribed components' accelerations."""
        return jnp.where(self.held(t), _derivative(lambda s: _derivative(self.motion, s), t), a)

    def free(self, residual: Array, t: Array) -> Array:
        """`residual` (n, 3) with the entries of components prescribed at time `t` set to zero."""
        return jnp.where(self.held(t), 0.0, residual)


def _derivative(function: Callable[[Array], Array], t: Array) -> Array:
    return jax.jvp(function, (t,), (jnp.ones_like(t),))[1]


class ElementEnergy(eqx.Module):
    """An energy of your own, element by element; forces and tangent follow by autodiff.

    **Arguments:**

    - `nodes`: (m, k) node numbers of the m elements.
    - `function`: `function(x, parameters, t)` -> energy in J of one element, with `x` (k, 3) in m.
    - `parameters`: any pytree of arrays with leading axis m, sliced for each element (or None).
    """

    nodes: Array
    function: Callable[[Array, Any, Array], Array] = eqx.field(static=True)
    parameters: Any = None

    def _map(self, transform: Callable, x: Array, t: Array) -> Array:
        return jax.vmap(transform(self.function), (0, 0, None))(x[self.nodes], self.parameters, t)

    def energy(self, x: Array, t: Array) -> Array:
        """Energy in J at positions `x` (n, 3) and time `t`."""
        return jnp.sum(self._map(lambda f: f, x, t))

    def force(self, x: Array, t: Array) -> Array:
        """Nodal forces (n, 3) in N."""
        return jnp.zeros_like(x).at[self.nodes].add(-self._map(jax.grad, x, t))

    def blocks(self, x: Array, t: Array) -> Array:
        """Element Hessians (pairs, 3, 3, m) in N/m, blocks ordered as `upper_pairs(k)`."""
        hessian = self._map(jax.hessian, x, t)
        pairs = upper_pairs(self.nodes.shape[1])
        return jnp.stack([jnp.moveaxis(hessian[:, a, :, b, :], 0, -1) for a, b in pairs])


def dead_load(nodes: ArrayLike, force: ArrayLike, ramp: float) -> ElementEnergy:
    """Forces of fixed direction that grow linearly from zero at t = 0 and stay from t = `ramp` s on.

    **Arguments:** `nodes` (m,) node numbers; `force` (m, 3) their final forces in N; `ramp` > 0.

    **Returns:** the load as an energy, $-\\sum f(t) \\cdot x$, zero for nodes at the origin.
    """
    numbers = jnp.asarray(nodes)
    parameters = (as_float(force), jnp.full(numbers.shape, float(ramp)))
    return ElementEnergy(numbers[:, None], _dead_energy, parameters)


def _dead_energy(x: Array, parameters: tuple[Array, Array], t: Array) -> Array:
    force, ramp = parameters
    return -jnp.clip(t / ramp, 0.0, 1.0) * (force @ x[0])
