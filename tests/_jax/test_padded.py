"""Lists a chunk at a time, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple._jax.padded import accumulate, filled


@pytest.mark.parametrize("count", [0, 1, 100, 999, 1000])
def test_every_entry_of_a_list_counts_once(count):
    """Also where the list is full, and its length no multiple of the chunk's."""

    def add(total, numbers, at, held):
        return total + jnp.sum(jnp.where(held, numbers[at], 0.0))

    def total(numbers):
        return accumulate(add, jnp.zeros(()), numbers, jnp.asarray(count), 1000, 128)

    numbers = jnp.asarray(np.random.default_rng(0).normal(size=1000))
    assert float(total(numbers)) == pytest.approx(float(np.sum(numbers[:count])), abs=1e-12)
    np.testing.assert_array_equal(jax.grad(total)(numbers), np.arange(1000) < count)


@pytest.mark.parametrize("count", [0, 5, 12])
def test_a_table_has_a_row_for_each_entry(count):
    columns = filled(lambda at: (at + 1.0, 2 * at), jnp.asarray(count), 12, 5)
    assert [column.dtype for column in columns] == [float, int]
    table = np.stack(columns, axis=1)
    expected = np.stack([np.arange(12) + 1.0, 2.0 * np.arange(12)], axis=1)
    np.testing.assert_array_equal(table[:count], expected[:count])
