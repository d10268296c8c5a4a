"""Performs the work of ``vslam run`` after the options have been checked."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Literal

import typer

from vslam.cli.console import Console
from vslam.cli.options import open_given
from vslam.run.warmup import Compilation
from vslam.support.errors import InputError, ResultsError
from vslam.types.source_options import AUTO

if TYPE_CHECKING:
    from vslam.datasets.fixes import Fixes
    from vslam.datasets.frames import Source
    from vslam.datasets.perturbation import Perturbation
    from vslam.run.autosave import Unfinished
    from vslam.run.moments import LoopPictureRecorder
    from vslam.run.options import RunOptions
    from vslam.run.outcome import RunOutcome
    from vslam.run.recorder import Recorder, Viewer


@dataclass(frozen=True)
class Output:
    """Options that determine what a run shows and writes. They may be changed when a run is
    resumed."""

    record: bool
    view: Literal["native", "web"] | None
    keep_open: bool
    pages: bool
    ply: bool
    save_map: Path | None
    quiet: bool


def drive(
    options: RunOptions,
    output: Output,
    *,
    out: Path = Path(),
    resume: Path | None = None,
) -> None:
    """Open the images, run SLAM and write the results.

    Args:
        out: the folder in which the folder of the run is created.
        resume: the folder of an interrupted run to continue. If it is None, a new run starts.
    """
    if options.localize and output.save_map is not None:
        raise InputError("--save-map: localising does not change the map; leave it out.")
    with Compilation() as kernels:
        _drive(options, output, out, resume, Console(shown=not output.quiet), kernels)


def _drive(
    options: RunOptions,
    output: Output,
    out: Path,
    resume: Path | None,
    console: Console,
    kernels: Compilation,
) -> None:
    source, perturbation = _open(options, console, kernels)
    _refuse_live_source(source, resume)
    fixes = None if options.gps is None else _fixes(options.gps, options.gps_antenna, source)

    # These imports take a second. Therefore, bad input is refused before them.
    from vslam.cli.tables import print_summary
    from vslam.doctor.nothing_tracked import why_nothing_was_tracked
    from vslam.report.folder import write_results
    from vslam.run.autosave import MAP, FolderAutosave, remove_autosave
    from vslam.run.moments import LoopPictureRecorder, MomentRecorder
    from vslam.run.pipeline import run_sequence
    from vslam.run.slam_run import begin

    effective = {"perturb": perturbation.name, "realtime": options.realtime or source.live}
    settings = options.model_copy(update=effective)
    with ExitStack() as lock:
        unfinished = _unfinished(options, source, resume, lock)
        _compile(settings, console, kernels)
        run = begin(source, settings, unfinished)
        viewer = _viewer(output, console)
        if unfinished is not None:
            console.announce(f"continuing at frame {len(unfinished.progress.tracks)} ...")
        folder = resume or _new_folder(options, source, perturbation.name, out, lock)
        moments, pictures = MomentRecorder(), LoopPictureRecorder()
        recorder = _recorder(folder, output, unfinished, viewer, moments, pictures)
        # Localising does not change the map, so there is nothing to save during the run.
        period = 0.0 if options.localize else options.autosave
        autosave = FolderAutosave(folder, period, f"{source.dataset} {source.name}")
        with console.progress_bar(source.n_expected) as on_frame:
            outcome = run_sequence(
                run, perturbation, recorder, on_frame=on_frame, autosave=autosave
            )
        gps_error = ""
        if fixes is not None:
            outcome, gps_error = _georeferenced(outcome, fixes)
        if why := why_nothing_was_tracked(outcome):
            outcome = replace(outcome, warnings=[why, *outcome.warnings])
        report = write_results(
            folder, outcome, moments.moments, pictures.pictures,
            pages=output.pages, ply=output.ply, map_file=output.save_map,
        )  # fmt: skip
        if not outcome.interrupted:
            remove_autosave(folder)
    if not output.quiet:
        print_summary(report, folder)
    if viewer is not None and output.keep_open and outcome.interrupted != "Ctrl-C":
        console.announce(f"{viewer.address} stays open until Ctrl-C")
        with suppress(KeyboardInterrupt):
            Event().wait()
    if why and output.quiet:  # otherwise the summary contains it
        raise ResultsError(f"{why}.")
    if outcome.interrupted and outcome.interrupted != "Ctrl-C":
        fix = f"; vslam run --resume {folder} continues it" if (folder / MAP).exists() else ""
        raise ResultsError(f"{folder}: ended early: {outcome.interrupted}{fix}.")
    if gps_error and not why:
        raise ResultsError(
            f"{folder}: no trajectory with GPS, all other results were written: {gps_error}"
        )
    if why or outcome.interrupted:
        raise typer.Exit(1)


def _open(
    options: RunOptions, console: Console, kernels: Compilation
) -> tuple[Source, Perturbation]:
    from vslam.datasets.perturbation import parse_perturbation

    perturbation = parse_perturbation(options.perturb, options.seed)
    kernels.start()  # a town may have to be rendered
    source = open_given(options, console)
    perturbation.bound_to(source)
    if source.imu is not None:
        source = replace(source, imu=perturbation.of_imu(source.imu))
    return source, perturbation


def _fixes(path: Path, antenna: tuple[float, ...] | None, source: Source) -> Fixes:
    """Read the GPS fixes. Their times must overlap with the times of the images."""
    from vslam.datasets.fixes import read_fixes, require_overlap

    first_image = float(source.timestamps[0]) if source.seekable else 0.0
    fixes = read_fixes(path, antenna, first_image)
    require_overlap(fixes, source, path)
    return fixes


def _georeferenced(outcome: RunOutcome, fixes: Fixes) -> tuple[RunOutcome, str]:
    """Return the outcome of a run with the georeferenced trajectory, and an error message, which is
    empty on success."""
    from vslam.run.gps import locate
    from vslam.support.plugins import reason

    if outcome.stored is None:
        return outcome, "the run has no map."
    try:
        track = locate(outcome.stored, fixes, outcome.settings.thresholds.pose_graph)
    except InputError as error:
        return outcome, str(error)
    except Exception as error:  # the other results of the run must be written
        return outcome, f"{reason(error)}."
    return replace(outcome, gps_track=track), ""


def _refuse_live_source(source: Source, resume: Path | None) -> None:
    if source.live and resume is not None:
        raise InputError(
            f"--resume {resume}: a run of a live camera cannot be resumed; continue its map with "
            "--map FOLDER/autosave.npz."
        )


def _unfinished(
    options: RunOptions, source: Source, resume: Path | None, lock: ExitStack
) -> Unfinished | None:
    """Read the saved state of the run to resume. The result is None for a new run."""
    from vslam.run.autosave import find_unfinished, lock_run
    from vslam.run.pipeline import require_camera

    if resume is None:
        if options.map_file is not None:
            require_camera(options.map_file, source.camera)
        return None
    lock.enter_context(lock_run(resume))
    unfinished = find_unfinished(resume)
    require_camera(unfinished.map, source.camera)
    return unfinished


def _viewer(output: Output, console: Console) -> Viewer | None:
    if output.view is None:
        return None
    from vslam.run.recorder import open_viewer

    viewer = open_viewer(output.view)
    if viewer.address:
        console.announce(f"live at {viewer.address}")
    return viewer


def _compile(settings: RunOptions, console: Console, kernels: Compilation) -> None:
    from vslam.run.warmup import is_cold

    if is_cold():
        console.announce("first run: compiling the kernels, about a minute ...")
    kernels.finish()
    if settings.realtime:  # no frame may wait until its kernels are loaded
        from vslam.run.toy_room import call_kernels

        call_kernels()


def _new_folder(
    options: RunOptions, source: Source, perturb: str, out: Path, lock: ExitStack
) -> Path:
    from vslam.calibration.files import CALIBRATION, write_calibration
    from vslam.config import changed_thresholds
    from vslam.report.folder import create_run_folder
    from vslam.run.autosave import lock_run
    from vslam.run.options import write_options

    changed = changed_thresholds(options.thresholds.model_dump())
    folder = create_run_folder(out, source.dataset, source.name, perturb, options.detector, changed)
    lock.enter_context(lock_run(folder))
    if options.calib == AUTO and source.calibration is not None:
        file = folder / CALIBRATION
        write_calibration(file, source.calibration)
        options = options.model_copy(update={"calib": (file,), "sensor": "mono"})
    write_options(folder, options)
    return folder


def _recorder(
    folder: Path,
    output: Output,
    unfinished: Unfinished | None,
    viewer: Viewer | None,
    moments: Recorder,
    pictures: LoopPictureRecorder,
) -> Recorder:
    from vslam.run.recorder import Recorder, RerunRecorder, SeveralRecorders

    recorders: list[Recorder] = []
    if output.record:
        name = "recording.rrd"
        if unfinished is not None:
            name = f"recording-from-{len(unfinished.progress.tracks)}.rrd"
        recorders.append(RerunRecorder(folder / name, pictures.pictures))
    if viewer is not None:
        recorders.append(RerunRecorder(viewer, pictures.pictures))
    if output.pages:
        recorders.append(moments)
    if not recorders:
        return Recorder()
    return SeveralRecorders((pictures, *recorders))  # the other recorders use the pictures
