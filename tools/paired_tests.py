"""Compare systems pairwise with Wilcoxon's signed-rank test, from tables written by run_table.py.

python tools/paired_tests.py runs.csv [MORE ...] --out paired.csv

The table has a row for each pair of systems, perturbation and measure. Only runs on the same images
are compared, so a seed of a perturbation counts only if both systems were run with it.
``vslam bench`` prints the same tests for the runs in its folder.
"""

from __future__ import annotations

import argparse
import csv
from itertools import combinations
from pathlib import Path

from vslam_lab.overview.collect import Found
from vslam_lab.overview.schema import DECIMALS, Comparison, Drive, RunEntry
from vslam_lab.overview.summary import summarize, systems


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    runs = [run for path in options.tables for run in read_runs(path)]
    pairs = combinations(systems(runs), 2)
    rows = [row_of(one) for first, second in pairs for one in compared(runs, first, second)]
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


def compared(runs: list[RunEntry], first: str, second: str) -> list[Comparison]:
    images = [{(one.drive, one.seed) for one in runs if one.system == x} for x in (first, second)]
    both = [
        one
        for one in runs
        if one.system in (first, second) and (one.drive, one.seed) in images[0] & images[1]
    ]
    return summarize(Found(both, [])).comparisons if both else []


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
