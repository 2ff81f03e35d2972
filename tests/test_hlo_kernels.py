"""The count of kernels in compiled programs, and what a benchmark of a device makes of it."""

import bench_device
import hlo_kernels
import jax
import jax.numpy as jnp
import pytest
from bench_device import Clock, named_loops

HLO = """
HloModule jit_f, entry_computation_layout={()->f64[]}

%fused (p: f64[]) -> f64[] {
  %p = f64[] parameter(0)
  ROOT %add.1 = f64[] add(%p, %p)
}

%inner_body (p.1: (f64[], s32[])) -> (f64[], s32[]) {
  %p.1 = (f64[], /*index=1*/s32[]) parameter(0)
  %x = f64[] get-tuple-element(%p.1), index=0
  %fusion.1 = f64[] fusion(%x), kind=kLoop, calls=%fused
  %solve = (f64[], s32[]) custom-call(%fusion.1), custom_call_target="solve"
  ROOT %tuple.1 = (f64[], s32[]) tuple(%fusion.1, %x)
}

%condition (p.2: (f64[], s32[])) -> pred[] {
  %p.2 = (f64[], s32[]) parameter(0)
  ROOT %less = pred[] compare(%p.2, %p.2), direction=LT
}

%few (p.3: f64[]) -> f64[] {
  ROOT %p.3 = f64[] parameter(0)
}

%many (p.4: f64[]) -> f64[] {
  %p.4 = f64[] parameter(0)
  %copy.1 = f64[] copy(%p.4)
  ROOT %fusion.2 = f64[] fusion(%copy.1), kind=kLoop, calls=%fused
}

%outer_body (p.5: (f64[], s32[])) -> (f64[], s32[]) {
  %p.5 = (f64[], s32[]) parameter(0)
  %choice = f64[] conditional(%p.5, %p.5, %p.5), branch_computations={%few, %many}
  ROOT %while.1 = (f64[], s32[]) while(%p.5), condition=%condition, body=%inner_body, metadata={op_name="jit(f)/while/body/newton/while"}
}

ENTRY %main (p.6: f64[]) -> f64[] {
  %p.6 = f64[] parameter(0)
  %constant.1 = f64[] constant(1)
  %sort.1 = f64[] sort(%p.6), to_apply=%fused
  %while.2 = (f64[], s32[]) while(%sort.1), condition=%condition, body=%outer_body, metadata={op_name="jit(f)/while"}
  ROOT %out = f64[] get-tuple-element(%while.2), index=0
}
"""  # noqa: E501


def test_kernels_of_each_loop_are_counted():
    top = hlo_kernels.program(HLO)
    (outer,) = top.inner
    (inner,) = outer.inner
    # Two of the larger branch and the condition; a fusion, a library call, and the condition.
    assert (top.kernels, outer.kernels, inner.kernels) == (1, 3, 3)
    assert [loop.scope for loop in top.walk()] == ["", "jit(f)/while", "jit(f)/while/body/newton/while"]


def test_loops_of_a_program_are_found_by_the_names_of_their_scopes():
    def f(x):
        with jax.named_scope("outside"):
            return jax.lax.while_loop(lambda x: x[0] < 9.0, inner, x)

    def inner(x):
        with jax.named_scope("inside"):
            return jax.lax.while_loop(lambda x: x[1] < x[0], lambda x: jnp.sin(x) @ jnp.outer(x, x), x) + 1.0

    loops = named_loops(jax.jit(f).lower(jnp.ones(3)).compile().as_text())
    assert {"outside", "inside"} <= set(loops)
    # A product of a matrix cannot be fused into what makes the matrix.
    assert loops["inside"].kernels >= 2
    assert [loop.scope for loop in loops["outside"].inner] == [loops["inside"].scope]


def test_time_ends(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(bench_device.time, "perf_counter", lambda: now[0])
    clock = Clock(minutes=1.0)
    assert clock.has_room()
    now[0] = 50.0
    assert not clock.has_room() and clock.left == pytest.approx(10.0)
    deadline = bench_device.Deadline(clock)
    deadline.chunk(State(0.25))
    now[0] = 61.0
    with pytest.raises(bench_device.OutOfTimeError):
        deadline.chunk(State(0.5))
    assert deadline.t == 0.5


class State:
    def __init__(self, t):
        self.t = t


@pytest.mark.slow
@pytest.mark.parametrize("part", ["sheet", "lanes"])
def test_a_part_measures(part, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "sys.argv", ["bench_device.py", part, "--nodes", "60", "--minutes", "60", "--out", str(tmp_path)]
    )
    monkeypatch.setattr(bench_device, "WHOLE", 5.0)
    bench_device.main()
    table = (tmp_path / f"device_{part}_{jax.default_backend()}.md").read_text()
    rows = [line for line in table.splitlines() if line.startswith("|")][2:]
    assert len(rows) == {"sheet": 4, "lanes": 1}[part]
