"""Every benchmark and check in `scripts` can be loaded: its imports name what exists."""

import importlib
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.mark.parametrize("name", sorted(path.stem for path in SCRIPTS.glob("*.py")))
def test_a_script_can_be_loaded(name):
    text = (SCRIPTS / f"{name}.py").read_text()
    assert hasattr(importlib.import_module(name), "main") == ("__main__" in text)
