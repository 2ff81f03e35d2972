"""The estimate of the remaining time of a run."""

import numpy as np
import pytest

from jaxcrumple.run.pace import Pace, duration


def paced(w, t):
    pace = Pace(w[0], t[0])
    for point in zip(w[1:], t[1:], strict=True):
        pace.add(*point)
    return pace


def test_a_constant_pace_is_extrapolated_exactly():
    w = np.linspace(5.0, 25.0, 11)
    assert paced(w, 0.1 * (w - 5.0)).left(3.0) == pytest.approx(10.0)


def test_a_run_that_slows_down_is_judged_by_its_last_half():
    # t = sqrt(w): at w = 16 the last half advanced from sqrt(8) to 4 in 8 s.
    w = np.linspace(0.0, 16.0, 1601)
    expected = 2.0 * 8.0 / (4.0 - np.sqrt(8.0))
    assert paced(w, np.sqrt(w)).left(6.0) == pytest.approx(expected, rel=1e-6)
    # The mean pace since the start would tell half of the 20 s that are left; this tells two thirds.
    assert expected / (36.0 - 16.0) == pytest.approx(0.683, abs=1e-3)


def test_a_pause_does_not_count():
    pace = paced([0.0, 10.0], [0.0, 1.0])
    pace.skip(40.0)
    pace.add(55.0, 1.5)
    # 1.5 s in 15 s of stepping.
    assert pace.left(3.0) == pytest.approx(15.0)


def test_nothing_is_told_before_the_run_has_moved():
    assert paced([0.0, 10.0], [0.5, 0.5]).left(1.0) is None


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (40.4, "40 s"),
        (89.0, "89 s"),
        (130.0, "2.2 min"),
        (4000.0, "67 min"),
        (12240.0, "3.4 h"),
        (2e5, "2.3 days"),
    ],
)
def test_durations(seconds, text):
    assert duration(seconds) == text
