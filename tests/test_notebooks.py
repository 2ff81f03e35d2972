"""The notebooks run from top to bottom."""

import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


# Take a minute and more to compile.
LONG = ("calibrate_a_fold", "first_crumple", "gradients_near_a_snap")


def _case(path: Path):
    return pytest.param(path, marks=pytest.mark.slow if path.stem in LONG else (), id=path.stem)


@pytest.mark.parametrize("path", [_case(path) for path in NOTEBOOKS])
def test_notebook_runs(path, capsys):
    cells = json.loads(path.read_text())["cells"]
    source = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    exec(compile(source, str(path), "exec"), {})
    assert "success" in capsys.readouterr().out
