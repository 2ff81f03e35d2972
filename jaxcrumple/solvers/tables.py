"""Rows of a log as tables."""

import numpy as np
import pandas as pd

from jaxcrumple.solvers.log import AFTER, BEFORE, ENERGIES, EVENT_COLUMNS, Row
from jaxcrumple.state import STAGES


def history_table(rows: np.ndarray) -> pd.DataFrame:
    """Return the rows of a `Log` as a table with the columns of `Row`, and names of stages."""
    table = pd.DataFrame(rows, columns=list(Row._fields))
    counts = (
        "kind",
        "order",
        *(name for name in Row._fields if name.endswith(("_steps", "_iterations", "factors"))),
    )
    table = table.astype(dict.fromkeys(counts, int))
    table["stage"] = [STAGES[int(stage)] for stage in table["stage"]]
    return table


def events_table(rows: np.ndarray) -> pd.DataFrame:
    """Return the changes of stage among the rows of a `Log`, with energies in J before and after."""
    events = []
    before: Row | None = None
    for values in rows:
        row = Row(*values)
        if row.kind == BEFORE:
            before = row
        elif row.kind == AFTER and before is not None:
            events.append(_event(before, row))
    return pd.DataFrame(events, columns=list(EVENT_COLUMNS))


def _event(before: Row, after: Row) -> dict:
    event = {
        "t": before.t,
        "origin": STAGES[int(before.stage)],
        "to": STAGES[int(after.stage)],
        "acceleration_mean": before.acceleration_mean,
        "h": after.h,
    }
    for side, row in (("before", before), ("after", after)):
        event |= {f"{name}_{side}": getattr(row, name) for name in ENERGIES}
    return event


def joined(tables: list[pd.DataFrame], empty: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of all tables in one; the `empty` one if there are none."""
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else empty
