"""Measure the speed of vslam and ORB-SLAM3 (pyorbslam3) and write the results as Markdown.

    python tools/bench_speed.py --case "KITTI 00=/data/kitti:00:216" [--also="--detector both"] \
        [--repeats 3] [--write PAGE.md] [--csv docs/research/performance.csv] \
        [--orbslam3-python PY --vocabulary voc.txt]

A case is a folder in KITTI's format, a sequence in it and a number of frames. The two systems run
alternately, and never at the same time. The first round is not counted. In each round, vslam runs

- with its report,
- with ``--no-report``,
- with ``--no-report`` and the options of each ``--also``,
- in the last round, with ``--realtime``. This run takes as long as the drive.

The script keeps the beginning of the page and the section "Limits", which are written by hand.

The wall time, CPU time and peak memory are those of whole processes. The errors of both systems are
computed from their trajectory files.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

VSLAM = str(Path(sys.executable).with_name("vslam"))
SCRIPT = Path(__file__).parents[1] / "vslam" / "lab" / "stress" / "orbslam3.py"
PACKAGE = "pyorbslam3"
LOOP_MESSAGE = "*Loop detected"  # ORB-SLAM3 prints it once for each loop that it closes
# Variables of tools/figures.toml. HOME comes last, because the other paths may begin with it.
PATHS = (
    "OUT", "KITTI_ROOT", "KITTI_AS_PNG", "TOWNS", "ORBSLAM3_PYTHON", "ORBSLAM3_VOCABULARY", "HOME",
)  # fmt: skip
FULL, LEAN, LIVE, ORBSLAM3 = "vslam", "vslam --no-report", "vslam --realtime", "ORB-SLAM3"
HEAD = """## How it was measured

The command under *Setting* measured everything and wrote these sections. It runs one process at a \
time.

- **Detector.** vslam runs with the detector `bow`, because ORB-SLAM3 always looks for loops.
- **Report.** With its report, vslam also evaluates the trajectory and draws figures. ORB-SLAM3 \
does neither. For a fair comparison, vslam also runs with `--no-report` and without ground truth.
- **Whole process** is the time from the start of Python to its end. It includes reading the \
vocabulary, loading the kernels from Numba's cache and writing all files.
- **Frame loop** is the time from the first image to the last pose.
- **The same without reading images.** In the rows with this name, the CPU time for decoding both \
images of a frame is subtracted. This time was measured in separate processes: with vslam's own \
reader for vslam, and with `cv2.imread` for ORB-SLAM3.
- **Real-time run and profile.** Each of them is done once per case. `tools/profile_frame.py` \
takes the profile, with one thread.
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


