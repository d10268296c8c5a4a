"""Write docs/research/loops/night_runs.csv: short loops that are hard to close, for each detector
with verification by ORB, by learned descriptors, or by both.

    vslam synth block --seed 501 --change 1    # and so on, with other seeds and drives
    python tools/experiments/local_descriptors/night_runs.py --runs FOLDER --seeds 501-516

Drives that are not rendered completely are left out: the column ``towns`` counts the others. A run
whose report lies in FOLDER is not repeated, so the same command continues; a new version of vslam
needs a new folder. Each run compares all detectors on the same frames (``vslam run --compare``).
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from vslam.datasets.synthetic import parse_drive
from vslam.datasets.synthetic.store import cache_folder, folder_name, list_stored
from vslam.report.schema import ReportJson

OUT = Path(__file__).parents[3] / "docs" / "research" / "loops" / "night_runs.csv"
DRIVES = ("block+change:1", "lane+change:0.9", "block+aliased")
DETECTORS = ("both", "bow", "capsule")  # the first one is the run's, the others are compared
VERIFIED_BY = ("usual", "both", "orb", "learned")  # of verification.descriptors
COLUMNS = (
    "drive", "candidates", "verified_by", "seeds", "towns", "found", "missed", "wrong", "lost",
    "ate_median_m", "ate_max_m", "loops_by",
)  # fmt: skip


def run(drive: str, seed: int, verified_by: str, detectors: list[str], runs: Path) -> ReportJson:
    """The report of one comparison, which is run if its report does not exist."""
    folder = runs / f"{drive}-{seed}-{verified_by}".replace(":", "")
    if not (reports := sorted(folder.glob("*/report.json"))):
        config = runs / f"verified-by-{verified_by}.json"
        config.write_text(json.dumps({"verification": {"descriptors": verified_by}}))
        command = [
            sys.executable, "-m", "vslam", "run", "--dataset", "synthetic",
            "--seq", f"{drive}+seed:{seed}", "--detector", detectors[0],
            "--compare", ",".join(detectors[1:]), "--config", str(config),
            "--quiet", "--no-report", "--no-record", "--out", str(folder),
        ]  # fmt: skip
        subprocess.run(command, check=True)
        reports = sorted(folder.glob("*/report.json"))
    return ReportJson.model_validate_json(reports[-1].read_bytes())


def row(
    drive: str, detector: str, verified_by: str, reports: dict[int, ReportJson]
) -> dict[str, Any]:
    """The row of a detector over the towns of a drive."""
    figures = [
        one for report in reports.values() for one in report.detectors if one.detector == detector
    ]
    ate = [one.ate_rmse_m for one in figures if one.ate_rmse_m is not None]
    by = Counter(
        f"{loop.proposed_by}/{loop.matched_by}"
        for report in reports.values()
        for loop in report.loops
        if loop.accepted and report.detector == detector
    )
    return {
        "drive": drive,
        "candidates": detector,
        "verified_by": verified_by,
        "seeds": " ".join(map(str, reports)),
        "towns": len(figures),
        "found": sum(one.loops_found or 0 for one in figures),
        "missed": sum(one.loops_missed or 0 for one in figures),
        "wrong": sum(one.loops_wrong or 0 for one in figures),
        "lost": sum(one.lost_frames for one in figures),
        "ate_median_m": f"{statistics.median(ate):.3f}",
        "ate_max_m": f"{max(ate):.3f}",
        "loops_by": " ".join(f"{name}:{count}" for name, count in sorted(by.items())),
    }


def rendered(drive: str, seed: int) -> bool:
    """Whether all frames of a drive in the town of that seed are rendered."""
    route, variation = parse_drive(f"{drive}+seed:{seed}")
    root = cache_folder() / folder_name(variation)
    stored = list_stored(cache_folder())
    return any(one.root == root and one.name == route and one.complete for one in stored)


def seeds_of(text: str) -> list[int]:
    """``501-516,520`` to numbers."""
    parts = [part.partition("-") for part in text.split(",")]
    return [s for first, _, last in parts for s in range(int(first), int(last or first) + 1)]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--seeds", type=seeds_of, default=seeds_of("501-516"))
    parser.add_argument("--drives", default=",".join(DRIVES), help="default: %(default)s")
    parser.add_argument("--detectors", default=",".join(DETECTORS), help="default: %(default)s")
    parser.add_argument("--verified-by", default=",".join(VERIFIED_BY), help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    given.runs.mkdir(parents=True, exist_ok=True)
    drives, verified = given.drives.split(","), given.verified_by.split(",")
    detectors = given.detectors.split(",")
    done: dict[tuple[str, str], dict[int, ReportJson]] = {}
    for seed in given.seeds:
        for drive in drives:
            if rendered(drive, seed):
                for by in verified:
                    report = run(drive, seed, by, detectors, given.runs)
                    done.setdefault((drive, by), {})[seed] = report
    rows = [row(d, name, by, reports) for (d, by), reports in done.items() for name in detectors]
    rows.sort(key=lambda one: (drives.index(one["drive"]), one["candidates"], one["verified_by"]))
    with given.out.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    for one in rows:
        print(", ".join(f"{key} {value}" for key, value in one.items()))


if __name__ == "__main__":
    main()
