"""Cases of a test, one for each file, of which some are slow."""

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import pytest


def by_stem(paths: Iterable[Path], slow: Collection[str]) -> list[Any]:
    """Return a case for each path, named after its stem; those whose stem is in `slow` are slow."""
    return [
        pytest.param(path, marks=pytest.mark.slow if path.stem in slow else (), id=path.stem)
        for path in paths
    ]
