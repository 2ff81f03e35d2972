"""Limits of runs on the command line, and the exit code where a run does not succeed."""

from typing import Annotated

import typer

from jaxcrumple.cli.console import ENDED

Limit = Annotated[
    str | None,
    typer.Option(
        help="Wall time in s, or with a unit, after which a run ends with the result budget; it can be "
        "resumed. Compile time does not count."
    ),
]


def seconds(limit: str | None) -> float | None:
    """Convert --max-seconds to a wall time in s."""
    from jaxcrumple._jax.tree import require_limit
    from jaxcrumple.options.units import TIME

    try:
        found = None if limit is None else float(TIME.si(limit))
        require_limit("max_seconds", found)
    except ValueError as error:
        raise ValueError(
            f"--max-seconds = {limit!r} is no wall time; give one such as 600 or '30 min'."
        ) from error
    return found


def all_must_succeed(success: bool) -> None:
    """End the program with the exit code of runs that ended without success, if one did."""
    if not success:
        raise typer.Exit(ENDED)
