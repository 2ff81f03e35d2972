"""Draw the picture of README.md: a crumple at three moments, and its crease pattern below each.

    python scripts/show_crumple.py FOLDER OUT.png [TIME ...]

FOLDER is that of a run of `jaxcrumple run`; TIMEs in s are by default three from the first contact on.
"""

import argparse
from pathlib import Path

import numpy as np

import jaxcrumple as jc
from jaxcrumple.measure import mean_curvature
from jaxcrumple.plot.figure import new_figure, save_figure
from jaxcrumple.plot.plot import draw_flat
from jaxcrumple.plot.sheet import CURVATURE_LABEL, color_scale


def main() -> None:
    """Read the arguments, and write the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("times", type=float, nargs="*")
    asked = parser.parse_args()
    run = jc.load(asked.folder)
    times = asked.times or run.t[-1] * np.array([0.5, 0.75, 1.0])
    frames = [int(np.argmin(np.abs(run.t - t))) for t in times]
    figure = new_figure((3.6 * len(frames) + 0.8, 6.4), "")
    curvature = [mean_curvature(run.mesh, run.x[frame]) for frame in frames]
    scale, maps = color_scale(*curvature, signed=True), []
    for column, (frame, values) in enumerate(zip(frames, curvature, strict=True)):
        space = figure.add_subplot(2, len(frames), column + 1)
        jc.picture(run, frame, field="paper", walls=False, axes=space, pixels=700)
        flat = figure.add_subplot(2, len(frames), len(frames) + column + 1, aspect="equal")
        flat.set_axis_off()
        draw_flat(flat, run.mesh, scale, values)
        maps.append(flat)
    figure.colorbar(scale, ax=maps, label=CURVATURE_LABEL, extend="both", shrink=0.8)
    print(save_figure(figure, asked.out))


if __name__ == "__main__":
    main()
