"""Compiled programs are forgotten before a process runs out of mappings, and runs do not notice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple import programs
from jaxcrumple.config import configure

on_linux = pytest.mark.skipif(not programs.LIMIT.exists(), reason="mappings are listed on Linux alone")


@pytest.fixture
def granted(monkeypatch, tmp_path):
    """A function that sets how many mappings the system seems to grant."""

    def grant(count: int) -> None:
        (tmp_path / "limit").write_text(f"{count}\n")
        monkeypatch.setattr(programs, "LIMIT", tmp_path / "limit")

    return grant


def mappings() -> int:
    return len(programs.MAPPINGS.read_bytes().splitlines())


@on_linux
def test_programs_are_forgotten_where_mappings_run_out(granted):
    traces = []

    @jax.jit
    def program(x):
        traces.append(1)
        return sum(jnp.sort(jnp.sin(k * x)) for k in range(40))

    x = jnp.arange(64.0)
    program(x)
    granted(10 * mappings())
    assert not programs.make_room()
    program(x)
    assert len(traces) == 1
    before = mappings()
    granted(before)
    assert programs.make_room()
    assert mappings() < before - 20  # a program's kernels are given back
    program(x)
    assert len(traces) == 2


def test_nothing_is_known_elsewhere(monkeypatch, tmp_path):
    monkeypatch.setattr(programs, "MAPPINGS", tmp_path / "absent")
    assert not programs.make_room(0.0)


@on_linux
def test_a_run_in_a_crowded_process_ends_as_any(granted):
    setup = configure("radial", nodes=60, settings={"contact": None}).build()
    state = jc.initial_state(setup.scene, setup.x)
    free = jc.simulate(setup.scene, state, 0.2)
    granted(1)
    crowded = jc.simulate(setup.scene, state, 0.2)
    assert crowded.result == free.result == "success"
    assert np.array_equal(crowded.state.x, free.state.x)
