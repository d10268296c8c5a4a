"""Measure the speed of vslam beside ORB-SLAM3 (pyorbslam3), and write it down as Markdown.

    python tools/bench_speed.py --case "KITTI 00=/data/kitti:00:216" \
        [--flat "town 00=/data/towns:kitti00:4541"] [--ours-only] [--also capsule] [--repeats 3] \
        [--orbslam3-python PY --orbslam3-script run_orbslam3.py --vocabulary voc.txt] \
        [--write docs/research/performance.md]

A case is a folder in KITTI's format, a sequence in it and a number of frames. The systems run in
turn, one at a time, after one round that is not counted; vslam with its report, with
``--no-report``, and in the last round with ``--realtime``, which takes as long as the drive; with
``--also`` once more without a report and with another detector than ``bow``. Of a ``--flat`` case
vslam runs once, and the time of its frames is drawn along the drive. What the script of ORB-SLAM3
takes and prints is said in compare_orbslam3.py; ``track_ms_median`` and ``track_ms_p95`` are taken
where it prints them. What people wrote on the page, from "Limits" on, is kept.
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
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import compare_orbslam3
from compare_orbslam3 import Run, spread

BLOCK = 100  # frames that one point of the drawing stands for
AHEAD = {"read_ms", "extract_ms"}  # stages done by the pool, beside tracking
FULL, LEAN, LIVE, ORBSLAM3 = "vslam", "vslam --no-report", "vslam --realtime", "ORB-SLAM3"
SHOWN = {
    "process_fps", "loop_fps", "process_cpu_ms", "loop_cpu_ms", "memory_mb", "lost", "ate_m"
}  # fmt: skip
HEAD = """## How it was measured

The command at the end of this page writes it. It runs one process at a time. *Load* is the load \
of the machine when the command began. *Whole process* is the time from the start of Python to \
its end, including the vocabulary, the kernels from Numba's cache and all files written. *Frame \
loop* is the time from the first image to the last pose. vslam runs with the detector `bow`, \
because ORB-SLAM3 always looks for loops. Its report judges the trajectory by the ground truth and \
draws figures. ORB-SLAM3 does neither, nor does vslam with `--no-report`, from which the ground \
truth is hidden here. *Reading images* is the CPU time that decoding both \
images of a frame takes, measured in separate processes: vslam's own reader for vslam, \
`cv2.imread` for ORB-SLAM3; it is subtracted from each system's time. The real-time run and the \
run along a drive are done once per case, and so is the profile, in one thread, by \
`tools/profile_frame.py`.
"""
BEGIN, END = "## How it was measured\n", "\n## Limits\n"  # what is outside was written by hand
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


def measures() -> Iterator[tuple[str, str, str]]:
    """Key, title and format of each row: compare_orbslam3.py's, and CPU times without reading."""
    for key, title, form in compare_orbslam3.MEASURES:
        if key in SHOWN:
            yield key, title, form
            if key.endswith("_cpu_ms"):
                bare = key.replace("_cpu_ms", "_bare_ms")
                yield bare, "the same without reading images ↓", form


MEASURES = tuple(measures())


class Case(NamedTuple):
    """Frames to run on: ``frames`` of a sequence, from the first one, under a title."""

    title: str
    data: Path
    seq: str
    frames: int


def parse_case(text: str) -> Case:
    """``TITLE=DATA:SEQ:FRAMES``."""
    title, separator, place = text.partition("=")
    parts = place.rsplit(":", 2)
    if not separator or len(parts) != 3 or not parts[2].isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: write TITLE=DATA:SEQ:FRAMES")
    data = Path(parts[0]).absolute()
    if not (data / "sequences" / parts[1]).is_dir():
        raise argparse.ArgumentTypeError(f"{data / 'sequences' / parts[1]}: not there")
    case = Case(title, data, parts[1], int(parts[2]))
    here = min(len(list(side.iterdir())) for side in sides(case))
    if not 2 <= case.frames <= here:
        raise argparse.ArgumentTypeError(f"{text}: FRAMES must be from 2 to {here}")
    return case


def sides(case: Case) -> list[Path]:
    """Folders of the left and right images."""
    return [case.data / "sequences" / case.seq / f"image_{side}" for side in (0, 1)]


