"""Run vslam and ORB-SLAM3 (pyorbslam3) on the same images in turn and print a table of medians.

Each system runs as a process of its own, alternately and never at once, after one round that is
not counted (compiled kernels, disk cache). Wall time, CPU time and peak memory are the kernel's
figures for the whole process: start, vocabulary, files written and all. Errors come from
vslam.evaluation.trajectories for both, on the trajectory files that they wrote.

ORB-SLAM3 is run by a script that takes VOCABULARY SEQUENCE_FOLDER OUT --frames N, writes a pose a
frame to OUT in KITTI's format and prints a JSON object with frames, fps, cpu_ms_per_frame and
lost. With ``--sensor mono`` it is given ``--mono --rate 20`` (it loses its way when images come
faster than its mapping) and writes its keyframes in TUM's format: its ATE is that of its keyframes
alone. Loops are found, missed and wrong by the ground truth for vslam (vslam.evaluation.loops); of
ORB-SLAM3 only the closed ones are known: ``loops`` of that object, or the lines that ORB-SLAM3
prints for them.

usage: python tools/compare_orbslam3.py --data KITTI --seq 06 --frames 51 --repeats 3 \
           --orbslam3-python PY --orbslam3-script run_orbslam3.py --vocabulary voc.txt
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

PACKAGE = "pyorbslam3"
LOOP_MESSAGE = "*Loop detected"  # printed once for each loop that it closes
MEASURES = (  # key, title with an arrow to the better side, format
    ("process_fps", "frames/s, whole process ↑", ".1f"),
    ("loop_fps", "frames/s, frame loop ↑", ".1f"),
    ("process_cpu_ms", "CPU ms/frame, whole process ↓", ".1f"),
    ("loop_cpu_ms", "CPU ms/frame, frame loop ↓", ".1f"),
    ("wall_s", "wall time, s ↓", ".1f"),
    ("cpu_s", "CPU time, s ↓", ".1f"),
    ("memory_mb", "peak memory, MB ↓", ".0f"),
    ("lost", "lost frames ↓", ".0f"),
    ("loops_closed", "loops closed", ".0f"),
    ("loops_missed", "revisits without a loop ↓", ".0f"),
    ("loops_wrong", "wrong loops ↓", ".0f"),
    ("ate_m", "ATE, aligned, m ↓", ".3f"),
    ("rpe_m", "RPE per frame, m ↓", ".4f"),
    ("t_rel", "t_rel, % ↓", ".3f"),
)


class Process(NamedTuple):
    """A process that has ended: its output and the kernel's account of it and its children;
    ``held`` is the memory it held at times since its start, as (s, MB)."""

    output: str
    wall_s: float
    cpu_s: float
    memory_mb: float
    held: list[tuple[float, float]]


class Run(NamedTuple):
    """One run: what the system reports of itself (``frames``, ``fps`` and ``cpu_ms_per_frame`` of
    the frame loop, and more), its lost frames, its loops closed, missed and wrong (None where it
    does not say), and its trajectory, in KITTI's format or, with times, in TUM's."""

    process: Process
    report: dict[str, Any]
    lost: int
    loops: tuple[int | None, int | None, int | None]
    trajectory: str


def measure(command: list[str], folder: Path) -> Process:
    """Run a command to its end and account for it. Nothing heavy may be imported before: the
    peak memory of a child starts at that of its parent."""
    log = folder / "output.txt"
    # Modules are compiled once, as when pip installs them.
    environment = {key: os.environ[key] for key in os.environ if key != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    with log.open("wb") as output:
        child = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT
        )
        ended, held = threading.Event(), []
        watch = threading.Thread(target=sample_memory, args=(child.pid, ended, start, held))
        watch.start()
        try:
            _, status, usage = os.wait4(child.pid, 0)
            wall = time.perf_counter() - start
        finally:  # Ctrl-C, too
            ended.set()
            watch.join()
        child.returncode = os.waitstatus_to_exitcode(status)
    text = log.read_text(errors="replace")
    if child.returncode:
        sys.exit(f"{text}\n{' '.join(command)}: exit code {child.returncode}")
    return Process(text, wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, held)


def sample_memory(
    pid: int, ended: threading.Event, start: float, held: list[tuple[float, float]]
) -> None:
    """Note twice a second what a process holds."""
    while not ended.wait(0.5):
        with suppress(OSError):
            status = Path(f"/proc/{pid}/status").read_text()
            kilobytes = [line.split()[1] for line in status.splitlines() if "VmRSS" in line]
            held += [(time.perf_counter() - start, int(kb) / 1024) for kb in kilobytes]


def run_vslam(options: argparse.Namespace, folder: Path, *words: str) -> Run:
    """Run vslam, with more ``words`` on its command line."""
    command = [options.vslam, "run", "--data", str(options.data), "--seq", options.seq]
    command += ["--max-frames", str(options.frames), "--no-record", "--quiet", "--out", "runs"]
    command += ["--detector", options.detector, "--sensor", options.sensor]
    if options.threads:
        command += ["--threads", str(options.threads)]
    if getattr(options, "no_report", False):
        command.append("--no-report")
    process = measure([*command, *words], folder)
    results = folder / "runs" / "latest"
    report = json.loads((results / "report.json").read_text())
    trajectory = (results / "trajectory_kitti.txt").read_text()
    loops = report["loops_closed"], report["loops_missed"], report["loops_wrong"]
    return Run(process, report, report["lost_frames"], loops, trajectory)


def run_orbslam3(options: argparse.Namespace, folder: Path) -> Run:
    sequence = options.data / "sequences" / options.seq
    command = [str(options.orbslam3_python), str(options.orbslam3_script), str(options.vocabulary)]
    command += [str(sequence), "out.txt", "--frames", str(options.frames)]
    command += ["--mono", "--rate", "20"] if options.sensor == "mono" else []
    process = measure(command, folder)
    said = next(line for line in reversed(process.output.splitlines()) if line.startswith("{"))
    report = json.loads(said)
    loops = report.get("loops", process.output.count(LOOP_MESSAGE))
    trajectory = (folder / "out.txt").read_text()
    return Run(process, report, report["lost"], (loops, None, None), trajectory)


def figures(run: Run, options: argparse.Namespace) -> dict[str, float]:
    """Every measure of one run; NaN where it has no value, as t_rel on a path below 100 m."""
    from vslam.datasets import open_sequence
    from vslam.errors import InputError
    from vslam.evaluation.trajectories import evaluate_trajectory
    from vslam.trajectory import Trajectory, read_trajectory

    process, frames = run.process, run.report["frames"]
    found = {
        "process_fps": frames / process.wall_s,
        "loop_fps": run.report["fps"],
        "process_cpu_ms": 1e3 * process.cpu_s / frames,
        "loop_cpu_ms": run.report["cpu_ms_per_frame"],
        "wall_s": process.wall_s,
        "cpu_s": process.cpu_s,
        "memory_mb": process.memory_mb,
        "lost": float(run.lost),
    }
    nan = float("nan")
    for name, count in zip(("closed", "missed", "wrong"), run.loops, strict=True):
        found[f"loops_{name}"] = nan if count is None else float(count)
    found |= dict.fromkeys(("ate_m", "rpe_m", "t_rel"), nan)
    sequence = open_sequence("kitti", options.data, options.seq, max_frames=options.frames)
    if sequence.ground_truth is None:
        return found
    with tempfile.NamedTemporaryFile("w") as file:
        file.write(run.trajectory)
        file.flush()
        try:
            estimate = read_trajectory(Path(file.name), sequence.timestamps)
        except InputError:  # too few poses: which belongs to which frame is not known
            return found
    truth = Trajectory(sequence.timestamps, sequence.ground_truth)
    if options.sensor == "mono":  # without a unit, and of ORB-SLAM3 keyframes alone
        return found | {"ate_m": evaluate_trajectory(estimate, truth, "sim3").ate_rmse_m}
    errors = evaluate_trajectory(estimate, truth)
    t_rel = errors.t_rel_percent
    found |= {"ate_m": errors.ate_rmse_m, "rpe_m": errors.rpe_m}
    return found | {"t_rel": nan if t_rel is None else t_rel}


def spread(values: list[float], form: str) -> str:
    """Median (least - greatest), the median alone where they are the same as printed."""
    low, high = format(min(values), form), format(max(values), form)
    median = format(statistics.median(values), form)
    return median if low == high else f"{median} ({low} - {high})"


def table(ours: list[dict[str, float]], theirs: list[dict[str, float]]) -> str:
    """Markdown: median (least - greatest) of each, and the ratio of the medians."""
    lines = ["| | vslam | ORB-SLAM3 | ratio |", "|---|---|---|---|"]
    for name, title, form in MEASURES:
        cells, medians = [], []
        for runs in (ours, theirs):
            values = [run[name] for run in runs]
            medians.append(statistics.median(values))
            cells.append(spread(values, form))
        counted = name.startswith("loops_")  # a ratio of counts says nothing
        ratio = "-" if counted or not medians[1] else f"{medians[0] / medians[1]:.2f}"
        row = f"| {title} | {cells[0]} | {cells[1]} | {ratio} |"
        lines.append(row.replace("nan", "-"))
    return "\n".join(lines)


def setting(report: dict[str, Any], orbslam3_python: Path | None, repeats: int) -> str:
    """Machine, versions and the number of runs, as one paragraph, from a report of vslam."""
    ask = f"from importlib.metadata import version; print(version('{PACKAGE}'))"
    version = ""
    if orbslam3_python is not None:
        said = subprocess.run([orbslam3_python, "-c", ask], capture_output=True, text=True)
        version = f"; {PACKAGE} {said.stdout.strip() or '(version unknown)'}"
    machine = report["machine"]
    ours = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    return (
        f"median (least - greatest) of {repeats} runs each, alternating, "
        f"{time.strftime('%Y-%m-%d')}. "
        f"{machine['cpu']}, {machine['cores']} cores, {machine['platform']}. {ours}{version}."
    )


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with sequences and poses")
    parser.add_argument("--seq", default="00")
    parser.add_argument("--frames", type=int, required=True, help="frames, from the first one")
    parser.add_argument("--repeats", type=int, default=3, help="counted runs of each system")
    parser.add_argument("--threads", type=int, help="of vslam; its default unless given")
    parser.add_argument("--detector", default="none", help="loop detector of vslam")
    parser.add_argument(
        "--no-report", action="store_true", help="vslam draws no page either; its figures as JSON"
    )
    parser.add_argument("--sensor", default="stereo", choices=("stereo", "mono"))
    parser.add_argument("--vslam", default=str(Path(sys.executable).with_name("vslam")))
    parser.add_argument("--orbslam3-python", type=Path, required=True)
    parser.add_argument("--orbslam3-script", type=Path, required=True)
    parser.add_argument("--vocabulary", type=Path, required=True)
    options = parser.parse_args()
    # The runs have working folders of their own. A link to the interpreter is what makes an
    # environment: it is not followed.
    for name in ("data", "orbslam3_python", "orbslam3_script", "vocabulary"):
        path = getattr(options, name).absolute()
        if not path.exists():
            parser.error(f"--{name.replace('_', '-')} {path}: not there")
        setattr(options, name, path)
    return options


def main() -> None:
    options = parse_options()
    runs: dict[str, list[Run]] = {"vslam": [], "ORB-SLAM3": []}
    with tempfile.TemporaryDirectory(prefix="vslam-orbslam3-") as scratch:
        for repeat in range(options.repeats + 1):
            for name, start in (("vslam", run_vslam), ("ORB-SLAM3", run_orbslam3)):
                run = start(options, Path(scratch))
                counted = f"{repeat} of {options.repeats}" if repeat else "not counted"
                print(f"{name}: {run.process.wall_s:.1f} s, {counted}", file=sys.stderr)
                if repeat:
                    runs[name].append(run)
    ours, theirs = ([figures(run, options) for run in done] for done in runs.values())
    frames = f"KITTI {options.seq}, frames 0-{options.frames - 1}, --detector {options.detector}"
    about = setting(runs["vslam"][0].report, options.orbslam3_python, options.repeats)
    print(f"{table(ours, theirs)}\n\n{frames}, {about}")


if __name__ == "__main__":
    main()
