"""How fast a loader reads the samples of a data set in random order, and how large they are.

Runs of a crumpled sheet are written without simulating: the sheet on waves of random amplitude, with damage
along random lines. The files are in the cache of the system, as from the second epoch on.

    python scripts/bench_dataset.py [--nodes N] [--samples COUNT] [--pixels P]
"""

import tempfile
import time
from pathlib import Path

import numpy as np
import zarr
from benchlib import markdown, options, save

import jaxcrumple as jc
from jaxcrumple.io import RunDirectory

FRAMES = 10


def write_runs(folder: Path, nodes: int, count: int) -> None:
    """Write so many runs of `FRAMES` frames, each with a mesh of its own."""
    rng = np.random.default_rng(0)
    for seed in range(count):
        mesh = jc.rectangle(0.1, 0.1, nodes, seed=seed, sweeps=3)
        config = jc.configure("radial", nodes=nodes, seed=seed).model_dump(mode="json")
        stiffness = np.ones(len(mesh.edges)), np.ones(len(mesh.hinges))
        run = RunDirectory.create(folder / f"seed={seed}", config, mesh, stiffness)
        u, w = mesh.vertices[:, :2].T
        middle = mesh.vertices[mesh.hinges[:, :2], :2].mean(axis=1)
        for k in range(FRAMES):
            a, b, c = rng.normal(size=3)
            x = mesh.vertices + 1e-3 * np.outer(np.sin(100 * (a * u + b * w)), [0, 0, 1])
            p = np.where(np.abs(np.sin(100 * (middle @ [b, c]))) < 0.1, a, 0.0)
            run.save_frame(k, x, np.zeros_like(x), p)
        run.commit({"t": 0.0}, {"t": 0.0})
        run.finish({"result": "success", "message": "", "versions": {}})


def clocks() -> np.ndarray:
    """Seconds of the wall clock, and of the CPU by all threads."""
    return np.array([time.perf_counter(), time.process_time()])


def rates(read, count: int) -> np.ndarray:
    """Samples per second of both clocks in random order, the best of five epochs."""
    found = []
    for epoch in range(5):
        order, start = np.random.default_rng(epoch).permutation(count), clocks()
        for sample in order:
            read(sample)
        found.append(count / (clocks() - start))
    return np.max(found, axis=0)


def main() -> None:
    """Write, export, read; print and save."""
    parser = options(__doc__ or "", [1000])
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--pixels", type=int, default=64)
    opts = parser.parse_args()
    # Eight of ten seeds are for training.
    runs = 10 * -(-opts.samples // (8 * FRAMES))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_runs(folder / "runs", opts.nodes[0], runs)
        start = clocks()
        card = jc.export_dataset(folder / "runs", folder / "data", pixels=opts.pixels)
        exported = sum(split["samples"] for split in card["splits"].values()) / (clocks() - start)
        train = zarr.open_group(folder / "data" / "data.zarr" / "train", mode="r")
        maps, x, rows = train["maps"], train["x"], train["rows"][:][train["run"][:]]
        count = opts.samples
        found = {
            "export": exported,
            "maps, shuffled": rates(lambda i: maps[i], count),
            "maps and positions of nodes, shuffled": rates(lambda i: (maps[i], x[i, : rows[i, 0]]), count),
            "all maps at once": count * rates(lambda i: maps[:count], 1),
        }
        size = maps.nbytes_stored() / maps.shape[0]
    table = [[name, *(f"{value:.0f}" for value in pair)] for name, pair in found.items()]
    of = f"{count} samples of {opts.pixels} x {opts.pixels} pixels and {opts.nodes[0]} nodes"
    text = f"{markdown(['what', 'samples/s', 'samples/CPU s'], table)}\n\n{of}, {size / 1e3:.0f} kB of maps "
    text += f"each on disk; one process, zarr {zarr.__version__}."
    save(opts, "dataset", text, None, {name: float(pair[1]) for name, pair in found.items()}, table)


if __name__ == "__main__":
    main()
