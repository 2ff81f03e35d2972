"""Keeping the lists of contact while a run goes on: nothing depends on when they were made."""

import jax
import numpy as np
from folded import folded, strip

import jaxcrumple as jc

SIGMA = 0.5e-3


def pressed_layers():
    """An elastic sheet folded onto itself, whose layers push one another apart, and its start."""
    mesh = strip(0.85 * SIGMA, columns=5, rows=4)
    material = jc.Material(thickness=0.3e-3, yield_curvature=None)
    scene = jc.sheet(mesh, material, contact=jc.SelfContact(range=SIGMA, level=3))
    return scene, jc.initial_state(scene, folded(mesh, 0.85 * SIGMA))


def test_a_run_cut_anywhere_goes_on_to_the_same_bits():
    """Also within the life of a factor that serves several steps, and of a list."""
    scene, state = pressed_layers()
    whole = jc.simulate(scene, state, 1.0, max_attempts=48).state
    assert int(np.sum(whole.counters.factors)) < int(np.sum(whole.counters.steps))
    for cut in (1, 7, 30):
        first = jc.simulate(scene, state, 1.0, max_attempts=cut)
        assert first.result == "budget"
        rest = jc.simulate(scene, first.state, 1.0, max_attempts=48 - cut).state
        for name in ("t", "x", "v", "h", "history", "kept", "listing"):
            for a, b in zip(*(jax.tree.leaves(getattr(s, name)) for s in (whole, rest)), strict=True):
                assert np.asarray(a).tobytes() == np.asarray(b).tobytes(), (cut, name)
