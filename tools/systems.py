"""Shared code of the scripts that compare vslam and ORB-SLAM3 (pyorbslam3): running both as
processes, and measuring their cost and accuracy.

Wall time, CPU time and peak memory are those of the whole process, as the kernel reports them. The
errors of both are computed by vslam.evaluation.trajectories from their trajectory files.

ORB-SLAM3 is run by vslam/lab/stress/orbslam3.py, as in ``vslam stress``. In a monocular run it gets
20 images per second, because it gets lost if images come faster than its mapping; its ATE is then
that of the keyframes. The loops of vslam are evaluated by the ground truth
(vslam.evaluation.loops). For ORB-SLAM3, only the number of closed loops is known, from its
messages.
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

VSLAM = str(Path(sys.executable).with_name("vslam"))
SCRIPT = Path(__file__).parents[1] / "vslam" / "lab" / "stress" / "orbslam3.py"
PACKAGE = "pyorbslam3"
LOOP_MESSAGE = "*Loop detected"  # printed once for each loop that it closes


class Case(NamedTuple):
    """Frames to run on: ``frames`` of a sequence in KITTI's format, from the first one."""

    title: str
    data: Path
    seq: str
    frames: int


class OrbSlam3(NamedTuple):
    """The interpreter that has pyorbslam3, and its vocabulary."""

    python: Path
    vocabulary: Path


class Process(NamedTuple):
    """A process that has ended: its output, and the resources used by it and its children;
    ``held`` has its memory over time, as (s, MB)."""

    output: str
    wall_s: float
    cpu_s: float
    memory_mb: float
    held: list[tuple[float, float]]


class Run(NamedTuple):
    """One run: the system's own report (``frames``, ``fps`` and ``cpu_ms_per_frame`` of the frame
    loop, and more), lost frames, numbers of closed, missed and wrong loops (None if unknown), and
    the file of the trajectory in KITTI's or TUM's format, which lives as long as the folder of the
    run."""

    process: Process
    report: dict[str, Any]
    lost: int
    loops: tuple[int | None, int | None, int | None]
    trajectory: Path


def measure(command: list[str], folder: Path) -> Process:
    """Run a command to its end and measure it. No large package may be imported before, because
    the peak memory of a child starts at that of its parent."""
    log = folder / "output.txt"
    # Modules are compiled once, as when pip installs them.
    environment = {key: os.environ[key] for key in os.environ if key != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    with log.open("wb") as output:
        child = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT,
            stdin=subprocess.PIPE,  # ORB-SLAM3's script ends when it closes
        )  # fmt: skip
        ended, held = threading.Event(), []
        watch = threading.Thread(target=sample_memory, args=(child.pid, ended, start, held))
        watch.start()
        try:
            _, status, usage = os.wait4(child.pid, 0)
            wall = time.perf_counter() - start
        finally:  # also after Ctrl-C
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
    """Record the memory of a process twice a second."""
    while not ended.wait(0.5):
        with suppress(OSError):
            status = Path(f"/proc/{pid}/status").read_text()
            kilobytes = [line.split()[1] for line in status.splitlines() if "VmRSS" in line]
            held += [(time.perf_counter() - start, int(kb) / 1024) for kb in kilobytes]


def run_vslam(case: Case, folder: Path, *words: str) -> Run:
    """Run vslam, with more ``words`` on its command line."""
    command = [VSLAM, "run", "--data", str(case.data), "--seq", case.seq, "--no-record", "--quiet"]
    command += ["--max-frames", str(case.frames), "--out", "runs"]
    process = measure([*command, *words], folder)
    results = folder / "runs" / "latest"
    report = json.loads((results / "report.json").read_text())
    loops = report["loops_closed"], report["loops_missed"], report["loops_wrong"]
    file = results / "trajectory_kitti.txt"
    return Run(process, report, report["lost_frames"], loops, file)


def run_orbslam3(case: Case, system: OrbSlam3, folder: Path, sensor: str = "stereo") -> Run:
    command = [str(system.python), str(SCRIPT), str(system.vocabulary)]
    command += [str(case.data / "sequences" / case.seq), "out", "--frames", str(case.frames)]
    command += ["--mono", "--rate", "20"] if sensor == "mono" else []
    process = measure(command, folder)
    said = next(line for line in reversed(process.output.splitlines()) if line.startswith("{"))
    report = json.loads(said)
    loops = process.output.count(LOOP_MESSAGE), None, None
    return Run(process, report, report["lost"], loops, folder / "out" / "trajectory.txt")


