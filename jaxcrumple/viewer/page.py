"""One page for runs, to turn in a browser: a single file that needs no network."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from jaxcrumple.io import load
from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.io.run import Run
from jaxcrumple.viewer.encode import encode, palette, shared_fields

SCRIPTS = ("three.bundle.js", "surface.js", "panel.js", "chart.js", "page.js")


def view(runs: Sequence[str | Path | Run] | str | Path | Run, path: str | Path) -> Path:
    """Write a page that shows runs side by side, and return its `path`.

    The page opens offline in any browser of 2023 or later: the sheet in space over time, coloured by a field,
    its crease pattern, and the energies.

    **Arguments:** `runs`: folders, or what `load` returned; one or several.

    **Raises:** `RunDirectoryError` as `load`, or if `path` cannot be written; ValueError without a run.
    """
    many = [runs] if isinstance(runs, str | Path | Run) else list(runs)
    if not many:
        raise ValueError("there is no run to view; give at least one folder.")
    loaded = [run if isinstance(run, Run) else load(run) for run in many]
    names = [_name(run) for run in many]
    path = Path(path)
    write_bytes(path, page(loaded, names).encode())
    return path


def _name(run: str | Path | Run) -> str:
    return str(run.config.get("scene", "run")) if isinstance(run, Run) else Path(run).resolve().name


def page(runs: Sequence[Run], names: Sequence[str]) -> str:
    """Return the page of `runs` with their `names`."""
    fields = shared_fields(runs)
    encoded = [encode(run, name, fields, k) for k, (run, name) in enumerate(zip(runs, names, strict=True))]
    about = {"runs": [described for described, _ in encoded], "palette": palette()}
    parts = {
        "TITLE": html.escape(", ".join(names)),
        "STYLE": _asset("page.css"),
        "LICENSE": _asset("three.LICENSE"),
        "ABOUT": _in_script(json.dumps(about, allow_nan=False)),
        "BLOCKS": "\n".join(
            f'<script type="text/plain" class="block">{block}</script>' for _, block in encoded
        ),
        "SCRIPTS": "\n".join(f"<script>{_asset(name)}</script>" for name in SCRIPTS),
    }
    text = _asset("page.html")
    for name, part in parts.items():
        text = text.replace(f"<!--{name}-->", part)
    return text


def _asset(name: str) -> str:
    return (files("jaxcrumple.viewer") / "assets" / name).read_text(encoding="utf-8")


def _in_script(text: str) -> str:
    """Return JSON that no tag in it can end the script around it."""
    return text.replace("<", "\\u003c")
