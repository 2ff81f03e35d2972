"""Command `jaxcrumple calibrate`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxcrumple.cli.console import check_place, noted, say

calibrations = typer.Typer(help="Find properties of a sheet from measurements.", no_args_is_help=True)


@calibrations.command("fold")
def calibrate_by_fold(
    target_angle: Annotated[float, typer.Option(help="Angle in degrees between the halves; 180 is flat.")],
    nodes: Annotated[int, typer.Option(help="Nodes of the mesh.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of the mesh.")] = 0,
    std: Annotated[float, typer.Option(help="Standard deviation of the angle in degrees.")] = 1.0,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="An option of the fold or the material, such as 'gap=6 mm'; repeatable.",
        ),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the result to this file.")] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="File of all runs; continued if present.")] = None,
) -> None:
    """Find the yield curvature at which a folded sheet retains an angle."""
    import math

    from jaxcrumple.calibrate.fold import calibrate_fold
    from jaxcrumple.io.atomic import json_bytes, write_bytes
    from jaxcrumple.run.config import configure

    if not 0 < target_angle < 180:
        raise ValueError(
            f"--target-angle = {target_angle:g} must lie between 0 and 180 degrees; 180 is flat."
        )
    if not (math.isfinite(std) and std > 0):
        raise ValueError(f"--std = {std:g} must be a positive angle in degrees.")
    config = configure("fold", nodes=nodes, seed=seed, settings=settings or [])
    options = {name: value for name, value in config.options.items() if value is not None}
    assert config.material is not None
    if json_file is not None:
        check_place(json_file, "--json")
    kept = "nothing is saved, because no --checkpoint was given"
    if checkpoint is not None:
        kept = f"{checkpoint} keeps the completed runs; go on with the same command"
    with noted(lambda: kept):
        found = calibrate_fold(
            math.radians(target_angle),
            nodes=nodes,
            seed=seed,
            std=math.radians(std),
            material=config.material.build(),
            options=options,
            checkpoint=checkpoint,
            tell=_tell_evaluation,
        )
    result = {
        "yield_curvature": found.yield_curvature,
        "std": found.std,
        "c0": found.c0,
        "c0_std": found.c0_std,
        "angle_deg": math.degrees(found.angle),
        "evaluations": found.fit.evaluations,
        "gradient_evaluations": found.fit.gradient_evaluations,
        "snaps": found.fit.snaps,
        "success": found.success,
        "message": found.fit.message,
        "target_angle_deg": target_angle,
        "nodes": nodes,
        "seed": seed,
    }
    if json_file is not None:
        write_bytes(json_file, json_bytes(result))
    say(
        f"yield curvature {found.yield_curvature:.4g} +- {found.std:.2g} 1/m, c0 = {found.c0:.4g}; the fold "
        f"then retains {result['angle_deg']:.4g} degrees ({found.fit.message})"
    )
    if not found.success:
        raise ValueError(f"found no yield curvature at which the fold retains {target_angle:g} degrees.")


def _tell_evaluation(row: Mapping[str, Any]) -> None:
    """Print one line for each new run of a fit."""
    if row["kind"] == "residuals" and row["seconds"] > 0.0:
        value, loss, seconds = row["yield_curvature"], row["loss"], row["seconds"]
        say(f"yield curvature {value:.5g} 1/m: loss {loss:.3g}, {seconds:.0f} s")
