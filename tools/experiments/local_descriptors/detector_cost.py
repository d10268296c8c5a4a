r"""What loop detectors cost whole runs, side by side, as a Markdown table.

    python tools/experiments/local_descriptors/detector_cost.py \
        --case "demo=$HOME/.cache/vslam/synthetic/v2-seed0:demo:477" \
        [--detectors bow,both] [--repeats 5]

A case is a folder in KITTI's format, a sequence in it and a number of frames. The detectors run in
turn, one process at a time, after one round that is not counted. *CPU*, *wall* and *peak memory*
are of the whole process, without report and recording; the percentages and differences are to the
first detector's medians. The ground truth is there: the time to judge by it is counted for all.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2]))  # tools/

import compare_orbslam3
from bench_speed import Case, parse_case


class Cost(NamedTuple):
    """Of one run: seconds of CPU and wall, the most memory held in MB, and its loops."""

    cpu_s: float
    wall_s: float
    memory_mb: float
    closed: int | None
    missed: int | None
    wrong: int | None


def measure(case: Case, detector: str, vslam: str) -> Cost:
    """Run vslam once."""
    options = argparse.Namespace(
        **case._asdict(), vslam=vslam, detector=detector, sensor="stereo", threads=None
    )
    with tempfile.TemporaryDirectory(prefix="vslam-cost-") as scratch:
        run = compare_orbslam3.run_vslam(options, Path(scratch), "--no-report")
    process = run.process
    return Cost(process.cpu_s, process.wall_s, process.memory_mb, *run.loops)


def table(costs: dict[tuple[str, str], list[Cost]]) -> str:
    """Medians by case and detector, against the first detector of the case."""
    lines = [
        "| case | detector | CPU, s | wall, s | peak memory, MB | loops closed / missed / wrong |",
        "|---|---|---|---|---|---|",
    ]
    first: dict[str, list[float]] = {}
    for (case, detector), runs in costs.items():
        medians = [
            statistics.median(getattr(run, name) for run in runs)
            for name in ("cpu_s", "wall_s", "memory_mb")
        ]
        cells = [f"{medians[0]:.2f}", f"{medians[1]:.2f}", f"{medians[2]:.0f}"]
        base = first.setdefault(case, medians)
        if base is not medians:
            for k in (0, 1):
                cells[k] += f" ({100 * (medians[k] / base[k] - 1):+.1f} %)"
            cells[2] += f" ({medians[2] - base[2]:+.0f})"
        last = runs[-1]
        loops = " / ".join("-" if n is None else str(n) for n in last[3:])
        lines.append(f"| {case} | `{detector}` | {' | '.join(cells)} | {loops} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--case", type=parse_case, action="append", required=True, metavar="TITLE=DATA:SEQ:FRAMES"
    )
    parser.add_argument("--detectors", default="bow,both", help="default: %(default)s")
    parser.add_argument("--repeats", type=int, default=5, help="counted runs of each")
    parser.add_argument("--vslam", default=str(Path(sys.executable).with_name("vslam")))
    given = parser.parse_args()
    detectors = given.detectors.split(",")
    if given.repeats < 1 or len(set(detectors)) < len(detectors):
        parser.error("--repeats: at least 1; --detectors: each once")
    costs: dict[tuple[str, str], list[Cost]] = {
        (case.title, name): [] for case in given.case for name in detectors
    }
    for case in given.case:
        for repeat in range(given.repeats + 1):
            for name in detectors:
                cost = measure(case, name, given.vslam)
                print(f"{case.title}, {name}: {cost.cpu_s:.2f} s CPU", file=sys.stderr)
                if repeat:
                    costs[case.title, name].append(cost)
    print(table(costs))


if __name__ == "__main__":
    main()
