"""What a page decodes is the run, as precisely as its numbers allow."""

import base64
import gzip
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folding import folding_run

from jaxcrumple import configure
from jaxcrumple.measure import DAMAGE, crease_pattern, edge_strain, mean_curvature
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.viewer.encode import ROWS, SHOWN, color_table, encode, shared_fields


def decoded(run, fields=None, number=0):
    described, block = encode(run, "a", shared_fields([run]) if fields is None else fields, number)
    data = gzip.decompress(base64.b64decode(block))

    def array(place):
        assert place["start"] % 4 == 0
        return np.frombuffer(data, place["type"], place["count"], place["start"])

    return json.loads(json.dumps(described, allow_nan=False)), array


def test_positions_and_mesh():
    run = folding_run()
    described, array = decoded(run)
    steps = array(described["x"]).reshape(run.x.shape)
    whole = np.cumsum(steps, axis=0, dtype=np.uint16)
    x = described["low"] + described["unit"] * whole
    np.testing.assert_allclose(x, run.x, atol=0.5001 * described["unit"])
    assert described["unit"] < 2e-6
    np.testing.assert_array_equal(array(described["faces"]).reshape(-1, 3), run.mesh.faces)
    np.testing.assert_array_equal(array(described["hinges"]).reshape(-1, 2), run.mesh.hinges[:, :2])
    np.testing.assert_allclose(array(described["rest"]).reshape(-1, 2), run.mesh.vertices[:, :2], atol=1e-8)


def test_creases():
    run = folding_run()
    described, array = decoded(run)
    found = array(described["creases"]).reshape(len(run.t), -1)
    expected = [crease_pattern(run.mesh, p, DAMAGE) for p in run.p]
    np.testing.assert_array_equal(found, expected)
    assert np.count_nonzero(found[-1]) == 1 and not found[:-1].any()


def test_fields():
    """Values are those of the measures to a 255th of their range; beyond it they saturate."""
    run = folding_run()
    described, array = decoded(run)
    expected = np.array([mean_curvature(run.mesh, x) for x in run.x])
    field = described["fields"]["curvature"]
    assert field["low"] == -field["high"] and set(described["fields"]) == set(SHOWN)
    values = array(field["values"]).reshape(expected.shape) / 255
    shown = field["low"] + (field["high"] - field["low"]) * values
    clipped = np.clip(expected, field["low"], field["high"])
    np.testing.assert_allclose(shown, clipped, atol=0.51 * (field["high"] - field["low"]) / 255)
    # The strain of a node is the largest of the edges of its triangles.
    field = described["fields"]["strain"]
    values = array(field["values"]).reshape(expected.shape)[0] / 255
    largest, half_level = 100 * np.abs(edge_strain(run.mesh, run.x[0])).max(), field["high"] / 255
    assert field["low"] + 2 * field["high"] * values.max() == pytest.approx(largest, abs=1.01 * half_level)


def test_runs_of_a_page_share_their_colours():
    calm, sharp = folding_run(), folding_run()
    calm.x[:] = calm.x[:1]
    fields = shared_fields([calm, sharp])
    limits = {name: (field.low, field.high) for name, field in fields.items()}
    for number, run in enumerate((calm, sharp)):
        described, _ = decoded(run, fields, number)
        assert {name: (f["low"], f["high"]) for name, f in described["fields"].items()} == limits


@pytest.mark.parametrize("scene", sorted(SCENES))
def test_walls_have_all_their_numbers(scene):
    """A page places a wall by its numbers; the gap of points on it vanishes."""
    run = folding_run(scene)
    sweeps = {"sweeps": 0} if "sweeps" in run.config["options"] else {}
    walls = configure(scene, nodes=120, settings=sweeps).build().scene.walls
    described, _ = decoded(run)
    assert len(described["walls"]) == len(walls)
    for told, wall in zip(described["walls"], walls, strict=True):
        for t, value in zip(run.t, told["moves"], strict=True):
            point = _on(told, value)
            gap = jax.vmap(wall.shape.gap, (0, None))(jnp.asarray(point), t)
            np.testing.assert_allclose(gap, 0.0, atol=2e-6)


def _on(wall, value):
    """A few points of a wall."""
    center = np.array(wall.get("center", [0, 0, 0]))
    axis = np.array(wall.get("axis", wall.get("normal", [0, 0, 1.0])))
    across = np.cross(axis, [0.3, -0.8, 0.52])
    across /= np.linalg.norm(across)
    turns = [across, np.cross(axis, across), -across]
    return np.array(
        {
            "Sphere": lambda: [center + value * side for side in (*turns, axis)],
            "Ball": lambda: (
                [center + value * axis + wall["radius"] * side for side in (*turns, axis)]
                if wall["kind"] == "Ball"
                else None
            ),
            "Cylinder": lambda: [center + 0.01 * axis + value * side for side in turns],
            "Plane": lambda: [value * axis + 0.01 * side for side in turns],
            "Cone": lambda: [
                center + (value + 0.02) * axis + 0.02 * np.tan(wall["half_angle"]) * side for side in turns
            ],
            "HoledPlate": lambda: [center + value * side for side in turns],
        }[wall["kind"]]()
    )


def test_history():
    described, _ = decoded(folding_run(rows=4000))
    history = described["history"]
    assert len(history["t"]) == len(history["stage"]) == ROWS
    assert history["t"][0] == 0 and history["t"][-1] == pytest.approx(0.3)
    assert list(history["energies"]) == ["bending"]
    assert history["energies"]["bending"][-1] == pytest.approx(1e-3)
    assert decoded(folding_run())[0]["history"] == {"t": [], "h": [], "stage": [], "energies": {}}


def test_colours_end_at_those_of_the_scale():
    table = np.array(color_table(True)).reshape(256, 3)
    assert table.shape == (256, 3) and table.min() >= 0 and table.max() <= 255
    # Blue, white, red.
    assert table[0, 2] > table[0, 0] and table[-1, 0] > table[-1, 2] and table[128].min() > 230
