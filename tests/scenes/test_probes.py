"""Probes of the physics of crumpling against theory: a minimal ridge, a developable cone, and what work on a
crumple becomes. Long physics, run before a release (pytest -m slow)."""

import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.solvers.log import ENERGIES
from jaxcrumple.state import Work

pytestmark = pytest.mark.slow


def elastic(thickness):
    return jc.Material(thickness=thickness, yield_curvature=None)


def rested(name, **options):
    """Setup and last state of an elastic phantom scene at its end."""
    entry = SCENES[name]
    setup = entry.build(contact=None, **options)
    given = entry.options().model_dump() | {key: value for key, value in options.items() if key != "material"}
    state = jc.initial_state(setup.scene, setup.x)
    solution = jc.simulate(setup.scene, state, entry.ends(given), solver=jc.integrator(scheme="dynamic"))
    assert solution.result == "success"
    return setup, solution.state


def test_the_curvature_of_a_ridge_grows_with_the_cube_root_of_its_slenderness():
    """Lobkovsky et al., Science 270, 1482 (1995): curvature X = const (sqrt(kappa/Y)/X)^(-1/3).

    For thicknesses from 1/200 to 1/800 of its length X; the law is that of vanishing thickness.
    """
    length, thickness = 0.1, np.array([0.5e-3, 0.25e-3, 0.125e-3])
    scaled = []
    for h in thickness:
        setup, state = rested("ridge", nodes=3000, material=elastic(h))
        scaled.append(length * jc.ridge_curvature(setup.mesh, np.asarray(state.x)))
    slope = np.polyfit(np.log(thickness / length), np.log(scaled), 1)[0]
    assert slope == pytest.approx(-1.0 / 3.0, abs=0.03)


def test_the_free_sector_of_a_developable_cone_tends_to_139_degrees():
    """Cerda & Mahadevan, Proc. R. Soc. A 461, 671 (2005): of a sheet that is thin beside its depth.

    Thickness over that depth is 0.025 and 0.0125; the sector grows towards the limit as that falls.
    """
    sectors = []
    for slope in (0.1, 0.2):
        setup, state = rested("dcone", nodes=3000, slope=slope, material=elastic(0.125e-3))
        sectors.append(np.rad2deg(jc.free_sector(setup, np.asarray(state.x), float(state.t))))
    assert 115.0 < sectors[0] < sectors[1] - 5.0 < 135.0
    assert 2.0 * sectors[1] - sectors[0] == pytest.approx(139.0, abs=5.0)


def test_the_ledger_of_a_crumple_is_closed():
    """To 1 % of the walls' work over a whole self-avoiding crumple, with a small share that is numerical."""
    setup = jc.radial(300)
    state = jc.initial_state(setup.scene, setup.x, ledger=True)
    solution = jc.simulate(setup.scene, state, 2.4)
    assert solution.result == "success"
    last = solution.history.iloc[-1]
    work = {name: last[f"work_{name}"] for name in Work._fields}
    energy = sum(last[name] for name in ENERGIES)
    assert work["walls"] > 0.02
    assert abs(sum(work.values()) - energy) < 0.01 * work["walls"]
    assert abs(work["numerical"]) < 0.03 * work["walls"]
    assert work["plastic"] < -0.05 * work["walls"] and work["drag"] < 0
