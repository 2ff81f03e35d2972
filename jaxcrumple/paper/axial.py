"""Fig. 9: repeated axial crumpling: growth of the crease length, facets, and distribution of facet areas."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxcrumple.io import Run
from jaxcrumple.measure import Facets, crease_length, fit_areas, fit_growth, segment_facets
from jaxcrumple.paper.base import Figure, Runs, save_table
from jaxcrumple.plot.facets import plot_areas, plot_facets, plot_growth
from jaxcrumple.plot.plot import about
from jaxcrumple.run.config import RunConfig, configure
from jaxcrumple.scenes.axial import AxialTimes

# Nodes, cycles and seeds for a laptop and at full size; frames per cycle.
NODES, CYCLES, SEEDS, FRAMES = (500, 2000), (4, 5), (1, 3), 10
# Height in m after the compression, and its duration in s, with equal speeds. A sheet of 500 nodes that is
# compressed further locks: most of its energy is stretching.
HEIGHT, COMPRESS = (0.07, 0.045), (0.11, 0.2)
# Number of cycles whose facets the figure shows.
SHOWN = 3


def configurations(full: bool, seeds: int) -> dict[str, RunConfig]:
    """Return a configuration for each seed, for a laptop (False) or at full size (True)."""
    settings = {
        "cycles": CYCLES[full],
        "frames": FRAMES * CYCLES[full],
        "height": HEIGHT[full],
        "compress": COMPRESS[full],
    }
    return {
        f"seed{seed}": configure("axial", nodes=NODES[full], seed=seed, settings=settings)
        for seed in range(seeds)
    }


def _runs(full: bool) -> dict[str, RunConfig]:
    return configurations(full, SEEDS[full])


def cycle_frames(run: Run) -> list[int]:
    """Return the index of the frame at the end of each cycle, when the sheet is flat again."""
    options = run.config["options"]
    times = AxialTimes(*(options[name] for name in AxialTimes._fields))
    ends = times.ends(options["cycles"])[:, -1]
    return [int(np.argmin(np.abs(run.t - end))) for end in ends if end <= run.t[-1] * (1.0 + 1e-9)]


def growth(run: Run) -> pd.DataFrame:
    """Return the crease length in m after each cycle of a run."""
    lengths = [crease_length(run.mesh, run.p[frame]) for frame in cycle_frames(run)]
    table = {"seed": run.config["seed"], "cycle": np.arange(1, len(lengths) + 1), "crease_length": lengths}
    return pd.DataFrame(table)


def _draw(runs: Runs, folder: Path) -> list[Path]:
    grown = pd.concat([growth(run) for run in runs.values()])
    fits = [
        fit_growth(own["cycle"], own["crease_length"]).reset_index().assign(seed=seed)
        for seed, own in grown.groupby("seed")
    ]
    lengths = grown.pivot(index="seed", columns="cycle", values="crease_length")
    caption = about(*runs.values())
    paths = [
        plot_growth(lengths.columns, lengths, caption=caption, path=folder / "figure_9b.png"),
        save_table(grown, folder / "figure_9b.csv"),
        save_table(pd.concat(fits), folder / "figure_9b_laws.csv"),
    ]
    rows: list[dict[str, Any]] = []
    areas: list[pd.DataFrame] = []
    for cycle, frame in enumerate(cycle_frames(next(iter(runs.values())))[:SHOWN], 1):
        facets = {name: segment_facets(run.mesh, run.p[frame]) for name, run in runs.items()}
        areas += [
            pd.DataFrame({"cycle": cycle, "run": name, "area": one.area}) for name, one in facets.items()
        ]
        paths += _draw_facets(runs, facets, cycle, frame, folder, rows)
    paths.append(save_table(pd.concat(areas), folder / "figure_9d_areas.csv"))
    return [*paths, save_table(pd.DataFrame(rows), folder / "figure_9d.csv")]


def _draw_facets(
    runs: Runs, facets: Mapping[str, Facets], cycle: int, frame: int, folder: Path, rows: list[dict[str, Any]]
) -> list[Path]:
    """Draw the facets of the first run after a cycle, and the facet areas of all runs; append table rows."""
    first = next(iter(runs.values()))
    now, after = about(first, t=first.t[frame]), f"cycle {cycle}"
    place, label = folder / f"figure_9d_facets_{cycle}.png", next(iter(facets.values())).label
    paths = [plot_facets(first.mesh, label, first.p[frame], caption=f"{now}, {after}", path=place)]
    together = np.concatenate([one.area for one in facets.values()])
    parts = [(name, one.area, 1) for name, one in facets.items()]
    for name, areas, sheets in [*parts, ("all", together, len(runs))]:
        found = {"facets": len(areas)} if len(areas) < 3 else fit_areas(areas, sheets)._asdict()
        rows.append({"cycle": cycle, "run": name, **found})
    if len(together) > 2:
        place, caption = folder / f"figure_9d_areas_{cycle}.png", f"{about(*runs.values())}, {after}"
        paths.append(plot_areas(together, len(runs), caption=caption, path=place))
    return paths


FIGURE = Figure("repeated axial crumpling: creases, facets and their areas", _runs, _draw)
