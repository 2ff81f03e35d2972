"""Read the output of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple._jax.memory import FRAME, require
from jaxcrumple.io.atomic import RunDirectoryError
from jaxcrumple.io.rundir import RunDirectory
from jaxcrumple.mesh.mesh import Mesh

if TYPE_CHECKING:
    from jaxcrumple.scene import Scene
    from jaxcrumple.simulation import Solution

# Maximum number of attempts to read a folder that changes during the read.
TRIES = 10


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """The output of a run, finished or not: what `load` reads, or `Run.from_solution` makes.

    - Frames: times `t` (f,) in s, positions `x` (f, n, 3) in m, velocities `v` (f, n, 3) in m/s, rest
      curvatures `p` (f, h), which are those of the mesh if the sheet is elastic.
    - `mesh`: the `Mesh`. `config`: settings of the run. `summary`: final result, empty if the run is in
      progress or was killed.
    - `history`: table with one row per logged step, in SI units. Its column `kind` is 0 for a step, 1 for the
      last state of a stage and 2 for the first state of the next stage. `events`: table of changes of stage.
    - `scene`: scene of a run in memory, else None, because `config` describes that of a folder.
    """

    t: Float[np.ndarray, " frames"]
    x: Float[np.ndarray, "frames nodes 3"]
    v: Float[np.ndarray, "frames nodes 3"]
    p: Float[np.ndarray, "frames hinges"]
    mesh: Mesh
    config: dict[str, Any]
    summary: dict[str, Any]
    history: pd.DataFrame
    events: pd.DataFrame
    scene: Scene | None = None

    @classmethod
    def from_solution(cls, mesh: Mesh, scene: Scene, solution: Solution) -> Run:
        """Return what `simulate` returned as a run, for pictures, films and pages.

        **Arguments:** `mesh`, `scene`: those of the `solution`.

        **Raises:** ValueError if the solution has no frames, or frames of another mesh.
        """
        if len(solution.t) == 0:
            raise ValueError("the solution has no frames: its run ended before the first time asked for.")
        if solution.x.shape[1] != mesh.n_nodes:
            raise ValueError(
                f"the solution has {solution.x.shape[1]} nodes and the mesh {mesh.n_nodes}: "
                "give the mesh of its scene."
            )
        elastic = np.broadcast_to(mesh.rest_curvature, (len(solution.t), len(mesh.hinges)))
        return cls(
            t=solution.t,
            x=solution.x,
            v=solution.v,
            p=elastic if solution.p is None else solution.p,
            mesh=mesh,
            config={},
            summary={"result": solution.result},
            history=solution.history,
            events=solution.events,
            scene=scene,
        )

    def __repr__(self) -> str:
        scene, result = self.config.get("scene", "in memory"), self.summary.get("result", "unfinished")
        shown = f"{len(self.t)} frames to t = {self.t[-1]:.4g} s" if len(self.t) else "no frames"
        return f"Run({scene}, n = {self.mesh.n_nodes}, {shown}, {result})"


def load(path: str | Path) -> Run:
    """Read the output folder of a run, with all frames, into memory and verify the checksums.

    For a run in progress, return its state at the last checkpoint.

    **Raises:** `RunDirectoryError` if the folder is missing, is not a run or has no frames yet, or if one of
    its files is missing or damaged.
    """
    for _ in range(TRIES):
        folder = RunDirectory.open(path)
        try:
            return _read(folder)
        except RunDirectoryError:
            # A concurrent run that returns to an earlier checkpoint deletes files of the old manifest.
            if RunDirectory.open(path).manifest == folder.manifest:
                raise
    raise RunDirectoryError(f"run {str(path)!r} changes faster than it can be read; try again")


def _read(folder: RunDirectory) -> Run:
    count = len(folder.frames())
    if count == 0:
        why = "ended before its first frame" if folder.finished else "has no frames yet; wait for the first"
        raise RunDirectoryError(f"run {str(folder.path)!r} {why}")
    mesh = folder.load_mesh()
    what = f"a run of {mesh.n_nodes} nodes with {count} frames"
    require(FRAME * mesh.n_nodes * count, what, "read frames one by one with RunDirectory.load_frames")
    frames = list(folder.load_frames())
    return Run(
        t=np.array([frame.t for frame in frames]),
        x=np.stack([frame.x for frame in frames]),
        v=np.stack([frame.v for frame in frames]),
        p=np.stack([mesh.rest_curvature if frame.p is None else frame.p for frame in frames]),
        mesh=mesh,
        config=folder.config,
        summary=folder.read_summary(),
        history=folder.read_history(),
        events=folder.read_events(),
    )
