"""Print the boundaries of two systems side by side, from the tables of ``vslam stress``.

The boundary of a system is the strength of a perturbation at which it fails.

python tools/experiments/stress/boundary_table.py stress/boundaries.csv --systems bow orbslam3
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from vslam.datasets.perturbation import LAWS

NAMES = {"bow": "vslam", "orbslam3": "ORB-SLAM3"}


def table(paths: list[Path], ours: str, theirs: str) -> str:
    """Return a Markdown table of the boundaries of the two systems.

    It contains the perturbations under which both systems were run.
    """
    rows = {}
    for path in paths:
        with path.open(newline="") as file:
            rows |= {(row["law"], row["system"]): row for row in csv.DictReader(file)}
    # In a comparison with another system, the detector bow is called vslam.
    known = NAMES if theirs in NAMES else {}
    names = [known.get(system, f"`{system}`") for system in (ours, theirs)]
    columns = [f"{name} {what}" for name in names for what in ("holds to", "fails at")]
    lines = [f"| law | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for law, kind in LAWS.items():
        found = [rows[law, system] for system in (ours, theirs) if (law, system) in rows]
        if len(found) == 2:
            name = f"`{law}`" + (f", {kind.unit}" if kind.unit != "x" else "")
            lines.append(f"| {name} | {' | '.join(map(_cells, found))} |")
    return "\n".join(lines)


def _cells(row: dict[str, str]) -> str:
    held = f"{float(row['holds_to']):g}" if row["holds_to"] else "nothing"
    failed = f"{float(row['fails_at']):g}: {row['reason']}" if row["fails_at"] else "never"
    return f"{held} | {failed}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("csv", type=Path, nargs="+", help="files boundaries.csv")
    parser.add_argument("--systems", nargs=2, required=True)
    args = parser.parse_args()
    print(table(args.csv, *args.systems))


if __name__ == "__main__":
    main()
