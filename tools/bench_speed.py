"""Measure the speed of vslam and ORB-SLAM3, and write a CSV table.

    python tools/bench_speed.py --case "KITTI 00=/data/kitti:00:216" [--also="--detector both"] \
        [--repeats 3] [--orbslam3-python PY --vocabulary voc.txt] --csv speed.csv

A case is a folder in KITTI's format, a sequence in it and a number of frames, ``DATA:SEQ:FRAMES``.
With ``:mono`` at its end, only the left images are used. A case ``DATA::FRAMES:rgbd`` is a folder
of TUM's RGB-D data.

The systems run alternately, and never at the same time. The first round is not counted. In each
round, vslam runs with its report, with ``--no-report``, and with ``--no-report`` and the options of
each ``--also``.

The wall time, CPU time and peak memory are those of whole processes. ORB-SLAM3 gets the images of
one camera no faster than the camera took them, and the time that it waits for them is not counted.
It reads RGB-D images and those of one camera from PNG files, whose distortion is corrected. The
errors of all systems are computed from their trajectory files, those of one camera with a scale.
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
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

VSLAM = str(Path(sys.executable).with_name("vslam"))
SCRIPT = Path(__file__).parent / "vslam_lab" / "stress" / "orbslam3.py"
LOOP_MESSAGE = "*Loop detected"  # ORB-SLAM3 prints it once for each loop that it closes
FULL, LEAN, ORBSLAM3 = "vslam", "vslam --no-report", "ORB-SLAM3"
_IMAGES = {"stereo": ("image_0", "image_1"), "mono": ("image_0",), "rgbd": ("rgb", "depth")}
_TRUTH = ("poses", "groundtruth.txt")
# Runs in a process of its own, because the caller must not import large packages (measure).
_EXPORT = """
import sys
from pathlib import Path

from bench_speed import Case, opened
from vslam.datasets.perturbation import Perturbation
from vslam_lab.stress.external import export_kitti

data, seq, frames, sensor, folder = sys.argv[1:]
source = opened(Case("", Path(data), seq, int(frames), sensor))
export_kitti(source, Perturbation("none"), Path(folder))
"""
MEASURES = {  # columns and formats
    "process_fps": ".1f",
    "loop_fps": ".1f",
    "process_cpu_ms": ".1f",
    "loop_cpu_ms": ".1f",
    "memory_mb": ".0f",
    "lost": ".0f",
    "loops_closed": ".0f",
    "ate_m": ".3f",
    "rpe_m": ".4f",
}


class Case(NamedTuple):
    """The first ``frames`` frames of a sequence: in KITTI's format if the sensor is ``stereo`` or
    ``mono``, and in TUM's if it is ``rgbd``."""

    title: str
    data: Path
    seq: str
    frames: int
    sensor: str = "stereo"


class OrbSlam3(NamedTuple):
    python: Path
    vocabulary: Path


