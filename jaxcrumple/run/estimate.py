"""Estimate run time and memory of a run from measurements, before anything is built.

The estimate is rough: runs of one size differ tenfold with how tightly the sheet is packed, and machines
differ as well. The numbers come from docs/numbers.md, measured on one core.
"""

from pathlib import Path
from typing import NamedTuple

from jaxcrumple._jax.memory import require, require_run, run_bytes
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.run.config import RunConfig
from jaxcrumple.scenes.functions import is_function

# Time in s of a step with inertia at n = 1000, and its power law in n ("Steps": 9 to 14 ms; more with
# contact). All costs below are in units of this time.
STEP, SIZE, POWER = 0.02, 1000, 1.23
# Least time in s of a step, most of it overhead (n = 300: 9 ms), and steps that a run may take however short
# it is.
LEAST_STEP, LEAST_STEPS = 0.009, 2000.0
# Smallest and largest number of steps per second of simulated time; explicit steps count by their cost.
# Source: `radial`, phantom sheet to R = 3.4 cm: 21 and 139 s for 3.7 s at n = 1000 and 3000.
PHANTOM = (250.0, 700.0)
# The same for a self-avoiding sheet, from light contact to R = 2.6 cm: 17.6 min for 4.5 s at n = 3000.
CONTACT = (500.0, 4000.0)
# Short scenes ("Snap-through": about 290 steps in 0.05 s; "Fold angles": 9 runs in 123 s).
SCENE_STEPS = {"arch": (4000.0, 8000.0), "cap": (4000.0, 8000.0), "fold": (400.0, 1000.0)}
# Scenes that snap most of the time ("Confined in five ways": `stamping` 3.1 min for 1.5 s, `conical` 4.6 to
# 11.6 min for 1.25 to 2.25 s, `shell` 4.7 min for 0.9 s; `cylindrical`, a compressed roll, 8.5 min for 0.2 s;
# `axial` at n = 2000 95 min for five cycles).
SCENE_STEPS |= {"stamping": (4e3, 1.5e4), "conical": (7e3, 3e4), "shell": (1e4, 4e4)}
SCENE_STEPS |= {"cylindrical": (7e4, 2.5e5), "axial": (2.5e4, 1e5)}
# Default tolerance, and exponent of the number of steps against it ("Error against tolerance", `hybrid`).
TOLERANCE, TOLERANCE_POWER = 1e-2, -0.31
# Cost of a scheme relative to the default scheme ("Run time against error", "Snap-through").
SCHEMES = {"alternating": 1.4, "paper": 20.0, "explicit": 20.0}
# Smallest and largest compile time in s of a phantom and of a self-avoiding sheet ("Use").
COMPILE, COMPILE_CONTACT = (10.0, 20.0), (40.0, 60.0)


class Estimate(NamedTuple):
    """Lower and upper estimates: run time and compile time in s, and peak memory in bytes."""

    run: tuple[float, float]
    compiling: tuple[float, float]
    memory: tuple[float, float]


def estimate(config: RunConfig, nodes: int) -> Estimate:
    """Estimate roughly the cost of a run with this number of nodes."""
    # A function of the user may build contact without an option that says so.
    unknown = is_function(config.scene) and "contact" not in config.options
    touching = unknown or config.options.get("contact") is not None
    rate = SCENE_STEPS.get(config.scene, CONTACT if touching else PHANTOM)
    step = max(STEP * (nodes / SIZE) ** POWER, LEAST_STEP) * SCHEMES.get(config.solver.scheme, 1.0)
    step *= (config.solver.rtol / TOLERANCE) ** TOLERANCE_POWER
    least, most = rate[0] * config.t_end * step, max(rate[1] * config.t_end, LEAST_STEPS) * step
    compiling = COMPILE_CONTACT if touching else COMPILE
    return Estimate((least, most), compiling, run_bytes(nodes, config.frames, touching))


def file_mesh(config: RunConfig) -> Mesh | None:
    """Read the mesh file of a configuration; return None if the run generates its mesh.

    **Raises:** `MeshError` for an unusable mesh file, ValueError for one that exceeds the memory.
    """
    sheet = config.options.get("sheet", {})
    if sheet.get("shape") != "file" or sheet["remesh"]:
        return None
    path = Path(sheet["path"])
    if path.is_file():
        require(path.stat().st_size, f"the mesh file {str(path)!r}", "give a coarser mesh")
    return Mesh.from_file(path, merge=sheet["merge"], unit=sheet["unit"])


def node_count(config: RunConfig) -> int:
    """Return the number of nodes of the sheet. **Raises:** as `file_mesh`."""
    mesh = file_mesh(config)
    return config.nodes if mesh is None else mesh.n_nodes


def require_config(config: RunConfig, runs: int = 1) -> None:
    """Refuse a run that certainly exceeds the memory, before anything is built.

    **Arguments:** `runs`: number of such runs that share the memory at the same time.

    **Raises:** as `file_mesh`, and ValueError with the estimate and the cure.
    """
    touching = config.options.get("contact") is not None
    require_run(node_count(config), config.frames, touching, runs)
