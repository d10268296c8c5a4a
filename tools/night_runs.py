"""Write docs/loops/night_runs.csv: whole runs over short loops that change between the passes.

    vslam synth block --seed 401 --change 1    # and so on, with other seeds, changes and `lane`
    python tools/night_runs.py --runs FOLDER --seeds 401-416 [--detectors bow,both,capsule-orb]

Drives that are rendered completely are run, others are left out: the column `towns` says how many
there are. A run whose report lies in FOLDER is not repeated, so the same command goes on; a
new version of vslam needs a new folder. Runs go through the towns in turn, so that rows which are
compared have the same towns when it is stopped early. Rows of the table with other seeds are kept.

`capsule-orb` is the detector `capsule` whose candidates ORB alone verifies.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from vslam.datasets.synthetic import parse_drive
from vslam.datasets.synthetic.store import cache_folder, folder_name, list_stored

OUT = Path(__file__).parent.parent / "docs" / "loops" / "night_runs.csv"
ORB_ALONE = "capsule-orb"
TITLES = {ORB_ALONE: "capsule, ORB alone"}
ROWS = (  # drive, perturbation
    ("block+change:1", "none"),
    ("block+change:0.9", "none"),
    ("block+change:0.9", "brightness:1.5"),
    ("lane+change:0.9", "none"),
)
COLUMNS = ("drive", "perturb", "detector", "seeds", "towns", "found", "missed", "wrong",
           "closed_by_orb", "closed_by_learned", "lost", "ate_median_m", "ate_max_m")  # fmt: skip


class Cell(NamedTuple):
    """One run: the drive without its seed, perturbation, detector, seed of the town."""

    drive: str
    perturb: str
    detector: str
    seed: int

    def folder(self, runs: Path) -> Path:
        return runs / f"{self.drive}-{self.perturb}-{self.detector}-{self.seed}".replace(":", "")


def rendered(drive: str, seed: int) -> bool:
    """Whether all frames of a drive in the town of that seed are there."""
    route, variation = parse_drive(f"{drive}+seed:{seed}")
    root = cache_folder() / folder_name(variation)
    return any(one.root == root and one.name == route and one.complete for one in STORED)


STORED = list_stored(cache_folder())


def run(cell: Cell, runs: Path) -> dict[str, Any]:
    """The report of a run, which is made if it is not there."""
    folder = cell.folder(runs)
    reports = sorted(folder.glob("*/report.json"))
    if not reports:
        orb_alone = cell.detector == ORB_ALONE
        command = ["run", "--dataset", "synthetic", "--seq", f"{cell.drive}+seed:{cell.seed}",
                   "--detector", "capsule" if orb_alone else cell.detector, "--quiet",
                   "--no-report", "--no-record", "--out", str(folder)]  # fmt: skip
        if cell.perturb != "none":
            command += ["--perturb", cell.perturb]
        if orb_alone:
            config = runs / "orb-alone.json"
            config.write_text(json.dumps({"verification": {"descriptors": "orb"}}))
            command += ["--config", str(config)]
        subprocess.run([sys.executable, "-m", "vslam", *command], check=True)
        reports = sorted(folder.glob("*/report.json"))
    found: dict[str, Any] = json.loads(reports[-1].read_text())
    return found


def row(cells: list[Cell], reports: list[dict[str, Any]]) -> dict[str, Any]:
    """The line of the table for the runs of a detector through the towns of a drive."""
    first = cells[0]
    closed = [one for report in reports for one in report["loops"] if one["accepted"]]
    by_learned = sum(one["matched_by"] == "learned" for one in closed)
    ate = [report["ate_rmse_m"] for report in reports]
    return {
        "drive": first.drive,
        "perturb": first.perturb,
        "detector": TITLES.get(first.detector, first.detector),
        "seeds": " ".join(str(cell.seed) for cell in cells),
        "towns": len(cells),
        "found": sum(report["loops_found"] for report in reports),
        "missed": sum(report["loops_missed"] for report in reports),
        "wrong": sum(report["loops_wrong"] for report in reports),
        "closed_by_orb": len(closed) - by_learned,
        "closed_by_learned": by_learned,
        "lost": sum(report["lost_frames"] for report in reports),
        "ate_median_m": f"{statistics.median(ate):.3f}",
        "ate_max_m": f"{max(ate):.3f}",
    }


def seeds_of(text: str) -> list[int]:
    """``401-416,420`` to numbers."""
    parts = [part.partition("-") for part in text.split(",")]
    return [s for first, _, last in parts for s in range(int(first), int(last or first) + 1)]


def rows_of(done: dict[Cell, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for drive, perturb in dict.fromkeys((cell.drive, cell.perturb) for cell in done):
        here = [cell for cell in done if (cell.drive, cell.perturb) == (drive, perturb)]
        for name in sorted({cell.detector for cell in here}):
            cells = sorted(cell for cell in here if cell.detector == name)
            yield row(cells, [done[cell] for cell in cells])


def write(rows: list[dict[str, Any]], out: Path) -> None:
    """Write the table; rows that it held stay, but those of seeds that are measured again."""

    def again(old: dict[str, Any]) -> bool:
        return any(
            all(old[key] == new[key] for key in ("drive", "perturb", "detector"))
            and set(old["seeds"].split()) & set(new["seeds"].split())
            for new in rows
        )

    if out.exists():
        with out.open(newline="") as file:
            rows = rows + [old for old in csv.DictReader(file) if not again(old)]
    rows.sort(key=lambda one: (one["drive"], one["perturb"], one["detector"], one["seeds"]))
    with out.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--seeds", type=seeds_of, default=seeds_of("401-416"))
    parser.add_argument("--detectors", default="bow,both")
    parser.add_argument("--drives", default=",".join("/".join(one) for one in ROWS),
                        help="DRIVE/PERTURBATION, with commas; default: %(default)s")  # fmt: skip
    parser.add_argument("--collect", action="store_true", help="run nothing, write the table")
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    given.runs.mkdir(parents=True, exist_ok=True)
    chosen = [tuple(one.split("/")) for one in given.drives.split(",")]
    done: dict[Cell, dict[str, Any]] = {}
    for seed in given.seeds:
        for drive, perturb in ROWS:
            for detector in given.detectors.split(","):
                cell = Cell(drive, perturb, detector, seed)
                there = any(cell.folder(given.runs).glob("*/report.json"))
                wanted = (drive, perturb) in chosen and not given.collect and rendered(drive, seed)
                if there or wanted:
                    done[cell] = run(cell, given.runs)
    rows = list(rows_of(done))
    write(list(rows), given.out)
    for one in rows:
        print(", ".join(f"{key} {value}" for key, value in one.items()))


if __name__ == "__main__":
    main()
