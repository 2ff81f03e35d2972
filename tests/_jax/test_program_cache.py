"""Compiled programs are forgotten before a process runs out of mappings, and runs do not notice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple._jax import program_cache as programs
from jaxcrumple.run.config import configure

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


def kernels() -> int:
    """Number of mappings of code that comes from no file."""
    lines = programs.MAPPINGS.read_text().splitlines()
    return sum(" r-xp " in line and len(line.split()) == 5 for line in lines)


@pytest.fixture
def used(monkeypatch, granted):
    """A function that sets how many bytes the process seems to use, of 1 TB and mappings without end."""
    granted(10**9)
    monkeypatch.setattr(programs, "_memory", programs._Memory())
    monkeypatch.setattr(programs, "memory_limit", lambda: 1e12)
    monkeypatch.setattr(programs, "GROWTH", 3e8)

    def use(bytes_: float) -> None:
        monkeypatch.setattr(programs, "resident", lambda: bytes_)

    use(1e9)
    return use


@on_linux
def test_programs_are_forgotten_where_memory_grew_by_many_sizes(used):
    def sizes(*counts):
        return [programs.make_room(jnp.zeros(count)) for count in counts]

    assert sizes(1) == [False]
    used(2e9)
    # A few are kept whatever they take, and so is one that was compiled already.
    assert sizes(2, 3, 4, 1, 4) == [False] * 5
    assert sizes(5) == [True]
    # What is in use then is what growth is counted from.
    assert sizes(6, 7, 8, 9, 10) == [False] * 5
    used(2e9 + 1.01 * programs.GROWTH)
    assert sizes(10, 11, 11) == [False, True, False]


@on_linux
def test_no_number_of_programs_is_kept_where_memory_is_short(used, monkeypatch):
    monkeypatch.setattr(programs, "memory_limit", lambda: 3e9)
    assert not programs.make_room(jnp.zeros(1))
    used(1.4e9)
    assert not programs.make_room(jnp.zeros(2))
    used(1.6e9)
    assert programs.make_room(jnp.zeros(3))


@on_linux
def test_options_and_types_make_other_programs(used):
    one, other = jc.integrator(1e-2, scheme="dynamic"), jc.integrator(1e-3, scheme="dynamic")
    alike = programs._signature((one, jnp.zeros(2)))
    assert alike == programs._signature((other, jnp.ones(2)))
    for differs in (
        (one, jnp.zeros(2, int)), (one, jnp.zeros(3)), (one, None),
        (jc.integrator(1e-2, scheme="quasistatic"), jnp.zeros(2)),
    ):  # fmt: skip
        assert programs._signature(differs) != alike


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
    before = kernels()
    granted(mappings())
    assert programs.make_room()
    assert kernels() < before  # those of the program are given back
    program(x)
    assert len(traces) == 2


def test_nothing_is_known_of_mappings_elsewhere(used, monkeypatch, tmp_path):
    monkeypatch.setattr(programs, "MAPPINGS", tmp_path / "absent")
    assert not programs.make_room(share=0.0)


@pytest.mark.slow
@on_linux
def test_a_run_in_a_crowded_process_ends_as_any(granted):
    setup = configure("radial", nodes=60, settings={"contact": None}).build()
    state = jc.initial_state(setup.scene, setup.x)
    free = jc.simulate(setup.scene, state, 0.2)
    granted(1)
    crowded = jc.simulate(setup.scene, state, 0.2)
    assert crowded.result == free.result == "success"
    assert np.array_equal(crowded.state.x, free.state.x)