def figures(run: Run, case: Case, sensor: str = "stereo") -> dict[str, float]:
    """Every measure of one run; NaN where it has no value, as t_rel on a path below 100 m."""
    import numpy as np

    from vslam.datasets import open_sequence
    from vslam.errors import InputError
    from vslam.evaluation.trajectories import evaluate_trajectory
    from vslam.lab.stress.external import read_poses
    from vslam.trajectory import Trajectory, read_trajectory

    process, frames = run.process, run.report["frames"]
    found = {
        "process_fps": frames / process.wall_s,
        "loop_fps": run.report["fps"],
        "process_cpu_ms": 1e3 * process.cpu_s / frames,
        "loop_cpu_ms": run.report["cpu_ms_per_frame"],
        "memory_mb": process.memory_mb,
        "lost": float(run.lost),
    }
    nan = float("nan")
    for name, count in zip(("closed", "missed", "wrong"), run.loops, strict=True):
        found[f"loops_{name}"] = nan if count is None else float(count)
    found |= dict.fromkeys(("ate_m", "rpe_m", "t_rel"), nan)
    sequence = open_sequence("kitti", case.data, case.seq, max_frames=case.frames)
    if sequence.ground_truth is None:
        return found
    times = sequence.timestamps
    truth = Trajectory(times, sequence.ground_truth)
    try:
        if sensor == "mono":  # the scale is unknown, and ORB-SLAM3 writes only keyframes
            estimate = read_trajectory(run.trajectory, times)
            return found | {"ate_m": evaluate_trajectory(estimate, truth, "sim3").ate_rmse_m}
        # Frames without a pose get an interpolated one, as in ``vslam stress``.
        estimate = read_poses(run.trajectory, times, np.arange(len(times))).bridged(times)
        errors = evaluate_trajectory(estimate, truth)
    except InputError:  # hardly a frame has a pose
        return found
    t_rel = errors.t_rel_percent
    found |= {"ate_m": errors.ate_rmse_m, "rpe_m": errors.rpe_m}
    return found | {"t_rel": nan if t_rel is None else t_rel}


def spread(values: list[float], form: str) -> str:
    """Median (least - greatest), or the median alone if both are equal as printed."""
    low, high = format(min(values), form), format(max(values), form)
    median = format(statistics.median(values), form)
    return median if low == high else f"{median} ({low} - {high})"


def setting(report: dict[str, Any], system: OrbSlam3 | None, repeats: int) -> str:
    """Machine, versions and the number of runs, as one paragraph, from a report of vslam."""
    ask = f"from importlib.metadata import version; print(version('{PACKAGE}'))"
    version = ""
    if system is not None:
        said = subprocess.run([system.python, "-c", ask], capture_output=True, text=True)
        version = f"; {PACKAGE} {said.stdout.strip() or '(version unknown)'}"
    machine = report["machine"]
    ours = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    return (
        f"Median (least - greatest) of {repeats} runs each, alternating, "
        f"{time.strftime('%Y-%m-%d')}. "
        f"{machine['cpu']}, {machine['cores']} cores, {machine['platform']}. {ours}{version}."
    )


def run_over(
    data: Path, name: str, system: OrbSlam3 | None, *words: str, sensor: str = "stereo"
) -> tuple[Run, dict[str, float]]:
    """Run ORB-SLAM3, or vslam with more ``words`` for None, over all frames of a drive."""
    case = Case(name, data, name, len(list((data / "sequences" / name / "image_0").iterdir())))
    with tempfile.TemporaryDirectory(prefix="vslam-table-") as scratch:
        folder = Path(scratch)
        if system is None:
            run = run_vslam(case, folder, "--sensor", sensor, *words)
        else:
            run = run_orbslam3(case, system, folder, sensor)
        return run, figures(run, case, sensor)


def add_orbslam3_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that locate ORB-SLAM3; without them, it is left out."""
    for name in ("orbslam3-python", "vocabulary"):
        # Paths must be absolute, because each run has its own working folder. Links must not be
        # resolved, because the link to the interpreter determines the virtual environment.
        parser.add_argument(f"--{name}", type=lambda text: Path(text).absolute())


def orbslam3_of(options: argparse.Namespace) -> OrbSlam3 | None:
    """ORB-SLAM3 by the options of :func:`add_orbslam3_options`; None without them."""
    given = (options.orbslam3_python, options.vocabulary)
    if not any(given):
        return None
    if missing := [path for path in given if path is None or not path.exists()]:
        sys.exit(f"ORB-SLAM3 needs --orbslam3-python and --vocabulary: {missing[0]}")
    return OrbSlam3(*given)
