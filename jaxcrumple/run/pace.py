"""Estimate how long a run takes to its end."""

import numpy as np


class Pace:
    """Estimate the remaining wall time of a run from the simulated times `t` in s that it reached at wall
    times `w` in s.

    Layers in contact slow a crumple down, so the mean pace since the start tells up to 30 times too little.
    The pace over the last half of the wall time told between 0.2 and 1.5 of what was left (five scenes,
    n = 200 to 3000): a lower bound as a rule.
    """

    def __init__(self, w: float, t: float):
        self.w, self.t = [w], [t]

    def add(self, w: float, t: float) -> None:
        """Add a point."""
        self.w.append(w)
        self.t.append(t)

    def skip(self, seconds: float) -> None:
        """Leave out a pause, e.g. to compile, since the last point."""
        self.w = [w + seconds for w in self.w]

    def left(self, t_end: float) -> float | None:
        """Return the wall time in s to `t_end`; None before the run has moved."""
        now, half = self.w[-1], 0.5 * (self.w[0] + self.w[-1])
        gone = self.t[-1] - float(np.interp(half, self.w, self.t))
        return (t_end - self.t[-1]) * (now - half) / gone if gone > 0 else None


def duration(seconds: float) -> str:
    """Format a wall time with two significant digits: "40 s", "12 min", "3.4 h" or "2.5 days"."""
    for size, name in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{rounded(seconds / size)} {name}"
    return f"{rounded(seconds)} s"


def rounded(value: float) -> str:
    """Format with two significant digits, without an exponent."""
    return f"{float(f'{value:.2g}'):.10g}"
