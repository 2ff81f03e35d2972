"""Which linear solver to use, by name and by what is installed."""

import importlib.util

from jaxcrumple.solvers.block_cg import BlockCG
from jaxcrumple.solvers.direct import Direct
from jaxcrumple.solvers.linear import AbstractLinearSolver


def direct_available() -> bool:
    """Whether the sparse direct solver's extra is installed."""
    return importlib.util.find_spec("pardiso_mkl_jax") is not None


def choose_linear_solver(name: str) -> AbstractLinearSolver:
    """Linear solver by name.

    **Arguments:** `name`: "direct" (sparse Cholesky-like factor with inertia; needs the extra
    `direct`), "block-cg" (the paper's), or "auto": direct where it is installed.

    **Raises:** ValueError for an unknown name or a missing extra.
    """
    if name not in ("auto", "direct", "block-cg"):
        raise ValueError(f"linear solver {name!r} is unknown; choose auto, direct or block-cg.")
    if name == "direct" and not direct_available():
        raise ValueError(
            "the direct solver needs the extra: pip install 'jaxcrumple[direct]' "
            "(x86-64 Linux); or choose linear solver block-cg."
        )
    if name == "block-cg" or not direct_available():
        return BlockCG()
    return Direct()
