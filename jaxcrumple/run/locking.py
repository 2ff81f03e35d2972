"""Locking: a sheet whose edges are too long for the folds that its walls ask for stretches instead."""

import math
from collections.abc import Mapping

from jaxcrumple.run.config import RunConfig
from jaxcrumple.scenes.functions import scene_entry

# A crumple that bends freely stores 2 to 30 % as much energy in stretching as in bending. A sheet that locks
# stores more in stretching than in bending, and PRESSED of the elastic energy in contact and walls; a sheet
# that is merely pulled stores nothing there.
LOCKED, PRESSED = 1.0, 0.02
# Fewest edges across a fold. Sheets of 0.125 mm with 1.8 edges store 2.8 times as much energy in stretching
# as in bending (n = 1000, R = 1.9 cm); of 0.25 mm, with 2.1 edges 0.3 times and with 1.3 edges 0.7 times.
EDGES = 2.0
# Mean area of a triangle in units of the squared mean edge, and number of triangles of a node.
TRIANGLE, TRIANGLES = 3.0**0.5 / 4.0, 2.0


def is_locked(energy: Mapping[str, float]) -> bool:
    """Return whether energies by term in J are those of a sheet that locks."""
    elastic = energy["stretch"] + energy["bending"]
    pressing = energy["contact"] + energy["walls"]
    return energy["stretch"] > LOCKED * energy["bending"] and pressing > PRESSED * elastic


def locking(energy: Mapping[str, float]) -> str:
    """Say that a sheet with these energies by term in J locks; return "" if it does not."""
    if not is_locked(energy):
        return ""
    share = energy["stretch"] / (energy["stretch"] + energy["bending"])
    return f"the mesh locks: stretching holds {share:.0%} of the elastic energy"


def fold_size(area: float, radius: float) -> float:
    """Return the size in m of the folds of a sheet of `area` in m2 in a sphere of `radius` in m.

    $R^2 \\sqrt{\\pi/A}$ is the radius over the root of the number of layers $A/(\\pi R^2)$ that fill a
    cross-section of the sphere.
    """
    return radius * radius * math.sqrt(math.pi / area)


def folds(config: RunConfig, nodes: int) -> list[str]:
    """Compare the folds at the end of a run with the edges of the mesh, in one line.

    Return none without a sphere, or for a phantom sheet, whose layers need no room."""
    options = config.options
    radius = scene_entry(config.scene).confines(options, config.t_end)
    if not math.isfinite(radius) or options["contact"] is None:
        return []
    area = options["size"] ** 2
    size, edge = fold_size(area, radius), math.sqrt(area / (TRIANGLES * TRIANGLE * nodes))
    wide, across = f"{1e3 * size:.2g} mm wide at R = {1e3 * radius:.3g} mm", f"{size / edge:.1f} edges"
    line = f"folds: about {wide}, {across} of the mesh"
    if size >= EDGES * edge:
        return [line]
    least = area / (TRIANGLES * TRIANGLE * (size / EDGES) ** 2)
    return [
        f"{line}: too few. Such a mesh locks: its edges stretch where they cannot fold, and steps become "
        f"short; give at least {math.ceil(least / 100.0) * 100} nodes, or end sooner"
    ]
