"""Run folders with a few frames, rows and events, written without a run."""

import numpy as np

from jaxcrumple.io import Frame
from jaxcrumple.solvers.log import COLUMNS


def stiffness_of(mesh):
    return np.full(len(mesh.edges), 3.0), np.full(len(mesh.hinges), 2.0)


def rows(first, count):
    """History rows that differ from each other, with numbers of many digits."""
    table = np.zeros((count, len(COLUMNS)))
    table[:, COLUMNS.index("t")] = (first + np.arange(count)) / 7
    table[:, COLUMNS.index("stage")] = np.arange(count) % 2
    table[:, COLUMNS.index("quasistatic_steps")] = first + np.arange(count)
    return table


def write(folder, frame, first):
    """A frame, two rows and an event, not yet part of the run."""
    folder.save_frame(*frame)
    folder.append_history(rows(first, 2))
    folder.append_events([{"t": frame.t, "origin": "quasistatic", "to": "implicit"}])


def fill(folder, mesh, frames=3):
    """A run with a few frames, rows and events, each with a checkpoint; returns the frames."""
    rng = np.random.default_rng(0)
    saved = []
    for index in range(frames):
        x, v = rng.normal(size=(2, mesh.n_nodes, 3))
        saved.append(Frame(index / 3, x, v, rng.normal(size=len(mesh.hinges))))
        write(folder, saved[-1], 2 * index)
        folder.commit({"x": x}, {"t": index / 3}, keep=index == 0)
    return saved


def contents(path):
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}
