"""Write docs/performance.md and docs/validation.md from the tables and plots in scripts/results."""

import csv
import tomllib
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

SCRIPTS = Path(__file__).parent
RESULTS, DOCS = SCRIPTS / "results", SCRIPTS.parent / "docs"
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
numbers or independent numerical solutions. The accepted deviation covers the discretisation of the mesh. All
{quantities} quantities are within it. The largest deviation below is {largest:.1f} %: {where}.

A benchmark on two meshes shows the finer one here; the whole table is `scripts/results/validation.md`.
"""
COLUMNS = ("benchmark", "quantity", "expected", "measured", "deviation %", "accepted %", "mesh")


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
    with (RESULTS / "validation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # A later row of the same quantity is of a finer mesh.
    shown = list({(row["benchmark"], row["quantity"]): row for row in rows}.values())
    worst = max(shown, key=lambda row: abs(float(row["deviation_percent"])))
    head = VALIDATION.format(
        benchmarks=len({row["benchmark"] for row in rows}),
        quantities=len(rows),
        largest=abs(float(worst["deviation_percent"])),
        where=f"{worst['title'][:1].lower()}{worst['title'][1:]}",
    )
    groups = groupby(shown, lambda row: row["group"])
    stamp = (RESULTS / "validation.md").read_text().strip().splitlines()[-1]
    return head + "".join(_group(name, list(found)) for name, found in groups) + f"\n{stamp}\n"


def _group(name: str, rows: Sequence[Mapping[str, str]]) -> str:
    """Return the table of a group, the sources of its benchmarks, and why larger deviations arise."""
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
    for title, found in groupby(rows, lambda row: row["title"]):
        for number, row in enumerate(found):
            unit = "" if row["unit"] == "1" else f" [{row['unit']}]"
            cells = (
                title if number == 0 else "",
                row["quantity"] + unit,
                f"{float(row['expected']):.5g}",
                f"{float(row['measured']):.5g}",
                f"{float(row['deviation_percent']):+.2f}",
                f"{float(row['tolerance_percent']):.2g}",
                row["mesh"],
            )
            lines.append(f"| {' | '.join(cells)} |")
    sources = {row["title"]: row["source"] for row in rows}
    causes = {f"{row['title']}, {row['quantity']}": row["why"] for row in rows if row["why"]}
    text = [f"\n## {name.capitalize()}\n", *lines, "\nSources:\n"]
    text += [f"* {title}: {source}." for title, source in sources.items()]
    if causes:
        text += ["\nDeviations above 1 %:\n", *(f"* {what}: {why}." for what, why in causes.items())]
    return "\n".join(text) + "\n"


def main() -> None:
    for path, text in pages().items():
        path.write_text(text)


if __name__ == "__main__":
    main()
