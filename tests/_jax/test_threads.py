"""Thread pools while a program runs: OpenBLAS one thread, MKL what the environment grants."""

import importlib

import pytest
from threadpoolctl import ThreadpoolController

from jaxcrumple._jax.threads import VARIABLE, limited_blas
from jaxcrumple.solvers.linear.registry import direct_available


def numbers(internal_api):
    pools = ThreadpoolController().select(internal_api=internal_api).lib_controllers
    return [pool.num_threads for pool in pools]


def test_openblas_has_one_thread_inside():
    before = numbers("openblas")
    if not before:
        pytest.skip("this NumPy does not use OpenBLAS")
    with limited_blas():
        assert numbers("openblas") == [1] * len(before)
    assert numbers("openblas") == before


@pytest.mark.skipif(not direct_available(), reason="needs the extra `direct`")
@pytest.mark.parametrize(("value", "threads"), [(None, 1), ("1", 1), ("2", 2)])
def test_mkl_has_the_threads_of_its_variable(monkeypatch, value, threads):
    importlib.import_module("pardiso_mkl_jax.primitive")
    monkeypatch.delenv(VARIABLE, raising=False)
    if value is not None:
        monkeypatch.setenv(VARIABLE, value)
    before = numbers("mkl")
    with limited_blas():
        assert numbers("mkl") == [threads]
    assert numbers("mkl") == before


@pytest.mark.parametrize("value", ["", "two", "0", "-1", "1.5"])
def test_a_number_of_threads_that_is_none_is_refused(monkeypatch, value):
    monkeypatch.setenv(VARIABLE, value)
    with pytest.raises(ValueError, match=r"MKL_NUM_THREADS=.* must be a positive integer"), limited_blas():
        pass
