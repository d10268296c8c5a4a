"""The folder of one run: its name, and everything that is written to it when the run ends."""

from __future__ import annotations

import contextlib
import re
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vslam.errors import InputError, ResultsError
from vslam.run import RunOutcome
from vslam.trajectory import Trajectory, write_kitti, write_tum

if TYPE_CHECKING:
    from vslam.evaluate import Evaluation


def create_run_folder(out: Path, dataset: str, sequence: str, perturb: str, detector: str) -> Path:
    """Create ``out/<YYYYmmdd-HHMMSS>-<dataset>-<sequence>-<perturb>-<detector>``.

    A number is added to a name in use. ``out/latest`` becomes a link to the folder where the file
    system has links.

    Raises:
        InputError: the folder cannot be created.
    """
    parts = [dataset, sequence, perturb.replace(":", "").replace(",", "+"), detector]
    safe = [re.sub(r"[^A-Za-z0-9.+-]+", "_", part) for part in parts]
    name = "-".join([f"{datetime.now():%Y%m%d-%H%M%S}", *safe])
    try:
        out.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            folder = out / (name if number == 1 else f"{name}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                break
    except OSError as error:
        raise InputError(
            f"{out}: cannot create a run folder here ({error.strerror}); "
            "name a writable folder with --out."
        ) from error
    with contextlib.suppress(OSError):
        (out / "latest").unlink(missing_ok=True)
        (out / "latest").symlink_to(folder.name, target_is_directory=True)
    return folder


def matched_ground_truth(outcome: RunOutcome) -> Trajectory | None:
    """The ground truth of just the frames that ``outcome.trajectory`` has, None without any."""
    poses = outcome.sequence.ground_truth
    if poses is None:
        return None
    done = np.isin(outcome.sequence.timestamps, outcome.trajectory.timestamps)
    return Trajectory(outcome.sequence.timestamps, poses).select(np.flatnonzero(done))


def write_trajectories(folder: Path, outcome: RunOutcome) -> None:
    """Write the final trajectory in both formats and the ground truth of the same frames.

    Files: ``trajectory_kitti.txt``, ``trajectory.tum``, ``ground_truth_kitti.txt``.
    """
    write_kitti(folder / "trajectory_kitti.txt", outcome.trajectory.T_wc)
    write_tum(folder / "trajectory.tum", outcome.trajectory)
    if (ground_truth := matched_ground_truth(outcome)) is not None:
        write_kitti(folder / "ground_truth_kitti.txt", ground_truth.T_wc)


def write_results(
    folder: Path, outcome: RunOutcome, *, pages: bool = True, ply: bool = False
) -> tuple[Evaluation | None, str]:
    """Evaluate a run and write trajectories, report and map, what matters most first.

    Args:
        pages: write the report as people read it, too, not only as ``report.json``.
        ply: write the landmarks as ``map.ply`` too.

    Returns:
        The evaluation, or None and the reason why there is none.

    Raises:
        ResultsError: a file could not be written; those before it are complete.
    """
    from vslam.evaluate import evaluate
    from vslam.mapio import save_map, save_ply
    from vslam.report import write_report

    try:
        write_trajectories(folder, outcome)
        evaluation, remark = None, "no ground truth"
        if (ground_truth := matched_ground_truth(outcome)) is not None:
            try:
                evaluation = evaluate(outcome.trajectory, ground_truth, outcome.settings.alignment)
            except InputError as error:  # a clip too short to align is no reason to lose the run
                remark = str(error)
        write_report(outcome, evaluation, folder, pages=pages)
        if outcome.map is not None:
            save_map(folder / "map.npz", outcome.map, outcome.sequence.camera)
            if ply:
                landmarks = outcome.map.living_landmarks()
                save_ply(folder / "map.ply", outcome.map.arrays.xyz[landmarks])
    except OSError as error:
        files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns)
        raise ResultsError(
            f"{folder}: not all results could be written ({error.strerror or error}); there are "
            f"{', '.join(file.name for file in files)}, the last of them incomplete. Free some "
            "space or name another folder with --out."
        ) from error
    return evaluation, remark
