"""Sparse direct solver: $L D L^T$ factorisation by oneMKL PARDISO inside jit, with the matrix inertia."""

from collections.abc import Callable
from typing import Any, ClassVar, NoReturn

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from jaxcrumple._jax.arrays import Flag, Scalar
from jaxcrumple._jax.door import own_modes
from jaxcrumple.assembly.sparsity import Pattern, upper_product
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor, LinearSolution
from jaxcrumple.solvers.linear.cg import conjugate_gradients

# Rounds of iterative refinement of a solution that conjugate gradients do not check.
REFINEMENTS = 2


class Direct(AbstractLinearSolver):
    """Solve with one symbolic analysis per program call, one numeric factor per tangent, and many solves.

    The solver always uses the symmetric indefinite mode. This mode raises no exception inside the program,
    and its number of negative eigenvalues is an exact test of the equilibrium's stability. The library
    rebuilds a factor that is no longer in its cache.

    `vmap` may batch right-hand sides, which are solved together. It cannot batch matrices, because a factor
    is stored outside the JAX arrays; use `TwoLevel` for these.

    A `Factor` holds the library's handle and the values of the one matrix of sheet and contact. These are far
    fewer than the `values` of a pattern, most of which are unused blocks of contact.

    **Arguments:** `max_iterations`: conjugate gradient iterations with a factor of other values.
    """

    exact: ClassVar[bool] = True
    one_matrix: ClassVar[bool] = True
    max_iterations: int = 200

    def load_library(self) -> None:
        """Load PARDISO, which registers its functions."""
        import pardiso_mkl_jax.primitive  # noqa: F401

    def start(self, pattern: Pattern) -> Factor:
        """Analyse the pattern (nested dissection)."""
        from pardiso_mkl_jax import primitive

        indptr, indices = _structure(pattern)
        matrix = _unbatched(jnp.zeros(len(indices)).at[_diagonal(pattern)].set(1.0))
        token, _ = primitive.analyze(indptr, indices, matrix, **_mode())
        return Factor(matrix, token, jnp.asarray(0))

    def factor(self, pattern: Pattern, values: Float[Array, " entries"], previous: Factor) -> Factor:
        """Factor new values. If one is not finite, factor the identity and report an indefinite matrix."""
        from pardiso_mkl_jax import primitive

        matrix, finite = _safe(pattern, _unbatched(values))
        token, report = primitive.factor(previous.workspace, *_structure(pattern), matrix, **_mode())
        # report[22] is PARDISO's count of negative eigenvalues (iparm(23)).
        negative = jnp.where(finite, report[22], 1).astype(int)
        return Factor(matrix, token, negative)

    def solve(
        self,
        pattern: Pattern,
        factor: Factor,
        values: Float[Array, " entries"] | None,
        rhs: Float[Array, " unknowns"],
        rtol: Scalar | float,
    ) -> LinearSolution:
        """Solve by one substitution with the factor's own values, or by conjugate gradients with others."""
        if values is None:
            return LinearSolution(_substitute(pattern, factor, rhs), jnp.asarray(1), factor.negative > 0)
        return conjugate_gradients(
            lambda d: pattern.product(values, d),
            lambda r: _substitute(pattern, factor, r),
            factor,
            rhs,
            rtol,
            self.max_iterations,
        )

    def solve_factored(
        self, pattern: Pattern, factor: Factor, rhs: Float[Array, " unknowns"], rtol: Scalar | float
    ) -> Float[Array, " unknowns"]:
        """Solve with the factor's own values, definite or not, and refine x (3n,) to rounding."""
        x = jnp.zeros_like(rhs)
        for _ in range(REFINEMENTS + 1):
            x = x + _substitute(pattern, factor, rhs - _product(pattern, factor.values, x))
        return x

    def solve_once(
        self,
        pattern: Pattern,
        start: Factor,
        values: Float[Array, " entries"],
        rhs: Float[Array, " unknowns"],
        rtol: Scalar | float,
    ) -> Float[Array, " unknowns"]:
        """Factor and solve in one library call with the analysis of `start`; refine x (3n,) to rounding."""
        from pardiso_mkl_jax import primitive

        matrix, _ = _safe(pattern, _unbatched(values))
        return _batched(
            primitive.factor_and_solve_stateful,
            start.workspace,
            *_structure(pattern),
            matrix,
            rhs,
            refinements=REFINEMENTS,
        )

    def release(self, factor: Factor, after: Shaped[Array, "..."]) -> None:
        """Free the factor, because the library keeps the factors of the last calls."""
        from pardiso_mkl_jax import primitive

        primitive.release(factor.workspace, after.astype(float))


def _substitute(
    pattern: Pattern, factor: Factor, rhs: Float[Array, " unknowns"]
) -> Float[Array, " unknowns"]:
    """Solve by forward and back substitution."""
    from pardiso_mkl_jax import primitive

    return _batched(primitive.solve_stateful, factor.workspace, *_structure(pattern), factor.values, rhs)


