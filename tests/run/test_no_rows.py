"""Runs that end before their first step: a named result, a summary, tables without rows, pictures."""

import json

import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.io.sketch import alike, sketch
from jaxcrumple.plot.plot import plot_run
from jaxcrumple.run.config import complete, configure
from jaxcrumple.run.run import start_run

STIFF = ["contact=none", "sweeps=5", "frames=2", "young_modulus=1e200"]
FALLING = {
    "scene": "custom",
    "nodes": 40,
    "t_end": 0.1,
    "frames": 2,
    "options": {"gravity": [0, 0, -9.81], "contact": None, "sheet": {"shape": "square", "sweeps": 5}},
    "material": {"drag_rate": 0.0, "internal_damping_time": 0.0},
    "solver": {"scheme": "quasistatic"},
}


def no_constant(name):
    raise AssertionError(f"{name} is no JSON")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("make", "result"),
    [
        (lambda: configure("radial", nodes=40, t_end=0.3, settings=STIFF), "nonfinite"),
        # A sheet that falls without drag has no quasistatic motion.
        (lambda: complete(FALLING), "collapsed"),
    ],
    ids=["stiff", "falling"],
)
def test_a_run_that_takes_no_step(tmp_path, make, result):
    folder = tmp_path / "run"
    summary = start_run(make(), folder)
    assert (summary["result"], summary["t_reached"], summary["step_size_s"]) == (result, 0.0, {})
    written = json.loads((folder / "summary.json").read_text(), parse_constant=no_constant)
    assert written["result"] == result
    run = jc.load(folder)
    assert (len(run.t), len(run.history), len(run.events)) == (1, 0, 0)
    assert "kind" in run.history and "to" in run.events
    assert [path.name for path in plot_run(folder)] == ["sheet.png", "creases.png"]
    assert "1 frames to t = 0 s" in repr(run)


def test_sketches_tell_numbers_apart_beyond_rounding():
    """Also numbers whose squares overflow."""
    numbers = 1e-3 * 1.1 ** np.arange(200)
    one = sketch(numbers)
    assert alike(one, sketch(numbers * (1 + 1e-13)))
    assert not alike(one, sketch(np.append(numbers[:-1], numbers[-1] * (1 + 1e-6))))
    assert not alike(one, sketch(numbers[::-1]))
    assert not alike(one, sketch(numbers[1:]))
    huge = sketch(np.array([1e200, 2e200]))
    assert alike(huge, huge)
    assert not alike(huge, sketch(np.array([1e200, 3e200])))
