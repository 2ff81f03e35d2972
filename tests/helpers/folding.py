"""A run without a simulation: a sheet that folds onto itself along the x axis, stretched along it."""

import numpy as np
import pandas as pd

from jaxcrumple import Run, configure
from jaxcrumple.solvers.log import COLUMNS, STEP


def folding_run(scene="radial", nodes=120, frames=4, rows=0, **summary):
    """A run with a crease of 0.7 at hinge 5 in its last frame, and a history of some rows."""
    config = configure(scene, nodes=nodes)
    mesh = config.build().mesh
    along, across = mesh.vertices[:, 0], mesh.vertices[:, 1]
    # The halves end up 0.4 mm apart at most.
    x = np.array(
        [
            np.stack([1.02 * along, np.abs(across) * np.sin(turn), across * np.cos(turn)], axis=1)
            for turn in np.linspace(0.0, 1.5665, frames)
        ]
    )
    p = np.tile(mesh.rest_curvature, (frames, 1))
    p[-1, 5] += 0.7
    history = pd.DataFrame(np.zeros((rows, len(COLUMNS))), columns=list(COLUMNS))
    history["t"], history["h"], history["kind"] = np.linspace(0, 0.3, rows), 1e-4, STEP
    history["bending"] = np.geomspace(1e-6, 1e-3, rows) if rows else 0.0
    history["stage"] = ["implicit"] * (rows // 2) + ["explicit"] * (rows - rows // 2)
    config = config.model_dump(mode="json")
    return Run(np.linspace(0, 0.3, frames), x, 0 * x, p, mesh, config, summary, history, pd.DataFrame())
