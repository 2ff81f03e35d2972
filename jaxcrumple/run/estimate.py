"""About how long a run takes, and how much memory: from what was measured, before anything is built.

Rough: runs of one size differ tenfold with how tightly a sheet is packed, and machines by as much as these
measurements' dates do. The numbers are those of README.md, "Numbers", of one core.
"""

from pathlib import Path
from typing import NamedTuple

from jaxcrumple._jax.memory import require, require_run, run_bytes
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.run.config import RunConfig

# Time of a step with inertia of n = 1000 in s, and the power of n that it grows with ("Steps": 9 to 14 ms;
# more with contact), in which all below is counted.
STEP, SIZE, POWER = 0.02, 1000, 1.23
# Steps in a second of simulated time, least and most; explicit steps are counted by their time. Of `radial`:
# a phantom sheet to R = 3.4 cm took 21 and 139 s for 3.7 s at n = 1000 and 3000.
PHANTOM = (250.0, 700.0)
# The same of one that avoids itself: from hardly touching to R = 2.6 cm, 17.6 min for 4.5 s at n = 3000.
CONTACT = (500.0, 4000.0)
# Scenes that are over sooner ("Snap-through": about 290 steps in 0.05 s; "Fold angles": 9 runs in 123 s).
SCENE_STEPS = {"arch": (4000.0, 8000.0), "cap": (4000.0, 8000.0), "fold": (400.0, 1000.0)}
# Scenes that snap most of the time ("Confined in five ways": 3.1, 4.6 to 11.6 and, a shell, 4.7 min for
# 1.5, 1.25 to 2.25 and 0.9 s; a roll that is compressed 8.5 min for 0.2 s; at n = 2000 95 min for five
# cycles).
SCENE_STEPS |= {"stamping": (4e3, 1.5e4), "conical": (7e3, 3e4), "shell": (1e4, 4e4)}
SCENE_STEPS |= {"cylindrical": (7e4, 2.5e5), "axial": (2.5e4, 1e5)}
# Steps grow as this power of the tolerance from the default's on ("Error against tolerance", `hybrid`).
TOLERANCE, TOLERANCE_POWER = 1e-2, -0.31
# Times that schemes take in units of the default's ("Run time against error", "Snap-through").
SCHEMES = {"alternating": 1.4, "paper": 20.0, "explicit": 20.0}
# Compiling in s, least and most: of a phantom, and of a sheet that avoids itself ("Use").
COMPILE, COMPILE_CONTACT = (10.0, 20.0), (40.0, 60.0)


class Estimate(NamedTuple):
    """Seconds of a run and of compiling before it, and peak memory in bytes, least and most."""

    run: tuple[float, float]
    compiling: tuple[float, float]
    memory: tuple[float, float]


def estimate(config: RunConfig, nodes: int) -> Estimate:
    """What a run of a configuration with as many nodes takes, roughly."""
    touching = config.options.get("contact") is not None
    rate = SCENE_STEPS.get(config.scene, CONTACT if touching else PHANTOM)
    step = STEP * (nodes / SIZE) ** POWER * SCHEMES.get(config.solver.scheme, 1.0)
    step *= (config.solver.rtol / TOLERANCE) ** TOLERANCE_POWER
    least, most = (steps * config.t_end * step for steps in rate)
    compiling = COMPILE_CONTACT if touching else COMPILE
    return Estimate((least, most), compiling, run_bytes(nodes, config.frames, touching))


def file_mesh(config: RunConfig) -> Mesh | None:
    """The mesh of a file that is the sheet of a configuration; None for a sheet that is generated.

    **Raises:** `MeshError` for a mesh file that cannot be used, ValueError for one that exceeds the memory.
    """
    sheet = config.options.get("sheet", {})
    if sheet.get("shape") != "file" or sheet["remesh"]:
        return None
    path = Path(sheet["path"])
    if path.is_file():
        require(path.stat().st_size, f"the mesh file {str(path)!r}", "give a coarser mesh")
    return Mesh.from_file(path, merge=sheet["merge"], unit=sheet["unit"])


def node_count(config: RunConfig) -> int:
    """Number of nodes of a configuration's sheet. **Raises:** as `file_mesh`."""
    mesh = file_mesh(config)
    return config.nodes if mesh is None else mesh.n_nodes


def require_config(config: RunConfig, runs: int = 1) -> None:
    """Refuse a run, or so many `runs` of its kind side by side, that surely exceeds the memory, before any of
    it is built.

    **Raises:** as `file_mesh`, and ValueError with the estimate and the cure.
    """
    touching = config.options.get("contact") is not None
    require_run(node_count(config), config.frames, touching, runs)
