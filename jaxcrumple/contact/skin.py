"""How far the skin of each neighbour list reaches: one policy per list."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from jaxcrumple._jax.arrays import NodeValues, Scalar
from jaxcrumple.contact.parameters import Contact


class SkinPolicy(NamedTuple):
    """Describe the skin of a new list, so that it stays valid for several steps.

    - `floor` in contact ranges: skin of a sheet at rest.
    - `steps`: steps like the next one that the skin covers beyond that, unless a node then moves further than
      `cap` in contact ranges; `min_steps` are always covered.
    """

    floor: float
    steps: float
    min_steps: float
    cap: float

    def skin(
        self, contact: Contact, moved: NodeValues, margin: NodeValues | Scalar | float = 0.0
    ) -> NodeValues:
        """Return the skin (n,) in m before steps that move nodes by `moved` (n,) in m.

        `margin` in m is added to the floor. Up to `Contact.calm` the skin costs nothing: a flat sheet then
        has no pairs.
        """
        least = self.floor * contact.range + margin
        most = jnp.maximum(least + self.cap * contact.range, contact.calm)
        return jnp.minimum(least + self.steps * moved, jnp.maximum(least + self.min_steps * moved, most))

    def steps_ahead(self, contact: Contact, moved: NodeValues) -> Scalar:
        """Return for how many steps that move nodes by `moved` (n,) in m no node exceeds the cap."""
        allowed = self.cap * contact.range / jnp.maximum(jnp.max(moved), 1e-300)
        return jnp.clip(allowed, self.min_steps, self.steps)


# A search for candidates takes as long as several steps, and a list with twice the skin twice as long.
CANDIDATES = SkinPolicy(floor=0.35, steps=16.0, min_steps=3.0, cap=2.0)
# A list of site pairs is built in the time of one or two implicit steps, but each of its pairs is tested in
# every evaluation.
PAIRS = SkinPolicy(floor=0.05, steps=4.0, min_steps=1.0, cap=0.25)
# An active set costs as much as an explicit step.
ACTIVE = SkinPolicy(floor=0.02, steps=16.0, min_steps=16.0, cap=math.inf)
# The host builds the structure of the matrix, and the solver analyses it again. Entries without a contact are
# zeros that the factorisation carries along: beyond `Contact.calm`, only two steps are worth them.
MATRIX = SkinPolicy(floor=0.75, steps=32.0, min_steps=2.0, cap=0.0)
