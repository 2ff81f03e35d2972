"""BFGS updates of a lagged tangent, against their formula for dense matrices."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple.solvers.implicit import secants
from jaxcrumple.solvers.implicit.secants import Secants

NODES = 4


def definite(seed):
    factor = np.random.default_rng(seed).normal(size=(3 * NODES, 3 * NODES))
    return factor @ factor.T + np.eye(3 * NODES)


def moves(count):
    return np.random.default_rng(9).normal(size=(count, NODES, 3))


def kept(tangent, count):
    """Changes of the iterate and of a residual that is linear, newest last, and what is kept of them."""
    found, steps = Secants.none(NODES), moves(count)
    for move in steps:
        force = (tangent @ move.reshape(-1)).reshape(NODES, 3)
        found = found.including(jnp.asarray(move), jnp.asarray(force), jnp.asarray(True))
    return steps, found


def applied(found, inverse, force):
    solve = lambda f: (jnp.asarray(inverse) @ f.reshape(-1)).reshape(NODES, 3)  # noqa: E731
    return np.asarray(found.applied(solve, jnp.asarray(force))).reshape(-1)


@pytest.mark.parametrize("count", [0, 1, 3, secants.MOST, secants.MOST + 3])
def test_the_updated_inverse_is_that_of_dense_matrices(count):
    tangent, older = definite(1), np.linalg.inv(definite(2))
    steps, found = kept(tangent, count)
    assert bool(found.full) == (count >= secants.MOST)
    inverse, eye = older, np.eye(3 * NODES)
    for move in steps[-secants.MOST :]:
        s = move.reshape(-1)
        y = tangent @ s
        rho = 1.0 / (s @ y)
        inverse = (eye - rho * np.outer(s, y)) @ inverse @ (eye - rho * np.outer(y, s)) + rho * np.outer(s, s)
    force = np.random.default_rng(3).normal(size=(NODES, 3))
    assert applied(found, older, force) == pytest.approx(inverse @ force.reshape(-1), rel=1e-10)


def test_the_last_change_would_be_made_again():
    """The secant equation: the change of the residual gives the change of the iterate."""
    tangent, older = definite(1), np.linalg.inv(definite(2))
    steps, found = kept(tangent, 3)
    force = (tangent @ steps[-1].reshape(-1)).reshape(NODES, 3)
    assert applied(found, older, force) == pytest.approx(steps[-1].reshape(-1), rel=1e-10)


@pytest.mark.parametrize(("factor", "there"), [(-1.0, True), (0.0, True), (np.nan, True), (1.0, False)])
def test_what_is_no_curvature_is_left_out(factor, there):
    move = moves(1)[0]
    found = Secants.none(NODES).including(jnp.asarray(move), jnp.asarray(factor * move), jnp.asarray(there))
    force = np.random.default_rng(3).normal(size=(NODES, 3))
    np.testing.assert_array_equal(applied(found, np.eye(3 * NODES), force), force.reshape(-1))
