"""About how long a run takes, and how much memory: from what was measured, without compiling anything.

Rough: runs of one size differ tenfold with how tightly a sheet is packed, and machines by as much as these
measurements' dates do. The numbers are those of README.md, "Numbers", of one core.
"""

from typing import NamedTuple

from jaxcrumple.config import RunConfig

# Time of a step with inertia of n = 1000 in s, and the power of n that it grows with ("Steps", 16 to 24 ms).
STEP, SIZE, POWER = 0.02, 1000, 1.23
# Steps in a second of simulated time, least and most; explicit steps are counted by their time. Of `radial`:
# a phantom sheet to R = 3.4 cm took 48, 236 and 659 s for 3.7 s at n = 1000, 3000 and 12000.
PHANTOM = (400.0, 800.0)
# The same of one that avoids itself: from hardly touching to R = 2.6 cm, 28.7 min for 4.5 s at n = 3000.
CONTACT = (500.0, 5000.0)
# Scenes that are over sooner ("Snap-through": about 290 steps in 0.05 s; "Fold angles": 9 runs in 123 s).
SCENE_STEPS = {"arch": (4000.0, 8000.0), "cap": (4000.0, 8000.0), "fold": (400.0, 1000.0)}
# Scenes that snap most of the time ("Confined in five ways": 4, 7 to 24 and, a shell, 20 min for 1.5, 1.25 to
# 2.25 and 0.9 s; a roll that is compressed 11 min for 0.2 s, and at n = 2000 95 min for five cycles).
SCENE_STEPS |= {"stamping": (5e3, 2e4), "conical": (2e4, 1e5), "shell": (3e4, 1e5)}
SCENE_STEPS |= {"cylindrical": (1e5, 3e5), "axial": (3e4, 1.2e5)}
# Steps grow as this power of the tolerance from the default's on ("Error against tolerance", `hybrid`).
TOLERANCE, TOLERANCE_POWER = 1e-2, -0.31
# Times that schemes take in units of the default's ("Run time against error", "Snap-through").
SCHEMES = {"alternating": 1.4, "paper": 20.0, "explicit": 20.0}
# Compiling in s, least and most: of a phantom, and of a sheet that avoids itself ("Use").
COMPILE, COMPILE_CONTACT = (10.0, 20.0), (40.0, 60.0)
# Memory in bytes: of compiling, and for each node ("Steps": 1.2, 1.3 and 2.1 GB at n = 1000, 3000 and 12000).
MEMORY, MEMORY_NODE = 1.1e9, 8.5e4


class Estimate(NamedTuple):
    """Seconds of a run and of compiling before it, least and most, and peak memory in bytes."""

    run: tuple[float, float]
    compiling: tuple[float, float]
    memory: float


def estimate(config: RunConfig, nodes: int) -> Estimate:
    """What a run of a configuration with as many nodes takes, roughly."""
    touching = config.options.get("contact") is not None
    rate = SCENE_STEPS.get(config.scene, CONTACT if touching else PHANTOM)
    step = STEP * (nodes / SIZE) ** POWER * SCHEMES.get(config.solver.scheme, 1.0)
    step *= (config.solver.rtol / TOLERANCE) ** TOLERANCE_POWER
    least, most = (steps * config.t_end * step for steps in rate)
    compiling = COMPILE_CONTACT if touching else COMPILE
    return Estimate((least, most), compiling, MEMORY + MEMORY_NODE * nodes)
