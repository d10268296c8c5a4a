r"""Make each part of vslam fail once during a run, and record the messages and results of the run.

tests/faults.py defines the faults and the points of a run at which they are injected. It also
decides whether an outcome is correct.

    python tools/experiments/lifelong/inject_faults.py --out faults.csv
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Collection
from dataclasses import astuple, fields
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # a forked process has no other threads
sys.path.insert(0, str(Path(__file__).parents[3] / "tests"))
from faults import FAULTS, POINTS, Row, inject, load_everything, run_in_fork, write_ring


def inject_all(
    work: Path, points: Collection[str], faults: Collection[str], seed: int, *, once: bool
) -> list[Row]:
    """Inject faults at the given points of a run, and print the outcome of each fault.

    Args:
        work: an empty folder.
        once: whether only one random fault is injected at each point, instead of all faults.
    """
    load_everything()
    rows = []
    write_ring(root := work / "kitti")
    words = ["run", "--data", str(root), "--quiet", "--no-record", "--no-report"]
    code = run_in_fork([*words, "--out", str(work / "whole")], work / "log", lambda: None)
    if code != 0:
        sys.exit(f"the undisturbed run fails: {(work / 'log').read_text()}")
    whole = (work / "whole" / "latest" / "trajectory.tum").read_bytes()
    for point in POINTS:
        if point.name not in points:
            continue
        drawn = random.Random(f"{seed} {point.function}").choice(sorted(faults))
        for fault in [drawn] if once else faults:
            folder = work / f"{len(rows)}"
            folder.mkdir()
            row = inject(root, folder, point, fault, seed, whole)
            print(*astuple(row), sep="\t", flush=True)
            rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", nargs="+", default=[point.name for point in POINTS])
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--once", action="store_true", help="inject one random fault per point")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="CSV table of all injections")
    options = parser.parse_args()
    work = Path(tempfile.mkdtemp())  # a forked process would delete a TemporaryDirectory at its end
    try:
        rows = inject_all(work, options.points, options.faults, options.seed, once=options.once)
    finally:
        shutil.rmtree(work)
    if options.out is not None:
        with options.out.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(field.name for field in fields(Row))
            table.writerows(map(astuple, rows))
    bad = [row for row in rows if row.wrong]
    print(f"{len(rows)} injections, {len(bad)} handled badly", flush=True)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
