"""Write a CSV table with a row for each run from the ``report.json`` of ``vslam bench``.

python tools/run_table.py bench/report.json [MORE ...] --out runs.csv
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from vslam_lab.overview.schema import DECIMALS, OverviewJson, RunEntry


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("reports", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    reports = [OverviewJson.model_validate_json(path.read_bytes()) for path in options.reports]
    rows = [row_of(run) for report in reports for run in report.runs]
    with options.out.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def row_of(run: RunEntry) -> dict[str, object]:
    measures = {
        name: "" if run.measures[name] is None else f"{run.measures[name]:.{decimals}f}"
        for name, decimals in DECIMALS.items()
        if name != "fps"  # the speed depends on the load of the machine
    }
    named = {"system": run.system, "seed": run.seed, "town": run.town, "alignment": run.alignment}
    return run.drive.model_dump() | named | {"frames": run.frames} | measures


if __name__ == "__main__":
    main()
