"""Fig. 4: node order along a Hilbert curve, and density of the tangent near its diagonal."""

from pathlib import Path

import numpy as np
import pandas as pd
import scipy.sparse as sparse
from jaxtyping import Int
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.paper.base import Figure, Runs, save_table
from jaxcrumple.plot.figure import new_figure, save_figure

NODES, SIZE = 3000, 0.1
# Sizes of the diagonal blocks in (c) and (d), and half the size of the middle part of the pattern in (b).
BLOCKS, MIDDLE = np.unique(np.geomspace(3, 1500, 40).astype(int)), 200


def coupling(mesh: Mesh) -> sparse.csr_array:
    """Return the sparsity pattern (n, n) of coupled nodes: nodes of a triangle, and nodes of a hinge."""
    rows = [np.repeat(table, table.shape[1], axis=1) for table in (mesh.faces, mesh.hinges)]
    columns = [np.tile(table, (1, table.shape[1])) for table in (mesh.faces, mesh.hinges)]
    row, column = (np.concatenate([part.ravel() for part in parts]) for parts in (rows, columns))
    pattern = sparse.coo_array((np.ones(len(row), bool), (row, column)), shape=(mesh.n_nodes,) * 2)
    return sparse.csr_array(pattern)


def share_in_blocks(pattern: sparse.csr_array, order: Int[np.ndarray, " nodes"], size: int) -> float:
    """Return the share of the entries inside diagonal blocks of `size` nodes, for a node order (n,)."""
    place = np.argsort(order)
    row, column = (place[part] // size for part in pattern.nonzero())
    return float(np.mean(row == column))


def share_of_blocks(pattern: sparse.csr_array, order: Int[np.ndarray, " nodes"], size: int) -> float:
    """Return the filled share of the diagonal blocks of `size` nodes, for a node order (n,)."""
    whole, rest = divmod(len(order), size)
    return share_in_blocks(pattern, order, size) * pattern.nnz / (whole * size**2 + rest**2)


def _draw(runs: Runs, folder: Path) -> list[Path]:
    mesh = rectangle(SIZE, SIZE, NODES)
    pattern = coupling(mesh)
    orders = {
        "y coordinate": np.argsort(mesh.vertices[:, 1]),
        "reverse Cuthill-McKee": reverse_cuthill_mckee(sparse.csr_matrix(pattern), symmetric_mode=True),
        "Hilbert curve": np.arange(NODES),
    }
    table = pd.DataFrame({"block": BLOCKS})
    for name, order in orders.items():
        table[name] = [share_in_blocks(pattern, order, size) for size in BLOCKS]
        table[f"{name}: filled"] = [share_of_blocks(pattern, order, size) for size in BLOCKS]
    figure = new_figure((9.6, 6.4), f"n = {NODES}, seed 0; no run, no tolerance")
    axes = figure.subplots(2, 3)
    axes[0, 0].plot(*(1e3 * mesh.vertices[:, :2].T), lw=0.5)
    axes[0, 0].set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]", title="order of the nodes")
    for place, (name, order) in zip((axes[0, 1], axes[0, 2], axes[1, 0]), orders.items(), strict=True):
        middle = order[NODES // 2 - MIDDLE : NODES // 2 + MIDDLE]
        place.spy(pattern[middle][:, middle], markersize=0.4)
        place.set(title=name, xticks=[], yticks=[])
        axes[1, 1].plot(BLOCKS, table[name], label=name)
        axes[1, 2].plot(BLOCKS, table[f"{name}: filled"], label=name)
    axes[1, 1].set(xscale="log", xlabel="nodes of a block", ylabel="entries within diagonal blocks")
    axes[1, 1].legend(fontsize=8)
    axes[1, 2].set(xscale="log", yscale="log", xlabel="nodes of a block", ylabel="diagonal blocks filled")
    return [save_figure(figure, folder / "figure_4.png"), save_table(table, folder / "figure_4.csv")]


FIGURE = Figure("order of the nodes, and the tangent's entries near its diagonal", lambda full: {}, _draw)