def _batched(
    routine: Callable,
    token: Any,
    indptr: Int[Array, " pointers"],
    indices: Int[Array, " stored"],
    matrix: Float[Array, " stored"],
    rhs: Float[Array, " unknowns"],
    **options: Any,
) -> Float[Array, " unknowns"]:
    """Call a routine of the library for one right-hand side, or under `vmap` for all of them together."""

    def found(
        token: Any,
        indptr: Int[Array, " pointers"],
        indices: Int[Array, " stored"],
        matrix: Float[Array, " stored"],
        rhs: Float[Array, "batch unknowns"],
    ) -> Float[Array, "batch unknowns"]:
        return routine(token, indptr, indices, matrix, _unbatched(rhs), **_mode(**options))[0]

    @jax.custom_batching.custom_vmap
    def one(
        token: Any,
        indptr: Int[Array, " pointers"],
        indices: Int[Array, " stored"],
        matrix: Float[Array, " stored"],
        rhs: Float[Array, " unknowns"],
    ) -> Float[Array, " unknowns"]:
        return found(token, indptr, indices, matrix, rhs[None])[0]

    @one.def_vmap
    @own_modes()
    def many(
        axis_size: int,
        in_batched: Any,
        token: Any,
        indptr: Int[Array, " pointers"],
        indices: Int[Array, " stored"],
        matrix: Float[Array, " stored"],
        rhs: Float[Array, "batch unknowns"],
    ) -> tuple[Float[Array, "batch unknowns"], bool]:
        if any(jax.tree.leaves(in_batched[:-1])):
            _refuse(axis_size, in_batched, rhs)
        return found(token, indptr, indices, matrix, rhs), True

    return one(token, indptr, indices, matrix, rhs)


def _structure(pattern: Pattern) -> tuple[Int[Array, " pointers"], Int[Array, " stored"]]:
    """Return row pointers and column indices of the upper triangle, contact included."""
    if pattern.contact is None:
        return pattern.indptr, pattern.indices
    merged = pattern.contact.matrix
    if merged is None:
        raise ValueError(
            "the direct solver needs the contact lists; build them by scene = "
            "jaxcrumple.with_contacts(scene, x)."
        )
    return merged.indptr, merged.indices


def _matrix(pattern: Pattern, values: Float[Array, " entries"]) -> Float[Array, " stored"]:
    """Return the values of the upper triangle, contact included."""
    if pattern.contact is None:
        return values
    return pattern.contact.merge(values[: pattern.nnz], values[pattern.nnz :])


def _safe(pattern: Pattern, values: Float[Array, " entries"]) -> tuple[Float[Array, " stored"], Flag]:
    """Return the values of the upper triangle, contact included, and whether all are finite; those of the
    identity if not."""
    matrix = _matrix(pattern, values)
    finite = jnp.all(jnp.isfinite(matrix))
    return jnp.where(finite, matrix, 0.0).at[_diagonal(pattern)].add(jnp.where(finite, 0.0, 1.0)), finite


def _diagonal(pattern: Pattern) -> Int[Array, " unknowns"]:
    """Return the places of the diagonal in the upper triangle, contact included."""
    return pattern.diagonal if pattern.contact is None else pattern.contact.entries(pattern.diagonal)


def _product(
    pattern: Pattern, matrix: Float[Array, " stored"], x: Float[Array, " unknowns"]
) -> Float[Array, " unknowns"]:
    """Multiply the symmetric matrix with the values `matrix` of its upper triangle by a vector (3n,)."""
    indptr, columns = _structure(pattern)
    rows = jnp.searchsorted(indptr, jnp.arange(len(columns)), side="right") - 1
    # Spare entries, behind those of the last row, are zero.
    return upper_product(jnp.minimum(rows, len(x) - 1), columns, matrix, x)


@jax.custom_batching.custom_vmap
def _unbatched(array: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
    """Return the array, and raise ValueError under `vmap`."""
    return array


@_unbatched.def_vmap
def _refuse(axis_size: int, in_batched: Any, array: Shaped[Array, "..."]) -> NoReturn:
    raise ValueError(
        f"the direct solver cannot be batched by vmap (here over {axis_size} lanes): its factors are stored "
        "outside the JAX arrays. Choose linear='two-level'."
    )


def _mode(refinements: int = 0) -> dict[str, Any]:
    """Return the matrix type and the options of all calls.

    Pivots are 1x1, which suffices for the matrices of a stable sheet. The callers refine a solution if it
    needs refinement. Both choices together save a third of the time.
    """
    from pardiso_mkl_jax import MatrixType, PardisoOption

    options = {PardisoOption.PIVOTING_STRATEGY: 0, PardisoOption.MAX_ITERATIVE_REFINEMENT_STEPS: refinements}
    return {"matrix_type": MatrixType.REAL_SYMMETRIC_INDEFINITE, "options": options}
