"""Compare systems pairwise with Wilcoxon's signed-rank test, from tables written by run_table.py.

python tools/paired_tests.py runs.csv [MORE ...] --out paired.csv

The table has a row for each pair of systems, perturbation and measure. ``vslam bench`` prints the
same tests for the runs in its folder.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from vslam.lab.overview.collect import Found
from vslam.lab.overview.schema import DECIMALS, Comparison, Drive, RunEntry
from vslam.lab.overview.summary import summarize


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    runs = [run for path in options.tables for run in read_runs(path)]
    rows = [row_of(one) for one in summarize(Found(runs, [])).comparisons]
    with options.out.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def read_runs(path: Path) -> list[RunEntry]:
    """Read the runs of a table. Measures that the table does not contain are None."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            RunEntry(
                drive=Drive(**{name: row[name] for name in Drive.model_fields}),
                system=row["system"],
                seed=int(row["seed"]) if row["seed"] else None,
                alignment=row["alignment"],
                frames=int(row["frames"]),
                measures={x: float(row[x]) if row.get(x) else None for x in DECIMALS},
                source=str(path),
                machine=None,
            )
            for row in csv.DictReader(file)
        ]


def row_of(found: Comparison) -> dict[str, object]:
    return {
        "first": found.first,
        "second": found.second,
        "perturb": found.perturb,
        "measure": found.measure,
        "sequences": len(found.pairs),
        "second_smaller": found.second_better,
        "first_smaller": found.first_better,
        "equal": found.ties,
        "median_difference": f"{found.median_difference:.4f}",
        "p_value": "" if found.p_value is None else f"{found.p_value:.3f}",
    }


if __name__ == "__main__":
    main()
