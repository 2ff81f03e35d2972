"""Phantom against self-avoiding sheets, elastic against elastoplastic (Fig. 8c): four runs and one figure.

The crease patterns at the end of `radial`, on the flat sheet, with one colour scale; and a table of how far
curvature is localized: the share of the area that holds half of the bending energy.

    python scripts/four_crumples.py [--nodes N ...] [--t-end S] [--workers W] [--resume]
"""

import itertools
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from benchlib import markdown, options, save
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

import jaxcrumple as jc
from jaxcrumple.config import MaterialOptions
from jaxcrumple.measure import face_bending_density, localization, mean_curvature

# Values of the options that make the four.
CONTACT = {"phantom": "none", "self-avoiding": "penalty"}
YIELD = {"elastic": "none", "elastoplastic": "200"}
# Colours span the curvatures of this share of the nodes.
SHOWN = 0.95


def run(nodes: int, contact: str, material: str, t_end: float, resume: bool) -> Path:
    """One run by the command line; its folder."""
    folder = Path("runs/four") / f"{nodes}_{contact}_{material}"
    command = [
        sys.executable,
        "-m",
        "jaxcrumple",
        "run",
        "radial",
        "--nodes",
        str(nodes),
        "--out",
        str(folder),
    ]
    command += ["--t-end", str(t_end), "--set", f"contact={CONTACT[contact]}"]
    command += ["--set", f"yield_curvature={YIELD[material]}"]
    if folder.exists() and resume:
        command.append("--resume")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_suffix(".txt").open("w") as log:
        subprocess.run(command, check=True, stdout=log, stderr=subprocess.STDOUT)
    return folder


def bending(result: jc.Run) -> np.ndarray:
    """Bending energy per area of the faces at the end, in J/m2."""
    mesh, material = result.mesh, MaterialOptions(**result.config["material"]).build()
    stiffness = material.discretize(mesh).kb * mesh.hinge_weight
    return face_bending_density(mesh, result.x[-1], result.p[-1], stiffness)


def row(result: jc.Run, contact: str, material: str) -> dict:
    """What the table says of a run."""
    summary = result.summary
    energy = {name: 1e3 * summary["energy"][name] for name in ("stretch", "bending")}
    return {
        "nodes": result.mesh.n_nodes, "sheet": f"{contact}, {material}", "result": summary["result"],
        "cpu_min": summary["cpu_s"] / 60.0, **energy, "half": localization(result.mesh, bending(result)),
        "crease_m": summary["crease_length"], "intersections": summary.get("intersections"),
    }  # fmt: skip


def table(rows: list[dict]) -> str:
    """The runs in numbers."""
    header = ["n", "sheet", "result", "CPU min", "stretch mJ", "bending mJ", "half of it on", "creases m"]
    header.append("intersections")
    lines = [
        [
            r["nodes"], r["sheet"], r["result"], f"{r['cpu_min']:.1f}", f"{r['stretch']:.1f}",
            f"{r['bending']:.1f}", f"{100 * r['half']:.1f} %", f"{r['crease_m']:.2f}",
            "-" if r["intersections"] is None else r["intersections"],
        ]
        for r in rows
    ]  # fmt: skip
    return markdown(header, lines)


def figure_of(runs: dict[tuple[str, str], jc.Run], title: str) -> Figure:
    """The four crease patterns."""
    figure = Figure(figsize=(8.2, 7.4), layout="constrained")
    curvature = {key: mean_curvature(r.mesh, r.x[-1]) for key, r in runs.items()}
    limit = np.quantile(np.abs(np.concatenate(list(curvature.values()))), SHOWN)
    grid = figure.subplots(
        len(CONTACT), len(YIELD), subplot_kw={"aspect": "equal", "xticks": [], "yticks": []}
    )
    for axes, (key, r) in zip(grid.flat, runs.items(), strict=True):
        flat = 1e3 * r.mesh.vertices
        sheet = Triangulation(flat[:, 0], flat[:, 1], r.mesh.faces)
        colors = axes.tripcolor(
            sheet, curvature[key], shading="gouraud", cmap="RdBu_r", vmin=-limit, vmax=limit
        )
        axes.set_title(", ".join(key))
    figure.colorbar(colors, ax=grid, label="mean curvature [1/m]", shrink=0.7, extend="both")
    figure.suptitle(title)
    return figure


def main() -> None:
    """Run, and write table and figure."""
    parser = options(__doc__, (3000,), resumable=True)
    parser.add_argument("--t-end", type=float, default=3.7, help="time in s at which they are compared")
    parser.add_argument("--workers", type=int, default=2, help="runs at a time")
    opts = parser.parse_args()
    for nodes in opts.nodes:
        keys = list(itertools.product(CONTACT, YIELD))
        with ThreadPoolExecutor(opts.workers) as pool:
            folders = list(pool.map(lambda key, n=nodes: run(n, *key, opts.t_end, opts.resume), keys))
        runs = {key: jc.load(folder) for key, folder in zip(keys, folders, strict=True)}
        rows = [row(r, *key) for key, r in runs.items()]
        title = f"R = {7.1 - opts.t_end:.2g} cm, n = {nodes}, rtol = 1e-2"
        save(opts, f"four_crumples_{nodes}", table(rows), figure_of(runs, title), {}, rows)


if __name__ == "__main__":
    main()
