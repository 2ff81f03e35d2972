"""Classical benchmarks through the public interface: expected and measured values in one table.

Expected values are closed forms, published numbers or independent numerical solutions. Each tolerance covers
the discretisation of the mesh that its row names.

With --only, the rows of the named benchmarks replace those of an earlier table.

    python scripts/validate.py [--only NAME ...] [--list] [--out FOLDER]
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd
from benchlib import RESULTS, markdown, stamp
from validation import beams, contact, crumpling, dynamics, folds, plates, shells
from validation.base import BENCHMARKS, Benchmark

import jaxcrumple as jc

# In the order of the table.
GROUPS = {module.__name__.split(".")[-1]: module for module in
          (plates, beams, shells, folds, contact, dynamics, crumpling)}  # fmt: skip
NUMBERS = ("quantity", "expected", "measured", "deviation %", "tolerance %", "mesh")
# Deviation above which the table gives the cause.
EXPLAINED = 0.01


def measured(benchmark: Benchmark) -> list[dict]:
    """Run a benchmark; return its rows, by the columns of the CSV file."""
    start = time.process_time()
    outcomes = benchmark.run()
    spent = time.process_time() - start
    rows = [
        {
            "group": benchmark.group,
            "benchmark": benchmark.name,
            "title": benchmark.title,
            "source": benchmark.source,
            "quantity": outcome.quantity,
            "unit": outcome.unit,
            "expected": float(outcome.expected),
            "measured": float(outcome.measured),
            "deviation_percent": 100.0 * outcome.deviation,
            "tolerance_percent": 100.0 * outcome.tolerance,
            "accepted": outcome.accepted,
            "mesh": outcome.mesh,
            "cpu_s": spent,
            "why": outcome.why if abs(outcome.deviation) > EXPLAINED else "",
        }
        for outcome in outcomes
    ]
    print(f"{benchmark.name}: {spent:.1f} CPU s", flush=True)
    for row in rows:
        mark = "" if row["accepted"] else "  NOT ACCEPTED"
        print(
            f"  {row['quantity']}: {row['expected']:.6g} expected, {row['measured']:.6g} {row['unit']}{mark}"
        )
    return rows


def numbers(row: Any) -> list[str]:
    """Return the cells of a row from its quantity to its mesh, by the names in `NUMBERS`."""
    return [
        row.quantity if row.unit == "1" else f"{row.quantity} [{row.unit}]",
        f"{row.expected:.5g}", f"{row.measured:.5g}", f"{row.deviation_percent:+.2f}",
        f"{row.tolerance_percent:.2g}", row.mesh,
    ]  # fmt: skip


def table(rows: pd.DataFrame) -> str:
    """Markdown table of all rows."""
    header = ("group", "benchmark", "source", *NUMBERS, "why it differs")
    return markdown(
        header, [[row.group, row.title, row.source, *numbers(row), row.why] for row in rows.itertuples()]
    )


def with_earlier(rows: pd.DataFrame, path: Path) -> pd.DataFrame:
    """Return new rows and those of an earlier table of all other benchmarks, in the order of the table."""
    if not path.exists():
        return rows
    earlier = pd.read_csv(path, keep_default_na=False)
    earlier = earlier[earlier["benchmark"].isin(set(BENCHMARKS) - set(rows["benchmark"]))]
    order = [b.name for b in sorted(BENCHMARKS.values(), key=lambda b: list(GROUPS).index(b.group))]
    both = pd.concat([earlier, rows])
    return both.sort_values("benchmark", key=lambda names: names.map(order.index), kind="stable")


def main() -> int:
    """Run the benchmarks and write the table; return 1 if one is not accepted."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="NAME",
        choices=list(BENCHMARKS),
        help="run only these, and keep the other rows of the table",
    )
    parser.add_argument("--list", action="store_true", help="name all benchmarks and stop")
    parser.add_argument(
        "--out", type=Path, default=RESULTS, help="folder of validation.md and validation.csv"
    )
    opts = parser.parse_args()
    chosen = [b for b in BENCHMARKS.values() if opts.only is None or b.name in opts.only]
    chosen.sort(key=lambda b: list(GROUPS).index(b.group))
    if opts.list:
        for benchmark in chosen:
            print(f"{benchmark.group:10} {benchmark.name:26} {benchmark.title}")
        return 0
    jc.enable_compilation_cache()
    rows = pd.DataFrame([row for benchmark in chosen for row in measured(benchmark)])
    opts.out.mkdir(parents=True, exist_ok=True)
    rows = with_earlier(rows, opts.out / "validation.csv") if opts.only else rows
    failed = int((~rows["accepted"]).sum())
    spent = rows.groupby("benchmark")["cpu_s"].first().sum()
    text = (
        f"{rows['benchmark'].nunique()} benchmarks, {len(rows)} quantities, {failed} beyond their tolerance; "
        f"{spent:.0f} CPU s, compiling included.\n\n{table(rows)}\n\n{stamp()}\n"
    )
    (opts.out / "validation.md").write_text(text)
    rows.to_csv(opts.out / "validation.csv", index=False, float_format="%.8g")
    print(text)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
