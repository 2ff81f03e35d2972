"""Compute the physical quantities of a run's summary."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple.contact.energy import closest_sites
from jaxcrumple.measure.creases import crease_length, folded_hinges
from jaxcrumple.measure.intersections import count_intersections
from jaxcrumple.measure.strain import edge_strain
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.run.locking import is_locked
from jaxcrumple.scene import Scene
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.solvers.contact.reallocate import with_contacts
from jaxcrumple.solvers.log import ENERGIES
from jaxcrumple.solvers.start import wall_gap
from jaxcrumple.state import CAUSES, QUASISTATIC, State
from jaxcrumple.system import energies

_energies = eqx.filter_jit(energies)


def physics(setup: Setup, state: State, history: pd.DataFrame, events: pd.DataFrame) -> dict[str, Any]:
    """Compute the quantities of a run's last state, and the share and step sizes of each stage."""
    rejected = np.asarray(state.counters.rejected)
    return {
        "rejected_by_cause": {cause: int(rejected[i]) for i, cause in enumerate(CAUSES)},
        **figures(setup, state, _last_energies(state, history)),
        "dynamic_share": dynamic_share(state, events),
        "step_size_s": _quantiles(history),
    }


def figures(setup: Setup, state: State, energy: dict[str, float] | None = None) -> dict[str, Any]:
    """Compute energies in J (unless given), strains, penetration, gap and crease length in m of a state."""
    mesh, scene = setup.mesh, with_contacts(setup.scene, state.x)
    x = np.asarray(state.x)
    p = np.asarray(scene.rest_curvature_of(state.p))
    if energy is None:
        parts = _energies(scene, state.x, state.v, state.p, state.t)
        energy = {name: float(value) for name, value in parts._asdict().items()}
    strain = edge_strain(mesh, x)
    gaps = [np.min(np.asarray(wall_gap(wall, state.x, state.t))) for wall in scene.walls]
    return {
        "energy": energy,
        "locked": is_locked(energy),
        "max_edge_strain": float(np.max(np.abs(strain))),
        "high_edge_strain": float(np.quantile(np.abs(strain), 0.999)),
        "rms_edge_strain": float(np.sqrt(np.mean(strain**2))),
        "max_wall_penetration": float(max([0.0, *(-gap for gap in gaps)])),
        **_contacts(mesh, scene, x),
        "inverted_hinges": folded_hinges(mesh, x),
        "crease_length": crease_length(mesh, p),
    }


def _last_energies(state: State, history: pd.DataFrame) -> dict[str, float] | None:
    """Return the energies in J of a run's last state from its history, which spares compiling them; None if
    its last row is of an earlier state."""
    if not len(history) or history["t"].iloc[-1] != float(state.t):
        return None
    return {name: float(history[name].iloc[-1]) for name in ENERGIES}


def _contacts(mesh: Mesh, scene: Scene, x: Float[np.ndarray, "nodes 3"]) -> dict[str, Any]:
    """Count intersections and contacts; find the smallest distance in m of two sites in contact, or None."""
    found: dict[str, Any] = {"intersections": count_intersections(mesh, x), "min_gap": None, "contacts": 0}
    if scene.contact is None:
        return found
    gap, count, _ = closest_sites(scene.contact, scene.own_lists, jnp.asarray(x))
    return found | {"min_gap": float(gap) if count else None, "contacts": int(count)}


def dynamic_share(state: State, events: pd.DataFrame) -> dict[str, float]:
    """Compute the share of simulated time and of steps in the stages with inertia.

    A run without a change of stage spent all its time in its final stage.
    """
    total, last, spent = float(state.t), 0.0, 0.0
    for event in events.itertuples():
        spent += event.t - last if event.origin != "quasistatic" else 0.0
        last = event.t
    spent += total - last if int(state.stage) != QUASISTATIC else 0.0
    steps = np.asarray(state.counters.steps)
    return {
        "time": spent / total if total else 0.0,
        "steps": float(1.0 - steps[QUASISTATIC] / max(steps.sum(), 1)),
    }


def _quantiles(history: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Compute the 10, 50 and 90 % quantiles of the step size in s, by stage."""
    steps = history[history["kind"] == 0]
    shares = {"10%": 0.1, "50%": 0.5, "90%": 0.9}
    return {
        str(stage): {name: float(group["h"].quantile(q)) for name, q in shares.items()}
        for stage, group in steps.groupby("stage")
    }
