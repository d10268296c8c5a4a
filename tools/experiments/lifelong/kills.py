"""Kill runs at random times and resume them, to test that little work is lost.

``kill -9`` ends a run after a random number of frames. Every other run is killed while an autosave
is being written. Afterwards, all files of the run are read, and the run is resumed.

The table has for each run the frame at which it was killed, the number of saved frames, the seconds
of work that were lost, the ATE of the whole run, and whether the trajectory is byte-identical to
that of an undisturbed run. The last two are empty if nothing had been saved.

    python tools/experiments/lifelong/kills.py --out kills.csv -- --dataset synthetic --seq demo
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from vslam.maps.storage import load_map
from vslam.run.autosave import MAP, ONLINE, PROGRESS
from vslam.run.progress import read_progress
from vslam.types.trajectory import read_trajectory

RUN = (sys.executable, "-m", "vslam", "run")
BRIEF = ("--no-record", "--no-report", "--quiet")


def report_of(folder: Path) -> dict[str, float]:
    return json.loads((folder / "report.json").read_text())


def trajectory_of(folder: Path) -> bytes:
    return (folder / "trajectory.tum").read_bytes()


def frames_done(folder: Path) -> int:
    try:
        return (folder / ONLINE).read_bytes().count(b"\n")
    except OSError:
        return 0


def is_saving(folder: Path) -> bool:
    return any(folder.glob(".autosave*.part"))


def kill_at(words: list[str], out: Path, frame: int, saving: bool) -> tuple[Path, int, float]:
    """Start a run, and kill it after some frames.

    Returns:
        The folder of the run, the number of tracked frames, and the seconds since the first frame.
    """
    process = subprocess.Popen([*RUN, *words, *BRIEF, "--out", str(out)])
    folder, begin = out / "latest", 0.0
    while process.poll() is None:
        done = frames_done(folder)
        begin = begin or (time.monotonic() if done else 0.0)
        if done >= frame and (not saving or is_saving(folder)):
            os.kill(process.pid, signal.SIGKILL)
            break
        time.sleep(0.001 if done >= frame else 0.05)
    process.wait()
    return folder.resolve(), frames_done(folder), time.monotonic() - begin


def saved_frames(folder: Path) -> tuple[int, float]:
    """Read all files of a killed run.

    Returns:
        The number of saved frames, and the wall time of the run when they were saved, in seconds.
    """
    read_trajectory(folder / ONLINE)
    if not (folder / MAP).exists():
        return 0, 0.0
    frames = load_map(folder / MAP).frames
    assert frames is not None
    progress = read_progress(folder / PROGRESS)
    assert len(progress.tracks) >= len(frames.timestamp)
    return len(frames.timestamp), progress.wall_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--autosave", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("words", nargs="+", help="options of vslam run that name the images")
    options = parser.parse_args()
    random_ = random.Random(options.seed)
    words = [*options.words, "--autosave", str(options.autosave)]
    rows: list[tuple[object, ...]] = []
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        subprocess.run([*RUN, *options.words, *BRIEF, "--out", str(out / "whole")], check=True)
        whole = report_of(out / "whole" / "latest")
        undisturbed = trajectory_of(out / "whole" / "latest")
        for number in range(options.kills):
            saving = number % 2 == 1
            at = random_.randrange(1, int(whole["frames"]) - 1)
            folder, done, seconds = kill_at(words, out / str(number), at, saving)
            if (folder / "report.json").exists():
                print(f"run {number} ended before it could be killed", flush=True)
                continue
            saved, wall_s = saved_frames(folder)
            ate = same = ""
            if saved:
                subprocess.run([*RUN, "--resume", str(folder), *BRIEF], check=True)
                ate = f"{report_of(folder)['ate_rmse_m']:.4f}"
                same = "yes" if trajectory_of(folder) == undisturbed else "no"
            during = "save" if saving else "run"
            rows.append((number, during, done, saved, f"{seconds - wall_s:.1f}", ate, same))
            print(*rows[-1], flush=True)
    with options.out.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["kill", "during", "frame", "saved", "lost_s", "ate_m", "same"])
        table.writerows(rows)


if __name__ == "__main__":
    main()
