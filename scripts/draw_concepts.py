"""Draw the pictures of the page on concepts, docs/images/concept_*.jpg."""

import argparse
import tempfile
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

IMAGES = Path(__file__).parents[1] / "docs" / "images"
COLORS = {"implicit": "#e8a33d", "explicit": "#d9541e", "quasistatic": "#1f6fb4"}


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


def crumple(nodes: int) -> jc.Run:
    config = jc.configure("radial", nodes=nodes, t_end=3.2, settings={"frames": 16})
    folder = tempfile.mkdtemp() + "/radial"
    print(jc.start_run(config, folder)["result"])
    return jc.load(folder)


def stages(run: jc.Run) -> None:
    """Step size of each accepted step over time, by stage."""
    figure, axes = plain()
    steps = run.history[run.history["kind"] == 0]
    for stage, rows in steps.groupby("stage"):
        axes.semilogy(rows["t"], rows["h"], ".", markersize=2, color=COLORS[str(stage)], label=stage)
    axes.set(xlabel="time [s]", ylabel="step size [s]")
    axes.legend(markerscale=5, frameon=False)
    save(figure, "stages")


def contact(run: jc.Run) -> None:
    """A plane cuts the last frame."""
    figure, axes = plain(height=4.2)
    middle = center_of_mass(run.mesh, run.x[-1])
    outlines = thick_section(run.mesh, run.x[-1], 0.25e-3, middle, (1.0, 0.0, 0.0))
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
    kept = p[len(time) // 2]
    axes.plot(kept, 0.0, "o", color="#d9541e")
    axes.annotate("released: the crease", (kept, 0.0), (-128, 6), textcoords="offset points", color="#d9541e")
    axes.set(xlabel="curvature c of the hinge [-]", ylabel="c - p, proportional to the moment [-]")
    save(figure, "yield")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=1000)
    nodes = parser.parse_args().nodes
    sheet()
    hinge_cycle()
    run = crumple(nodes)
    jc.picture(run, len(run.t) // 2, field="paper", pixels=560).save(IMAGES / "concept_scene.jpg")
    jc.picture(run, field="damage", pixels=560).save(IMAGES / "concept_state.jpg")
    stages(run)
    contact(run)


if __name__ == "__main__":
    main()
