"""The gradients of a run of `radial` in all its stages: what `scripts/gradient_check.py` shows."""

import pytest
from gradient_check import KINDS, checks, recorded_window

from jaxcrumple.state import STAGES


@pytest.mark.slow
def test_gradients_are_those_of_the_replay_by_every_kind_of_number():
    window = recorded_window()
    record = window.solution.record
    assert window.solution.result == "success"
    assert len(record.stages) == len(STAGES)
    assert window.solution.history["contact"].max() > 1e-5
    lines = checks(window, False)
    assert len(lines) == len(KINDS)
    for line in lines:
        assert line.forward < 1e-8, line
        assert line.difference < 1e-5, line
