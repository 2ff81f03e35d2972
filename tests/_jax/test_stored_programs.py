"""Programs that later processes read from the compilation cache without tracing."""

import os
import subprocess
import sys
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple._jax import stored_programs as stored
from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple.contact.lists import Reference, VerletList, motion, nowhere


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """An empty compilation cache, in which every program is kept."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.setattr(stored, "LONG", 0.0)
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture
def uncompiled(monkeypatch):
    """A function after whose call no program is compiled."""
    return lambda: monkeypatch.setattr(StoredJit, "_compiled", lambda *_: pytest.fail("compiled"))


def points(seed, n=50):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(n, 3)))


def files(folder):
    return sorted(folder.glob(f"*{stored.SUFFIX}"))


def test_a_program_that_was_read_gives_the_same_bits(folder, uncompiled):
    first = StoredJit(motion)(points(0), points(1))
    assert [path.name.partition("-")[0] for path in files(folder)] == ["motion"]
    uncompiled()
    read = StoredJit(motion)
    np.testing.assert_array_equal(read(points(0), points(1)), first)
    # New numbers need no other program.
    np.testing.assert_allclose(read(points(2), points(3)), motion(points(2), points(3)), rtol=1e-14)


def test_results_may_be_trees_with_parts_that_are_no_arrays(folder, uncompiled):
    made = StoredJit(nowhere)(7)
    uncompiled()
    read = StoredJit(nowhere)(7)
    assert isinstance(read, Reference)
    assert eqx.tree_equal(jax.tree.map(jnp.isnan, read), jax.tree.map(jnp.isnan, made))
    covers = StoredJit(Reference.covers)
    with pytest.raises(pytest.fail.Exception, match="compiled"):
        covers(read, points(0, 7), 0.1)


def name(*args):
    return stored._name(motion, args)


def test_all_that_a_program_depends_on_is_in_its_name(folder, monkeypatch):
    x, other = points(0), points(1)
    names = [
        name(x, other),
        name(x, points(1, 60)),
        name(x, other.astype(jnp.float32)),
        name(x, other, None),
        name(x, other, 0.1),
        name(x, other, 0.2),
        name(x, jnp.asarray(1.0)),
        name(x, jnp.asarray(1.0, float)),
        name((x, other)),
        name(Reference(x, other[:, 0])),
        stored._name(nowhere, (x, other)),
    ]
    assert name(points(2), points(3)) == names[0]
    assert name(np.asarray(x), np.asarray(other)) == names[0]
    with jax.default_matmul_precision("float32"):
        names.append(name(x, other))
    for change in ("XLA_FLAGS", "sources"):
        stored._surroundings.cache_clear()
        if change == "sources":
            monkeypatch.setattr(stored, "_sources", b"others")
        else:
            monkeypatch.setenv(change, "--xla_cpu_enable_fast_math=false")
        names.append(name(x, other))
    stored._surroundings.cache_clear()
    assert None not in names and len(set(names)) == len(names)


class Foreign(NamedTuple):
    """A part of arguments whose code the name of a program cannot tell."""

    x: jax.Array


class ForeignList(VerletList):
    reference: Reference


@pytest.mark.parametrize(
    "wrapped",
    [Foreign, lambda x: ForeignList(Reference(x, x[:, 0])), lambda x: (x, motion, points)],
    ids=["tuple", "module", "function"],
)
def test_parts_of_other_packages_are_not_kept(folder, wrapped):
    assert name(wrapped(points(0))) is None


def test_a_foreign_function_is_compiled_as_usual(folder):
    scale = StoredJit(lambda x: 2.0 * x)
    np.testing.assert_array_equal(scale(points(0)), 2.0 * points(0))
    assert files(folder) == []


def test_derivatives_and_batches_pass_through(folder):
    program = StoredJit(motion)
    batch = jax.vmap(program)(jnp.stack([points(0), points(1)]), jnp.stack([points(2), points(3)]))
    np.testing.assert_allclose(batch[1], motion(points(1), points(3)), rtol=1e-14)
    grad = jax.grad(lambda x: jnp.sum(program(points(0), x) ** 2))(points(1))
    moved = points(1) - points(0)
    np.testing.assert_allclose(grad, 2.0 * (moved - jnp.mean(moved, axis=0)), atol=1e-12)
    assert files(folder) == []


@pytest.mark.parametrize("spoil", [lambda old: b"", lambda old: old[:-7], lambda old: b"other" + old])
def test_a_damaged_file_is_compiled_and_stored_again(folder, uncompiled, spoil):
    first = StoredJit(motion)(points(0), points(1))
    (path,) = files(folder)
    path.write_bytes(spoil(path.read_bytes()))
    np.testing.assert_array_equal(StoredJit(motion)(points(0), points(1)), first)
    uncompiled()
    np.testing.assert_array_equal(StoredJit(motion)(points(0), points(1)), first)


def test_a_program_that_fails_when_it_first_runs_is_compiled_again(folder, monkeypatch):
    def fails(arrays):
        raise jax.errors.JaxRuntimeError("INTERNAL: Function not found")

    monkeypatch.setattr(stored, "_read", lambda path: fails)
    np.testing.assert_allclose(
        StoredJit(motion)(points(0), points(1)), motion(points(0), points(1)), rtol=1e-14
    )


def test_the_files_not_used_for_longest_are_dropped(folder, monkeypatch):
    monkeypatch.setattr(stored, "KEPT", 2)
    program = StoredJit(motion)
    program(points(0, 4), points(1, 4))
    (first,) = files(folder)
    os.utime(first, (1e9, 1e9))
    program(points(0, 5), points(1, 5))
    program(points(0, 6), points(1, 6))
    assert len(files(folder)) == 2 and not first.exists()


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("jax_compilation_cache_dir", None),
        ("jax_compilation_cache_dir", "gs://bucket"),
        ("jax_enable_compilation_cache", False),
        ("jax_debug_nans", True),
    ],
)
def test_without_a_cache_nothing_is_written(folder, setting, value):
    before = getattr(jax.config, setting)
    jax.config.update(setting, value)
    try:
        assert stored._folder() is None
        StoredJit(motion)(points(0), points(1))
    finally:
        jax.config.update(setting, before)
    assert files(folder) == []


RUN = """
import jax, jaxcrumple as jc
traced = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **names: traced.append(names.get("fun_name")) if "jaxpr_trace" in event else None
)
s = jc.radial(16, contact=None)
end = jc.simulate(s.scene, jc.initial_state(s.scene, s.x), 1e-3, solver=jc.integrator(scheme="explicit"))
print("integrate" in traced, end.result, float(end.state.x.sum()).hex())
"""


def test_a_second_process_does_not_trace_the_run(tmp_path):
    own = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_ENABLE_X64": "1"}
    told = [
        subprocess.run(
            [sys.executable, "-c", RUN], capture_output=True, text=True, check=True, env=os.environ | own
        ).stdout.split()
        for _ in range(2)
    ]
    assert told[0][:2] == ["True", "success"]
    assert told[1] == ["False", *told[0][1:]]


FACTOR = """
import jax.numpy as jnp
from jaxcrumple._jax import stored_programs as stored
from jaxcrumple.assembly.sparsity import build_pattern
from jaxcrumple.mesh.generate import hexagonal
from jaxcrumple.solvers.linear.{module} import {name}

stored.LONG = 0.0
mesh, solver = hexagonal(4, 3, 1e-3), {name}()
pattern = build_pattern(mesh.vertices, [mesh.edges])
factor = stored.StoredJit({name}.factor, lambda solver, *_: solver.load_library())
values = jnp.zeros(pattern.size).at[pattern.diagonal].set(2.0)
read, identity = [], solver.start(pattern)
stored._read = lambda path, own=stored._read: read.append(own(path)) or read[-1]
made = factor(solver, pattern, values, identity)
print(read[0] is not None, int(made.negative), made.values.sum())
"""


@pytest.mark.parametrize(("module", "name"), [("block_jacobi", "BlockCG"), ("two_level", "TwoLevel")])
def test_a_stored_program_may_call_lapack(tmp_path, module, name):
    """A process that has not traced anything must load it."""
    own = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_ENABLE_X64": "1"}
    script = FACTOR.format(module=module, name=name)
    told = [
        subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=os.environ | own
        ).stdout.split()
        for _ in range(2)
    ]
    assert told == [["False", "-1", "96.0"], ["True", "-1", "96.0"]]
