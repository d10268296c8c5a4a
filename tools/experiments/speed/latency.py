"""Measure the latency from image to pose while a drive is played in real time.

    python tools/experiments/speed/latency.py --data KITTI --seq 00 --frames 216 --out latency.csv

The same images are played at several rates. ``median_ms``, ``p95_ms`` and ``p99_ms`` are
percentiles over the frames of a run, and ``dropped`` is the number of frames that came while the
frame before was still tracked. Each row is the median of several runs. The first run is not
counted.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

VSLAM = str(Path(sys.executable).with_name("vslam"))
PERCENTILES = {"median_ms": "median", "p95_ms": "p95", "p99_ms": "p99"}


def played(data: Path, seq: str, rate: float, folder: Path) -> Path:
    """Make a data set with the images of a sequence in KITTI's format, and with other times."""
    sequence = folder / "data" / "sequences" / seq
    sequence.mkdir(parents=True)
    for path in (data / "sequences" / seq).iterdir():
        if path.name != "times.txt":
            (sequence / path.name).symlink_to(path.absolute())
    rows = (data / "sequences" / seq / "times.txt").read_text().split()
    (sequence / "times.txt").write_text("".join(f"{k / rate:.6e}\n" for k in range(len(rows))))
    return folder / "data"


def run(data: Path, seq: str, frames: int, rate: float, detector: str) -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="vslam-latency-") as name:
        folder = Path(name)
        command = [VSLAM, "run", "--data", str(played(data, seq, rate, folder))]
        command += ["--seq", seq, "--max-frames", str(frames), "--detector", detector, "--realtime"]
        command += ["--no-report", "--no-record", "--quiet", "--out", str(folder / "runs")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        report = json.loads((folder / "runs" / "latest" / "report.json").read_text())
    found = {column: report["latency_ms"][key] for column, key in PERCENTILES.items()}
    return {**found, "dropped": report["dropped_frames"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder in KITTI's format")
    parser.add_argument("--seq", default="00")
    parser.add_argument("--frames", type=int, default=216)
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 20.0])
    parser.add_argument("--detectors", nargs="+", default=["bow", "both"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    with options.out.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["rate_hz", "detector", "runs", *PERCENTILES, "dropped"])
        for rate in options.rates:
            for detector in options.detectors:
                given = (options.data, options.seq, options.frames, rate, detector)
                runs = [run(*given) for _ in range(options.repeats + 1)][1:]
                cells = [statistics.median(one[key] for one in runs) for key in runs[0]]
                row = [f"{rate:g}", detector, len(runs), *(f"{cell:.1f}" for cell in cells)]
                print(*row, flush=True)
                table.writerow(row)


if __name__ == "__main__":
    main()
