"""Drive many laps of a closed route, and record the size of the map and the errors of each lap.

    python tools/experiments/lifelong/laps.py --data FOLDER --seq demo --laps 20 --out laps.csv

The sequence is in KITTI's format and returns to its beginning. There, the last frame is followed by
the frame of the first pass at the same place, so that the motion is continuous. With ``--jumps N``,
the camera is carried to another place N times, as if the recording continued there.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.report.schema import ReportJson
from vslam.support.errors import InputError
from vslam.types.trajectory import read_kitti_poses, read_trajectory, write_kitti

Indices = NDArray[np.int64]

DEGREE_M = 0.05  # metres that a degree counts for in the search for the seam
MAX_SEAM_M, MAX_SEAM_DEG = 0.5, 2.0
STEP_S = 0.1


def find_seam(T_wc: NDArray[np.float64]) -> tuple[int, int]:
    """Find the two frames with the most similar poses, at least half a route apart.

    Args:
        T_wc: ``(N, 4, 4)`` true poses.

    Returns:
        The later frame, and the earlier frame at the same place.

    Raises:
        InputError: the route does not return to its beginning.
    """
    half = len(T_wc) // 2
    position, forward = T_wc[:, :3, 3], T_wc[:, :3, 2]
    apart = np.linalg.norm(position[half:, None] - position[None, :half], axis=-1)
    turned = np.degrees(np.arccos(np.clip(forward[half:] @ forward[:half].T, -1.0, 1.0)))
    late, early = np.unravel_index(np.argmin(apart + DEGREE_M * turned), apart.shape)
    if apart[late, early] > MAX_SEAM_M or turned[late, early] > MAX_SEAM_DEG:
        raise InputError(
            "the route does not return to its beginning: its ends are at least "
            f"{apart[late, early]:.1f} m and {turned[late, early]:.0f} degrees apart."
        )
    return half + int(late), int(early)


def plan(seam: tuple[int, int], laps: int, jumps: int, seed: int) -> tuple[Indices, Indices]:
    """Choose the frames of the route that the camera sees one after the other.

    Args:
        seam: result of ``find_seam``.
        jumps: number of times that the camera is carried to another place, after the first lap.

    Returns:
        ``(N,)`` frames of the route, and the lap of each, counted from 1.
    """
    late, early = seam
    length = late - early
    total = late + 1 + (laps - 1) * length
    rng = np.random.default_rng(seed)
    target = dict(
        zip(
            rng.choice(np.arange(late + 1, total), jumps, replace=False).tolist(),
            rng.integers(early + 1, late + 1, jumps).tolist(),
            strict=True,
        )
    )
    places = [0]
    while len(places) < total:
        following = places[-1] + 1 if places[-1] < late else early + 1
        places.append(target.get(len(places), following))
    frames = np.arange(total)
    lap = np.where(frames <= late, 1, 2 + (frames - late - 1) // length)
    return np.array(places), lap


def link(data: Path, name: str, places: Indices, folder: Path) -> None:
    """Make a sequence ``laps`` in KITTI's format, whose images are links to those of another."""
    source, made = data / "sequences" / name, folder / "sequences" / "laps"
    for side in ("image_0", "image_1"):
        (made / side).mkdir(parents=True)
        for frame, place in enumerate(places.tolist()):
            (made / side / f"{frame:06d}.png").symlink_to(source / side / f"{place:06d}.png")
    (made / "calib.txt").symlink_to(source / "calib.txt")
    np.savetxt(made / "times.txt", STEP_S * np.arange(len(places)), fmt="%.6f")
    (folder / "poses").mkdir()
    write_kitti(
        folder / "poses" / "laps.txt", read_kitti_poses(data / "poses" / f"{name}.txt")[places]
    )


def rows(run: Path, data: Path, places: Indices, lap: Indices) -> list[dict[str, Any]]:
    """Summarise a run for each lap."""
    with (run / "frames.csv").open(newline="", encoding="utf-8") as file:
        frames = list(csv.DictReader(file))
    tracked = np.array([frame["state"] in {"OK", "WEAK"} for frame in frames])
    added = np.array([frame["keyframe"] == "1" for frame in frames])
    known = np.flatnonzero(tracked)
    estimate = read_trajectory(run / "trajectory.tum")
    truth = type(estimate)(
        estimate.timestamps, read_kitti_poses(data / "poses" / "laps.txt")[: len(places)]
    )
    errors = np.full(len(places), np.nan)
    errors[known] = evaluate_trajectory(estimate.select(known), truth.select(known)).errors_m
    milliseconds = np.array([float(frame["track_ms"] or "nan") for frame in frames])
    kept = np.searchsorted(lap, np.arange(1, lap[-1] + 1), "right")
    keyframes = np.round(read_trajectory(run / "keyframes.tum").timestamps / STEP_S)
    loops = [
        loop.query_frame for loop in ReportJson.read(run / "report.json").loops if loop.accepted
    ]
    return [
        {
            "lap": k,
            "frames": int(np.count_nonzero(lap == k)),
            "lost_frames": int(np.count_nonzero(~tracked[lap == k])),
            "new_keyframes": int(np.count_nonzero(added[lap == k])),
            "keyframes": int(np.count_nonzero(keyframes < kept[k - 1])),
            "loops": sum(bool(lap[frame] == k) for frame in loops),
            "ate_rmse_m": f"{np.sqrt(np.nanmean(errors[lap == k] ** 2)):.4f}",
            "track_ms": f"{np.nanmedian(milliseconds[lap == k]):.1f}",
        }
        for k in range(1, int(lap[-1]) + 1)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder in KITTI's format")
    parser.add_argument("--seq", required=True)
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--jumps", type=int, default=0)
    parser.add_argument("--perturb", default="none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    data = options.data.resolve()
    try:
        seam = find_seam(read_kitti_poses(data / "poses" / f"{options.seq}.txt"))
    except InputError as error:
        sys.exit(f"error: {error}")
    places, lap = plan(seam, options.laps, options.jumps, options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        link(data, options.seq, places, folder)
        command = [sys.executable, "-m", "vslam", "run", "--data", name, "--seq", "laps"]
        command += ["--perturb", options.perturb, "--seed", str(options.seed)]
        command += ["--no-report", "--no-record", "--quiet", "--out", str(folder / "runs")]
        subprocess.run(command, check=True)
        run = folder / "runs" / "latest"
        report = ReportJson.read(run / "report.json")
        table = rows(run, folder, places, lap)
    print(
        f"{len(places)} frames, {report.lost_frames} lost, {report.keyframes} keyframes, "
        f"{report.landmarks} landmarks, loops: {report.loops_closed} closed, "
        f"{report.loops_wrong} wrong, ATE {report.ate_rmse_m} m, "
        f"{report.cpu_ms_per_frame:.1f} ms of CPU time per frame, {report.peak_memory_mb:.0f} MB"
    )
    with options.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, table[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
