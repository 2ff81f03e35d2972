"""Rows of a log as tables."""

from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple.solvers.log import AFTER, BEFORE, COLUMNS, ENERGIES, EVENT_COLUMNS
from jaxcrumple.state import STAGES


def history_table(rows: Float[np.ndarray, "rows columns"]) -> pd.DataFrame:
    """Return the rows of a `Log` as a table with the columns `COLUMNS`, and names of stages."""
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    counts = (name for name in COLUMNS if name.endswith(("_steps", "_iterations", "factors")))
    table = table.astype(dict.fromkeys(("kind", "order", *counts), int))
    table["stage"] = [STAGES[int(stage)] for stage in table["stage"]]
    return table


def events_table(rows: Float[np.ndarray, "rows columns"]) -> pd.DataFrame:
    """Return the changes of stage among the rows of a `Log`, with energies in J before and after."""
    events = []
    before: dict[str, float] = {}
    for values in rows:
        row = dict(zip(COLUMNS, values, strict=True))
        if row["kind"] == BEFORE:
            before = row
        elif row["kind"] == AFTER and before:
            events.append(_event(before, row))
    return pd.DataFrame(events, columns=list(EVENT_COLUMNS))


def _event(before: dict[str, float], after: dict[str, float]) -> dict[str, Any]:
    event = {
        "t": before["t"],
        "origin": STAGES[int(before["stage"])],
        "to": STAGES[int(after["stage"])],
        "acceleration_mean": before["acceleration_mean"],
        "h": after["h"],
    }
    sides = {"before": before, "after": after}
    return event | {f"{name}_{side}": row[name] for name in ENERGIES for side, row in sides.items()}


def joined(tables: list[pd.DataFrame], empty: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of all tables in one; the `empty` one if there are none."""
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else empty
