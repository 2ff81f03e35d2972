"""The source of a notebook or script with other values of its constants."""

import ast
from collections.abc import Mapping
from typing import Any


def smaller(source: str, values: Mapping[str, Any]) -> ast.Module:
    """Replace what top-level statements `name = value` of `source` assign to the names in `values`.

    **Raises:** ValueError for a name that no such statement assigns.
    """
    module, missing = ast.parse(source), set(values)
    for statement in module.body:
        if isinstance(statement, ast.Assign):
            for target in statement.targets:
                if isinstance(target, ast.Name) and target.id in values:
                    new = ast.parse(repr(values[target.id]), mode="eval").body
                    statement.value = ast.copy_location(new, statement.value)
                    missing.discard(target.id)
    if missing:
        raise ValueError(f"no top-level statement assigns {', '.join(sorted(missing))}")
    return ast.fix_missing_locations(module)
