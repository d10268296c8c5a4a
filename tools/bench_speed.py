"""Measure the speed of vslam and ORB-SLAM3 (pyorbslam3), and write the results as Markdown.

    python tools/bench_speed.py --case "KITTI 00=/data/kitti:00:216" [--also capsule] \
        [--repeats 3] [--write docs/research/performance.md] [--csv docs/research/performance.csv] \
        [--orbslam3-python PY --orbslam3-script run_orbslam3.py --vocabulary voc.txt]

A case is a folder in KITTI's format, a sequence in it and a number of frames. The systems run one
at a time and alternate, after one round that is not counted. vslam runs with its report, with
``--no-report``, with ``--no-report`` and each detector of ``--also`` instead of ``bow``, and in the
last round with ``--realtime``, which takes as long as the drive. systems.py describes what the
script of ORB-SLAM3 takes and prints; its ``track_ms_median`` and ``track_ms_p95`` are optional. The
hand-written parts of the page, at its beginning and from "Limits" on, are kept.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import systems
from systems import Case, OrbSlam3, Run

FULL, LEAN, LIVE, ORBSLAM3 = "vslam", "vslam --no-report", "vslam --realtime", "ORB-SLAM3"
HEAD = """## How it was measured

The command below, under *Setting*, writes these sections. It runs one process at a time. *Load* \
is the load of the machine when the command began. *Whole process* is the time from the start of \
Python to its end, including the vocabulary, the kernels from Numba's cache and all files written. \
*Frame loop* is the time from the first image to the last pose. vslam runs with the detector \
`bow`, because ORB-SLAM3 always looks for loops. For its report, vslam evaluates the trajectory by \
the ground truth and draws figures. ORB-SLAM3 does neither; for a fair comparison, vslam with \
`--no-report` gets no ground truth. *Reading images* is the CPU time for decoding both images of a \
frame, measured in separate processes with vslam's own reader for vslam and `cv2.imread` for \
ORB-SLAM3. The rows without reading images subtract it. The real-time run and the profile, which \
`tools/profile_frame.py` takes with one thread, are done once per case.
"""
BEGIN, END = "## How it was measured\n", "\n## Limits\n"  # the rest of the page is hand-written
READING = """
import sys, time, cv2
from pathlib import Path
cv2.setNumThreads(1)
files = sys.stdin.read().splitlines()
if sys.argv[1] == "vslam":
    from vslam.datasets.image_files import read_grey
    def read(file):
        read_grey(Path(file))
else:
    def read(file):
        cv2.imread(file, cv2.IMREAD_GRAYSCALE)
read(files[0])  # imports, and kernels from the cache
start = time.process_time()
for file in files:
    read(file)
