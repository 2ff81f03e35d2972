"""Tell how runs ended, and what to do next."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxcrumple.cli.console import command, say

if TYPE_CHECKING:
    import pandas as pd


def tell_outcome(summary: dict[str, Any]) -> None:
    """Print result, cost, steps, energies and strains of a run."""
    from jaxcrumple.run.locking import locking

    steps, share, energy = summary["steps"], summary["dynamic_share"], summary["energy"]
    mixed = 0.0 < share["steps"] < 1.0
    lines = [
        f"result: {summary['result']} ({summary['message']})",
        f"t = {summary['t_reached']:.4g} s after {summary['run_s']:.0f} s ({summary['cpu_s']:.0f} CPU s), "
        f"{summary['compile_s']:.0f} s of it compiling since the last start; rtol {summary['rtol']:g}",
        f"steps: {steps['quasistatic']} quasistatic, {steps['implicit']} implicit and {steps['explicit']} "
        f"explicit with inertia, {steps['rejected']} "
        f"rejected; {summary['switches']} switches",
        *([f"inertia: {share['time']:.2%} of the time, {share['steps']:.1%} of the steps"] if mixed else []),
        f"energy: {energy['bending'] * 1e3:.3g} mJ bending, {energy['stretch'] * 1e3:.3g} mJ stretch",
        f"edge strain: {summary['max_edge_strain']:.2%} largest, {summary['rms_edge_strain']:.2%} rms; "
        f"wall penetration {summary['max_wall_penetration'] * 1e6:.3g} um; "
        f"creases {summary['crease_length'] * 100:.3g} cm",
    ]
    if locks := locking(energy):
        lines.append(f"{locks}, as its edges are too long to fold so tightly; give more nodes, or end before")
    for line in lines:
        say(line)


# Measures of an ensemble that are printed, with their units.
MEASURES = {"crease_length": " m", "energy.bending": " J", "energy.stretch": " J", "max_edge_strain": ""}


def tell_ensemble(statistics: "pd.DataFrame") -> None:
    """Print the numbers of runs of each ensemble, and the statistics of some measures."""
    options = list(statistics.index.names[:-1])
    table = statistics.reset_index()
    for values, own in table.groupby(options, sort=False, dropna=False) if options else [((), table)]:
        name = "".join(f"{key} = {value}, " for key, value in zip(options, values, strict=True))
        runs, left_out = own["runs"].max(), own["left_out"].max()
        say(f"{name}{runs} runs" + (f", {left_out} left out without success" if left_out else ""))
        if runs < 2:
            say("  one run or none has no spread; give more seeds")
        rows = {row.measure: row for row in own.itertuples() if row.runs}
        for measure, unit in MEASURES.items():
            if measure in rows:
                say(f"  {measure}: {_told(rows[measure], unit)}")


def _told(row: Any, unit: str) -> str:
    if row.runs < 2:
        return f"{row.mean:.4g}{unit}"
    return f"{row.mean:.4g}{unit}, std {row.std:.2g}, interval {row.low:.4g} to {row.high:.4g}"


def tell_case(name: str, result: str) -> None:
    """Print how a run of several ended."""
    say(f"{name}: {result}")


def tell_next(summary: dict[str, Any], folder: Path, go_on: str) -> None:
    """Print where the results are and which commands show them; `go_on` resumes the run."""
    say(f"all results: {folder}")
    say(f"turn it in a browser: {command('view', folder)} --open")
    if summary["result"] == "budget":
        say(f"go on with: {go_on}")
    elif summary["result"] != "success":
        say(f"what this means: {command('explain', summary['result'])}")
