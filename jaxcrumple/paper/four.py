"""Fig. 8c: phantom and self-avoiding sheets, elastic and elastoplastic."""

import itertools
from pathlib import Path

import pandas as pd

from jaxcrumple.contact.potentials import DEFAULT_POTENTIAL
from jaxcrumple.io import Run
from jaxcrumple.measure import face_bending_density, localization
from jaxcrumple.paper.base import Figure, Runs, save_table
from jaxcrumple.paper.panels import Moment, plot_moments, table_of
from jaxcrumple.run.config import MaterialOptions, RunConfig, configure

# Option values of the four cases.
CONTACT = {"phantom": None, "self-avoiding": DEFAULT_POTENTIAL}
YIELD = {"elastic": None, "elastoplastic": 200.0}
NODES, T_END = (1000, 3000), (2.6, 3.7)


def _runs(full: bool) -> dict[str, RunConfig]:
    return {
        f"{avoids}, {yields}": configure(
            "radial",
            nodes=NODES[full],
            t_end=T_END[full],
            settings={"contact": CONTACT[avoids], "yield_curvature": YIELD[yields]},
        )
        for avoids, yields in itertools.product(CONTACT, YIELD)
    }


def bending_localization(run: Run) -> float:
    """Return the share of the area that holds half of the bending energy in the last frame."""
    constants = MaterialOptions(**run.config["material"]).build().discretize(run.mesh)
    stiffness = constants.kb * run.mesh.hinge_weight
    return localization(run.mesh, face_bending_density(run.mesh, run.x[-1], run.p[-1], stiffness))


def _draw(runs: Runs, folder: Path) -> list[Path]:
    shown = [Moment(name, run, len(run.t) - 1) for name, run in runs.items()]
    first = next(iter(runs.values()))
    caption = (
        f"radial, n = {first.mesh.n_nodes}, seed {first.config['seed']}, rtol "
        f"{first.config['solver']['rtol']:g}, t = {first.t[-1]:.3g} s"
    )
    more = {
        "half_of_bending_on": [bending_localization(run) for run in runs.values()],
        "intersections": [run.summary["intersections"] for run in runs.values()],
        "cpu_s": [run.summary["cpu_s"] for run in runs.values()],
    }
    table = pd.concat([table_of(shown), pd.DataFrame(more)], axis=1)
    picture = plot_moments(shown, caption, folder / "figure_8c.png")
    return [picture, save_table(table, folder / "figure_8c.csv")]


FIGURE = Figure("phantom and self-avoiding, elastic and elastoplastic sheets", _runs, _draw)
