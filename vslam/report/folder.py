"""The folder of one run: its name, and the results that are written when the run ends."""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields, replace
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vslam.evaluation.loops import LoopEvaluation, evaluate_loops
from vslam.evaluation.map_alignment import truth_alignment_of
from vslam.evaluation.trajectories import Evaluation, evo_command
from vslam.maps.formats import save_ply
from vslam.maps.storage import save_map
from vslam.method.gaps import Gap
from vslam.report.frame_table import write_covariances, write_frames
from vslam.report.render import csv_text
from vslam.report.schema import ReportJson
from vslam.report.summary import evaluate_run, gps_figures, summarize
from vslam.run.outcome import RunOutcome, causal_trajectory, odometry_trajectory
from vslam.support.errors import InputError, ResultsError
from vslam.types.trajectory import write_kitti, write_tum

if TYPE_CHECKING:
    from vslam.report.page import Figure
    from vslam.run.loop_pictures import LoopPicture
    from vslam.run.moments import Moment

_LONGEST_PART = 60  # characters; file systems limit a name to 255, and a URL may be longer


def create_run_folder(
    out: Path,
    dataset: str,
    sequence: str,
    perturb: str,
    detector: str,
    thresholds: Mapping[str, Any] | None = None,
) -> Path:
    """Create the folder ``out/<YYYYmmdd-HHMMSS>-<dataset>-<sequence>-<perturb>-<detector>``.

    If some thresholds differ from their defaults, the first of these thresholds is appended to the
    name, followed by the number of the others. If the name is in use, a number is appended.
    ``out/latest`` becomes a symbolic link to the folder if the file system supports such links.

    Raises:
        InputError: the folder cannot be created.
    """
    parts = [dataset, sequence, perturb.replace(":", "").replace(",", "+"), detector]
    if thresholds:
        (name, value), *more = thresholds.items()
        parts.append(f"{name}={value}" + (f"+{len(more)}more" if more else ""))
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
            "give a writable folder with --out."
        ) from error
    with contextlib.suppress(OSError):
        (out / "latest").unlink(missing_ok=True)
        (out / "latest").symlink_to(folder.name, target_is_directory=True)
    return folder


def _safe(part: str) -> str:
    """Replace the characters of a text that should not be part of a file name, and limit its
    length."""
    return re.sub(r"[^A-Za-z0-9.+=-]+", "_", part)[:_LONGEST_PART]


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
    """Evaluate a complete or interrupted run, and write all results into its folder.

    The most valuable files are written first. If a file cannot be written, the other files are
    still written. These are the files:

    - trajectories: ``trajectory_kitti.txt``, ``trajectory.tum``, ``gaps.csv`` (the gaps of these
      two, if there are any; ``vslam.method.gaps.Gap``), ``ground_truth_kitti.txt``,
      ``keyframes.tum``, ``trajectory_causal.tum`` (poses at the time of tracking),
      ``covariance.csv`` (covariances of these poses), ``trajectory_odom.tum`` (poses from odometry,
      which never jump), and ``trajectory_<detector>.tum`` for each detector of ``--compare``. With
      GPS, ``trajectory_enu.tum``, ``trajectory_gps.csv`` and ``gps.json`` are also written;
    - maps: ``map.npz``, ``map.ply``;
    - numbers: ``frames.csv``, ``config.json`` (which ``--config`` can read), ``report.json``;
    - pages: ``figures/*.png``, ``report.md``, ``report.html`` (self-contained).

    Args:
        folder: an existing folder. Files of an earlier report are replaced.
        moments: images of keyframes for the HTML page.
        pictures: pictures of closed loops. Some of them are written as
            ``figures/loop-<frame>-<frame>.jpg``.
        pages: whether to write the pages.
        ply: whether to write the landmarks as ``map.ply``.
        map_file: a second path to which the map is written.

    Raises:
        ResultsError: some results could not be written. All other results were written.
    """
    written = Results(folder)
    evaluation, remark = _write_data(written, outcome, ply=ply, map_file=map_file)
    verdict, report = None, None
    with written.file("report.json") as file:
        verdict = evaluate_loops(outcome)
        command = _evo_command(folder, outcome, evaluation)
        report = summarize(outcome, evaluation, verdict, command, remark)
        file.write_text(report.to_json(), encoding="utf-8")
    if pages and report is not None:
        _write_pages(written, report, outcome, evaluation, verdict, moments, pictures)
    written.require_all()
    assert report is not None
    return report