MEASURES = (  # key of the figure, title with an arrow towards better values, format
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


class Case(NamedTuple):
    """The first ``frames`` frames of a sequence in KITTI's format."""

    title: str
    data: Path
    seq: str
    frames: int


class OrbSlam3(NamedTuple):
    python: Path
    vocabulary: Path


class Process(NamedTuple):
    """The output of a finished process, and the resources used by it and by its children.

    ``held`` is the memory of the process over time, as pairs (s, MB).
    """

    output: str
    wall_s: float
    cpu_s: float
    memory_mb: float
    held: list[tuple[float, float]]


class Run(NamedTuple):
    """One run of vslam or ORB-SLAM3.

    ``report`` contains at least the ``frames``, ``fps`` and ``cpu_ms_per_frame`` of the frame loop.
    ``trajectory`` is a file in KITTI's or TUM's format, which is deleted together with the folder
    of the run.
    """

    process: Process
    report: dict[str, Any]
    lost: int
    loops_closed: int
    trajectory: Path


def measure(command: list[str], folder: Path) -> Process:
    """Run a command, and measure its wall time, CPU time and peak memory.

    The caller must not import large packages before the call, because the peak memory of a child
    process starts at the peak memory of its parent.
    """
    log = folder / "output.txt"
    # Let Python store compiled modules, as pip does when it installs a package.
    environment = {key: os.environ[key] for key in os.environ if key != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    with log.open("wb") as output:
        child = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT,
            stdin=subprocess.PIPE,  # the script of ORB-SLAM3 ends when this pipe is closed
        )  # fmt: skip
        ended, held = threading.Event(), []
        watch = threading.Thread(target=sample_memory, args=(child.pid, ended, start, held))
        watch.start()
        try:
            _, status, usage = os.wait4(child.pid, 0)
            wall = time.perf_counter() - start
        finally:  # this is also executed after Ctrl-C
            ended.set()
            watch.join()
        child.returncode = os.waitstatus_to_exitcode(status)
        child.stdin.close()
    text = log.read_text(errors="replace")
    if child.returncode:
        sys.exit(f"{text}\n{' '.join(command)}: exit code {child.returncode}")
    return Process(text, wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, held)


def sample_memory(
    pid: int, ended: threading.Event, start: float, held: list[tuple[float, float]]
) -> None:
    while not ended.wait(0.1):
        with suppress(OSError):
            status = Path(f"/proc/{pid}/status").read_text()
            kilobytes = [line.split()[1] for line in status.splitlines() if "VmRSS" in line]
            held += [(time.perf_counter() - start, int(kb) / 1024) for kb in kilobytes]


def parse_case(text: str) -> Case:
    """Parse the text of a case, ``TITLE=DATA:SEQ:FRAMES``."""
    title, separator, place = text.partition("=")
    parts = place.rsplit(":", 2)
    if not separator or len(parts) != 3 or not parts[2].isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: write TITLE=DATA:SEQ:FRAMES")
    case = Case(title, Path(parts[0]).absolute(), parts[1], int(parts[2]))
    if missing := [side for side in sides(case) if not side.is_dir()]:
        raise argparse.ArgumentTypeError(f"{missing[0]}: no such folder; give a KITTI sequence")
    here = min(len(list(side.iterdir())) for side in sides(case))
    if not 2 <= case.frames <= here:
        raise argparse.ArgumentTypeError(f"{text}: FRAMES must be from 2 to {here}")
    return case


def sides(case: Case) -> list[Path]:
    return [case.data / "sequences" / case.seq / f"image_{side}" for side in (0, 1)]


def reading_ms(case: Case, system: str) -> float:
    """Measure the CPU time for decoding both images of a frame in one thread, in milliseconds."""
    files = [str(path) for side in sides(case) for path in sorted(side.iterdir())[: case.frames]]
    reader = "opencv" if system == ORBSLAM3 else "vslam"
    command = [sys.executable, "-c", READING, reader]
    done = subprocess.run(
        command, input="\n".join(files), capture_output=True, text=True, check=True
    )
    return 1e3 * float(done.stdout) / case.frames


def run_vslam(case: Case, folder: Path, *words: str) -> Run:
    """Run vslam on a case. ``words`` are added to its command line.

    With ``--no-report``, vslam gets no ground truth. Like ORB-SLAM3, it then does not evaluate its
    trajectory, so that their times can be compared.
    """
    data = case.data
    if "--no-report" in words:
        data = folder / "data"
        data.mkdir()
        (data / "sequences").symlink_to(case.data / "sequences")
    command = [VSLAM, "run", "--data", str(data), "--seq", case.seq, "--no-record", "--quiet"]
    command += ["--max-frames", str(case.frames), "--out", "runs", "--detector", "bow"]
    process = measure([*command, *words], folder)
    results = folder / "runs" / "latest"
    report = json.loads((results / "report.json").read_text())
    file = results / "trajectory_kitti.txt"
    return Run(process, report, report["lost_frames"], report["loops_closed"], file)


def run_orbslam3(case: Case, system: OrbSlam3, folder: Path) -> Run:
    command = [str(system.python), str(SCRIPT), str(system.vocabulary)]
    command += [str(case.data / "sequences" / case.seq), "out", "--frames", str(case.frames)]
    process = measure(command, folder)
    report = json.loads((folder / "out" / "costs.json").read_text())
    loops = process.output.count(LOOP_MESSAGE)
    return Run(process, report, report["lost"], loops, folder / "out" / "trajectory.txt")


def measure_case(
    case: Case, orbslam3: OrbSlam3 | None, repeats: int, also: list[str], scratch: str
) -> dict[str, list[Run]]:
    """Run all systems on a case several times, each time in a new folder in ``scratch``.

    Returns:
        The runs of each system, without the first round.
    """
    runs: dict[str, list[Run]] = {FULL: [], ORBSLAM3: [], LEAN: [], LIVE: []}
    words = {FULL: (), LEAN: ("--no-report",), LIVE: ("--no-report", "--realtime")}
    for options in also:
        runs[title := f"{LEAN} {options}"] = []
        # A --detector here replaces the --detector of run_vslam, because the last one counts.
        words[title] = ("--no-report", *shlex.split(options))
    if orbslam3 is None:
        del runs[ORBSLAM3]
    for repeat in range(repeats + 1):
        for system, done in runs.items():
            if system == LIVE and repeat < repeats:
                continue
            folder = Path(tempfile.mkdtemp(dir=scratch))
            if system == ORBSLAM3:
                assert orbslam3 is not None
                run = run_orbslam3(case, orbslam3, folder)
            else:
                run = run_vslam(case, folder, *words[system])
            counted = f"{repeat} of {repeats}" if repeat else "not counted"
            print(f"{case.title}, {system}: {run.process.wall_s:.1f} s, {counted}", file=sys.stderr)
            if repeat:
                done.append(run)
    return runs


def figures(run: Run, case: Case, reading: float) -> dict[str, float]:
    import numpy as np

    from vslam.datasets import open_sequence
    from vslam.evaluation.trajectories import evaluate_trajectory
    from vslam.support.errors import InputError
    from vslam.types.trajectory import Trajectory
    from vslam_lab.stress.external import read_poses

    process, frames = run.process, run.report["frames"]
    whole, loop = 1e3 * process.cpu_s / frames, run.report["cpu_ms_per_frame"]
    found = {
        "process_fps": frames / process.wall_s,
        "loop_fps": run.report["fps"],
        "process_cpu_ms": whole,
        "process_bare_ms": whole - reading,
        "loop_cpu_ms": loop,
        "loop_bare_ms": loop - reading,
        "memory_mb": process.memory_mb,
        "lost": float(run.lost),
        "loops_closed": float(run.loops_closed),
        "ate_m": float("nan"),
        "rpe_m": float("nan"),
    }
    sequence = open_sequence("kitti", case.data, case.seq, max_frames=case.frames)
    if sequence.ground_truth is not None:
        times = sequence.timestamps
        with suppress(InputError):  # too few frames have a pose
            # Frames without a pose get an interpolated pose, as in ``vslam stress``.
            estimate = read_poses(run.trajectory, times, np.arange(len(times))).bridged(times)
            errors = evaluate_trajectory(estimate, Trajectory(times, sequence.ground_truth))
            found |= {"ate_m": errors.ate_rmse_m, "rpe_m": errors.rpe_m}
    return found


def comparison(measured: dict[str, list[dict[str, float]]]) -> str:
    """Return a table of the medians of each system, and of the ratios to ORB-SLAM3 if it ran."""
    ours = [system for system in measured if system != ORBSLAM3]
    columns = ours + [ORBSLAM3] * (ORBSLAM3 in measured)
    head = [
        *columns,
        *([f"{system} / {ORBSLAM3}" for system in ours] if ORBSLAM3 in columns else []),
    ]
    lines = [f"| | {' | '.join(head)} |", "|---" * (len(head) + 1) + "|"]
    for name, title, form in MEASURES:
        medians = {s: statistics.median(run[name] for run in measured[s]) for s in columns}
        cells = [spread([run[name] for run in measured[s]], form) for s in columns]
        if ORBSLAM3 in columns:
            theirs = medians[ORBSLAM3]
            cells += [f"{medians[s] / theirs:.2f}" if theirs else "-" for s in ours]
        lines.append(f"| {title} | {' | '.join(cells)} |".replace("nan", "-"))
    return "\n".join(lines)


def spread(values: list[float], form: str) -> str:
    """Format values as ``median (smallest - largest)``, or as the median if they are all equal."""
    low, high = format(min(values), form), format(max(values), form)
    median = format(statistics.median(values), form)
    return median if low == high else f"{median} ({low} - {high})"


def latency(runs: dict[str, list[Run]], case: Case) -> str:
    """Return a table of the latency from an image to its pose.

    For ORB-SLAM3, the table contains the times of its tracking calls.
    """
    ours = [run.report for run in runs[LIVE]]
    values = [
        spread([report["latency_ms"][key] for report in ours], ".0f")
        for key in ("median", "p95", "p99")
    ]
    dropped = spread([report["dropped_frames"] for report in ours], ".0f")
    lines = ["| ms per frame | p50 | p95 | p99 | dropped |", "|---|---|---|---|---|"]
    row = f"| vslam, image to pose, {rate(case):.0f} Hz | {' | '.join(values)} | {dropped} |"
    lines.append(row)
    if theirs := [run.report for run in runs.get(ORBSLAM3, [])]:
        cells = [
            spread([report[key] for report in theirs], ".0f")
            for key in ("track_ms_median", "track_ms_p95")
        ]
        lines.append(
            f"| ORB-SLAM3, tracking call only, images already decoded | {' | '.join(cells)} | | |"
        )
    return "\n".join(lines)


def rate(case: Case) -> float:
    times = (case.data / "sequences" / case.seq / "times.txt").read_text().split()[: case.frames]
    return (len(times) - 1) / (float(times[-1]) - float(times[0]))


def stages(report: dict[str, Any]) -> str:
    """Return a table of the wall time of each stage of vslam.

    The sum of these times is not the time of a frame, because stages in the thread pool overlap
    with others.
    """
    lines = ["| stage, ms | mean | p50 | p95 | p99 |", "|---|---|---|---|---|"]
    for name, ms in report["stage_ms"].items():
        cells = [f"{ms[key]:.1f}" for key in ("mean", "median", "p95", "p99")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def memory(run: Run) -> str:
    """Return a sentence about the memory per keyframe.

    It is the growth of the memory use from the first frame to the peak, divided by the number of
    keyframes.
    """
    before = [mb for seconds, mb in run.process.held if seconds <= run.report["startup_s"]]
    if not before or not run.report["keyframes"]:
        return "The run was too short to measure the memory of a keyframe."
    growth = run.process.memory_mb - before[-1]
    kept = run.report["keyframes"]
    return (
        f"The process used {before[-1]:.0f} MB of memory before the first frame and "
        f"{run.process.memory_mb:.0f} MB at its peak. The growth, divided by the {kept} keyframes "
        f"of the final map, is {growth / kept:.2f} MB per keyframe."
    )


def measures(
    case: Case, runs: dict[str, list[Run]], reading: dict[str, float]
) -> dict[str, list[dict[str, float]]]:
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
    return (
        f"## {case.title}\n\nThe drive has {case.frames} frames. Decoding both images of a frame "
        f"takes {reading[FULL]:.1f} ms of CPU time with vslam's reader, and "
        f"{reading[ORBSLAM3]:.1f} ms with OpenCV.\n\n"
        f"{comparison(measured)}\n\n{latency(runs, case)}\n\n{stages(runs[FULL][-1].report)}\n\n"
        f"{memory(runs[LEAN][-1])}\n\n{profile(case)}"
    )


def profile(case: Case) -> str:
    """Return a table of the CPU time per frame by stage; an empty text if profiling fails."""
    tool = str(Path(__file__).with_name("profile_frame.py"))
    command = [sys.executable, tool, str(case.data), case.seq, str(case.frames)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        print(f"{case.title}, no profile: {done.stderr}", file=sys.stderr)
    return done.stdout


def orbslam3_of(options: argparse.Namespace) -> OrbSlam3 | None:
    given = (options.orbslam3_python, options.vocabulary)
    if not any(given):
        return None
    if missing := [path for path in given if path is None or not path.exists()]:
        sys.exit(f"ORB-SLAM3 needs --orbslam3-python and --vocabulary: {missing[0]}")
    return OrbSlam3(*given)


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    shape = "TITLE=DATA:SEQ:FRAMES"
    parser.add_argument("--case", type=parse_case, action="append", required=True, metavar=shape)
    parser.add_argument("--repeats", type=int, default=3, help="counted runs of each system")
    parser.add_argument(
        "--also", action="append", default=[], metavar="OPTIONS", help="more options to run with"
    )
    # Paths must be absolute, because each run has its own working folder. Symbolic links are kept,
    # because the link to the interpreter determines its virtual environment.
    for name in ("--orbslam3-python", "--vocabulary"):
        parser.add_argument(name, type=lambda text: Path(text).absolute())
    parser.add_argument("--write", type=Path, help="file to write; printed unless given")
    parser.add_argument("--csv", type=Path, help="table to write: a row for each case and system")
    options = parser.parse_args()
    if options.repeats < 1:
        parser.error("--repeats: at least 1")
    return options


def setting_of(report: dict[str, Any], system: OrbSlam3 | None, repeats: int) -> str:
    ask = f"from importlib.metadata import version; print(version('{PACKAGE}'))"
    version = ""
    if system is not None:
        done = subprocess.run([system.python, "-c", ask], capture_output=True, text=True)
        version = f"; {PACKAGE} {done.stdout.strip() or '(version unknown)'}"
    machine = report["machine"]
    ours = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    return (
        f"The comparisons give the median (minimum - maximum) of {repeats} runs of each system. "
        f"The systems ran alternately, on {time.strftime('%Y-%m-%d')}. Machine: "
        f"{machine['cpu']}, {machine['cores']} cores, {machine['platform']}. Versions: "
        f"{ours}{version}. *method* is the version of the SLAM method (`vslam.METHOD_VERSION`)."
    )


def anonymous(words: list[str]) -> str:
    """Return a command with variables instead of the paths of this machine."""
    command = shlex.join(words).replace("'", '"')  # variables are expanded in double quotes only
    for name in PATHS:
        if path := os.environ.get(name, "").rstrip("/"):
            command = command.replace(path, f"${name}")
    return command


def written(page: Path) -> tuple[str, str]:
    """Return the hand-written parts of a page: before ``BEGIN``, and after ``END``."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    above, begin, rest = text.partition(BEGIN)
    _, end, below = rest.partition(END)
    return (above, end + below) if begin else ("# Performance\n\n", "")


def write_table(path: Path, cases: dict[str, dict[str, list[dict[str, float]]]]) -> None:
    """Write the median, the smallest and the largest value of each measure, by case and system."""
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
    orbslam3 = orbslam3_of(options)
    with tempfile.TemporaryDirectory(prefix="vslam-speed-") as scratch:
        # No large package may be imported before the last run (measure).
        done = [
            (case, measure_case(case, orbslam3, options.repeats, options.also, scratch))
            for case in options.case
        ]
        sections, tables = [], {}
        for case, runs in done:
            reading = {system: reading_ms(case, system) for system in (FULL, ORBSLAM3)}
            tables[case.title] = measures(case, runs, reading)
            sections.append(section(case, runs, reading, tables[case.title]))
    setting = setting_of(done[0][1][FULL][0].report, orbslam3, options.repeats)
    setting += f" The load of the machine was {load:.1f} when the command began."
    text = "\n".join((
        HEAD, *sections, f"## Setting\n\n{setting}\n",
        f"```sh\npython {anonymous(sys.argv)}\n```\n",
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
