"""Linear solvers for the symmetric tangent, behind one interface usable inside jit.

A solver is a set of options. `start` prepares a workspace for one pattern, `factor` renews it for
new values and counts the negative eigenvalues when it can (-1: not known), `solve` uses it on these
values or on others near them.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxcrumple.assembly.sparsity import Pattern


class Factor(NamedTuple):
    """A prepared matrix: its `values` (size,), a solver's own `workspace`, `negative` eigenvalues."""

    values: Array
    workspace: Any
    negative: Array


class Solution(NamedTuple):
    """`x` (3n,), `iterations` spent, and whether the matrix showed negative curvature."""

    x: Array
    iterations: Array
    indefinite: Array


class AbstractLinearSolver(eqx.Module):
    """Contract of a linear solver. `exact` says that one application of a factor solves its system,
    `one_matrix` that it needs the tangent in one matrix, contact included, whose structure the host makes."""

    exact: eqx.AbstractClassVar[bool]
    one_matrix: ClassVar[bool] = False

    @abc.abstractmethod
    def start(self, pattern: Pattern) -> Factor:
        """A workspace of the right structure, holding the identity."""

    @abc.abstractmethod
    def factor(self, pattern: Pattern, values: Array, previous: Factor) -> Factor:
        """Prepare new `values`."""

    @abc.abstractmethod
    def solve(
        self, pattern: Pattern, factor: Factor, values: Array | None, rhs: Array, rtol: Array | float
    ) -> Solution:
        """Solve A x = `rhs` (3n,), A being `values`, until the residual is `rtol` of it; the factor may
        be that of older values. None for the factor's own values."""

    def solve_factored(self, pattern: Pattern, factor: Factor, rhs: Array, rtol: Array | float) -> Array:
        """Solution (3n,) for the factor's own values, to `rtol` at least."""
        return self.solve(pattern, factor, None, rhs, rtol).x

    def solve_once(
        self, pattern: Pattern, start: Factor, values: Array, rhs: Array, rtol: Array | float
    ) -> Array:
        """Solution (3n,) for `values` that are prepared for it alone; `start` stays as it is."""
        return self.solve_factored(pattern, self.factor(pattern, values, start), rhs, rtol)

    def release(self, factor: Factor, after: Array) -> None:
        """Give back what the factor holds outside the arrays, once `after` is known."""


def identity_values(pattern: Pattern) -> Array:
    """Values of the identity matrix."""
    return jnp.zeros(pattern.size).at[pattern.diagonal].set(1.0)
