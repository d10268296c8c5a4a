"""The folder of one run: its name, and everything that is written to it when the run ends."""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Collection, Iterator
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
    from vslam.run.loop_pictures import LoopPicture
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
    name = "-".join([f"{datetime.now():%Y%m%d-%H%M%S}", *map(_safe, parts)])
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


def _safe(part: str) -> str:
    """A name as a part of a file name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", part)[:_LONGEST_PART]


def write_results(
    folder: Path,
    outcome: RunOutcome,
    moments: Collection[Moment] = (),
    pictures: Collection[LoopPicture] = (),
    *,
    pages: bool = True,
    ply: bool = False,
    map_file: Path | None = None,
) -> ReportJson:
    """Evaluate a run, in any state of completion, and write all that is known of it.

    Files: ``trajectory_kitti.txt``, ``trajectory.tum``, ``trajectory_causal.tum`` (poses as they
    were given at the time), ``trajectory_<detector>.tum`` (of each one compared),
    ``ground_truth_kitti.txt``, ``config.json`` (read by ``--config``),
    ``keyframes.tum``, ``frames.csv``, ``report.json``,
    ``report.md``, ``report.html`` (one file, no network request), ``figures/*.png``, ``map.npz``,
    ``map.ply``; what matters most comes first.

    Args:
        folder: an existing folder; what is written replaces files of an earlier report.
        outcome: the run; it may be interrupted, all lost, or without a single frame.
        pages: write what people read, too: Markdown, HTML and figures.
        ply: write the landmarks as ``map.ply``, too.
        moments: images of keyframes for the HTML page.
        pictures: of closed loops; some are written as ``figures/loop-<frame>-<frame>.jpg``.
        map_file: where to write the map, too.

    Raises:
        ResultsError: files could not be written; none is incomplete, and all others are there.
    """
    written = Results(folder)
    write_trajectories(written, outcome)
    with written.file("trajectory_causal.tum") as file:
        write_tum(file, causal_trajectory(outcome))
    for other in outcome.compared:
        with written.file(f"trajectory_{_safe(other.settings.detector)}.tum") as file:
            write_tum(file, other.trajectory)
    with written.file("keyframes.tum") as file:
        write_tum(file, outcome.keyframes)
    with written.file("frames.csv") as file:
        write_frames(file, outcome.tracks)
    config = outcome.settings.config.model_dump_json(indent=2) + "\n"
    with written.file("config.json") as file:
        file.write_text(config)
    evaluation, remark = evaluate_run(outcome)
    report = _write_report(
        written, outcome, config, evaluation, remark, moments, pictures, pages=pages
    )
    if outcome.map is not None and ply:
        landmarks = outcome.map.living_landmarks()
        with written.file("map.ply") as file:
            save_ply(file, outcome.map.arrays.xyz[landmarks])
    if (stored := outcome.stored) is not None:
        if outcome.settings.map is None and evaluation is not None:
            stored = replace(stored, world=world_of(outcome, evaluation))
        with written.file("map.npz") as file:
            save_map(file, stored)
    written.require_all()
    if map_file is not None and outcome.stored is not None:
        _copy_map(folder / "map.npz", map_file)
    return report


class Results:
    """The files of a run: each is tried, and what cannot be written whole is removed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._failed: dict[str, OSError] = {}

    @contextlib.contextmanager
    def file(self, name: str) -> Iterator[Path]:
        """Where to write a file, or a folder of files."""
        path = self.folder / name
        try:
            yield path
        except OSError as error:
            self._failed[name] = error
            with contextlib.suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)

    def require_all(self) -> None:
        """
        Raises:
            ResultsError: some could not be written.
        """
        if not self._failed:
            return
        error = next(iter(self._failed.values()))
        remedy = "free some space or name another folder with --out"
        if all((self.folder / name).exists() for name in ("autosave.npz", "run.json")):
            remedy = f"free some space, then vslam run --resume {self.folder}"
        raise ResultsError(
            f"{self.folder}: {', '.join(self._failed)} could not be written "
            f"({error.strerror or error}), all other results are there; {remedy}."
        ) from error


def _copy_map(file: Path, to: Path) -> None:
    try:
        with replaced_file(to) as copy:
            copy.write(file.read_bytes())
    except OSError as error:
        raise ResultsError(
            f"{to}: cannot be written ({error.strerror or error}); the map is in {file}."
        ) from error


def write_trajectories(written: Results, outcome: RunOutcome) -> None:
    """Write the final trajectory in both formats and the ground truth of the same frames; in TUM's
    alone, which has times, where not all of them have one."""
    with written.file("trajectory_kitti.txt") as file:
        write_kitti(file, outcome.trajectory.T_wc)
    with written.file("trajectory.tum") as file:
        write_tum(file, outcome.trajectory)
    ground_truth = matched_ground_truth(outcome)
    if ground_truth is None:
        return
    if len(ground_truth) == len(outcome.trajectory):
        with written.file("ground_truth_kitti.txt") as file:
            write_kitti(file, ground_truth.T_wc)
    else:
        with written.file("ground_truth.tum") as file:
            write_tum(file, ground_truth)


def _write_report(
    written: Results,
    outcome: RunOutcome,
    config: str,
    evaluation: Evaluation | None,
    remark: str | None,
    moments: Collection[Moment],
    pictures: Collection[LoopPicture],
    *,
    pages: bool,
) -> ReportJson:
    """``report.json``, and with ``pages`` what people read."""
    folder, verdict = written.folder, evaluate_loops(outcome)
    command = None
    if evaluation is not None:
        estimate, truth = folder / "trajectory_kitti.txt", folder / "ground_truth_kitti.txt"
        if evaluation.frames == len(outcome.trajectory):
            command = evo_command(estimate, truth, evaluation.alignment, "kitti")
        else:
            estimate, truth = folder / "trajectory.tum", folder / "ground_truth.tum"
            command = evo_command(estimate, truth, evaluation.alignment, "tum")
    report = summarize(outcome, evaluation, verdict, command, remark)
    with written.file("report.json") as file:
        file.write_text(report.model_dump_json(indent=2) + "\n", encoding="utf-8")
    if pages:
        from vslam.report.explorer import explorer_data
        from vslam.report.figures import draw_figures
        from vslam.report.render import render_html, render_markdown
        from vslam.report.seen_loops import seen_loops

        seen = seen_loops(report, pictures)
        with written.file("report.md") as file:
            file.write_text(render_markdown(report, seen), encoding="utf-8")
        figures = draw_figures(outcome, evaluation, matched_ground_truth(outcome), verdict)
        with written.file("figures") as file:
            file.mkdir(exist_ok=True)
            for figure in figures:
                (file / f"{figure.name}.png").write_bytes(figure.png)
            for loop in seen:
                (file / loop.name).write_bytes(loop.jpeg)
        explorer = explorer_data(outcome, evaluation, matched_ground_truth(outcome), moments)
        page = render_html(report, config, figures, explorer, seen)
        with written.file("report.html") as file:
            file.write_text(page, encoding="utf-8")
    return report
