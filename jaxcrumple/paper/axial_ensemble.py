"""Fig. 9b for an ensemble: growth of the crease length of sheets that differ in their seeds."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from jaxcrumple.measure import ensemble_growth
from jaxcrumple.paper.axial import configurations, growth
from jaxcrumple.paper.base import Ensemble, Runs, save_table
from jaxcrumple.plot.ensembles import plot_ensemble_growth
from jaxcrumple.plot.plot import about, spans

SEEDS = 24


def _draw(runs: Runs, left_out: Mapping[str, str], folder: Path) -> list[Path]:
    missing = {_seed(name): result for name, result in left_out.items()}
    grown = pd.concat([growth(run) for run in runs.values()]).assign(result="success")
    lengths = grown.pivot(index="seed", columns="cycle", values="crease_length")
    found = ensemble_growth(lengths.columns, lengths)
    absent = pd.DataFrame({"seed": list(missing), "result": list(missing.values())})
    table = pd.concat([grown, absent])[["seed", "result", "cycle", "crease_length"]]
    caption = "\n".join([about(*runs.values()), *_told(missing)])
    return [
        plot_ensemble_growth(
            lengths.columns, lengths, caption=caption, path=folder / "figure_9_ensemble.png"
        ),
        save_table(table.astype({"cycle": "Int64"}), folder / "figure_9_ensemble.csv"),
        save_table(found.cycles.reset_index(), folder / "figure_9_ensemble_cycles.csv"),
        save_table(found.laws.reset_index(), folder / "figure_9_ensemble_laws.csv"),
    ]


def _seed(name: str) -> int:
    return int(name.removeprefix("seed"))


def _told(left_out: Mapping[int, str]) -> list[str]:
    """Return a line for each result of seeds that were left out."""
    seeds: dict[str, list[int]] = {}
    for seed, result in left_out.items():
        seeds.setdefault(result, []).append(seed)
    return [
        f"left out, {result}: seed{'s' if len(found) > 1 else ''} {' '.join(spans(found))}"
        for result, found in seeds.items()
    ]


ENSEMBLE = Ensemble(
    "growth of the crease length of repeatedly crumpled sheets",
    lambda full: configurations(full, SEEDS),
    _draw,
)
