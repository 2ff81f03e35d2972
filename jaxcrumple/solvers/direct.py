"""Sparse direct solver: $L D L^T$ by oneMKL PARDISO inside jit, with the inertia of the matrix."""

import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.pattern import Pattern
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor, Solution, identity_values


class Direct(AbstractLinearSolver):
    """One symbolic analysis per program call, one numeric factor per tangent, many solves.

    The symmetric indefinite mode is used even where a positive definite matrix is expected: it never
    raises out of the program, and the number of negative eigenvalues it reports is an exact test of
    the equilibrium's stability. A factor that fell out of the library's cache is rebuilt silently.
    """

    def start(self, pattern: Pattern) -> Factor:
        """Analyse the pattern (nested dissection)."""
        from pardiso_mkl_jax import primitive

        values = identity_values(pattern)
        token, _ = primitive.analyze(pattern.indptr, pattern.indices, values, matrix_type=_kind())
        return Factor(values, token, jnp.asarray(0))

    def factor(self, pattern: Pattern, values: Array, previous: Factor) -> Factor:
        """Factor new values; values that are not finite are replaced by the identity and reported."""
        from pardiso_mkl_jax import primitive

        finite = jnp.all(jnp.isfinite(values))
        safe = jnp.where(finite, values, identity_values(pattern))
        token, report = primitive.factor(
            previous.workspace, pattern.indptr, pattern.indices, safe, matrix_type=_kind()
        )
        # report[22] is PARDISO's count of negative eigenvalues (iparm(23)).
        negative = jnp.where(finite, report[22], 1).astype(int)
        return Factor(safe, token, negative)

    def solve(self, pattern: Pattern, factor: Factor, rhs: Array) -> Solution:
        """Back substitution."""
        from pardiso_mkl_jax import primitive

        finite = jnp.all(jnp.isfinite(rhs))
        safe = jnp.where(finite, rhs, 0.0)
        x, _, _ = primitive.solve_stateful(
            factor.workspace,
            pattern.indptr,
            pattern.indices,
            factor.values,
            safe[None],
            matrix_type=_kind(),
        )
        return Solution(jnp.where(finite, x[0], jnp.nan), jnp.asarray(1), factor.negative > 0)


def _kind():
    from pardiso_mkl_jax import MatrixType

    return MatrixType.REAL_SYMMETRIC_INDEFINITE
