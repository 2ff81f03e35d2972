"""A sample of the stability study: every run ends with a named result, finite and within its tolerance."""

import numpy as np
import pytest
from stability import NODES, SWEEPS, judged, sample

RUNS = sample(10, seed=1, largest=NODES[0])
SECONDS = 3.0
# Each compiles anew; in these nodes are thrown at the wall.
SHORT = (5,)


def test_the_cube_spans_its_ranges():
    runs = sample(200)
    assert {run.nodes for run in runs} == set(NODES)
    assert {run.options["sweeps"] for run in runs} == set(SWEEPS)
    for name, decades in (("drag_rate", 4), ("internal_damping_time", 4), ("plastic_time", 4)):
        values = [getattr(run.material, name) for run in runs]
        assert np.log10(max(values) / min(values)) > 0.98 * decades
    speeds = [run.options["speed"] for run in runs]
    assert np.log10(max(speeds) / min(speeds)) > 2.95
    elastic = [run.material.yield_curvature is None for run in runs]
    assert 0.05 < np.mean(elastic) < 0.15


@pytest.mark.parametrize(
    "number", [pytest.param(k, marks=() if k in SHORT else pytest.mark.slow) for k in range(len(RUNS))]
)
def test_every_run_ends_with_a_named_result(number):
    found = judged(RUNS[number], SECONDS)
    assert found["result"] in ("success", "budget", "collapsed")
    assert not found["failures"], found
    assert found["result"] == "success" or found["reached"] > 0
