"""A sheet folded in half, pressed and let go."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import jaxcrumple as jc
from jaxcrumple.cli.cli import app
from jaxcrumple.scenes.fold import GRIP, TIMES


@pytest.fixture(scope="module")
def kept():
    """Positions at the end of each part, of sheets that yield early and late."""
    frames = {}
    for yields in (40.0, 120.0):
        setup = jc.fold(150, gap=0.01, sweeps=30, material=jc.Material(yield_curvature=yields))
        times = [TIMES.close, TIMES.release, TIMES.end]
        state = jc.initial_state(setup.scene, setup.x)
        solution = jc.simulate(setup.scene, state, times, solver=jc.integrator(scheme="dynamic"))
        assert solution.result == "success"
        frames[yields] = setup.mesh, solution
    return frames


@pytest.mark.slow
def test_strips_lie_over_one_another_when_it_is_closed(kept):
    for mesh, solution in kept.values():
        right = mesh.vertices[:, 0] > (0.5 - GRIP) * 0.1
        closed, start = solution.x[0][right], mesh.vertices[right]
        np.testing.assert_allclose(closed, start * [-1.0, 1.0, -1.0], atol=1e-12)
        assert np.ptp(solution.x[1][:, 2]) < 0.01


@pytest.mark.slow
def test_a_fold_keeps_a_sharper_angle_where_it_yields_early(kept):
    angles = [float(jc.fold_angle(mesh, jnp.asarray(run.x[-1]))) for mesh, run in kept.values()]
    assert 0.2 < angles[0] < angles[1] - 0.2
    assert angles[1] < np.pi - 0.1


def test_the_angle_of_a_sharp_fold():
    mesh = jc.rectangle(0.1, 0.1, 200, sweeps=10)
    for angle in (0.3, 1.5, 3.0):
        x = np.array(mesh.vertices)
        right = x[:, 0] > 0
        x[right] = x[right] * [np.cos(np.pi - angle), 1.0, 0.0] + np.outer(x[right, 0], [0, 0, np.sin(angle)])
        assert float(jc.fold_angle(mesh, jnp.asarray(x))) == pytest.approx(angle, abs=1e-9)
    with pytest.raises(ValueError, match="more than twice the thickness"):
        jc.fold(100, gap=4e-4)


@pytest.mark.slow
def test_the_command_finds_the_yield_curvature_of_a_fold(tmp_path):
    """That of a run which kept that angle, in few derivatives; and says how well it is known."""
    true, nodes, path = 28.0, 60, tmp_path / "found.json"
    gap, thin = 0.03, jc.Material(yield_curvature=true, thickness=2e-4)
    setup = jc.fold(nodes, gap=gap, relax=0.4, material=thin)
    state = jc.initial_state(setup.scene, setup.x)
    times = [TIMES.release, TIMES.release + 0.4]
    solution = jc.simulate(setup.scene, state, times, solver=jc.integrator(1e-3, scheme="dynamic"))
    angle = np.rad2deg(float(jc.fold_angle(setup.mesh, jnp.asarray(solution.x[-1]))))
    options = ["--nodes", str(nodes), "--std", "0.5", "--json", str(path), "--set", "thickness=0.2 mm"]
    options += ["--set", f"gap={gap}", "--set", "relax=0.4"]
    answer = CliRunner().invoke(app, ["calibrate", "fold", "--target-angle", str(angle), *options])
    assert answer.exit_code == 0, answer.output
    found = json.loads(path.read_text())
    assert found["yield_curvature"] == pytest.approx(true, rel=1e-2)
    assert found["angle_deg"] == pytest.approx(angle, abs=0.05)
    c0 = jc.Material(yield_curvature=true).discretize(setup.mesh).c0
    assert found["c0"] == pytest.approx(np.mean(c0), rel=1e-2)
    assert found["c0_std"] / found["c0"] == pytest.approx(found["std"] / found["yield_curvature"])
    assert 0.1 < found["std"] < 1.0
    assert found["gradient_evaluations"] <= 6
