"""The folder of one run: its name, and everything that is written to it when the run ends."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection
from dataclasses import replace
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from vslam.errors import InputError, ResultsError
from vslam.evaluation.loops import evaluate_loops
from vslam.evaluation.trajectories import Evaluation, evo_command
from vslam.evaluation.worlds import world_of
from vslam.maps.new_output import replaced_file
from vslam.maps.ply import save_ply
from vslam.maps.storage import save_map
from vslam.report.frame_table import write_frames
from vslam.report.schema import ReportJson
from vslam.report.summary import evaluate_run, summarize
from vslam.run.outcome import RunOutcome, causal_trajectory, matched_ground_truth
from vslam.trajectory import write_kitti, write_tum

if TYPE_CHECKING:
    from vslam.run.moments import Moment

_LONGEST_PART = 60  # characters: file systems take 255 for a name, and a URL may have more


def create_run_folder(out: Path, dataset: str, sequence: str, perturb: str, detector: str) -> Path:
    """Create ``out/<YYYYmmdd-HHMMSS>-<dataset>-<sequence>-<perturb>-<detector>``.

    A number is added to a name in use. ``out/latest`` becomes a link to the folder where the file
    system has links.

    Raises:
        InputError: the folder cannot be created.
    """
    parts = [dataset, sequence, perturb.replace(":", "").replace(",", "+"), detector]
    safe = [re.sub(r"[^A-Za-z0-9.+-]+", "_", part)[:_LONGEST_PART] for part in parts]
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


def write_results(
    folder: Path,
    outcome: RunOutcome,
    moments: Collection[Moment] = (),
    *,
    pages: bool = True,
    ply: bool = False,
    map_file: Path | None = None,
) -> ReportJson:
    """Evaluate a run, in any state of completion, and write all that is known of it.

    Files: ``trajectory_kitti.txt``, ``trajectory.tum``, ``trajectory_causal.tum`` (poses as they
    were given at the time), ``ground_truth_kitti.txt``, ``config.json`` (read by ``--config``),
    ``keyframes.tum``, ``frames.csv``, ``report.json``,
    ``report.md``, ``report.html`` (one file, no network request), ``figures/*.png``, ``map.npz``,
    ``map.ply``; what matters most comes first.

    Args:
        folder: an existing folder; what is written replaces files of an earlier report.
        outcome: the run; it may be interrupted, all lost, or without a single frame.
        pages: write what people read, too: Markdown, HTML and figures.
        ply: write the landmarks as ``map.ply``, too.
        moments: images of keyframes for the HTML page.
        map_file: where to write the map, too.

    Raises:
        ResultsError: a file could not be written; those before it are complete.
    """
    try:
        write_trajectories(folder, outcome)
        write_tum(folder / "trajectory_causal.tum", causal_trajectory(outcome))
        write_tum(folder / "keyframes.tum", outcome.keyframes)
        write_frames(folder / "frames.csv", outcome.tracks)
        config = outcome.settings.config.model_dump_json(indent=2) + "\n"
        (folder / "config.json").write_text(config)
        evaluation, remark = evaluate_run(outcome)
        report = _write_report(folder, outcome, config, evaluation, remark, moments, pages=pages)
        if outcome.map is not None and ply:
            landmarks = outcome.map.living_landmarks()
            save_ply(folder / "map.ply", outcome.map.arrays.xyz[landmarks])
        if (stored := outcome.stored) is not None:
            if outcome.settings.map is None and evaluation is not None:
                stored = replace(stored, world=world_of(outcome, evaluation))
            save_map(folder / "map.npz", stored)
    except OSError as error:
        files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns)
        raise ResultsError(
            f"{folder}: not all results could be written ({error.strerror or error}); there are "
            f"{', '.join(file.name for file in files)}, the last of them incomplete. Free some "
            "space or name another folder with --out."
        ) from error
    if map_file is not None and outcome.stored is not None:
        _copy_map(folder / "map.npz", map_file)
    return report


def _copy_map(file: Path, to: Path) -> None:
    try:
        with replaced_file(to) as copy:
            copy.write(file.read_bytes())
    except OSError as error:
        raise ResultsError(
            f"{to}: cannot be written ({error.strerror or error}); the map is in {file}."
        ) from error


def write_trajectories(folder: Path, outcome: RunOutcome) -> None:
    """Write the final trajectory in both formats and the ground truth of the same frames; in TUM's
    alone, which has times, where not all of them have one."""
    write_kitti(folder / "trajectory_kitti.txt", outcome.trajectory.T_wc)
    write_tum(folder / "trajectory.tum", outcome.trajectory)
    ground_truth = matched_ground_truth(outcome)
    if ground_truth is None:
        return
    if len(ground_truth) == len(outcome.trajectory):
        write_kitti(folder / "ground_truth_kitti.txt", ground_truth.T_wc)
    else:
        write_tum(folder / "ground_truth.tum", ground_truth)


def _write_report(
    folder: Path,
    outcome: RunOutcome,
    config: str,
    evaluation: Evaluation | None,
    remark: str | None,
    moments: Collection[Moment],
    *,
    pages: bool,
) -> ReportJson:
    """``report.json``, and with ``pages`` what people read."""
    verdict = evaluate_loops(outcome)
    command = None
    if evaluation is not None:
        estimate, truth = folder / "trajectory_kitti.txt", folder / "ground_truth_kitti.txt"
        if evaluation.frames == len(outcome.trajectory):
            command = evo_command(estimate, truth, evaluation.alignment, "kitti")
        else:
            estimate, truth = folder / "trajectory.tum", folder / "ground_truth.tum"
            command = evo_command(estimate, truth, evaluation.alignment, "tum")
    report = summarize(outcome, evaluation, verdict, command, remark)
    (folder / "report.json").write_text(report.model_dump_json(indent=2) + "\n", encoding="utf-8")
    if pages:
        from vslam.report.explorer import explorer_data
        from vslam.report.figures import draw_figures
        from vslam.report.render import render_html, render_markdown

        (folder / "report.md").write_text(render_markdown(report), encoding="utf-8")
        figures = draw_figures(outcome, evaluation, matched_ground_truth(outcome), verdict)
        (folder / "figures").mkdir(exist_ok=True)
        for figure in figures:
            (folder / "figures" / f"{figure.name}.png").write_bytes(figure.png)
        explorer = explorer_data(outcome, evaluation, matched_ground_truth(outcome), moments)
        page = render_html(report, config, figures, explorer)
        (folder / "report.html").write_text(page, encoding="utf-8")
    return report
