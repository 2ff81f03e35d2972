"""Describe and check a run before it starts."""

import numpy as np

from jaxcrumple._jax.memory import gigabytes, memory_limit
from jaxcrumple.mesh.isotropy import patch_test
from jaxcrumple.run.balance import Balance, start_balance
from jaxcrumple.run.config import RunConfig
from jaxcrumple.run.estimate import estimate, file_mesh, require_config
from jaxcrumple.run.locking import folds
from jaxcrumple.run.pace import duration
from jaxcrumple.scenes.functions import scene_entry
from jaxcrumple.state import initial_state


def described(config: RunConfig) -> list[str]:
    """Describe scene, sheet, walls, contact, material, solver, end time, folds and estimated cost, one per
    line.

    `check_built` covers what only the built scene shows, such as a wall that leaves no room for the sheet.

    **Raises:** `MeshError` for an unusable mesh file.
    """
    mesh, options = file_mesh(config), config.options
    nodes = config.nodes if mesh is None else mesh.n_nodes
    entry = scene_entry(config.scene)
    walls = ("as the function builds them",) if entry.own else entry.walls(options)
    unknown = "as the function builds it" if entry.own else None
    contact = options.get("contact", unknown) or "none: the sheet passes through itself"
    solver = config.solver
    return [
        f"scene: {config.scene}, {entry.summary}",
        f"nodes: {nodes}, seed {config.seed}",
        *([] if mesh is None else [f"mesh: {patch_test(mesh)}"]),
        f"walls: {'; '.join(walls) or 'none'}",
        f"contact: {contact}",
        f"material: {_material(config)}",
        *_fall(config),
        f"solver: {solver.scheme}, rtol {solver.rtol:g}",
        f"until: t = {config.t_end:g} s, in {config.frames} frames",
        *folds(config, nodes),
        f"takes: {_taken(config, nodes)}",
    ]


def check_built(config: RunConfig) -> Balance:
    """Build the scene, evaluate energies and forces at its start, and refuse an impossible start.

    **Raises:** ValueError with cause and cure, also if the run certainly exceeds the memory.
    """
    require_config(config)
    setup = config.build()
    return start_balance(setup.scene, initial_state(setup.scene, setup.x))


def _material(config: RunConfig) -> str:
    made_of = config.material
    if made_of is None:
        return "of the Setup"
    if made_of.yield_c0 is not None:
        yields = f"yields at c0 = {made_of.yield_c0:g}"
    elif made_of.yield_curvature is not None:
        yields = f"yields at {made_of.yield_curvature:.4g} 1/m"
    else:
        yields = "elastic"
    name = "" if made_of.preset is None else f"{made_of.preset}, "
    return (
        f"{name}{made_of.young_modulus * 1e-9:.4g} GPa, {made_of.density:g} kg/m3, "
        f"{made_of.thickness * 1e3:.4g} mm thick, {yields}"
    )


def _fall(config: RunConfig) -> list[str]:
    """Say how fast a free sheet falls: drag often limits it to less than one expects."""
    gravity, made_of = config.options.get("gravity"), config.material
    if made_of is None or not made_of.drag_rate or not gravity or not np.any(gravity):
        return []
    speed = float(np.linalg.norm(gravity)) / made_of.drag_rate
    return [f"drag: {made_of.drag_rate:g} 1/s, so a free sheet falls at {speed * 1e3:.2g} mm/s at most"]


def _taken(config: RunConfig, nodes: int) -> str:
    guess = estimate(config, nodes)
    run = " to ".join(duration(seconds) for seconds in guess.run)
    compiling = " to ".join(f"{seconds:.0f}" for seconds in guess.compiling)
    memory = " to ".join(f"{size * 1e-9:.2g}" for size in guess.memory)
    return (
        f"about {run} on one core, compiling {compiling} s, {memory} GB of the {gigabytes(memory_limit())} "
        "here (rough)"
    )
