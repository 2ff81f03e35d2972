"""Tell how a run ended, and what to do next."""

from pathlib import Path
from typing import Any

from jaxcrumple.cli.console import command, say


def tell_outcome(summary: dict[str, Any]) -> None:
    """Print result, cost, steps, energies and strains of a run."""
    from jaxcrumple.run.locking import locking

    steps, share, energy = summary["steps"], summary["dynamic_share"], summary["energy"]
    mixed = 0.0 < share["steps"] < 1.0
    lines = [
        f"result: {summary['result']} ({summary['message']})",
        f"t = {summary['t_reached']:.4g} s after {summary['run_s']:.0f} s ({summary['cpu_s']:.0f} CPU s), "
        f"{summary['compile_s']:.0f} s of it compiling at the last start; rtol {summary['rtol']:g}",
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


def tell_next(summary: dict[str, Any], folder: Path, go_on: str) -> None:
    """Print where the results are and which commands show them; `go_on` resumes the run."""
    say(f"all results: {folder}")
    say(f"turn it in a browser: {command('view', folder)} --open")
    if summary["result"] == "budget":
        say(f"go on with: {go_on}")
    elif summary["result"] != "success":
        say(f"what this means: {command('explain', summary['result'])}")
