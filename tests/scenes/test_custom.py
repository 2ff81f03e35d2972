"""A scene of one's own: sheet, walls and supports do what their tables say."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc

SHEET = {"shape": "square", "sweeps": 3}


def test_a_bent_sheet_is_stress_free_and_curved():
    for kind, mean in (("sphere", 1.0), ("cylinder", 0.5)):
        bend = {"kind": kind, "radius": 0.2}
        setup = jc.custom(400, sheet={**SHEET, "sweeps": 30, "imperfection": 0, "bend": bend}, contact=None)
        x = np.asarray(setup.x)
        off = (x + np.array([0, 0, 0.2]))[:, [0, 1, 2] if kind == "sphere" else [0, 2]]
        np.testing.assert_allclose(np.linalg.norm(off, axis=1), 0.2, rtol=1e-12)
        state = jc.initial_state(setup.scene, setup.x)
        parts = jc.energies(setup.scene, state.x, state.v, state.p, state.t)
        assert float(parts.stretch + parts.bending) < 1e-25
        # Mean curvature from the hinges, the sum of angle times length over the area: 1/R and half of it.
        mesh = setup.mesh
        angle = 2 * np.arcsin(mesh.rest_curvature / 2)
        assert abs(angle @ mesh.hinge_length) / (2 * mesh.area) == pytest.approx(mean / 0.2, rel=0.05)


def test_a_sheet_bent_round_is_refused():
    with pytest.raises(ValueError, match=r"sheet\.bend\.radius = 0\.01 m bends the sheet all the way round"):
        jc.custom(60, sheet={**SHEET, "bend": {"kind": "cylinder", "radius": "1 cm"}})


def test_a_tapered_sheet():
    taper = {"between": ["0.1 mm", "0.3 mm"], "direction": [0, 2, 0]}
    setup = jc.custom(60, sheet={**SHEET, "taper": taper}, contact=None)
    y = setup.mesh.vertices[:, 1]
    np.testing.assert_allclose(setup.material.thickness, 2e-4 + 2e-3 * y, rtol=1e-9)


def test_walls_are_where_they_are_said_to_be():
    motion = {"times": [1.0, "2 s"], "values": ["8 cm", 0.06]}
    walls = [
        {"kind": "sphere", "center": [0, 0, "1 cm"], "radius": motion},
        {"kind": "cylinder", "axis": [0, 3, 0], "radius": 0.1},
        {"kind": "plane", "normal": [0, 0, -2], "offset": -0.03},
        {"kind": "cone", "half_angle": "45 deg", "height": "-5 cm"},
    ]
    scene = jc.custom(60, sheet=SHEET, walls=walls, contact=None).scene
    point = jnp.array([[0.03, 0.02, 0.01]])
    gaps = [[float(wall.gap(point, t)[0]) for wall in scene.walls] for t in (0.0, 1.5, 9.0)]
    far = np.hypot(0.03, 0.02)
    expected = [0.08 - far, 0.1 - np.hypot(0.03, 0.01), 0.02, (0.06 - far) / np.sqrt(2)]
    np.testing.assert_allclose(gaps[0], expected, rtol=1e-9)
    np.testing.assert_allclose([row[0] for row in gaps], [0.08 - far, 0.07 - far, 0.06 - far])


def test_supports_hold_move_and_let_go():
    box = {"lower": [-1, -1, -1], "upper": ["-4.9 cm", 1, 1]}
    supports = [{"nodes": "boundary", "until": 0.1}, {"nodes": box, "velocity": [0, 0, "1 cm/s"]}]
    setup = jc.custom(60, sheet=SHEET, supports=supports, contact=None)
    held, x = setup.scene.prescribed, np.asarray(setup.x)
    left = x[:, 0] <= -0.049
    np.testing.assert_array_equal(held.held(0.2).any(axis=1), left)
    boundary = np.isin(np.arange(60), setup.mesh.boundary_nodes)
    np.testing.assert_array_equal(held.held(0.1).all(axis=1), boundary | left)
    moved = np.asarray(held.position(setup.x, 0.5)) - x
    np.testing.assert_allclose(moved, np.outer(left, [0, 0, 0.005]), atol=1e-15)
    with pytest.raises(ValueError, match=r"supports\[0\] holds no node"):
        jc.custom(60, sheet=SHEET, supports=[{"nodes": {"lower": [1, 1, 1], "upper": [2, 2, 2]}}])


def test_a_held_sheet_sags_under_its_weight():
    """The edge is let go at 5 ms and falls as the rest does; before, only the middle moves."""
    options = {"sheet": {**SHEET, "imperfection": 0}, "gravity": [0, 0, "-10 m/s^2"], "contact": None}
    setup = jc.custom(60, supports=[{"nodes": "boundary", "until": "5 ms"}], **options)
    state = jc.initial_state(setup.scene, setup.x)
    solution = jc.simulate(setup.scene, state, [5e-3, 1e-2], solver=jc.integrator(scheme="dynamic"))
    assert solution.result == "success"
    edge = setup.mesh.boundary_nodes
    inside = np.setdiff1d(np.arange(60), edge)
    np.testing.assert_array_equal(solution.x[0][edge], np.asarray(setup.x)[edge])
    assert np.all(solution.x[0][inside, 2] < 0)
    assert np.all(solution.x[1][edge, 2] < 0)


def test_unknown_options_are_refused():
    with pytest.raises(jc.ConfigError, match=r"'wals' is unknown; did you mean 'walls'\?"):
        jc.custom(60, wals=[])