def reading_ms(case: Case, system: str) -> float:
    """CPU milliseconds that decoding both images of a frame takes a system, in one thread."""
    files = [str(path) for side in sides(case) for path in sorted(side.iterdir())[: case.frames]]
    reader = "opencv" if system == ORBSLAM3 else "vslam"
    command = [sys.executable, "-c", READING, reader]
    done = subprocess.run(
        command, input="\n".join(files), capture_output=True, text=True, check=True
    )
    return 1e3 * float(done.stdout) / case.frames


def all_options(case: Case, options: argparse.Namespace) -> argparse.Namespace:
    """The options that compare_orbslam3.py takes."""
    fixed = {"detector": "bow", "sensor": "stereo", "threads": None}
    return argparse.Namespace(**vars(options) | case._asdict() | fixed)


def run_vslam(case: Case, options: argparse.Namespace, scratch: str, *words: str) -> Run:
    """Run vslam; without the ground truth where it draws no page: ORB-SLAM3 judges nothing."""
    if "--no-report" in words:
        data = Path(scratch, "data")
        data.mkdir()
        (data / "sequences").symlink_to(case.data / "sequences")
        case = case._replace(data=data)
    return compare_orbslam3.run_vslam(all_options(case, options), Path(scratch), *words)


def measure_case(case: Case, options: argparse.Namespace) -> dict[str, list[Run]]:
    """All counted runs of each system."""
    runs: dict[str, list[Run]] = {FULL: [], ORBSLAM3: [], LEAN: [], LIVE: []}
    words = {FULL: (), LEAN: ("--no-report",), LIVE: ("--no-report", "--realtime")}
    for name in options.also:
        runs[title := f"{LEAN} --detector {name}"] = []
        # Of two detectors on the command line the last one counts.
        words[title] = ("--no-report", "--detector", name)
    if options.ours_only:
        del runs[ORBSLAM3]
    for repeat in range(options.repeats + 1):
        for system, done in runs.items():
            if system == LIVE and repeat < options.repeats:
                continue
            with tempfile.TemporaryDirectory(prefix="vslam-speed-") as scratch:
                if system == ORBSLAM3:
                    run = compare_orbslam3.run_orbslam3(all_options(case, options), Path(scratch))
                else:
                    run = run_vslam(case, options, scratch, *words[system])
            counted = f"{repeat} of {options.repeats}" if repeat else "not counted"
            print(f"{case.title}, {system}: {run.process.wall_s:.1f} s, {counted}", file=sys.stderr)
            if repeat:
                done.append(run)
    return runs


def figures(run: Run, case: Case, reading: float) -> dict[str, float]:
    """Every measure of one run."""
    found = compare_orbslam3.figures(run, argparse.Namespace(**case._asdict(), sensor="stereo"))
    for name in ("process", "loop"):
        found[f"{name}_bare_ms"] = found[f"{name}_cpu_ms"] - reading
    return found


def comparison(measured: dict[str, list[dict[str, float]]]) -> str:
    """A table of medians, with the ratios to ORB-SLAM3 where it ran."""
    ours = [system for system in measured if system != ORBSLAM3]
    systems = ours + [ORBSLAM3] * (ORBSLAM3 in measured)
    head = [
        *systems,
        *([f"{system} / {ORBSLAM3}" for system in ours] if ORBSLAM3 in systems else []),
    ]
    lines = [f"| | {' | '.join(head)} |", "|---" * (len(head) + 1) + "|"]
    for name, title, form in MEASURES:
        medians = {s: statistics.median(run[name] for run in measured[s]) for s in systems}
        cells = [spread([run[name] for run in measured[s]], form) for s in systems]
        if ORBSLAM3 in systems:
            theirs = medians[ORBSLAM3]
            cells += [f"{medians[s] / theirs:.2f}" if theirs else "-" for s in ours]
        lines.append(f"| {title} | {' | '.join(cells)} |".replace("nan", "-"))
    return "\n".join(lines)