print(time.process_time() - start)
"""


MEASURES = (  # key of systems.figures, title with an arrow to the better side, format
    ("process_fps", "frames/s, whole process ↑", ".1f"),
    ("loop_fps", "frames/s, frame loop ↑", ".1f"),
    ("process_cpu_ms", "CPU ms/frame, whole process ↓", ".1f"),
    ("process_bare_ms", "the same without reading images ↓", ".1f"),
    ("loop_cpu_ms", "CPU ms/frame, frame loop ↓", ".1f"),
    ("loop_bare_ms", "the same without reading images ↓", ".1f"),
    ("memory_mb", "peak memory, MB ↓", ".0f"),
    ("lost", "lost frames ↓", ".0f"),
    ("loops_closed", "loops closed", ".0f"),
    ("ate_m", "ATE, aligned, m ↓", ".3f"),
    ("rpe_m", "RPE per frame, m ↓", ".4f"),
)


def parse_case(text: str) -> Case:
    """``TITLE=DATA:SEQ:FRAMES``."""
    title, separator, place = text.partition("=")
    parts = place.rsplit(":", 2)
    if not separator or len(parts) != 3 or not parts[2].isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: write TITLE=DATA:SEQ:FRAMES")
    data = Path(parts[0]).absolute()
    if not (data / "sequences" / parts[1]).is_dir():
        raise argparse.ArgumentTypeError(f"{data / 'sequences' / parts[1]}: no such folder")
    case = Case(title, data, parts[1], int(parts[2]))
    here = min(len(list(side.iterdir())) for side in sides(case))
    if not 2 <= case.frames <= here:
        raise argparse.ArgumentTypeError(f"{text}: FRAMES must be from 2 to {here}")
    return case


def sides(case: Case) -> list[Path]:
    """Folders of the left and right images."""
    return [case.data / "sequences" / case.seq / f"image_{side}" for side in (0, 1)]


def reading_ms(case: Case, system: str) -> float:
    """CPU milliseconds in which a system decodes both images of a frame, in one thread."""
    files = [str(path) for side in sides(case) for path in sorted(side.iterdir())[: case.frames]]
    reader = "opencv" if system == ORBSLAM3 else "vslam"
    command = [sys.executable, "-c", READING, reader]
    done = subprocess.run(
        command, input="\n".join(files), capture_output=True, text=True, check=True
    )
    return 1e3 * float(done.stdout) / case.frames


def run_vslam(case: Case, scratch: str, *words: str) -> Run:
    """Run vslam. Without a report, it gets no ground truth, as ORB-SLAM3 evaluates nothing."""
    if "--no-report" in words:
        data = Path(scratch, "data")
        data.mkdir()
        (data / "sequences").symlink_to(case.data / "sequences")
        case = case._replace(data=data)
    return systems.run_vslam(case, Path(scratch), "--detector", "bow", *words)


def measure_case(
    case: Case, orbslam3: OrbSlam3 | None, repeats: int, also: list[str]
) -> dict[str, list[Run]]:
    """All counted runs of each system."""
    runs: dict[str, list[Run]] = {FULL: [], ORBSLAM3: [], LEAN: [], LIVE: []}
    words = {FULL: (), LEAN: ("--no-report",), LIVE: ("--no-report", "--realtime")}
    for name in also:
        runs[title := f"{LEAN} --detector {name}"] = []
        # If the command line has two detectors, the last one counts.
        words[title] = ("--no-report", "--detector", name)
    if orbslam3 is None:
        del runs[ORBSLAM3]
    for repeat in range(repeats + 1):
        for system, done in runs.items():
            if system == LIVE and repeat < repeats:
                continue
            with tempfile.TemporaryDirectory(prefix="vslam-speed-") as scratch:
                if system == ORBSLAM3:
                    assert orbslam3 is not None
                    run = systems.run_orbslam3(case, orbslam3, Path(scratch))
                else:
                    run = run_vslam(case, scratch, *words[system])
            counted = f"{repeat} of {repeats}" if repeat else "not counted"
            print(f"{case.title}, {system}: {run.process.wall_s:.1f} s, {counted}", file=sys.stderr)
            if repeat:
                done.append(run)
    return runs


def figures(run: Run, case: Case, reading: float) -> dict[str, float]:
    """Every measure of one run."""
    found = systems.figures(run, case)
    for name in ("process", "loop"):
        found[f"{name}_bare_ms"] = found[f"{name}_cpu_ms"] - reading
    return found


def comparison(measured: dict[str, list[dict[str, float]]]) -> str:
    """A table of medians, with the ratios to ORB-SLAM3 if it ran."""
    ours = [system for system in measured if system != ORBSLAM3]
    columns = ours + [ORBSLAM3] * (ORBSLAM3 in measured)
    head = [
        *columns,
        *([f"{system} / {ORBSLAM3}" for system in ours] if ORBSLAM3 in columns else []),
    ]
    lines = [f"| | {' | '.join(head)} |", "|---" * (len(head) + 1) + "|"]
    for name, title, form in MEASURES:
        medians = {s: statistics.median(run[name] for run in measured[s]) for s in columns}
        cells = [systems.spread([run[name] for run in measured[s]], form) for s in columns]
        if ORBSLAM3 in columns:
            theirs = medians[ORBSLAM3]
            cells += [f"{medians[s] / theirs:.2f}" if theirs else "-" for s in ours]
        lines.append(f"| {title} | {' | '.join(cells)} |".replace("nan", "-"))
    return "\n".join(lines)


def latency(runs: dict[str, list[Run]], case: Case) -> str:
    """Milliseconds from the time of an image to its pose, and ORB-SLAM3's own tracking times."""
    ours = [run.report for run in runs[LIVE]]
    values = [
        systems.spread([report["latency_ms"][key] for report in ours], ".0f")
        for key in ("median", "p95", "p99")
    ]
    dropped = systems.spread([report["dropped_frames"] for report in ours], ".0f")
    lines = ["| ms per frame | p50 | p95 | p99 | dropped |", "|---|---|---|---|---|"]
    row = f"| vslam, image to pose, {rate(case):.0f} Hz | {' | '.join(values)} | {dropped} |"
    lines.append(row)
    theirs = [run.report for run in runs.get(ORBSLAM3, [])]
    if theirs and "track_ms_median" in theirs[0]:
        cells = [
            systems.spread([report[key] for report in theirs], ".0f")
            for key in ("track_ms_median", "track_ms_p95")
        ]
        lines.append(
            f"| ORB-SLAM3, tracking call only, images already decoded | {' | '.join(cells)} | | |"
        )
    return "\n".join(lines)


def rate(case: Case) -> float:
    """Frames per second of the recording."""
    times = (case.data / "sequences" / case.seq / "times.txt").read_text().split()[: case.frames]
    return (len(times) - 1) / (float(times[-1]) - float(times[0]))


