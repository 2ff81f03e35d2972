"""Crease length, energy and the wall's force of a crumple against mesh size and tolerance, over seeds.

`radial` at a fixed physical yield curvature. Crumples of two seeds are two crumples, so that figures are
means with the standard error over seeds; what changes from row to row by less is not resolved.

    python scripts/convergence.py [--nodes N ...] [--rtol R ...] [--seeds K] [--t-end S] [--folder DIR]
"""

from pathlib import Path

import pandas as pd
from benchlib import markdown, options, save
from matplotlib.figure import Figure

import jaxcrumple as jc
from jaxcrumple.io import RunDirectory
from jaxcrumple.measure import crease_length, wall_force
from jaxcrumple.run.run import stored_config
from jaxcrumple.sweeps.campaign import campaign
from jaxcrumple.sweeps.cases import grid

MEASURED = ("crease m", "energy mJ", "force N")
MARKERS = "osd^v<>"
STEPS = ("quasistatic", "implicit", "explicit")
# Contact of one range for all, so that meshes differ in nothing else.
COMMON = {"contact_range": 0.25e-3, "frames": 4}


def measured(folder: Path) -> dict[str, float]:
    """What the last frame of a run tells."""
    run = jc.load(folder)
    config = stored_config(RunDirectory.open(folder))
    wall = config.build().scene.walls[0]
    energy = run.summary["energy"]
    numbers = (
        crease_length(run.mesh, run.p[-1]),
        1e3 * (energy["stretch"] + energy["bending"]),
        wall_force(wall, run.x[-1], run.t[-1]),
    )
    spent = {"result": run.summary["result"], "steps": sum(run.summary["steps"][stage] for stage in STEPS)}
    about = {"nodes": run.mesh.n_nodes, "rtol": config.solver.rtol, "seed": config.seed}
    return about | dict(zip(MEASURED, numbers, strict=True)) | spent


def means(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean and standard error over seeds for each size and tolerance."""
    groups = rows.groupby(["nodes", "rtol"])
    found = {(name, what): groups[name].agg(what) for name in MEASURED for what in ("mean", "sem")}
    return pd.DataFrame(
        {**found, ("seeds", "size"): groups.size(), ("steps", "mean"): groups["steps"].mean()}
    )


def figure_of(found: pd.DataFrame) -> Figure:
    """Each figure against the mesh size, a line for each tolerance."""
    figure = Figure(figsize=(9.6, 3.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(MEASURED)), MEASURED, strict=True):
        for marker, (rtol, own) in zip(MARKERS, found.groupby(level="rtol"), strict=False):
            nodes = own.index.get_level_values("nodes")
            axes.errorbar(
                nodes,
                own[name, "mean"],
                own[name, "sem"],
                marker=marker,
                fillstyle="none",
                capsize=3,
                label=f"rtol {rtol:g}",
            )
        axes.set(xscale="log", xlabel="nodes", ylabel=name)
        axes.set_ylim(bottom=0.0)
    axes.legend()
    return figure


def main() -> None:
    """Run what is missing, and write table and figure."""
    parser = options(__doc__, (300, 500, 1000))
    parser.add_argument("--rtol", type=float, nargs="+", default=[1e-2, 1e-3])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--t-end", type=float, default=2.4, help="time in s at which they are compared")
    parser.add_argument("--folder", type=Path, default=Path("runs/convergence"), help="folder of the runs")
    opts = parser.parse_args()
    over = {"nodes": opts.nodes, "rtol": opts.rtol, "seed": list(range(opts.seeds))}
    runs = grid("radial", over, COMMON, t_end=opts.t_end)
    campaign(runs, opts.folder, tell=lambda name, result: print(name, result, flush=True))
    rows = pd.DataFrame([measured(opts.folder / name) for name in runs])
    found = means(rows)
    header = ["n", "rtol", *MEASURED, "seeds", "steps"]
    lines = [
        [nodes, f"{rtol:g}", *(f"{row[name, 'mean']:.3g} +- {row[name, 'sem']:.1g}" for name in MEASURED),
         int(row["seeds", "size"]), f"{row['steps', 'mean']:.0f}"]
        for (nodes, rtol), row in found.iterrows()
    ]  # fmt: skip
    text = markdown(header, lines) + f"\n\nt = {opts.t_end:g} s, yield curvature 200 1/m."
    save(opts, "convergence", text, figure_of(found), {}, rows.to_dict("records"))


if __name__ == "__main__":
    main()