class Results:
    """Writes the results of a run. If one result cannot be written, the other results are still
    written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._failed: dict[str, Exception] = {}

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Run a ``with`` block as one part of the work. If the block raises an exception, the
        exception is recorded and not passed on."""
        try:
            yield
        except Exception as error:
            self._failed[name] = error

    @contextlib.contextmanager
    def file(self, name: str) -> Iterator[Path]:
        """Yield the path at which to write a file or folder. If writing fails, the file or folder
        is removed."""
        path = self.folder / name
        with self.part(name):
            try:
                yield path
            except Exception:
                with contextlib.suppress(OSError):
                    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
                raise

    def require_all(self) -> None:
        """Check that all parts of the work have succeeded.

        Raises:
            ResultsError: some parts failed. The message names these parts and their errors.
        """
        if not self._failed:
            return
        by_reason: dict[str, list[str]] = {}
        for name, error in self._failed.items():
            by_reason.setdefault(_reason(error), []).append(name)
        failed = ", ".join(f"{', '.join(names)} {why}" for why, names in by_reason.items())
        first = next(iter(self._failed.values()))
        if not any(isinstance(error, OSError) for error in self._failed.values()):
            remedy = "this is a fault of vslam, please report it"
        elif all((self.folder / name).exists() for name in ("autosave.npz", "run.json")):
            remedy = f"free some space, then vslam run --resume {self.folder}"
        else:
            remedy = "free some space or give another folder with --out"
        raise ResultsError(
            f"{self.folder}: {failed}, all other results were written; {remedy}."
        ) from first


