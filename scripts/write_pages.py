"""Write docs/performance.md and docs/validation.md from the tables and plots in scripts/results."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from benchlib import RESULTS, markdown
from validate import NUMBERS, numbers

SCRIPTS = Path(__file__).parent
DOCS = SCRIPTS.parent / "docs"
# A table with more rows than this is folded.
ROWS = 18

PERFORMANCE = """\
<!-- Written by scripts/write_pages.py: edit scripts/performance.toml. -->

# Performance

Each section names the command that measured it. The line below a table has date, versions and machine.
"CPU s" are seconds of one core.
"""

VALIDATION = """\
<!-- Written by scripts/write_pages.py: run scripts/validate.py. -->

# Validation

{benchmarks} classical benchmarks of plates, beams, shells, folds, contact, dynamics and crumpling, posed
through the public interface by `python scripts/validate.py`. Expected values are closed forms, published
numbers or independent numerical solutions. The tolerance covers the discretisation of the mesh. All
{quantities} quantities are within it. The largest deviation below is {largest:.1f} %: {where}.

A benchmark on two meshes shows the finer one here; the whole table is `scripts/results/validation.md`.
"""


def pages() -> dict[Path, str]:
    """Return the text of each page."""
    return {DOCS / "performance.md": performance(), DOCS / "validation.md": validation()}


def performance() -> str:
    """Return the page of run times and errors."""
    sections = tomllib.loads((SCRIPTS / "performance.toml").read_text())["section"]
    return PERFORMANCE + "".join(map(_section, sections))


def _section(section: Mapping[str, Any]) -> str:
    title = section["title"]
    parts = [f"\n## {title}\n", f"`{section['command']}`\n", f"{section['says'].strip()}\n"]
    parts += [_table(name) for name in section.get("tables", ())]
    parts += [f"![{title}](../scripts/results/{name}.png)\n" for name in section.get("plots", ())]
    return "\n".join(parts)


def _table(name: str) -> str:
    """Return a table; a long one is folded."""
    text = (RESULTS / f"{name}.md").read_text().strip()
    rows = sum(line.startswith("|") for line in text.splitlines())
    if rows <= ROWS:
        return f"{text}\n"
    return f"<details>\n<summary>Table of {rows - 2} rows</summary>\n\n{text}\n\n</details>\n"


def validation() -> str:
    """Return the page of the validation benchmarks."""
    rows = pd.read_csv(RESULTS / "validation.csv", keep_default_na=False)
    # A later row of the same quantity is of a finer mesh.
    shown = rows.drop_duplicates(["benchmark", "quantity"], keep="last")
    worst = shown.loc[shown["deviation_percent"].abs().idxmax()]
    head = VALIDATION.format(
        benchmarks=rows["benchmark"].nunique(),
        quantities=len(rows),
        largest=abs(worst["deviation_percent"]),
        where=f"{worst['title'][:1].lower()}{worst['title'][1:]}",
    )
    groups = shown.groupby("group", sort=False)
    stamp = (RESULTS / "validation.md").read_text().strip().splitlines()[-1]
    return head + "".join(_group(str(name), found) for name, found in groups) + f"\n{stamp}\n"


def _group(name: str, rows: pd.DataFrame) -> str:
    """Return the table of a group, the sources of its benchmarks, and why larger deviations arise."""
    first = ~rows["title"].duplicated()
    cells = [
        [row.title if begins else "", *numbers(row)]
        for row, begins in zip(rows.itertuples(), first, strict=True)
    ]
    text = [f"\n## {name.capitalize()}\n", markdown(("benchmark", *NUMBERS), cells), "\nSources:\n"]
    text += [f"* {row.title}: {row.source}." for row in rows[first].itertuples()]
    if causes := [f"* {row.title}, {row.quantity}: {row.why}." for row in rows.itertuples() if row.why]:
        text += ["\nDeviations above 1 %:\n", *causes]
    return "\n".join(text) + "\n"


def main() -> None:
    for path, text in pages().items():
        path.write_text(text)


if __name__ == "__main__":
    main()