class Process(NamedTuple):
    """The output of a finished process, and the resources used by it and by its children."""

    output: str
    wall_s: float
    cpu_s: float
    memory_mb: float


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
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.perf_counter() - start
        child.returncode = os.waitstatus_to_exitcode(status)
        child.stdin.close()
    text = log.read_text(errors="replace")
    if child.returncode:
        sys.exit(f"{text}\n{' '.join(command)}: exit code {child.returncode}")
    return Process(text, wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def parse_case(text: str) -> Case:
    """Parse the text of a case, ``TITLE=DATA:SEQ:FRAMES`` or ``TITLE=DATA:SEQ:FRAMES:SENSOR``."""
    title, separator, place = text.partition("=")
    place, _, sensor = place.rpartition(":")
    if sensor not in _IMAGES:
        place, sensor = f"{place}:{sensor}", "stereo"
    parts = place.rsplit(":", 2)
    if not separator or len(parts) != 3 or not parts[2].isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: write TITLE=DATA:SEQ:FRAMES[:SENSOR]")
    case = Case(title, Path(parts[0]).absolute(), parts[1], int(parts[2]), sensor)
    sequence = case.data if sensor == "rgbd" else case.data / "sequences" / case.seq
    sides = [sequence / name for name in _IMAGES[sensor]]
    if missing := [side for side in sides if not side.is_dir()]:
        raise argparse.ArgumentTypeError(f"{missing[0]}: no such folder; give a {sensor} sequence")
    here = min(len(list(side.iterdir())) for side in sides)
    if not 2 <= case.frames <= here:
        raise argparse.ArgumentTypeError(f"{text}: FRAMES must be from 2 to {here}")
    return case


def run_vslam(case: Case, folder: Path, *words: str) -> Run:
    """Run vslam on a case. ``words`` are added to its command line.

    With ``--no-report``, vslam gets no ground truth. Like ORB-SLAM3, it then does not evaluate its
    trajectory, so that their times can be compared. The detector is ``bow``, because ORB-SLAM3
    always looks for loops.
    """
    data = case.data
    if "--no-report" in words:
        data = folder / case.data.name  # the name of TUM's folders tells their calibration
        data.mkdir()
        for path in case.data.iterdir():
            if path.name not in _TRUTH:
                (data / path.name).symlink_to(path)
    chosen = [] if case.sensor == "rgbd" else ["--seq", case.seq]
    if case.sensor == "mono":
        chosen += ["--sensor", "mono"]
    command = [VSLAM, "run", "--data", str(data), *chosen, "--no-record", "--quiet"]
    command += ["--max-frames", str(case.frames), "--out", "runs", "--detector", "bow"]
    process = measure([*command, *words], folder)
    results = folder / "runs" / "latest"
    report = json.loads((results / "report.json").read_text())
    file = results / "trajectory_kitti.txt"
    return Run(process, report, report["lost_frames"], report["loops_closed"], file)


def exported(case: Case, scratch: str) -> Path:
    """Return the folder that ORB-SLAM3 reads. That of a stereo camera is the folder of the case."""
    if case.sensor == "stereo":
        return case.data / "sequences" / case.seq
    folder = Path(tempfile.mkdtemp(dir=scratch)) / "sequence"
    command = [sys.executable, "-c", _EXPORT, str(case.data), case.seq, str(case.frames)]
    here = Path(__file__).parent  # where this module can be imported
    subprocess.run([*command, case.sensor, str(folder)], check=True, cwd=here)
    return folder


def run_orbslam3(case: Case, images: Path, system: OrbSlam3, folder: Path) -> Run:
    command = [str(system.python), str(SCRIPT), str(system.vocabulary)]
    command += [str(images), "out", "--frames", str(case.frames)]
    process = measure(command, folder)
    report = json.loads((folder / "out" / "costs.json").read_text())
    process = process._replace(wall_s=process.wall_s - report["waited_s"])
    loops = process.output.count(LOOP_MESSAGE)
    return Run(process, report, report["lost"], loops, folder / "out" / "trajectory.txt")


def measure_case(
    case: Case, orbslam3: OrbSlam3 | None, repeats: int, also: list[str], scratch: str
) -> dict[str, list[Run]]:
    """Run all systems on a case several times, each time in a new folder in ``scratch``.

    Returns:
        The runs of each system, without the first round.
    """
    # A --detector in ``also`` replaces the --detector of run_vslam, because the last one counts.
    more = {f"{LEAN} {options}": ("--no-report", *shlex.split(options)) for options in also}
    words = {FULL: (), ORBSLAM3: (), LEAN: ("--no-report",), **more}
    if orbslam3 is None:
        del words[ORBSLAM3]
    runs: dict[str, list[Run]] = {system: [] for system in words}
    images = exported(case, scratch) if orbslam3 else case.data
    for repeat in range(repeats + 1):
        for system, done in runs.items():
            folder = Path(tempfile.mkdtemp(dir=scratch))
            if system == ORBSLAM3:
                assert orbslam3 is not None
                run = run_orbslam3(case, images, orbslam3, folder)
            else:
                run = run_vslam(case, folder, *words[system])
            counted = f"{repeat} of {repeats}" if repeat else "not counted"
            print(f"{case.title}, {system}: {run.process.wall_s:.1f} s, {counted}", file=sys.stderr)
            if repeat:
                done.append(run)
    return runs


def opened(case: Case) -> Any:
    """Open the images of a case as a `Source`."""
    from vslam.datasets import open_sequence

    dataset = "tum" if case.sensor == "rgbd" else "kitti"
    mono = case.sensor == "mono"
    return open_sequence(dataset, case.data, case.seq, max_frames=case.frames, monocular=mono)


def measures(run: Run, case: Case) -> dict[str, float]:
    import numpy as np

    from vslam.evaluation.trajectories import evaluate_trajectory
    from vslam.run.outcome import ground_truth_of
    from vslam.support.errors import InputError
    from vslam_lab.stress.external import read_poses

    process, frames = run.process, run.report["frames"]
    found = {
        "process_fps": frames / process.wall_s,
        "loop_fps": run.report["fps"],
        "process_cpu_ms": 1e3 * process.cpu_s / frames,
        "loop_cpu_ms": run.report["cpu_ms_per_frame"],
        "memory_mb": process.memory_mb,
        "lost": float(run.lost),
        "loops_closed": float(run.loops_closed),
        "ate_m": float("nan"),
        "rpe_m": float("nan"),
    }
    sequence = opened(case)
    if (truth := ground_truth_of(sequence)) is not None:
        times = sequence.timestamps
        with suppress(InputError):  # too few frames have a pose
            # Frames without a pose get an interpolated pose, as in ``vslam stress``.
            estimate = read_poses(run.trajectory, times, np.arange(len(times))).bridged(times)
            alignment = "sim3" if case.sensor == "mono" else "se3"
            errors = evaluate_trajectory(estimate, truth, alignment)
            found |= {"ate_m": errors.ate_rmse_m, "rpe_m": errors.rpe_m}
    return found


def write_table(path: Path, cases: dict[str, dict[str, list[dict[str, float]]]]) -> None:
    """Write the median, the smallest and the largest value of each measure, by case and system."""
    endings = {"": statistics.median, "_least": min, "_greatest": max}
    names = [f"{key}{ending}" for key in MEASURES for ending in endings]
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["case", "system", "runs", *names])
        for title, measured in cases.items():
            for system, runs in measured.items():
                cells = [
                    format(of([run[key] for run in runs]), form).replace("nan", "")
                    for key, form in MEASURES.items()
                    for of in endings.values()
                ]
                table.writerow([title, system, len(runs), *cells])


