"""Write a table that shows which runs of ``vslam bench`` fail according to AirSLAM's rules.

vslam bench ... --perturb none,dark:1,dark:2 --out FOLDER
python tools/experiments/light/ladder.py FOLDER TABLE.csv
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from vslam.report.schema import ReportJson
from vslam.support.errors import InputError
from vslam_lab.stress.criterion import absolute_verdict


def rows_of(folder: Path) -> list[list[object]]:
    rows: list[list[object]] = []
    for path in folder.glob("*/report.json"):
        try:
            report = ReportJson.read(path)
        except InputError as error:
            raise SystemExit(str(error)) from error
        named = [report.sequence, report.detector, report.perturb, report.seed]
        lost = [report.frames, report.lost_frames, report.longest_loss_s]
        rows.append([*named, *lost, report.ate_rmse_m, absolute_verdict(report)])
    return sorted(rows, key=_order)


def _order(row: list[object]) -> tuple[object, ...]:
    sequence, system, perturb, seed = row[:4]
    law, _, strength = str(perturb).partition(":")
    return sequence, system, law, float(strength or 0), seed


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("table", type=Path)
    options = parser.parse_args()
    head = "sequence,system,law,seed,frames,lost,longest_loss_s,ate_m,fails"
    with options.table.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head.split(","))
        for *named, loss, ate, fails in rows_of(options.folder):
            rounded = ("" if x is None else round(x, 3) for x in (loss, ate))
            writer.writerow([*named, *rounded, fails])


if __name__ == "__main__":
    main()
