"""Pair potentials of self-contact: the energy of two sites as a function of their distance.

All of them vanish with two derivatives at the contact range $\\sigma$. With the nearness $s = 1 - r/\\sigma$
of two sites at distance r, they differ in how they rise from there, and in whether they diverge.
"""

import abc
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Scalar
from jaxcrumple._jax.tree import as_float

Potential = Literal["penalty", "barrier", "inverse-power"]
# The one of a sheet whose options name none.
DEFAULT_POTENTIAL: Potential = "inverse-power"
# Factor $\kappa$ on the inverse-power law. Layers that are 0.54 or 0.88 ranges apart then press each other as
# with the penalty, and less in between.
STRENGTH = 0.3
# Sites closer than this share of the range at the start of a run give the force no reliable direction.
CLOSEST = 1e-6


class AbstractPairPotential(eqx.Module):
    """Define the energy of two sites.

    - `name`: how options name it.
    - `error_share`: largest local error of an implicit step in contact ranges. From a worse prediction
      Newton's iteration takes longer than two steps, or diverges.
    """

    name: eqx.AbstractClassVar[Potential]
    error_share: eqx.AbstractClassVar[float]

    @abc.abstractmethod
    def energy(
        self, distance: Float[Array, " *axes"] | float, stiffness: Scalar | float, range: Scalar | float
    ) -> Float[Array, " *axes"]:
        """Return the energy in J at `distance` in m, with $k_s$ in N/m and the contact range in m."""

    def closer(self, distance: Float[Array, " *axes"], share: float) -> Float[Array, " *axes"]:
        """Return `distance` in m, reduced to the `share` that motion may leave of it."""
        return share * distance

    def closest(self, range: Scalar) -> Scalar:
        """Return the distance in m that all sites must exceed at the start of a run."""
        return CLOSEST * range


class Penalty(AbstractPairPotential):
    """The paper's potential $k_s \\sigma^2 \\exp(\\sigma/(r - \\sigma))$.

    Its negative gradient is the force of eq. (26). It is finite at r = 0, so that it does not exclude
    penetration."""

    name: ClassVar[Potential] = "penalty"
    error_share: ClassVar[float] = 0.01

    def energy(
        self, distance: Float[Array, " *axes"] | float, stiffness: Scalar | float, range: Scalar | float
    ) -> Float[Array, " *axes"]:
        """Return the energy in J."""
        inside = distance < range
        gap = jnp.where(inside, range - distance, range)
        return jnp.where(inside, stiffness * range * range * jnp.exp(-range / gap), 0.0)


class Barrier(AbstractPairPotential):
    """The penalty with r and $\\sigma$ measured from a `core` $r_0$ in m, times $(\\sigma - r_0)/(r - r_0)$.

    It is infinite at $r_0$ and inside."""

    name: ClassVar[Potential] = "barrier"
    error_share: ClassVar[float] = 0.01
    core: Scalar = eqx.field(converter=as_float)

    def energy(
        self, distance: Float[Array, " *axes"] | float, stiffness: Scalar | float, range: Scalar | float
    ) -> Float[Array, " *axes"]:
        """Return the energy in J."""
        inside = distance < range
        gap = jnp.where(inside, range - distance, range)
        width, depth = range - self.core, jnp.where(distance > self.core, distance - self.core, 0.0)
        growth = jnp.where(depth > 0, width / jnp.where(depth > 0, depth, 1.0), jnp.inf)
        return jnp.where(inside, stiffness * range * range * jnp.exp(-width / gap) * growth, 0.0)

    def closer(self, distance: Float[Array, " *axes"], share: float) -> Float[Array, " *axes"]:
        """Return the reduced `distance` in m, at most halfway to the core."""
        return jnp.maximum(share * distance, 0.5 * (self.core + distance))

    def closest(self, range: Scalar) -> Scalar:
        """Return the core."""
        return self.core


class InversePower(AbstractPairPotential):
    """The potential $\\kappa k_s \\sigma^2 s^3/(3 (1 - s)^4)$ with the nearness $s = 1 - r/\\sigma$.

    It diverges where sites meet. Under light pressure its force grows e-fold over four hundredths of the
    range, and the penalty's over one, so that steps may be longer. $\\kappa$ is `STRENGTH`."""

    name: ClassVar[Potential] = "inverse-power"
    error_share: ClassVar[float] = 0.15

    def energy(
        self, distance: Float[Array, " *axes"] | float, stiffness: Scalar | float, range: Scalar | float
    ) -> Float[Array, " *axes"]:
        """Return the energy in J."""
        apart = jnp.minimum(distance / range, 1.0)
        nearness = 1.0 - apart
        law = nearness * nearness * nearness / (apart * apart * apart * apart)
        return STRENGTH / 3.0 * stiffness * range * range * law
