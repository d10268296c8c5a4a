"""Compare the strengths of perturbations that two systems withstand, from ``vslam stress``.

python tools/experiments/stress/compare_boundaries.py boundaries.csv ... \\
    --pair bow orbslam3 --pair both orbslam3 --out compared.csv

For each law, the medians over the seeds are compared. The table has a row for each pair of systems
and each sequence. It contains the laws under which the first system withstands more, those under
which the second system withstands more, those under which there is no difference, and those under
which the medians differ by only one of the steps that the bisection distinguishes.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from pathlib import Path
from statistics import median

from vslam.datasets.perturbation import LAWS
from vslam_lab.stress.search import strength_at

Medians = dict[tuple[str, str], dict[str, float]]  # (sequence, system) -> law -> steps
STEPS = 16  # strengths that four bisections distinguish


def steps(law: str, strength: str) -> int:
    """Return the step of a strength, from 0 for the weakest strength to 16 for the greatest.

    ``strength`` is empty if the system failed at all tested strengths. The step is then 0.

    Raises:
        ValueError: the search had another number of bisections, so the strength is between steps.
    """
    if not strength:
        return 0
    tested = [strength_at(LAWS[law], step / STEPS) for step in range(STEPS + 1)]
    return tested.index(float(strength))


def read_medians(paths: list[Path]) -> Medians:
    """Read tables of ``vslam stress``, and return the median step that was withstood."""
    found: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for path in paths:
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                key = row["sequence"], row["system"], row["law"]
                found[key].append(steps(row["law"], row["holds_to"]))
    medians: Medians = defaultdict(dict)
    for (sequence, system, law), values in found.items():
        medians[sequence, system][law] = median(values)
    return medians


def compare(medians: Medians, first: str, second: str) -> list[dict[str, object]]:
    """Return a row for each sequence on which both systems were tested."""
    rows: list[dict[str, object]] = []
    for sequence in dict.fromkeys(sequence for sequence, _ in medians):
        one, other = (medians.get((sequence, system), {}) for system in (first, second))
        common = [law for law in LAWS if law in one and law in other]
        if not common:
            continue
        more = [law for law in common if one[law] > other[law]]
        less = [law for law in common if one[law] < other[law]]
        same = [law for law in common if one[law] == other[law]]
        near = [law for law in common if abs(one[law] - other[law]) == 1]
        rows.append(
            {
                "sequence": sequence,
                "first": first,
                "second": second,
                "laws": len(common),
                "first_more": len(more),
                "second_more": len(less),
                "equal": len(same),
                "one_step": len(near),
                "laws_first_more": " ".join(more),
                "laws_second_more": " ".join(less),
                "laws_equal": " ".join(same),
                "laws_one_step": " ".join(near),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("csv", type=Path, nargs="+", help="files boundaries.csv")
    parser.add_argument("--pair", nargs=2, action="append", required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    medians = read_medians(args.csv)
    rows = [row for pair in args.pair for row in compare(medians, *pair)]
    with args.out.open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
