"""Campaigns of a few frames, written without simulating."""

import numpy as np
from run_folders import stiffness_of

import jaxcrumple as jc
from jaxcrumple.io import Frame, RunDirectory

VERSIONS = {"jaxcrumple": "0.1", "jax": "0.10"}


def write_run(place, mesh, frames, *, result="success", **options):
    """Write a run of frames (t, x, p); `result` None leaves it unfinished."""
    config = jc.configure("radial", **{"nodes": mesh.n_nodes, **options}).model_dump(mode="json")
    folder = RunDirectory.create(place, config, mesh, stiffness_of(mesh))
    for t, x, p in frames:
        folder.save_frame(*Frame(t, x, np.zeros_like(x), p))
    folder.commit({"t": 0.0}, {"t": 0.0})
    if result is not None:
        folder.finish({"result": result, "message": "told", "versions": VERSIONS})


def write_campaign(place, seeds=range(10), frames=2):
    """Write a campaign of discs of various sizes, one for each seed, in random shapes; return its meshes and
    frames by name."""
    rng, written = np.random.default_rng(0), {}
    for seed in seeds:
        mesh = jc.disc(0.05, 40 + 3 * seed, seed=seed, sweeps=3)
        shapes = [
            (
                0.5 * k,
                mesh.vertices + 1e-3 * rng.normal(size=(mesh.n_nodes, 3)),
                rng.normal(size=len(mesh.hinges)),
            )
            for k in range(frames)
        ]
        thickness = 1e-4 * (1 + seed % 2)
        write_run(place / f"seed={seed}", mesh, shapes, seed=seed, settings={"thickness": thickness})
        written[f"seed={seed}"] = mesh, shapes
    return written
