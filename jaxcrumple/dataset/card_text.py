"""The data card as Markdown, for people."""

from collections.abc import Mapping, Sequence
from typing import Any

README = "README.md"
_STATISTICS = ("min", "max", "mean", "std")


def text_of(card: Mapping[str, Any]) -> str:
    """Return the data card as text."""
    options = [[name, one["unit"] or "", one["value"]] for name, one in card["options"].items()]
    parts = [
        _origin(card),
        "## Splits\n\nBy seed: no seed is in two splits.",
        _table(["split", "samples", "runs", "seeds"], [_split(*item) for item in card["splits"].items()]),
        _grid(card["grid"]),
        _table(
            ["channel", "unit", "meaning", *_STATISTICS], [_map(*item) for item in card["channels"].items()]
        ),
        "## Parameters\n\nOptions in which runs differ.",
        _table(["option", "unit", "range"], [_range(*item) for item in card["parameters"].items()]),
        "## Options of all runs",
        _table(["option", "unit", "value"], options),
        "## Runs left out",
        "\n".join(f"* {name}: {reason}" for name, reason in card["left_out"].items()) or "None.",
    ]
    return "\n\n".join(parts) + "\n"


def _origin(card: Mapping[str, Any]) -> str:
    made = ", ".join(f"{name} {' and '.join(found)}" for name, found in card["simulated_by"].items())
    exported = ", ".join(f"{name} {version}" for name, version in card["written_by"].items())
    return (
        f"# Simulated sheets\n\nScenes: {', '.join(card['scenes'])}. Frames of each run: {card['frames']}. "
        f"All numbers are in SI units.\n\nSimulated by {made}; exported by {exported}."
    )


def _grid(grid: Mapping[str, Any]) -> str:
    count, pixel, (x, y) = grid["pixels"], grid["pixel"], grid["origin"]
    return (
        f"## Maps\n\n{count} x {count} pixels of {pixel:.6g} m, on the undeformed sheet. The centre of the "
        f"first pixel is at x = {x:.6g} m, y = {y:.6g} m. Rows go along y, columns along x. "
        "Statistics are of the training samples, of pixels on the sheet."
    )


def _split(name: str, found: Mapping[str, Any]) -> list[Any]:
    return [name, found["samples"], found["runs"], ", ".join(map(str, found["seeds"])) or "none"]


def _map(name: str, found: Mapping[str, Any]) -> list[Any]:
    return [name, found["unit"], found["meaning"], *(f"{found[key]:.4g}" for key in _STATISTICS)]


def _range(name: str, found: Mapping[str, Any]) -> list[Any]:
    if "words" in found:
        return [name, "", ", ".join(f"{number}: {word}" for number, word in enumerate(found["words"]))]
    return [name, found["unit"] or "", f"{found['min']:.6g} to {found['max']:.6g}"]


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
