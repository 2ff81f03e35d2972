"""The choice of a device, and what is computed otherwise on an accelerator: the same numbers."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple._jax import device, padded
from jaxcrumple.geometry.distance import primitive_distances


def chosen(name, **environment):
    """What a new process says that chooses a device, with a function that a second process could see."""
    program = (
        "import os, sys; from jaxcrumple._jax.device import choose_device\n"
        f"try: choose_device({name!r})\n"
        "except ValueError as error: sys.exit(f'refused: {error}')\n"
        "import jax; from jaxcrumple.solvers.linear.registry import choose_linear_solver\n"
        "print(jax.default_backend(), os.environ['JAX_PLATFORMS'], choose_linear_solver('auto').exact)"
    )
    environment = os.environ | environment
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)


def test_a_cpu_is_chosen_against_the_environment():
    """The solver "auto" follows the device, and processes started later inherit it."""
    pytest.importorskip("pardiso_mkl_jax")
    found = chosen("cpu", JAX_PLATFORMS="cuda")
    assert found.stdout.split() == ["cpu", "cpu", "True"], found.stderr


@pytest.mark.parametrize("name", ["gpu", "gpu:1"])
def test_a_missing_device_is_refused(name):
    if jax.default_backend() != "cpu":
        pytest.skip("this machine has a GPU")
    found = chosen(name, JAX_PLATFORMS="cpu")
    assert found.returncode == 1
    assert f"refused: JAX has no device {name}" in found.stderr


@pytest.mark.parametrize("name", ["", "cuda", "cpu:0", "gpu:", "gpu:-1", "GPU"])
def test_an_unknown_device_is_refused(name):
    found = chosen(name)
    assert found.returncode == 1
    assert f"refused: device {name!r} is unknown; choose cpu, gpu" in found.stderr


@pytest.mark.parametrize("count", [0, 1, 999, 1000])
def test_an_accelerator_adds_larger_chunks(count, monkeypatch):
    sizes = []

    def add(total, numbers, at, held):
        sizes.append(at.shape[0])
        return total + jnp.sum(jnp.where(held, numbers[at], 0.0))

    numbers = jnp.asarray(np.random.default_rng(0).normal(size=1000))
    monkeypatch.setattr(padded, "on_accelerator", lambda: True)
    total = padded.accumulate(add, jnp.zeros(()), numbers, jnp.asarray(count), 1000, 3)
    assert float(total) == pytest.approx(float(np.sum(numbers[:count])), abs=1e-12)
    assert set(sizes) == {3 * padded.AT_ONCE}


def test_an_accelerator_maps_all_parts_at_once(monkeypatch):
    """The tangent and the distances of triangles are the same, without a loop."""
    rng = np.random.default_rng(0)
    mesh = jc.hexagonal(6, 5, 2e-3)
    x = jnp.asarray(mesh.vertices + 2e-4 * rng.normal(size=mesh.vertices.shape))
    scene = jc.sheet(mesh, jc.Material())
    sides = jnp.asarray(rng.normal(size=(2, 3, 3, 20)))

    def numbers():
        def both(x, sides):
            return jc.elastic_tangent(scene, x, None, 0.0), primitive_distances(sides)

        return both(x, sides), str(jax.make_jaxpr(both)(x, sides)).count("scan[")

    (one, loops), _ = numbers(), monkeypatch.setattr(device, "on_accelerator", lambda: True)
    other, none = numbers()
    assert loops == 4 and none == 0
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * float(jnp.max(jnp.abs(a[jnp.isfinite(a)]))))