def latency(runs: dict[str, list[Run]], case: Case) -> str:
    """Milliseconds from the time of an image to its pose, and what ORB-SLAM3 says of its frames."""
    ours = [run.report for run in runs[LIVE]]
    values = [
        spread([report["latency_ms"][key] for report in ours], ".0f")
        for key in ("median", "p95", "p99")
    ]
    dropped = spread([report["dropped_frames"] for report in ours], ".0f")
    lines = ["| ms per frame | p50 | p95 | p99 | dropped |", "|---|---|---|---|---|"]
    row = f"| vslam, image to pose, {rate(case):.0f} Hz | {' | '.join(values)} | {dropped} |"
    lines.append(row)
    theirs = [run.report for run in runs.get(ORBSLAM3, [])]
    if theirs and "track_ms_median" in theirs[0]:
        cells = [
            spread([report[key] for report in theirs], ".0f")
            for key in ("track_ms_median", "track_ms_p95")
        ]
        lines.append(
            f"| ORB-SLAM3, tracking call only, images already decoded | {' | '.join(cells)} | | |"
        )
    return "\n".join(lines)


def rate(case: Case) -> float:
    """Frames a second of the recording."""
    times = (case.data / "sequences" / case.seq / "times.txt").read_text().split()[: case.frames]
    return (len(times) - 1) / (float(times[-1]) - float(times[0]))


