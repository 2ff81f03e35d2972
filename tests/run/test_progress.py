"""What the console shows of a run."""

import io

import equinox as eqx
import numpy as np
import pytest
from pressed import pressed_layers
from rich.console import Console

import jaxcrumple as jc
from jaxcrumple import simulation
from jaxcrumple.run import progress as module
from jaxcrumple.run.progress import ConsoleProgress
from jaxcrumple.solvers.log import empty_log


def setup(contact=None):
    mesh = jc.disc(0.05, 60)
    scene = jc.sheet(mesh, jc.Material(thickness=0.2e-3), gravity=(0, 0, -9.81), contact=contact)
    return scene, jc.initial_state(scene, mesh.vertices)


def shown(terminal, monkeypatch, contact=None, width=200):
    """The output of a run of a small sheet, and the observer."""
    monkeypatch.setattr(module, "INTERVAL", 0.0)
    console = Console(file=io.StringIO(), force_terminal=terminal, width=width)
    scene, state = setup(contact)
    with ConsoleProgress(0.2, console) as progress:
        jc.simulate(scene, state, np.linspace(0.02, 0.2, 10), observers=[progress])
    return console.file.getvalue(), progress


def test_lines_name_phases_in_order_then_time_rate_and_end(monkeypatch):
    lines = shown(False, monkeypatch, jc.SelfContact())[0].splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == ["building", "searching", "compiling"]
    times = [float(line.split()[2]) for line in lines[3:]]
    np.testing.assert_allclose(times, np.linspace(0.02, 0.2, 10), atol=1e-4)
    assert all("steps/s" in line and "or more left" in line for line in lines[4:-1])
    assert "left" not in lines[-1]


def test_a_terminal_shows_the_same_as_a_bar(monkeypatch):
    text, progress = shown(True, monkeypatch)
    assert all(word in text for word in ("compiling", "stepping", "━", "t = 0.2000 of 0.2 s"))
    assert progress.bar.tasks[0].completed == pytest.approx(0.2)


class Phases:
    """Keep the phases of a run, repeated ones once."""

    def __init__(self):
        self.seen = []

    def phase(self, phase):
        if self.seen[-1:] != [phase]:
            self.seen.append(phase)

    def frame(self, index, state):
        pass

    def chunk(self, state, history, events, frames):
        pass


def test_lists_that_overflow_are_told_as_compiling(monkeypatch):
    scene, state = pressed_layers()

    def overflowing(scene, state, *_):
        return eqx.tree_at(lambda s: s.listing.needed, state, state.listing.needed + 1), empty_log(1)

    monkeypatch.setattr(simulation, "_integrate", overflowing)
    phases = Phases()
    jc.simulate(scene, state, 1.0, observers=[phases])
    assert phases.seen[:5] == ["searching", "compiling", "stepping", "compiling", "stepping"]
