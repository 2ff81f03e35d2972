"""The notebooks run from top to bottom at a small size, and have stored outputs."""

import json
import re
from pathlib import Path

import pytest
from slow_cases import by_stem
from smaller import smaller

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# Values that replace those of the notebooks; their assertions hold at both sizes.
SMALL = {
    "batch": {
        "nodes": 60,
        "curvatures": [20.0, 150.0],
        "radii": [0.071, 0.0714],
        "t_lanes": 0.1,
        "frames": 4,
        "pixels": 60,
    },
    "calibrate_a_fold": {"nodes": 60, "first": 29.0, "others": [60.0], "pixels": 60},
    "crease_statistics": {
        "nodes": 120,
        "coarse_nodes": 80,
        "t_end": 0.1,
        "cycle_nodes": 100,
        "cycles": 3,
        "pixels": 60,
    },
    "first_crumple": {"nodes": 80, "t_end": 2.6, "contact": None, "columns": 20, "pixels": 60},
    "gradients_near_a_snap": {"rtol": 3e-3, "frames": 6, "cases": 2, "pixels": 60},
    "phase_diagram": {"nodes": 60, "curvatures": [25.0, 100.0], "seeds": [0], "moments": 4},
    "scenes": {"nodes": 80, "names": ["radial", "ridge"], "pixels": 60},
}
# Take more than 15 s of CPU time, or a minute to compile.
LONG = ("batch", "calibrate_a_fold", "crease_statistics", "gradients_near_a_snap", "phase_diagram")
# Bytes of a notebook with its outputs.
LARGEST = 480_000
# Paths of the machine that ran the notebook.
PATH = re.compile(r"(?<![\w.])/(?:tmp|root|home|Users|work)/")


def _cells(path: Path, kind: str) -> list[dict]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


def test_every_notebook_has_a_small_size():
    assert [path.stem for path in NOTEBOOKS] == sorted(SMALL)


def test_smaller_replaces_constants_and_refuses_other_names():
    source = "nodes = 400\nseeds = [0, 1]\ndef double():\n    return 2 * nodes\nfound = double(), seeds\n"
    names: dict = {}
    exec(compile(smaller(source, {"nodes": 3, "seeds": [5]}), "here", "exec"), names)
    assert names["found"] == (6, [5])
    with pytest.raises(ValueError, match="assigns knots, size"):
        smaller(source, {"nodes": 3, "knots": 1, "size": 2})


@pytest.mark.parametrize("path", by_stem(NOTEBOOKS, LONG))
@pytest.mark.usefixtures("own_figures")
def test_a_notebook_runs_at_a_small_size(path):
    source = "\n\n".join("".join(cell["source"]) for cell in _cells(path, "code"))
    exec(compile(smaller(source, SMALL[path.stem]), path.name, "exec"), {"__name__": path.stem})


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_stored_outputs(path):
    code = _cells(path, "code")
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
    for output in outputs:
        assert output["output_type"] != "error" and output.get("name") != "stderr"
        assert not PATH.search(json.dumps(output))
    assert len(path.read_bytes()) < LARGEST


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_begins_with_a_title_and_asserts(path):
    first = json.loads(path.read_text())["cells"][0]
    assert first["cell_type"] == "markdown" and first["source"][0].startswith("# ")
    assert "assert " in "".join("".join(cell["source"]) for cell in _cells(path, "code"))
