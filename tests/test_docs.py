"""Every piece of code in the documentation runs, and prints what stands below it."""

import re
from pathlib import Path

import pytest
import write_pages
from slow_cases import by_stem

ROOT = Path(__file__).parents[1]
# Pages whose code runs from top to bottom.
PAGES = [page for page in sorted((ROOT / "docs").glob("*.md")) if "```python" in page.read_text()]
# Pages that compile for a minute and more.
LONG = ("README", "derivatives", "sweeps")
LINK = re.compile(r"\]\((?P<target>[^)#]+)[^)]*\)")
BLOCK = re.compile(r"```python\n(?P<code>.*?)```(?:\n\n```text\n(?P<output>.*?)```)?", re.DOTALL)
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")


def test_links_lead_somewhere():
    for page in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")):
        for link in LINK.finditer(page.read_text()):
            if "://" not in link["target"]:
                assert (page.parent / link["target"]).exists(), (page.name, link["target"])


def test_pages_are_those_of_the_results():
    """`poe pages` writes them."""
    for path, text in write_pages.pages().items():
        assert path.read_text() == text, path.name


def test_the_readme_is_short():
    """A stranger reads it in three minutes."""
    assert len((ROOT / "README.md").read_text().split()) < 700


@pytest.mark.parametrize("page", by_stem([*PAGES, ROOT / "README.md"], LONG))
def test_a_page_runs_from_top_to_bottom(page, capsys):
    names = {"__name__": page.stem}
    blocks = list(BLOCK.finditer(page.read_text()))
    assert blocks
    for block in blocks:
        exec(compile(block["code"], page.name, "exec"), names)
        printed = capsys.readouterr().out
        if block["output"] is not None:
            assert NUMBER.sub("#", printed) == NUMBER.sub("#", block["output"])
            found, shown = (list(map(float, NUMBER.findall(text))) for text in (printed, block["output"]))
            # Processors round differently, and so list other pairs at the edge of a skin: 1.4 % were seen.
            assert found == pytest.approx(shown, rel=2e-2)
        else:
            assert "False" not in printed