def stages(report: dict[str, Any]) -> str:
    """Wall milliseconds of each stage; stages in the thread pool overlap with the others."""
    lines = ["| stage, ms | mean | p50 | p95 | p99 |", "|---|---|---|---|---|"]
    for name, ms in report["stage_ms"].items():
        cells = [f"{ms[key]:.1f}" for key in ("mean", "median", "p95", "p99")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def memory(run: Run) -> str:
    """Memory per keyframe: the growth from the first frame to the peak, divided by keyframes."""
    before = [mb for seconds, mb in run.process.held if seconds <= run.report["startup_s"]]
    if not before or not run.report["keyframes"]:
        return "The run was too short to measure the memory of a keyframe."
    grown = run.process.memory_mb - before[-1]
    kept = run.report["keyframes"]
    return (
        f"Memory: {before[-1]:.0f} MB before the first frame, {run.process.memory_mb:.0f} MB at "
        f"its peak, with {kept} keyframes in the final map: {grown / kept:.2f} MB per keyframe."
    )


def measures(
    case: Case, runs: dict[str, list[Run]], reading: dict[str, float]
) -> dict[str, list[dict[str, float]]]:
    """Every measure of the runs of each system, except those in real time."""
    return {
        s: [figures(run, case, reading[ORBSLAM3 if s == ORBSLAM3 else FULL]) for run in runs[s]]
        for s in runs
        if s != LIVE
    }


def section(
    case: Case,
    runs: dict[str, list[Run]],
    reading: dict[str, float],
    measured: dict[str, list[dict[str, float]]],
) -> str:
    """The section of a case."""
    return (
        f"## {case.title}\n\n{case.frames} frames. "
        f"Reading both images: {reading[FULL]:.1f} ms CPU, by OpenCV {reading[ORBSLAM3]:.1f}.\n\n"
        f"{comparison(measured)}\n\n{latency(runs, case)}\n\n{stages(runs[FULL][-1].report)}\n\n"
        f"{memory(runs[LEAN][-1])}\n\n{profile(case)}"
    )


def profile(case: Case) -> str:
    """The CPU time of a frame by stage; empty on failure, so that the measurements are not lost."""
    tool = str(Path(__file__).with_name("profile_frame.py"))
    command = [sys.executable, tool, str(case.data), case.seq, str(case.frames)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        print(f"{case.title}, no profile: {done.stderr}", file=sys.stderr)
    return done.stdout


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    shape = "TITLE=DATA:SEQ:FRAMES"
    parser.add_argument("--case", type=parse_case, action="append", required=True, metavar=shape)
    parser.add_argument("--repeats", type=int, default=3, help="counted runs of each system")
    parser.add_argument(
        "--also", action="append", default=[], metavar="DETECTOR", help="run with it as well"
    )
    systems.add_orbslam3_options(parser)
    parser.add_argument("--write", type=Path, help="file to write; printed unless given")
    parser.add_argument("--csv", type=Path, help="table to write: a row for each case and system")
    options = parser.parse_args()
    if options.repeats < 1:
        parser.error("--repeats: at least 1")
    return options


def anonymous(command: str) -> str:
    """Remove the paths of this machine from a command."""
    for name in ("KITTI_ROOT", "HOME"):
        if path := os.environ.get(name, "").rstrip("/"):
            command = command.replace(path, f"${name}")
    return command


def written(page: Path) -> tuple[str, str]:
    """The hand-written parts of a page: before ``BEGIN``, and from ``END`` on."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    above, begin, rest = text.partition(BEGIN)
    _, end, below = rest.partition(END)
    return (above, end + below) if begin else ("# Performance\n\n", "")


def write_table(path: Path, cases: dict[str, dict[str, list[dict[str, float]]]]) -> None:
    """Write a row for each case and system: median, least and greatest value of each measure."""
    endings = {"": statistics.median, "_least": min, "_greatest": max}
    names = [f"{key}{ending}" for key, *_ in MEASURES for ending in endings]
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["case", "system", "runs", *names])
        for title, measured in cases.items():
            for system, runs in measured.items():
                cells = [
                    format(of([run[key] for run in runs]), form).replace("nan", "")
                    for key, _, form in MEASURES
                    for of in endings.values()
                ]
                table.writerow([title, system, len(runs), *cells])


def main() -> None:
    options = parse_options()
    load = os.getloadavg()[0]
    orbslam3 = systems.orbslam3_of(options)
    # No large package may be imported before the last run; see systems.measure.
    done = [
        (case, measure_case(case, orbslam3, options.repeats, options.also)) for case in options.case
    ]
    setting = systems.setting(done[0][1][FULL][0].report, orbslam3, options.repeats)
    sections, tables = [], {}
    for case, runs in done:
        reading = {system: reading_ms(case, system) for system in (FULL, ORBSLAM3)}
        tables[case.title] = measures(case, runs, reading)
        sections.append(section(case, runs, reading, tables[case.title]))
    text = "\n".join((
        HEAD, *sections,
        f"## Setting\n\n{setting} Load at the start: {load:.1f}.\n",
        f"```sh\npython {anonymous(shlex.join(sys.argv))}\n```\n",
    ))  # fmt: skip
    if options.write:
        above, below = written(options.write)
        options.write.write_text(f"{above}{text}{below}", encoding="utf-8")
    else:
        print(text)
    if options.csv:
        write_table(options.csv, tables)


if __name__ == "__main__":
    main()
