"""The paper's contact potential between two refined sites (Section 2.5)."""

import jax.numpy as jnp
from jax import Array


def pair_energy(distance: Array, stiffness: Array, sigma: Array) -> Array:
    """Energy of two sites in J: $k_s \\sigma^2 \\exp(\\sigma/(r - \\sigma))$ for $r < \\sigma$, else 0.

    Its negative gradient is the force of eq. (26). Finite at $r = 0$: it repels but does not forbid.
    """
    inside = distance < sigma
    gap = jnp.where(inside, sigma - distance, sigma)
    return jnp.where(inside, stiffness * sigma * sigma * jnp.exp(-sigma / gap), 0.0)
