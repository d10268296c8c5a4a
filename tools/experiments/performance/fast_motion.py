"""Measure how tracking copes with fast motion, by using only every N-th frame of a sequence.

    python tools/experiments/performance/fast_motion.py --every 3 4 5 --out fast.csv \\
      --source "00=--dataset kitti --data $KITTI_ROOT --seq 00 --max-frames 216"

A source is a name for the table and a list of options of ``vslam run``. Each run is made twice:
with the attempt to find the pose after a sudden turn (``track_sudden_motion``), and without this
attempt. The table has a row for each pair of runs.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

# No pose has more inliers than matches, so a ratio of 1 is hardly ever reached.
WAYS = {"without": ["--config", "tracking.sudden_min_inlier_ratio=1"], "with": []}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", action="append", required=True, metavar="NAME=OPTIONS")
    parser.add_argument("--every", type=int, nargs="+", required=True, metavar="N")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    sources = [source.partition("=") for source in options.source]
    rows = [row(name, source.split(), n) for name, _, source in sources for n in options.every]
    with options.out.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def row(name: str, source: list[str], every: int) -> dict[str, object]:
    reports = {way: run(source, every, options) for way, options in WAYS.items()}
    made: dict[str, object] = {
        "sequence": name,
        "every": every,
        "frames": reports["with"]["frames"],
    }
    for way, report in reports.items():
        made |= {
            f"lost_{way}": report["lost_frames"],
            f"ate_m_{way}": f"{report['ate_rmse_m']:.3f}",
        }
    print(made, flush=True)
    return made


def run(source: list[str], every: int, options: list[str]) -> dict[str, float]:
    words = list(source)
    if "--max-frames" in words:
        at = words.index("--max-frames") + 1
        words[at] = str(-(-int(words[at]) // every))
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "vslam", "run", *words, f"--every={every}", *options]
        command += ["--no-report", "--no-record", "--quiet", "--out", folder]
        subprocess.run(command, check=True)
        found: dict[str, float] = json.loads(Path(folder, "latest", "report.json").read_text())
    return found


if __name__ == "__main__":
    main()