def stages(report: dict[str, Any]) -> str:
    """Milliseconds of each stage, wall time: stages of the pool overlap with the others."""
    lines = ["| stage, ms | mean | p50 | p95 | p99 |", "|---|---|---|---|---|"]
    for name, ms in report["stage_ms"].items():
        cells = [f"{ms[key]:.1f}" for key in ("mean", "median", "p95", "p99")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def memory(run: Run) -> str:
    """How much a keyframe costs: from what is held at the first frame to the most ever held."""
    before = [mb for seconds, mb in run.process.held if seconds <= run.report["startup_s"]]
    if not before or not run.report["keyframes"]:
        return "The run was too short to tell what a keyframe holds."
    grown = run.process.memory_mb - before[-1]
    kept = run.report["keyframes"]
    return (
        f"Memory: {before[-1]:.0f} MB before the first frame, {run.process.memory_mb:.0f} MB at "
        f"its peak, with {kept} keyframes in the final map: {grown / kept:.2f} MB for each "
        "keyframe."
    )


def blocks(table: list[dict[str, str]]) -> tuple[list[float], list[float]]:
    """Mean milliseconds of each ``BLOCK`` frames: of all stages, and of those in turn alone."""
    everything, in_turn = [], []
    for first in range(0, len(table), BLOCK):
        rows = [
            {k: float(v or 0.0) for k, v in row.items() if k.endswith("_ms")}
            for row in table[first : first + BLOCK]
        ]
        everything.append(statistics.mean(sum(row.values()) for row in rows))
        in_turn.append(
            statistics.mean(sum(v for k, v in row.items() if k not in AHEAD) for row in rows)
        )
    return everything, in_turn


def measure_flat(case: Case, options: argparse.Namespace) -> str:
    """Run vslam once over a long case and draw the cost of a frame along it."""
    with tempfile.TemporaryDirectory(prefix="vslam-speed-") as scratch:
        run = run_vslam(case, options, scratch, "--no-report")
        path = Path(scratch, "runs", "latest", "frames.csv")
        with path.open(newline="", encoding="utf-8") as file:
            everything, in_turn = blocks(list(csv.DictReader(file)))
    draw(everything, in_turn, options.image)
    fps, frames = run.report["fps"], run.report["frames"]
    shown = options.image.name
    if options.write:
        shown = os.path.relpath(options.image, options.write.parent)
    return (
        f"## Along the drive: {case.title}\n\n![Time per frame]({shown})\n\n"
        f"{frames} frames at {fps:.1f} frames/s. Mean over the first and the last {BLOCK} frames, "
        "ms: all stages "
        f"{everything[0]:.1f} and {everything[-1]:.1f}, tracking and waiting for mapping "
        f"{in_turn[0]:.1f} and {in_turn[-1]:.1f}. {memory(run)}\n"
    )


def draw(everything: list[float], in_turn: list[float], path: Path) -> None:
    """Both lines over the frame number, as PNG."""
    from matplotlib import style

    from vslam.report.drawing import BLUE, GREY, LOW, STYLE, add_legend, new_figure, save

    with style.context(STYLE, after_reset=True):
        figure, axes = new_figure("Time per frame along the drive", "frame", "ms", LOW)
        middle = [BLOCK * (k + 0.5) for k in range(len(everything))]
        axes.plot(middle, everything, color=GREY, label="all stages")
        axes.plot(middle, in_turn, color=BLUE, label="without reading and extraction")
        axes.set_ylim(bottom=0)
        add_legend(figure, axes)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(save("along", "", figure).image)


def section(case: Case, runs: dict[str, list[Run]]) -> str:
    """All that is said of a case."""
    reading = {system: reading_ms(case, system) for system in (FULL, ORBSLAM3)}
    measured = {
        s: [figures(run, case, reading[ORBSLAM3 if s == ORBSLAM3 else FULL]) for run in runs[s]]
        for s in runs
        if s != LIVE
    }
    return (
        f"## {case.title}\n\n{case.frames} frames. "
        f"Reading both images: {reading[FULL]:.1f} ms CPU, by OpenCV {reading[ORBSLAM3]:.1f}.\n\n"
        f"{comparison(measured)}\n\n{latency(runs, case)}\n\n{stages(runs[FULL][-1].report)}\n\n"
        f"{memory(runs[LEAN][-1])}\n\n{profile(case)}"
    )


def profile(case: Case) -> str:
    """Where the CPU time of a frame goes; nothing if that fails, after all that was measured."""
    tool = str(Path(__file__).with_name("profile_frame.py"))
    command = [sys.executable, tool, str(case.data), case.seq, str(case.frames)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        print(f"{case.title}, no profile: {done.stderr}", file=sys.stderr)
    return done.stdout


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    shape = "TITLE=DATA:SEQ:FRAMES"
    parser.add_argument("--case", type=parse_case, action="append", default=[], metavar=shape)
    parser.add_argument("--flat", type=parse_case, metavar=shape, help="draw cost along it")
    parser.add_argument("--repeats", type=int, default=3, help="counted runs of each system")
    parser.add_argument("--ours-only", action="store_true", help="leave out ORB-SLAM3")
    parser.add_argument(
        "--also", action="append", default=[], metavar="DETECTOR", help="run with it as well"
    )
    parser.add_argument("--vslam", default=str(Path(sys.executable).with_name("vslam")))
    parser.add_argument("--orbslam3-python", type=lambda text: Path(text).absolute())
    parser.add_argument("--orbslam3-script", type=lambda text: Path(text).absolute())
    parser.add_argument("--vocabulary", type=lambda text: Path(text).absolute())
    parser.add_argument("--write", type=Path, help="file to write; printed unless given")
    parser.add_argument("--image", type=Path, default=Path("docs/images/cost-along-drive.png"))
    options = parser.parse_args()
    if not options.case and not options.flat:
        parser.error("nothing to measure: give --case or --flat")
    if options.repeats < 1:
        parser.error("--repeats: at least 1")
    needed = (options.orbslam3_python, options.orbslam3_script, options.vocabulary)
    if options.case and not options.ours_only and not all(needed):
        parser.error("--orbslam3-python, --orbslam3-script and --vocabulary, or --ours-only")
    return options


def anonymous(command: str) -> str:
    """A command without the paths of this machine."""
    for name in ("KITTI_ROOT", "HOME"):
        if path := os.environ.get(name, "").rstrip("/"):
            command = command.replace(path, f"${name}")
    return command


def written(page: Path) -> tuple[str, str]:
    """What people wrote on a page: before ``BEGIN``, and from ``END`` on."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    above, begin, rest = text.partition(BEGIN)
    _, end, below = rest.partition(END)
    return (above, end + below) if begin else ("# Performance\n\n", "")


def main() -> None:
    options = parse_options()
    load = os.getloadavg()[0]
    # Nothing heavy is imported before the last run: see compare_orbslam3.measure.
    measured = [(case, measure_case(case, options)) for case in options.case]
    flat = [measure_flat(options.flat, options)] if options.flat else []
    parts = [HEAD, *(section(case, runs) for case, runs in measured), *flat]
    if measured:
        report = measured[0][1][FULL][0].report
        python = None if options.ours_only else options.orbslam3_python
        setting = compare_orbslam3.setting(report, python, options.repeats)
        setting = setting[0].upper() + setting[1:]
        parts.append(f"## Setting\n\n{setting} Load at the start: {load:.1f}.\n")
    parts.append(f"```sh\npython {anonymous(shlex.join(sys.argv))}\n```\n")
    text = "\n".join(parts)
    if options.write:
        above, below = written(options.write)
        options.write.write_text(f"{above}{text}{below}", encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