def orbslam3_of(options: argparse.Namespace) -> OrbSlam3 | None:
    given = (options.orbslam3_python, options.vocabulary)
    if not any(given):
        return None
    if missing := [path for path in given if path is None or not path.exists()]:
        sys.exit(f"ORB-SLAM3 needs --orbslam3-python and --vocabulary: {missing[0]}")
    return OrbSlam3(*given)


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    shape = "TITLE=DATA:SEQ:FRAMES[:SENSOR]"
    parser.add_argument("--case", type=parse_case, action="append", required=True, metavar=shape)
    parser.add_argument("--repeats", type=int, default=3, help="counted runs of each system")
    parser.add_argument(
        "--also", action="append", default=[], metavar="OPTIONS", help="more options to run with"
    )
    # Paths must be absolute, because each run has its own working folder. Symbolic links are kept,
    # because the link to the interpreter determines its virtual environment.
    for name in ("--orbslam3-python", "--vocabulary"):
        parser.add_argument(name, type=lambda text: Path(text).absolute())
    parser.add_argument("--csv", type=Path, required=True, help="table to write")
    options = parser.parse_args()
    if options.repeats < 1:
        parser.error("--repeats: at least 1")
    return options


def main() -> None:
    options = parse_options()
    print(f"load of the machine: {os.getloadavg()[0]:.1f}", file=sys.stderr)
    orbslam3 = orbslam3_of(options)
    with tempfile.TemporaryDirectory(prefix="vslam-speed-") as scratch:
        # No large package may be imported before the last run (measure).
        done = [
            (case, measure_case(case, orbslam3, options.repeats, options.also, scratch))
            for case in options.case
        ]
        tables = {
            case.title: {s: [measures(run, case) for run in some] for s, some in runs.items()}
            for case, runs in done
        }
    write_table(options.csv, tables)


if __name__ == "__main__":
    main()
