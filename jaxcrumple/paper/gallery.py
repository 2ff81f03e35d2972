"""Fig. 7: five ways to confine a sheet."""

from pathlib import Path

from jaxcrumple.io import Run
from jaxcrumple.paper.base import Figure, Runs, save_table
from jaxcrumple.paper.panels import Moment, plot_moments, table_of
from jaxcrumple.paper.radial import THIN, THIN_END
from jaxcrumple.run.config import RunConfig, configure

# Name, scene, end times in s for a laptop and at the paper's size (None: the scene's), settings.
CASES = {
    "radial": ("radial", (4.5, THIN_END), THIN),
    "cylindrical": ("cylindrical", (None, None), {}),
    "stamping": ("stamping", (None, None), {}),
    "conical, low": ("conical", (None, None), {"pull": 0.025}),
    "conical, high": ("conical", (None, None), {"pull": 0.045}),
}
NODES = (1000, 3000)


def _runs(full: bool) -> dict[str, RunConfig]:
    return {
        name: configure(scene, nodes=NODES[full], t_end=ends[full], settings=settings)
        for name, (scene, ends, settings) in CASES.items()
    }


def _draw(runs: Runs, folder: Path) -> list[Path]:
    shown = [Moment(_title(name, run), run, len(run.t) - 1) for name, run in runs.items()]
    first = next(iter(runs.values()))
    tolerances = sorted({run.config["solver"]["rtol"] for run in runs.values()})
    words = " and ".join(f"{rtol:g}" for rtol in tolerances)
    caption = f"n = {first.mesh.n_nodes}, seed {first.config['seed']}, rtol {words}"
    picture = plot_moments(shown, caption, folder / "figure_7.png")
    table = table_of(shown).assign(panel=list(runs), cpu_s=[run.summary["cpu_s"] for run in runs.values()])
    return [picture, save_table(table, folder / "figure_7.csv")]


def _title(name: str, run: Run) -> str:
    """Return the name of a panel, the radius of a sphere at the end, and the CPU time."""
    options, words = run.config["options"], [f"{run.summary['cpu_s'] / 60:.2g} CPU min"]
    if run.config["scene"] == "radial":
        words.insert(0, f"R = {100 * (options['radius'] - options['speed'] * run.t[-1]):.2g} cm")
    return f"{name}\n{', '.join(words)}"


FIGURE = Figure("sheets confined in five ways", _runs, _draw)
