"""Which linear solver to use, by name, by device and by what is installed."""

import importlib.util

import jax

from jaxcrumple.solvers.linear.base import AbstractLinearSolver
from jaxcrumple.solvers.linear.block_jacobi import BlockCG
from jaxcrumple.solvers.linear.direct import Direct
from jaxcrumple.solvers.linear.two_level import TwoLevel

LINEAR_SOLVERS = ("auto", "direct", "two-level", "block-cg")


def direct_available() -> bool:
    """Whether the sparse direct solver's extra is installed and the default device is a CPU."""
    return importlib.util.find_spec("pardiso_mkl_jax") is not None and jax.default_backend() == "cpu"


def choose_linear_solver(name: str | AbstractLinearSolver) -> AbstractLinearSolver:
    """Linear solver by name; one that is a solver already is returned as it is.

    **Arguments:** `name`: "direct" (sparse factor with inertia; needs the extra `direct` and a CPU),
    "two-level" (pure JAX, any device), "block-cg" (the paper's), or "auto": direct where it runs,
    else two-level.

    **Raises:** ValueError for an unknown name or a missing extra.
    """
    if isinstance(name, AbstractLinearSolver):
        return name
    if name not in LINEAR_SOLVERS:
        raise ValueError(f"linear solver {name!r} is unknown; choose one of {', '.join(LINEAR_SOLVERS)}.")
    if name == "direct" and not direct_available():
        raise ValueError(
            "the direct solver needs the extra, pip install 'jaxcrumple[direct]' (x86-64 Linux, Python up to "
            "3.13), and a CPU as JAX's default device; or choose linear solver two-level."
        )
    if name == "block-cg":
        return BlockCG()
    return Direct() if name != "two-level" and direct_available() else TwoLevel()