def _reason(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"could not be written ({error.strerror or ' '.join(str(error).split())})"
    return f"failed ({' '.join(f'{type(error).__name__}: {error}'.split()).rstrip(':.')})"


def _write_data(
    written: Results, outcome: RunOutcome, *, ply: bool, map_file: Path | None
) -> tuple[Evaluation | None, str | None]:
    """Write trajectories, maps and tables, and return the result of ``evaluate_run``."""
    write_trajectories(written, outcome)
    with written.file("keyframes.tum") as file:
        write_tum(file, outcome.keyframes)
    with written.file("trajectory_causal.tum") as file:
        write_tum(file, causal_trajectory(outcome.tracks))
    with written.file("trajectory_odom.tum") as file:
        write_tum(file, odometry_trajectory(outcome.tracks))
    with written.file("covariance.csv") as file:
        write_covariances(file, outcome.tracks)
    _write_gps(written, outcome)
    for other in outcome.compared:
        with written.file(f"trajectory_{_safe(other.settings.detector)}.tum") as file:
            write_tum(file, other.trajectory)
    evaluation, remark = None, None
    with written.part("the evaluation"):
        evaluation, remark = evaluate_run(outcome)
    if (stored := outcome.stored) is not None:
        if outcome.settings.map_file is None and evaluation is not None:
            with written.part("the map's place in the ground truth"):
                stored = replace(stored, truth_alignment=truth_alignment_of(outcome, evaluation))
        with written.file("map.npz") as file:
            save_map(file, stored)
        if map_file is not None:
            with written.part(str(map_file)):
                save_map(map_file, stored)
    if outcome.map is not None and ply:
        with written.file("map.ply") as file:
            save_ply(file, outcome.map.arrays.xyz[outcome.map.living_landmarks()])
    with written.file("frames.csv") as file:
        write_frames(file, outcome.tracks)
    with written.file("config.json") as file:
        file.write_text(_config_text(outcome))
    return evaluation, remark


def _write_gps(written: Results, outcome: RunOutcome) -> None:
    if (track := outcome.gps_track) is None:
        return
    with written.file("trajectory_enu.tum") as file:
        write_tum(file, track.trajectory)
    with written.file("trajectory_gps.csv") as file:
        times = track.trajectory.timestamps.tolist()
        lines = [
            f"{time:.6f},{latitude:.9f},{longitude:.9f},{altitude:.3f}\n"
            for time, (latitude, longitude, altitude) in zip(
                times, track.geodetic.tolist(), strict=True
            )
        ]
        file.write_text("time,latitude,longitude,altitude\n" + "".join(lines))
    with written.file("gps.json") as file:
        figures = gps_figures(outcome)
        assert figures is not None
        file.write_text(figures.model_dump_json(indent=2) + "\n")


def _config_text(outcome: RunOutcome) -> str:
    return outcome.settings.thresholds.model_dump_json(indent=2) + "\n"


def write_trajectories(written: Results, outcome: RunOutcome) -> None:
    """Write the final trajectory and the ground truth of its frames, in the formats of KITTI and
    TUM.

    If some frames have no ground truth, the ground truth is written only in TUM's format, because
    only this format has timestamps.
    """
    with written.file("trajectory_kitti.txt") as file:
        write_kitti(file, outcome.trajectory.T_wc)
    with written.file("trajectory.tum") as file:
        write_tum(file, outcome.trajectory, outcome.gap_sentences)
    with written.file("gaps.csv") as file:
        file.unlink(missing_ok=True)
        if outcome.gaps:
            rows = [tuple(vars(gap).values()) for gap in outcome.gaps]
            file.write_text(csv_text([tuple(one.name for one in fields(Gap)), *rows]))
    ground_truth = None
    with written.part("the ground truth"):
        ground_truth = outcome.ground_truth
    if ground_truth is None:
        return
    if len(ground_truth) == len(outcome.trajectory):
        with written.file("ground_truth_kitti.txt") as file:
            write_kitti(file, ground_truth.T_wc)
    else:
        with written.file("ground_truth.tum") as file:
            write_tum(file, ground_truth)


def _evo_command(folder: Path, outcome: RunOutcome, evaluation: Evaluation | None) -> str | None:
    """Return the command that repeats the evaluation with evo, or None if evo cannot evaluate this
    run."""
    if evaluation is None or evaluation.on_one_line:
        return None
    if evaluation.frames == len(outcome.trajectory):
        estimate, truth = folder / "trajectory_kitti.txt", folder / "ground_truth_kitti.txt"
        return evo_command(estimate, truth, evaluation.alignment, "kitti")
    estimate, truth = folder / "trajectory.tum", folder / "ground_truth.tum"
    return evo_command(estimate, truth, evaluation.alignment, "tum")


def _write_pages(
    written: Results,
    report: ReportJson,
    outcome: RunOutcome,
    evaluation: Evaluation | None,
    verdict: LoopEvaluation | None,
    moments: Collection[Moment],
    pictures: Collection[LoopPicture],
) -> None:
    from vslam.report.explorer import explorer
    from vslam.report.figures import draw_figures
    from vslam.report.loop_tables import seen_loops
    from vslam.report.render import html, markdown
    from vslam.report.run_page import run_page

    figures: list[Figure] = []
    seen: list[Figure] = []
    with written.file("figures") as file:
        drawn = draw_figures(outcome, evaluation, verdict)
        figures = [replace(figure, file=f"figures/{figure.name}.png") for figure in drawn]
        seen = seen_loops(report, pictures)
        file.mkdir(exist_ok=True)
        for figure in (*figures, *seen):
            (written.folder / figure.file).write_bytes(figure.image)
    recordings = sorted(path.name for path in written.folder.glob("recording*.rrd"))
    with written.file("report.md") as file:
        page = run_page(report, figures, seen, recordings)
        file.write_text(markdown(page), encoding="utf-8")
    with written.file("report.html") as file:
        sections = explorer(outcome, evaluation, moments)
        page = run_page(report, figures, seen, recordings, sections, _config_text(outcome))
        file.write_text(html(page), encoding="utf-8")
