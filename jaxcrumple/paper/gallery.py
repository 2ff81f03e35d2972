"""Fig. 7: five ways to confine a sheet."""

from pathlib import Path

from jaxcrumple.paper.base import Figure, Runs, save_table
from jaxcrumple.paper.panels import Moment, plot_moments, table_of
from jaxcrumple.run.config import RunConfig, configure

# Name, scene, end time in s (None: the scene's), settings.
CASES = {
    "radial": ("radial", 2.6, {"thickness": 0.125e-3}),
    "cylindrical": ("cylindrical", None, {}),
    "stamping": ("stamping", None, {}),
    "conical, low": ("conical", None, {"pull": 0.025}),
    "conical, high": ("conical", None, {"pull": 0.045}),
}
NODES = (1000, 3000)


def _runs(full: bool) -> dict[str, RunConfig]:
    return {
        name: configure(scene, nodes=NODES[full], t_end=t_end, settings=settings)
        for name, (scene, t_end, settings) in CASES.items()
    }


def _draw(runs: Runs, folder: Path) -> list[Path]:
    shown = [Moment(name, run, len(run.t) - 1) for name, run in runs.items()]
    first = next(iter(runs.values()))
    caption = (
        f"n = {first.mesh.n_nodes}, seed {first.config['seed']}, rtol {first.config['solver']['rtol']:g}"
    )
    picture = plot_moments(shown, caption, folder / "figure_7.png")
    return [picture, save_table(table_of(shown), folder / "figure_7.csv")]


FIGURE = Figure("sheets confined in five ways", _runs, _draw)
