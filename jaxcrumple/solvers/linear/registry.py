"""Choice of a linear solver by name, device and installed packages."""

import importlib.util
from typing import Literal, get_args

import jax

from jaxcrumple.solvers.linear.base import AbstractLinearSolver
from jaxcrumple.solvers.linear.block_jacobi import BlockCG
from jaxcrumple.solvers.linear.direct import Direct
from jaxcrumple.solvers.linear.two_level import TwoLevel

LinearSolverName = Literal["auto", "direct", "two-level", "block-cg"]


def direct_available() -> bool:
    """Return whether the extra `direct` is installed and the default device is a CPU."""
    return importlib.util.find_spec("pardiso_mkl_jax") is not None and jax.default_backend() == "cpu"


def choose_linear_solver(name: str | AbstractLinearSolver) -> AbstractLinearSolver:
    """Return the linear solver of a name, or a given solver unchanged.

    **Arguments:** `name`: "direct" (sparse factor with inertia; needs the extra `direct` and a CPU),
    "two-level" (pure JAX, any device), "block-cg" (the paper's), or "auto": direct if available, else
    two-level.

    **Raises:** ValueError for an unknown name or a missing extra.
    """
    if isinstance(name, AbstractLinearSolver):
        return name
    names = get_args(LinearSolverName)
    if name not in names:
        raise ValueError(f"linear solver {name!r} is unknown; choose one of {', '.join(names)}.")
    if name == "direct" and not direct_available():
        raise ValueError(
            "the direct solver needs the extra, pip install 'jaxcrumple[direct]' (x86-64 Linux, Python up to "
            "3.13), and a CPU as JAX's default device; or choose the linear solver 'two-level'."
        )
    if name == "block-cg":
        return BlockCG()
    return Direct() if name != "two-level" and direct_available() else TwoLevel()
