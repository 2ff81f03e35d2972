"""Write docs/performance.md from the tables and plots in scripts/results, as performance.toml tells."""

import tomllib
from pathlib import Path
from typing import Any

SCRIPTS = Path(__file__).parent
RESULTS, PAGE = SCRIPTS / "results", SCRIPTS.parent / "docs" / "performance.md"
# A table with more rows than this is folded.
ROWS = 18
HEAD = """\
<!-- Written by scripts/performance_page.py: edit scripts/performance.toml. -->

# Performance

Each section names the command that measured it. The line below a table has date, versions and machine.
"CPU s" are seconds of one core.
"""


def page() -> str:
    """Return the page."""
    sections = tomllib.loads((SCRIPTS / "performance.toml").read_text())["section"]
    return HEAD + "".join(map(_section, sections))


def _section(section: dict[str, Any]) -> str:
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


if __name__ == "__main__":
    PAGE.write_text(page())
