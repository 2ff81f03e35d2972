"""Every script of the gallery runs at a small size, and its picture and its text fit together."""

from pathlib import Path

import pytest
from slow_cases import by_stem
from smaller import smaller

import jaxcrumple as jc

GALLERY = sorted((Path(__file__).parents[1] / "docs" / "gallery").glob("*.py"))
# Values that replace the constants at the top of each script.
SMALL = {
    "axial": {
        "nodes": 60,
        "cycles": 3,
        "height": 0.07,
        "gap": 0.008,
        "sheet": {"thickness": 0.0005, "yield_curvature": 60.0, "density": 10000.0},
        "parts": {
            "roll": 0.03,
            "compress": 0.06,
            "open": 0.01,
            "unfold": 0.06,
            "flatten": 0.08,
            "rest": 0.01,
        },
        "pixels": 60,
    },
    "calibration": {"across": 4, "t_end": 0.08, "pixels": 100},
    "conical": {"nodes": 100, "contact": None, "yield_curvature": 150.0, "pull": 0.02, "pixels": 60},
    "crease_gradient": {"nodes": 60, "rtol": 0.05, "pixels": 100},
    "cylindrical": {"nodes": 100, "height": 0.09, "compress": 0.05, "frames": 20, "pixels": 60},
    "dcone": {"nodes": 400, "pixels": 60},
    "ensemble": {"nodes": 60, "seeds": 3, "pixels": 100},
    "fold": {"nodes": 60, "yield_curvatures": [20, 35, 50], "pixels": 60},
    "holes": {"columns": 18, "rows": 16, "pixels": 100},
    "phase_diagram": {"nodes": 60, "gaps": [0.03, 0.045], "yields": [15.0, 200.0], "backend": "batch"},
    "radial": {"nodes": 80, "contact": None, "t_end": 0.8, "pixels": 60},
    "ridge": {"nodes": 1000, "thicknesses": [0.0005, 0.000125], "pixels": 60},
    "scanned_mesh": {"nodes": 100},
    "snap": {"nodes": 120, "heights": 10, "pixels": 100},
    "stamping": {"nodes": 80, "contact": None, "gap": 0.01, "pixels": 60},
    "thickness": {"across": 8, "pixels": 100},
}
# Compile for more than 20 s of CPU time.
LONG = (
    "axial", "calibration", "conical", "crease_gradient", "cylindrical", "dcone", "ensemble", "phase_diagram",
    "ridge", "scanned_mesh", "snap", "stamping", "thickness",
)  # fmt: skip
# Largest size of a picture in bytes.
LARGEST = 100_000


def first_cell(path: Path) -> str:
    """Return the text of the first cell, a cell of Markdown."""
    head, cell, *_ = path.read_text().split("# %% [markdown]\n")
    assert head == ""
    return "\n".join(line.removeprefix("#").removeprefix(" ") for line in cell.split("# %%")[0].splitlines())


@pytest.mark.parametrize("path", by_stem(GALLERY, LONG))
@pytest.mark.usefixtures("own_figures")
def test_a_script_runs_at_a_small_size(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jc.Picture, "save", lambda self, name: Path(name).write_bytes(b"JPEG"))
    code = compile(smaller(path.read_text(), SMALL[path.stem]), str(path), "exec")
    exec(code, {"__name__": path.stem})
    assert (tmp_path / f"{path.stem}.jpg").exists()


@pytest.mark.parametrize("path", GALLERY, ids=lambda path: path.stem)
def test_a_script_has_a_title_and_its_picture(path):
    text = first_cell(path)
    assert text.startswith("# ")
    assert f"]({path.stem}.jpg)" in text
    picture = path.with_suffix(".jpg")
    assert picture.read_bytes()[:2] == b"\xff\xd8"
    assert picture.stat().st_size <= LARGEST
