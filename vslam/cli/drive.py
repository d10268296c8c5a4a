"""What ``vslam run`` does once its options are known to make sense."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Literal

import typer

from vslam.cli.console import console
from vslam.cli.options import open_given
from vslam.errors import InputError, ResultsError

if TYPE_CHECKING:
    from vslam.cli.console import Console
    from vslam.datasets.frames import Source
    from vslam.datasets.perturbation import Perturbation
    from vslam.run.autosave import Unfinished
    from vslam.run.moments import LoopPictureRecorder
    from vslam.run.options import RunOptions
    from vslam.run.outcome import RunSettings
    from vslam.run.recorder import Recorder, Viewer


@dataclass(frozen=True)
class Output:
    """What a run shows and writes; another one may be wanted when it is resumed."""

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
        out: where to make the folder of the run.
        resume: the folder of the run to go on with instead.
    """
    if options.localize and output.save_map is not None:
        raise InputError("--save-map: localising changes no map; leave it out.")
    told = console(shown=not output.quiet)
    source, perturbation = _open(options, told)
    _refuse_camera(source, resume)

    # Bad input has been refused by now; what follows takes a second to import.
    from vslam.cli.tables import print_summary
    from vslam.doctor.nothing_tracked import why_nothing_was_tracked
    from vslam.report.folder import write_results
    from vslam.run.autosave import MAP, FolderAutosave, remove_autosave
    from vslam.run.moments import LoopPictureRecorder, MomentRecorder
    from vslam.run.options import settings_of
    from vslam.run.pipeline import begin, run_sequence

    settings = settings_of(options, source, perturbation.name)
    with ExitStack() as lock:
        unfinished = _unfinished(options, source, resume, lock)
        _compile(settings, told)
        slam = begin(source.camera, settings, None if unfinished is None else unfinished.map)
        viewer = _viewer(output, told)
        folder = resume or _new_folder(options, settings, out, lock)
        moments, pictures = MomentRecorder(), LoopPictureRecorder()
        recorder = _recorder(folder, output, unfinished, viewer, moments, pictures)
        # When only localising there is nothing to save but the poses.
        period = 0.0 if options.localize else options.autosave
        autosave = FolderAutosave(folder, period, f"{settings.dataset} {source.name}")
        with told.progress_bar(source.n_expected) as on_frame:
            outcome = run_sequence(
                source, perturbation, settings, recorder,
                on_frame=on_frame, autosave=autosave, resume=unfinished, slam=slam,
            )  # fmt: skip
        if why := why_nothing_was_tracked(outcome, options):
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
        told.announce(f"{viewer.address} stays open until Ctrl-C")
        with suppress(KeyboardInterrupt):
            Event().wait()
    if why and output.quiet:  # else the summary has said it
        raise ResultsError(f"{why}.")
    if outcome.interrupted and outcome.interrupted != "Ctrl-C":
        go_on = f"; vslam run --resume {folder} continues it" if (folder / MAP).exists() else ""
        raise ResultsError(f"{folder}: ended early: {outcome.interrupted}{go_on}.")
    if why or outcome.interrupted:
        raise typer.Exit(1)


def _open(options: RunOptions, told: Console) -> tuple[Source, Perturbation]:
    """The images and what is done to them. Refuses laws that the data cannot serve."""
    from vslam.datasets.perturbation import parse_perturbation

    perturbation = parse_perturbation(options.perturb, options.seed)
    source = open_given(options, told)
    perturbation.bound_to(source)
    return source, perturbation


def _refuse_camera(source: Source, resume: Path | None) -> None:
    """What a camera has shown is gone."""
    if source.live and resume is not None:
        raise InputError(
            f"--resume {resume}: the images of a live camera are gone; continue its map with "
            "--map FOLDER/autosave.npz."
        )


def _unfinished(
    options: RunOptions, source: Source, resume: Path | None, lock: ExitStack
) -> Unfinished | None:
    """What to go on from, of a run that is resumed. Refuses images of another camera than that of
    the map to go on in."""
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


def _viewer(output: Output, told: Console) -> Viewer | None:
    if output.view is None:
        return None
    from vslam.run.recorder import open_viewer

    viewer = open_viewer(output.view)
    if viewer.address:
        told.announce(f"live at {viewer.address}")
    return viewer


def _compile(settings: RunSettings, told: Console) -> None:
    from vslam.run.warmup import compile_kernels, is_cold

    if is_cold():
        told.announce("first run: compiling the kernels, less than a minute ...")
    compile_kernels(processes=min(settings.threads, 2), load=settings.realtime)


def _new_folder(options: RunOptions, settings: RunSettings, out: Path, lock: ExitStack) -> Path:
    from vslam.report.folder import create_run_folder
    from vslam.run.autosave import lock_run
    from vslam.run.options import write_options

    s = settings
    folder = create_run_folder(out, s.dataset, s.sequence, s.perturb, s.detector)
    lock.enter_context(lock_run(folder))
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
    """All that is to be told of the run: a file, a viewer, and what the report shows."""
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
    return SeveralRecorders((pictures, *recorders))  # pictures first, since the others show them
