"""What the benchmarks share: logs that go on or begin afresh, and calls in turn."""

import jax.numpy as jnp
from benchlib import Log, paired


def test_a_log_goes_on_or_begins_afresh(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = []

    def result(log, nodes, value):
        def make():
            made.append(nodes)
            return {"seconds": value}

        return log.result({"nodes": nodes}, make)

    first = Log("speed", resume=False)
    assert result(first, 10, 1.5) == {"nodes": 10, "seconds": 1.5}
    result(first, 20, 2.5)
    again = Log("speed", resume=True)
    assert result(again, 20, 9.0) == {"nodes": 20, "seconds": 2.5}
    result(again, 30, 3.5)
    assert made == [10, 20, 30]
    # A new benchmark forgets the old results with its own first one, and not before.
    fresh = Log("speed", resume=False)
    assert len((tmp_path / "runs/bench/speed.jsonl").read_text().splitlines()) == 3
    assert result(fresh, 20, 7.0)["seconds"] == 7.0
    assert len((tmp_path / "runs/bench/speed.jsonl").read_text().splitlines()) == 1
    assert made == [10, 20, 30, 20]


def test_paired_calls_come_in_turn():
    calls = []

    def function(name):
        def call():
            calls.append(name)
            return jnp.asarray(len(calls))

        return call

    timings = paired({"a": function("a"), "b": function("b")}, repeats=2)
    assert calls == ["a", "b", "a", "b", "a", "b"]
    assert int(timings["b"].output) == 6
    assert all(timing.seconds >= 0 for timing in timings.values())
