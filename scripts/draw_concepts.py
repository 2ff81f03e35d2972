"""Draw the pictures of the page on concepts, docs/images/concept_*.jpg."""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

jax.config.update("jax_enable_x64", True)

import jaxcrumple as jc  # noqa: E402
from jaxcrumple.measure import center_of_mass, thick_section  # noqa: E402
from jaxcrumple.plot.plot import STAGE_COLORS  # noqa: E402
from jaxcrumple.solvers.log import STEP  # noqa: E402

IMAGES = Path(__file__).parents[1] / "docs" / "images"


def plain(width: float = 6.0, height: float = 3.6) -> tuple[Figure, Axes]:
    figure = Figure((width, height), layout="constrained", dpi=110)
    return figure, figure.add_subplot()


def save(figure: Figure, name: str) -> None:
    figure.savefig(IMAGES / f"concept_{name}.jpg", pil_kwargs={"quality": 85})


def sheet() -> None:
    """A mesh, with one hinge marked."""
    mesh = jc.rectangle(0.1, 0.06, 150)
    figure, axes = plain()
    x, y = 1e3 * mesh.vertices[:, :2].T
    axes.triplot(x, y, mesh.faces, color="#777777", linewidth=0.8)
    axes.plot(x, y, "o", color="#444444", markersize=3)
    offset = mesh.vertices[mesh.hinges[:, :2]].mean(axis=1) - mesh.vertices.mean(axis=0)
    a, b, c, d = mesh.hinges[np.argmin(np.linalg.norm(offset, axis=1))]
    for corners in ([a, b, c], [a, b, d]):
        axes.fill(x[corners], y[corners], color="#e8a33d", alpha=0.5)
    axes.plot(x[[a, b]], y[[a, b]], color="#d9541e", linewidth=3)
    middle = (x[[a, b]].mean(), y[[a, b]].mean())
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    axes.annotate("hinge", middle, (14, 12), textcoords="offset points", weight="bold", bbox=box)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    save(figure, "sheet")


def crumple(folder: Path) -> jc.Run:
    """The run in a folder; it is made if the folder does not exist."""
    if not folder.exists():
        config = jc.configure("radial", nodes=3000, seed=1, t_end=4.5)
        print(jc.start_run(config, folder)["result"])
    return jc.load(folder)


def stages(run: jc.Run) -> None:
    """Step size of each accepted step over time, by stage."""
    figure, axes = plain()
    steps = run.history[run.history["kind"] == STEP]
    for stage, rows in steps.groupby("stage"):
        axes.semilogy(rows["t"], rows["h"], ".", markersize=2, color=STAGE_COLORS[str(stage)], label=stage)
    axes.set(xlabel="time [s]", ylabel="step size [s]")
    axes.legend(markerscale=5, frameon=False)
    save(figure, "stages")


def contact(run: jc.Run) -> None:
    """A plane cuts the last frame."""
    figure, axes = plain(height=4.2)
    middle = center_of_mass(run.mesh, run.x[-1])
    outlines = thick_section(run.mesh, run.x[-1], 0.25e-3, middle, (0.0, 0.0, 1.0))
    axes.add_collection(PolyCollection(list(1e3 * outlines), color="#1f4e79", linewidth=0.2))
    axes.autoscale_view()
    axes.set(xlabel="[mm]", ylabel="[mm]", aspect="equal")
    save(figure, "contact")


def hinge_cycle() -> None:
    """Rest curvature of a hinge that bends to one side, back, and to the other side."""
    rule = jc.SmoothstepFlow(yield_threshold=0.3, gamma=0.0, time=1e-3)
    time = np.linspace(0.0, 4.0, 200_001)
    c = 1.2 * np.sin(0.5 * np.pi * time)

    def step(p: Array, c: Array) -> tuple[Array, Array]:
        return p + (time[1] - time[0]) * rule.rate(c, p), p

    p = np.asarray(jax.lax.scan(step, jnp.asarray(0.0), c)[1])
    figure, axes = plain()
    axes.plot(c, c - p, color="#1f4e79")
    axes.axhline(0.0, color="#bbbbbb", linewidth=0.8)
    for threshold in (-0.3, 0.3):
        axes.axhline(threshold, color="#888888", linewidth=0.8, linestyle="--")
    for part, moment in enumerate((0.45, 1.5, 3.5), start=1):
        place = np.searchsorted(time, moment)
        ahead = place + 4000
        axes.annotate(
            "",
            (c[ahead], (c - p)[ahead]),
            (c[place], (c - p)[place]),
            arrowprops={"arrowstyle": "-|>", "color": "#1f4e79", "mutation_scale": 16},
        )
        axes.annotate(str(part), (c[place], (c - p)[place]), (-14, 6), textcoords="offset points")
    released = np.flatnonzero((time > 1.0) & (c <= p))[0]
    kept = p[released]
    axes.plot(kept, 0.0, "o", color="#d9541e")
    axes.annotate(
        "released: the crease", (kept, 0.0), (-126, -14), textcoords="offset points", color="#d9541e"
    )
    axes.set(xlabel="curvature c of the hinge [-]", ylabel="c - p, proportional to the moment [-]")
    save(figure, "yield")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--run", type=Path, default=Path("runs/concepts"), help="folder of the crumple (26 min)"
    )
    run = crumple(parser.parse_args().run)
    sheet()
    hinge_cycle()
    middle = int(np.searchsorted(run.t, 2.5))
    jc.picture(run, middle, field="paper").save(IMAGES / "concept_scene.jpg")
    jc.picture(run, field="damage", walls=False).save(IMAGES / "concept_state.jpg")
    stages(run)
    contact(run)


if __name__ == "__main__":
    main()
