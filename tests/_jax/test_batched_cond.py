"""Work that a batch skips where no lane needs it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple._jax.batched_cond import once, where_needed


@pytest.fixture
def counted():
    """A function of two numbers that counts its calls in the program as it runs, and the counts."""
    calls = []

    def make(a, b):
        jax.debug.callback(lambda: calls.append(1))
        return {"sum": a + b}

    return make, calls


@pytest.mark.parametrize("needed", [(0, 0, 0), (0, 1, 0), (1, 1, 1)])
def test_lanes_take_what_they_need_and_none_is_made_for_nobody(counted, needed):
    make, calls = counted
    needed = np.array(needed, bool)
    a, old = jnp.array([1.0, 2.0, 3.0]), {"sum": jnp.array([-1.0, -2.0, -3.0])}

    def lane(needed, a, old):
        return where_needed(needed, make, old, a, 10.0)

    found = jax.jit(jax.vmap(lane))(needed, a, old)
    jax.effects_barrier()
    np.testing.assert_array_equal(found["sum"], np.where(needed, a + 10.0, old["sum"]))
    assert bool(calls) == needed.any()


def test_what_all_lanes_share_is_not_repeated():
    """A decision that all lanes share stays one, and so does an argument."""
    shared = jnp.arange(3.0)

    def lane(old, needed):
        return where_needed(needed, lambda shared: 2.0 * jnp.sum(shared), old, shared)

    for needed, expected in ((True, [6.0, 6.0]), (False, [1.0, 2.0])):
        found = jax.vmap(lane, in_axes=(0, None))(jnp.array([1.0, 2.0]), jnp.asarray(needed))
        np.testing.assert_array_equal(found, expected)


def test_derivatives_pass_through_outside_of_a_batch():
    def function(a):
        return where_needed(a > 0, jnp.square, -a, a)

    for a, slope in ((3.0, 6.0), (-3.0, -1.0)):
        assert float(jax.jvp(function, (a,), (1.0,))[1]) == slope


@pytest.mark.parametrize("needed", [False, True])
def test_what_is_made_once_is_made_only_if_needed(counted, needed):
    make, calls = counted
    found = jax.jit(lambda needed, old: once(needed, lambda old: make(old["sum"], 1.0), old))
    old = {"sum": jnp.arange(3.0)}
    np.testing.assert_array_equal(found(needed, old)["sum"], old["sum"] + needed)
    jax.effects_barrier()
    assert len(calls) == needed
