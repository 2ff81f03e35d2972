"""Linear solvers for the symmetric tangent, behind one interface usable inside jit.

A solver is a set of options. `start` prepares a workspace for one pattern. `factor` updates it for new
values, and counts their negative eigenvalues if it can (-1: unknown). `solve` uses it for these values, or
for values close to them.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from jaxcrumple._jax.arrays import Count, Flag, Scalar
from jaxcrumple.assembly.sparsity import Pattern


class Factor(NamedTuple):
    """Hold a factored matrix: its `values` as the solver keeps them, the solver's `workspace`, and the number
    of `negative` eigenvalues."""

    values: Float[Array, " entries"]
    workspace: Any
    negative: Count


class LinearSolution(NamedTuple):
    """Hold the solution `x` (3n,), the `iterations`, and whether the matrix was found `indefinite`."""

    x: Float[Array, " unknowns"]
    iterations: Count
    indefinite: Flag


class AbstractLinearSolver(eqx.Module):
    """Define the interface of a linear solver: subclass it with `start`, `factor` and `solve`.

    A pattern, `Scene.sparsity`, holds the positions of the entries; `values` (size,) in N/m are the entries
    of the upper triangle. `exact`: whether one application of a factor solves its system; `one_matrix`:
    whether the solver needs sheet and contact merged into one matrix, whose structure the host builds.
    """

    exact: eqx.AbstractClassVar[bool]
    one_matrix: ClassVar[bool] = False

    def load_library(self) -> None:
        """Load the library that its programs call, if any; tracing does so too."""

    @abc.abstractmethod
    def start(self, pattern: Pattern) -> Factor:
        """Build a workspace for a `pattern`, with the factor of the identity matrix."""

    @abc.abstractmethod
    def factor(self, pattern: Pattern, values: Float[Array, " entries"], previous: Factor) -> Factor:
        """Factor the matrix of `pattern` with new `values` (size,), in the workspace of `previous`."""

    @abc.abstractmethod
    def solve(
        self,
        pattern: Pattern,
        factor: Factor,
        values: Float[Array, " entries"] | None,
        rhs: Float[Array, " unknowns"],
        rtol: Scalar | float,
    ) -> LinearSolution:
        """Solve A x = `rhs` (3n,) to a residual of `rtol` relative to `rhs`.

        `values` (size,) are the entries of A in its `pattern`, or None for those of the `factor`. The factor
        may be that of older values.
        """

    def solve_factored(
        self, pattern: Pattern, factor: Factor, rhs: Float[Array, " unknowns"], rtol: Scalar | float
    ) -> Float[Array, " unknowns"]:
        """Solve A x = `rhs` (3n,) for x (3n,), to a relative residual of `rtol` or less.

        A has the `pattern` and the values of the `factor`.
        """
        return self.solve(pattern, factor, None, rhs, rtol).x

    def solve_once(
        self,
        pattern: Pattern,
        start: Factor,
        values: Float[Array, " entries"],
        rhs: Float[Array, " unknowns"],
        rtol: Scalar | float,
    ) -> Float[Array, " unknowns"]:
        """Factor `values` (size,) of a `pattern` for one right-hand side `rhs` (3n,); return x (3n,).

        `start`: a workspace, which does not change. `rtol`: relative residual.
        """
        return self.solve_factored(pattern, self.factor(pattern, values, start), rhs, rtol)

    def release(self, factor: Factor, after: Shaped[Array, "..."]) -> None:
        """Free memory that the `factor` holds outside JAX arrays, once the array `after` is computed."""


def identity_values(pattern: Pattern) -> Float[Array, " entries"]:
    """Return the values (size,) of the identity matrix."""
    return jnp.zeros(pattern.size).at[pattern.diagonal].set(1.0)
