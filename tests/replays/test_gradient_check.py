"""The gradients of a run of `radial` in all its stages: what `scripts/gradient_check.py` shows."""

import pytest
from gradient_check import KINDS, checks, measure, recorded_window

from jaxcrumple.state import STAGES

# What a difference may be off by: relatively, and over the measure. A replay solves its steps to 1e-12; a
# snap and contact amplify this.
RELATIVE, RESOLVED = 1e-5, 1e-9


@pytest.mark.slow
def test_gradients_are_those_of_the_replay_by_every_kind_of_number():
    window = recorded_window()
    record = window.solution.record
    assert window.solution.result == "success"
    assert len(record.stages) == len(STAGES)
    assert window.solution.history["contact"].max() > 1e-5
    lines = checks(window, False)
    assert len(lines) == len(KINDS)
    value = abs(float(measure(window, window.solution)))
    for line in lines:
        size = abs(line.reverse)
        # The window begins in the quasistatic stage, where velocities do not matter.
        if line.kind == "start: velocities":
            assert size == line.forward == 0.0 and line.difference < 1e-9 * value, line
            continue
        assert line.forward < 1e-8, line
        assert line.difference * size < max(RELATIVE * size, RESOLVED * value), line
        # What next to nothing depends on is the exception.
        assert size > 1e-5 * value or line.kind == "plastic time", line
